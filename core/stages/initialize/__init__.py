"""Stage `initialize`: cameras and sparse points of the photos, a first volume and first splats of the X-rays."""

from .stage import PRESETS, InitializeSettings, reason_to_skip, run

__all__ = ["PRESETS", "InitializeSettings", "reason_to_skip", "run"]
