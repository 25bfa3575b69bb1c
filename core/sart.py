"""Algebraic reconstruction of projections from any scan, by ITK-RTK on the CPU.

SART: Andersen and Kak, Ultrasonic Imaging 6, 1984, as ITK-RTK has it (Rit et al., J. Phys. Conf. Ser. 489, 2014):
the volume is corrected after each projection, in a shuffled order that is always the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .capture.model import Projections
from .errors import SettingError
from .progress import Progress, Reporter
from .rtk import (
    as_cone,
    circular_geometry,
    empty_volume,
    grid_of,
    projection_image,
    run_filter,
    used_projections,
    volume_of,
)
from .rtk_classes import rtk_class
from .told import Told
from .volume import Volume


@dataclass(frozen=True)
class SartSettings:
    """ITK-RTK's own defaults, positivity, and a margin.

    Attributes:
        iterations: times that all projections are gone through.
        relaxation: λ, how far each projection corrects the volume; 1 corrects it fully.
        positive: values below zero are set to zero after each projection.
        margin: voxels around the box that are reconstructed, too, and cut away. A ray that only grazes the grid has
            its whole residual, noise and all, put into a sliver of the outermost voxels, which end up many times as
            dense as the object. With more than one the same iterations end further from the truth.
    """

    iterations: int = 3
    relaxation: float = 0.3
    positive: bool = True
    margin: int = 1


def sart(
    projections: Projections,
    subset: np.ndarray | None = None,
    voxels: tuple[int, int, int] | None = None,
    reporter: Reporter | None = None,
    settings: SartSettings | None = None,
    stage: str = "initialize",
) -> Volume:
    """The attenuation volume that explains the projections, from an empty one. What is outside the box counts as air.

    Detectors may stand anywhere, over any range of angles; rows need not run level. It takes about as long as
    `iterations` FDKs with one projection more for each.

    Args:
        projections, subset, voxels, stage: as of `core.fdk.fdk`.

    Returns:
        Volume in mm⁻¹.

    Raises:
        CaptureError: fewer than two projections, or a detector that RTK refuses.
        SettingError: a setting out of range.
        Cancelled: through `reporter`, after the iteration; `core.fdk_process.sart` ends at once.
    """
    import itk

    reporter, settings = reporter or Reporter(), settings or SartSettings()
    if settings.iterations < 1:
        raise SettingError("iterations of SART is {iterations}; give 1 or more.", iterations=settings.iterations)
    if not 0 < settings.relaxation < 2:
        raise SettingError(
            "relaxation of SART is {relaxation}; give a number above 0 and below 2.", relaxation=settings.relaxation
        )
    if settings.margin < 0:
        raise SettingError("margin of SART is {margin}; give 0 or more voxels.", margin=settings.margin)
    used = used_projections(projections, subset)
    grid = grid_of(projections, voxels)
    reporter.update(Progress(stage, "sart", 0.0, message=Told("SART from {count} projections", count=len(used))))
    cones = [as_cone(projections.detectors[i], projections.box_mm) for i in used]
    geometry, pitches = circular_geometry(cones)
    stack = projection_image(projections.images[used], pitches)
    empty, low, spacing = empty_volume(*_with_margin(projections.box_mm, grid, settings.margin))
    solver = rtk_class("SARTConeBeamReconstructionFilter", 2).New()
    solver.SetGeometry(geometry)
    solver.SetInput(0, empty)
    solver.SetInput(1, stack)
    solver.SetNumberOfIterations(settings.iterations)
    solver.SetLambda(settings.relaxation)
    solver.SetEnforcePositivity(settings.positive)
    done = 0

    def stop() -> None:
        # RTK's SART does not look at ITK's abort, but at this after each iteration.
        solver.SetNumberOfIterations(0)

    def tell() -> None:
        nonlocal done
        done += 1
        reporter.update(Progress(stage, "sart", min(0.99, done / settings.iterations), done, settings.iterations))

    size = " x ".join(map(str, grid))
    what = Told("SART of {count} projections on {voxels} voxels", count=len(used), voxels=size)
    run_filter(solver, itk.IterationEvent(), tell, what, stop)
    reporter.update(Progress(stage, "sart", 1.0))
    return _without_margin(volume_of(solver.GetOutput(), low, spacing), settings.margin)


def _with_margin(box_mm: np.ndarray, grid: tuple[int, ...], margin: int) -> tuple[np.ndarray, tuple[int, ...]]:
    low, high = np.asarray(box_mm, np.float64)
    more = margin * (high - low) / np.asarray(grid)
    return np.stack([low - more, high + more]), tuple(count + 2 * margin for count in grid)


def _without_margin(volume: Volume, margin: int) -> Volume:
    inside = tuple(slice(margin, count - margin) for count in volume.values.shape)
    values = np.ascontiguousarray(volume.values[inside])
    return Volume(values, volume.spacing_mm, volume.origin_mm + margin * np.asarray(volume.spacing_mm))
