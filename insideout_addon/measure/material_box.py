"""Where the material of a model begins and ends. Numpy alone, no bpy."""

from __future__ import annotations

from collections.abc import Generator

import numpy as np

from ...core.render.section_numpy import SectionSplats, section_density
from ...core.views import Plane

_CELLS = 64
# Where splats are, without the strays among them, may be short of where the material ends by this part of a side.
_WIDER = 0.2


def material_box_in_steps(
    splats: SectionSplats, box: np.ndarray, level: float, cells: int = _CELLS
) -> Generator[float, None, np.ndarray]:
    """(2, 3) a box widened to hold what is denser than `level` mm⁻¹, to one of `cells` along the longest side, mm.

    Yields the share that is done.

    Args:
        box: (2, 3) of most of the splats; a fifth of its sides around it is searched. It is not made smaller: thin
            plastic beside metal is fainter than any level that is one of metal.
    """
    box = np.asarray(box, np.float64)
    wide = box + _WIDER * (box[1] - box[0]) * [[-1], [1]]
    values, steps = yield from sample_box_in_steps(splats, wide, cells)
    dense = values > level
    if not dense.any():
        return box
    low, high = np.empty(3), np.empty(3)
    for axis in range(3):
        found = np.flatnonzero(dense.any(axis=tuple(other for other in range(3) if other != axis)))
        low[axis], high[axis] = found[0], found[-1] + 1
    # The edge is somewhere between the last dense cell's middle and the next one's.
    return np.stack(
        [np.minimum(box[0], wide[0] + (low - 0.5) * steps), np.maximum(box[1], wide[0] + (high + 0.5) * steps)]
    )


def sample_box_in_steps(
    splats: SectionSplats, box: np.ndarray, cells: int
) -> Generator[float, None, tuple[np.ndarray, np.ndarray]]:
    """Density in the middles of cells that divide a box exactly, `cells` of them along its longest side.

    Yields the share that is done.

    Returns:
        (nx, ny, nz) float32 mm⁻¹, and (3,) mm of a cell's sides.
    """
    extent = box[1] - box[0]
    counts = np.maximum(np.rint(extent / extent.max() * cells).astype(int), 1)
    steps = extent / counts
    # Few large sections take less time than many small ones.
    order = np.argsort(-extent)
    u, v, along = (np.eye(3)[axis] * steps[axis] for axis in order)
    width, height, count = (int(counts[axis]) for axis in order)
    slices = []
    for index in range(count):
        slices.append(section_density(splats, Plane(box[0] + (index + 0.5) * along, u, v, width, height)))
        yield (index + 1) / count
    # Along, v, u to x, y, z.
    values = np.stack(slices).transpose(np.argsort([order[2], order[1], order[0]]))
    return values, steps
