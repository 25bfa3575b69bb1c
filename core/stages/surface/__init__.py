"""Stage `surface`: coloured Gaussians fitted to the photos, radiative Gaussians to the projections."""

from .stage import PRESETS, SurfaceSettings, reason_to_skip, run

__all__ = ["PRESETS", "SurfaceSettings", "reason_to_skip", "run"]
