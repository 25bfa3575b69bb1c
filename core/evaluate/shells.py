"""How far the photo splats of a run lie from its radiative splats: chamfer distance of what is seen from outside."""

from __future__ import annotations

import numpy as np

from ..gaussians import GaussianSet
from ..run_folder import RunFolder
from .chamfer import chamfer, outer_points

# Of the two-way distances for `trimmed_mm`.
_KEEP = 0.8


def shell_distance(run: RunFolder, rgb: GaussianSet, xray: GaussianSet, seed: int) -> dict[str, float] | None:
    """Chamfer distance (paper, table "alignment") of two sets in one frame.

    Args:
        run: whose `align` says how dense a surface is.
        rgb: numpy set; splats of an opacity over 0.1 count.
        xray: numpy set in mm; those denser than a tenth of the 99th percentile count, but not what only evens out
            noise in the air.
        seed: of the choice where there are many points.

    Returns:
        `mm` and `squared_mm2`, the means of the two mean nearest distances between centres seen from 20 views,
        `percent_of_diagonal`, and `trimmed_mm` without the largest fifth each way. None where a set has no such splats.

    Raises:
        CaptureError: the run's volume cannot be read.
    """
    first, second = _shell_of(rgb, seed), _shell_of(_in_material(run, xray), seed)
    if len(first) == 0 or len(second) == 0:
        return None
    whole, trimmed = chamfer(first, second), chamfer(first, second, keep=_KEEP)
    return {
        "mm": whole.mm,
        "squared_mm2": whole.squared_mm2,
        "percent_of_diagonal": whole.percent_of_diagonal,
        "trimmed_mm": trimmed.mm,
    }


def _in_material(run: RunFolder, xray: GaussianSet) -> GaussianSet:
    """Radiative splats whose centre lies where the volume is denser than the surface that `align` used."""
    threshold = run.report("align").get("surface_threshold")
    if threshold is None:
        return xray
    return xray.select(run.volume().sample(xray.means) > threshold)


def _shell_of(gaussians: GaussianSet, seed: int) -> np.ndarray:
    strength, least = gaussians.opacities, 0.1
    if (gaussians.density > 0).any():
        strength, least = gaussians.density, 0.1 * float(np.percentile(gaussians.density, 99))
    counts = (strength > least) & np.isfinite(gaussians.means).all(axis=1)
    return outer_points(gaussians.means[counts], seed=seed)
