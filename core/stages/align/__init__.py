"""align: the photo frame laid on the X-ray frame, then the RGB splats on the X-rayed surface."""

from .stage import PRESETS, AlignSettings, reason_to_skip, run

__all__ = ["PRESETS", "AlignSettings", "reason_to_skip", "run"]
