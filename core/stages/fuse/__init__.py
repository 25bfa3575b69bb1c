"""Stage five, `fuse`: one set from two (paper, "Visual Alignment")."""

from .stage import PRESETS, FuseSettings, reason_to_skip, run
from .transfer import Fusion, clone_details, color_by_density, detail_threshold, fuse_sets

__all__ = [
    "PRESETS",
    "FuseSettings",
    "Fusion",
    "clone_details",
    "color_by_density",
    "detail_threshold",
    "fuse_sets",
    "reason_to_skip",
    "run",
]
