"""Stage five, `fuse`: one set from two (paper, "Visual Alignment")."""

from .finish import FinishLoss, limit_display, pixels_seen
from .stage import PRESETS, FuseSettings, reason_to_skip, run
from .transfer import Fusion, clone_details, color_by_density, density_at_centers, detail_threshold, fuse_sets

__all__ = [
    "PRESETS",
    "FinishLoss",
    "FuseSettings",
    "Fusion",
    "clone_details",
    "color_by_density",
    "density_at_centers",
    "detail_threshold",
    "fuse_sets",
    "limit_display",
    "pixels_seen",
    "reason_to_skip",
    "run",
]
