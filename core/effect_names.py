"""The names of the effects that a run knows; Blender's side lists them, so nothing here needs torch."""

PHOTO_EFFECTS = ("exposure", "rolling_shutter", "defocus", "pixel_integration")
"""Effects of photos, learnt with the splats."""

XRAY_EFFECTS = ("truncation", "scatter", "focal_spot", "beam_hardening", "geometry", "ring", "noise")
"""Effects of X-rays, in the order in which they are looked for: what was found before is taken out first."""
