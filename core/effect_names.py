"""The names of the effects that a run knows; Blender's side lists them, so nothing here needs torch."""

PHOTO_EFFECTS = (
    "moving_background", "lens", "exposure", "rolling_shutter", "defocus", "motion_blur", "pixel_integration"
)  # fmt: skip
"""Effects of photos, in the order in which they are looked for; most are learnt with the splats."""

BEFORE_CAMERAS = ("moving_background",)
"""Of those, what is looked for and taken out before cameras are found."""

BEFORE_SPLATS = ("lens",)
"""Of those, what is looked for and taken out once there are cameras, before splats are placed."""

NOT_LEARNT = (*BEFORE_CAMERAS, *BEFORE_SPLATS, "pixel_integration")
"""Of those, what has no numbers that are learnt with the splats."""

NOT_TOGETHER = {("motion_blur", "rolling_shutter"), ("motion_blur", "defocus")}
"""Effects of photos that cannot be learned at once: a camera moves in one way, and a lens would have to blur each view
on the way by itself."""

XRAY_EFFECTS = ("truncation", "scatter", "focal_spot", "beam_hardening", "motion", "geometry", "ring", "noise")
"""Effects of X-rays, in the order in which they are looked for: what was found before is taken out first."""
