"""The names of the effects that a run knows; Blender's side lists them, so nothing here needs torch."""

PHOTO_EFFECTS = ("exposure", "rolling_shutter", "defocus", "pixel_integration")
"""Effects of photos; so far they are not looked for, and used where a user asks for them."""

XRAY_EFFECTS = ("scatter", "beam_hardening", "geometry", "noise")
"""Effects of X-rays, in the order in which they are looked for: what was found before is taken out first."""
