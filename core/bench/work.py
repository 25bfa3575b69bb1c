"""What the inner loops of the `cpu` kernel do: pixels evaluated for a splat, and operations for each of those.

Counted are the additions, multiplications, divisions and square roots in float32 that the loops over pixels carry out
for every pixel of a run, whether the splat turns out to reach it or not: a fused multiply-add is two, exp is its range
reduction and its polynomial. Comparisons, conversions, bit operations, loads and stores are not counted, nor is
what is done once for each splat, tile or row.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from ..render.kernels.cpu import radiograph_raster, section_raster, splat_raster
from ..render.kernels.cpu.bands import BAND_ROWS, LANES
from ..render.kernels.cpu.radiograph_table import BOTTOM, PER_ROOT, TOP
from ..render.kernels.cpu.tiles import TILE
from ..render.kernels.cpu.vectors import ROOT_OPERATIONS


class Operations(NamedTuple):
    """Operations for one pixel of one splat, forward and backward."""

    forward: int
    backward: int


# exp2_negative: 3 for the range reduction, 11 for the polynomial; exp_negative: 3, 10, and the scaling by 2ⁿ.
_EXP2 = _EXP = 14

# opacity: p 2, −(p² + q²) 2, times opacity 1; blending: weight 1, after 1, three colours and depth 8, alpha 1.
_SPLAT_OPACITY = 5 + _EXP2
# Backward: weight 1, after 1, value 9, behind 2, power 5; sums: p 2, of power 11, of weight 8.
SPLAT = Operations(_SPLAT_OPACITY + 11, _SPLAT_OPACITY + 18 + 21)
# Of an exact cone beam: step 1, a 2, r 2, den 2, its root and inverse, q 3; then amplitude, exp and sum 3.
# Backward: w 2, tau 2, gamma 3; sums: step and x 2, a 2, products 4, sums 20.
_RADIOGRAPH_RAY = 10 + ROOT_OPERATIONS + 1 + _EXP2
RADIOGRAPH = Operations(_RADIOGRAPH_RAY + 3, _RADIOGRAPH_RAY + 7 + 28)
# A cut's density: x, m 4, q 4, −½q 1, sum 2.
# Backward: x, m and offset 5, h 1, q and m² 5, −½q 1, Hermite series 27, weight 1, share 4, taus 10, sums 30, w·h 2.
SECTION = Operations(11 + _EXP, 86 + _EXP)

OPERATIONS = {"splat": SPLAT, "radiograph": RADIOGRAPH, "section": SECTION}


@njit(error_model="numpy")
def splat_pixels(starts: Any, splats: Any, blended: Any, attributes: Any, columns: Any) -> int:
    """Pixel-splat pairs that `splat_raster` evaluates: the rows of a tile within reach, all 16 columns of them.

    Args:
        starts, splats, blended, attributes: as `splat_raster.rasterize_backward` has them.
        columns: tiles across the image.
    """
    centers, (floats, ints) = attributes.view(np.float64), splat_raster.empty_block()
    total = 0
    for tile in range(len(starts) - 1):
        x0, y0 = tile % columns * TILE, tile // columns * TILE
        stop = starts[tile] + blended[tile]
        for begin in range(starts[tile], stop, splat_raster.BATCH):
            end = min(begin + splat_raster.BATCH, stop)
            splat_raster.fetch(splats, begin, end, centers, attributes, (x0, y0, np.float32(0)), floats, ints)
            for n in range(np.uint64(end - begin)):
                total += TILE * int(ints[splat_raster.STRIP_ROWS + n])
    return total


@njit(error_model="numpy")
def radiograph_pixels(table: Any, k2: Any, width: Any) -> int:
    """Pixel-splat pairs that `radiograph_raster` evaluates: rows within reach, in whole strips."""
    floats, ints, rows, offsets = radiograph_raster.empty_strips(width)
    total = 0
    for n in range(np.uint64(len(table))):
        for top in range(int(table[n, TOP]), int(table[n, BOTTOM]), BAND_ROWS):
            radiograph_raster.find_rows(table, n, k2, width, top, table[n, BOTTOM], floats, np.uint64(0))
            total += LANES * int(radiograph_raster.cut(floats, ints, np.uint64(1), rows, offsets))
    return total


@njit(error_model="numpy")
def section_pixels(table: Any, reference: Any, boxes: Any, k2: Any) -> int:
    """Pixel-splat pairs that `section_raster` evaluates: rows within reach, in whole stretches."""
    rows = np.empty(section_raster.PLANES * BAND_ROWS, np.float32)
    total = 0
    for n in range(len(boxes)):
        for top in range(boxes[n, 2], boxes[n, 3], BAND_ROWS):
            section_raster.find_rows(table[n], reference[n], boxes[n], np.sqrt(k2), top, rows)
            for k in range(min(BAND_ROWS, boxes[n, 3] - top)):
                total += LANES * int(rows[int(section_raster.STRETCHES) + k])
    return total


def evaluated_pixels(renderer: str, calls: dict[str, tuple[Any, ...]]) -> int:
    """Pixel-splat pairs of one step, from the arguments that the pixel loops were last called with.

    Args:
        calls: of a stopwatch, by label: "blend" (forward) and "blend_backward".
    """
    if renderer == "splat":
        starts, splats, blended, attributes, color = calls["blend_backward"][:5]
        columns = -(-color.shape[1] // TILE)
        return int(splat_pixels(starts, splats, blended, attributes, columns))
    if renderer == "radiograph":
        table, _, _, k2, width = calls["blend"][:5]
        return int(radiograph_pixels(table, k2 * PER_ROOT**2, width))
    table, reference, boxes, *_, k2 = calls["blend"][:8]
    return int(section_pixels(table, reference, boxes, k2))
