"""The names of the effects that a run knows; Blender's side lists them, so nothing here needs torch."""

PHOTO_EFFECTS = ("exposure", "rolling_shutter", "defocus", "pixel_integration")
"""Effects of photos, learnt with the splats; those that are not looked for are used where a user asks for them."""

LOOKED_FOR_IN_PHOTOS = ("exposure", "pixel_integration")
"""Those of photos that are looked for."""

XRAY_EFFECTS = ("truncation", "scatter", "beam_hardening", "geometry", "ring", "noise")
"""Effects of X-rays, in the order in which they are looked for: what was found before is taken out first."""
