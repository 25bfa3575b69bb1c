"""The names of the effects that a run knows; Blender's side lists them, so nothing here needs torch."""

from .told import Told

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

TOLD = {
    "moving_background": Told("moving_background"),
    "lens": Told("lens"),
    "exposure": Told("exposure"),
    "rolling_shutter": Told("rolling_shutter"),
    "defocus": Told("defocus"),
    "motion_blur": Told("motion_blur"),
    "pixel_integration": Told("pixel_integration"),
    "truncation": Told("truncation"),
    "scatter": Told("scatter"),
    "focal_spot": Told("focal_spot"),
    "beam_hardening": Told("beam_hardening"),
    "motion": Told("motion"),
    "geometry": Told("geometry"),
    "ring": Told("ring"),
    "noise": Told("noise"),
}
"""Each name as it stands in sentences: another language has a word for it."""
