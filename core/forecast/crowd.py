"""Where splats of a scan lie: all over the scanned box as a training begins, crowded in the object as it goes on."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import maximum_filter

from ..capture.detectors import project_points
from ..capture.model import Projections
from ..gaussians import GaussianSet, Modality
from ..volume import Volume

# Views that tell where something is, and up to which share of their full scale a pixel shows air.
_VIEWS, _AIR = 8, 0.05
# Fewer cells than this share of all are no object: views whose geometry is off agree on next to nothing.
_LEAST = 0.005
# About so many cells along a side, and a splat's standard deviation over the side of what it has for itself.
_CELLS, _SHARE = 32, 0.5


def filling(box_mm: np.ndarray, splats: int) -> GaussianSet:
    """About so many splats that fill the scanned box (2, 3) mm evenly, as radiative ones begin."""
    from ..stages.initialize.xray import first_splats

    return first_splats(even_cells(box_mm), "coarse", splats, 1, 0)


def crowded(box_mm: np.ndarray, splats: int, cells: np.ndarray) -> GaussianSet:
    """Splats at random places in some cells of a box.

    Args:
        box_mm: (2, 3) lowest and highest corner.
        splats: how many.
        cells: (nz, ny, nx) bool, as `object_cells` has them; at least one is true.
    """
    even, rng = even_cells(box_mm), np.random.default_rng(0)
    chosen = np.argwhere(cells)[:, ::-1]
    places = rng.choice(chosen, splats) + rng.uniform(-0.5, 0.5, (splats, 3))
    scales = _SHARE * even.spacing_mm * (len(chosen) / splats) ** (1 / 3)
    return GaussianSet.create(
        (even.origin_mm + places * even.spacing_mm).astype(np.float32),
        np.broadcast_to(scales, (splats, 3)).astype(np.float32),
        opacities=0.1,
        density=0.01,
        modality=Modality.XRAY,
    )


def object_cells(projections: Projections) -> np.ndarray:
    """(nz, ny, nx) bool: those of `even_cells` of the scanned box that no view shows to be air.

    Cells that a view does not see, or where it has no finite value, may hold something. All of them where next to
    none is left.
    """
    from ..stages.surface.xray import body_scale

    cells = even_cells(projections.box_mm)
    middles = cells.origin_mm + np.argwhere(np.ones(cells.values.shape, bool))[:, ::-1] * cells.spacing_mm
    # What lies anywhere in a cell counts, not at its middle alone.
    covered = max(1, int(np.ceil(np.max(cells.spacing_mm) / projections.pixel_mm)))
    inside = np.ones(len(middles), bool)
    height, width = projections.images.shape[1:]
    for index in np.unique(np.linspace(0, len(projections.images), _VIEWS, endpoint=False).astype(int)):
        image = projections.images[index]
        air = np.isfinite(image) & (image <= _AIR * body_scale(projections, [index]))
        seen = maximum_filter(~air, size=covered)
        across, down = np.floor(project_points(projections.detectors[index], middles)).astype(int).T
        there = (across >= 0) & (across < width) & (down >= 0) & (down < height)
        inside[there] &= seen[down[there], across[there]]
    if inside.mean() < _LEAST:
        inside[:] = True
    return inside.reshape(cells.values.shape)


def even_cells(box_mm: np.ndarray) -> Volume:
    """The scanned box (2, 3) mm as about 32³ voxels, nearly cubes, of an even attenuation."""
    low, high = box_mm
    side = (np.prod(high - low) / _CELLS**3) ** (1 / 3)
    counts = np.maximum(np.round((high - low) / side), 1).astype(int)
    spacing = (high - low) / counts
    return Volume(np.full(counts[::-1], 0.01, np.float32), spacing, low + 0.5 * spacing)
