"""How far the photo splats of a run lie from its radiative splats: chamfer distance of what is seen from outside."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..gaussians import GaussianSet, Modality
from ..run_folder import RunFolder
from .chamfer import chamfer, outer_points

SHELL_STEPS = {"none": ("surface", "surface"), "align": ("align", "surface"), "internal": ("internal", "internal")}
"""What is done to the halves, and the stages that the photo splats and the radiative ones are of then."""

# Of the two-way distances for `trimmed_mm`.
_KEEP = 0.8
_OPAQUE = 0.1


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
    seen, dense = rgb.select(rgb.opacities > _OPAQUE), _dense(_in_material(run, xray))
    first, second = _shell_of(seen, seed), _shell_of(dense, seed)
    if len(first) == 0 or len(second) == 0:
        return None
    whole, trimmed = chamfer(first, second), chamfer(first, second, keep=_KEEP)
    return {
        "mm": whole.mm,
        "squared_mm2": whole.squared_mm2,
        "percent_of_diagonal": whole.percent_of_diagonal,
        "trimmed_mm": trimmed.mm,
    }


def shell_distances(
    run: RunFolder, seed: int, tick: Callable[[], None] | None = None
) -> dict[str, dict[str, float]] | None:
    """`shell_distance` of a run's halves by what was done to them: "none", in the photo frame with its lengths taken as
    mm, "align" and "internal", as far as it came.

    Args:
        tick: called before each; may raise to stop.

    Returns:
        None where the run has not both halves.
    """
    aligned = run.is_done("align") and "similarity" in run.report("align")
    found = {}
    for step, (rgb, xray) in SHELL_STEPS.items():
        if not (run.has_set(rgb, "rgb") and run.has_set(xray, "xray")) or (step != "none" and not aligned):
            continue
        if tick is not None:
            tick()
        radiative = run.read_set(xray, "xray").to_numpy()
        if step == "internal":
            # Of a joint set the others would be compared with themselves.
            radiative = radiative.select(radiative.modality == Modality.XRAY)
        distance = shell_distance(run, run.read_set(rgb, "rgb").to_numpy(), radiative, seed)
        if distance is not None:
            found[step] = distance
    return found or None


def _in_material(run: RunFolder, xray: GaussianSet) -> GaussianSet:
    """Radiative splats whose centre lies where the volume is denser than the surface that `align` used."""
    threshold = run.report("align").get("surface_threshold")
    if threshold is None:
        return xray
    return xray.select(run.volume().sample(xray.means) > threshold)


def _dense(xray: GaussianSet) -> GaussianSet:
    if not (xray.density > 0).any():
        return xray.select(xray.opacities > _OPAQUE)
    return xray.select(xray.density > 0.1 * float(np.percentile(xray.density, 99)))


def _shell_of(gaussians: GaussianSet, seed: int) -> np.ndarray:
    finite = np.isfinite(gaussians.means).all(axis=1)
    return outer_points(gaussians.means[finite], seed=seed)
