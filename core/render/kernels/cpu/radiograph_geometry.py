"""From splats to the few numbers a pixel row of a radiograph needs, and from their gradients back.

On a flat detector whitened ray and offset are linear in the pixel: with z = (j − j₀, i − i₀, 1) measured from where
the centre projects to, the ray is E·z and the cross product of offset and ray is G·z, and a pixel's line integral

    ρ·√(2π)·‖d‖ · den^(−1/2) · exp(−½·num/den),    num = ‖G z‖²,    den = ‖E z‖²

with ‖d‖ the length of the pixel's unnormalised ray. A cone beam has f × (E z) with a constant f, a parallel beam
(F z) × e with a constant e. G has rank 2, because all its columns are at right angles to f (or e), and G's last
column is 0 at the projected centre, so nothing cancels in the pixel loop. The pixel loop uses the triangular
factors P of G (2 x 3) and R of E (3 x 3), scaled by κ such that den = 1 at the reference.

The affine form is the same with den frozen at the centre: den = t²‖f‖², amplitude ρ·√(2π)·‖μ − s‖·t, where t is
the distance of the detector in units of the centre's.

`radiograph_cone` has the geometry of the exact cone beam, `radiograph_linear` that of parallel beams and of the affine
form, where den is the same in all pixels.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ....compiled import njit, prange
from ....threads import loops_only
from .bands import SUMS
from .radiograph_cone import cone_backward, cone_rows
from .radiograph_lanes import (
    BATCH,
    BUFFER,
    DEEP,
    DENSITY,
    FACTOR,
    FROM_COLUMN,
    FROM_ROW,
    HIGH,
    LOW,
    MEAN,
    NUMBERS,
    QUAT,
    SCALE,
    STEP,
    SUMS_AT,
    TO_DENSITY,
    TO_MEAN,
    TO_QUAT,
    TO_SCALE,
    TO_VIEW,
    UP,
)
from .radiograph_linear import affine_backward, affine_rows, parallel_backward, parallel_rows
from .radiograph_table import A_AT, AMPLITUDE, BOTTOM, COLUMN0, COLUMNS, LEFT, RIGHT, ROW0, SQRT_2PI, TOP
from .vectors import aligned
from .whitening import pixel_range, usable

SPLATS_A_TASK = 256
CONE, PARALLEL, AFFINE = 0, 1, 2


@njit(parallel=loops_only(), error_model="numpy", cache=True)
def project(
    means: Any,
    quats: Any,
    scales: Any,
    density: Any,
    view: Any,
    width: int,
    height: int,
    kind: int,
    k2: float,
    keep_empty: bool,
) -> Any:
    """Coefficient table (N, COLUMNS) float64 and boxes (N, 4) int32: left, right, top, bottom.

    Splats that cannot be seen have an empty box, and so have those without density unless `keep_empty`, which their
    density's gradient needs.
    """
    count = len(means)
    # Three whole lines of the cache for each splat.
    table = aligned(2 * COLUMNS * count).view(np.float64).reshape((count, COLUMNS))
    boxes = np.zeros((count, 4), np.int32)
    for task in prange((count + SPLATS_A_TASK - 1) // SPLATS_A_TASK):
        start = np.int64(task) * SPLATS_A_TASK
        stop: Any = min(count, start + SPLATS_A_TASK)
        table[start:stop] = 0.0
        lanes, found, batch = np.zeros(BUFFER), np.empty(BATCH, np.uint64), 0
        for n in range(start, stop):
            if (density[n] != 0 or keep_empty) and usable(means[n], quats[n], scales[n], density[n]):
                found[batch] = n - start
                batch += 1
            if batch == BATCH or n == stop - 1:
                _fetch(found, batch, start, means, quats, scales, lanes)
                if kind == CONE:
                    cone_rows(lanes, view, width, height, k2)
                elif kind == PARALLEL:
                    parallel_rows(lanes, view, width, height, k2)
                else:
                    affine_rows(lanes, view, width, height, k2)
                _tabulate(found, batch, start, lanes, density, width, height, table, boxes)
                batch = 0
    return table, boxes


@njit(error_model="numpy", _nrt=False)
def _fetch(found: Any, count: Any, start: Any, means: Any, quats: Any, scales: Any, lanes: Any) -> None:
    for m in range(np.uint64(count)):
        i = np.uint64(start) + found[m]
        for k in range(np.uint64(3)):
            lanes[MEAN + k * STEP + m], lanes[SCALE + k * STEP + m] = means[i, k], scales[i, k]
        for k in range(np.uint64(4)):
            lanes[QUAT + k * STEP + m] = quats[i, k]


@njit(error_model="numpy", _nrt=False)
def _tabulate(
    found: Any, count: Any, start: Any, lanes: Any, density: Any, width: Any, height: Any, table: Any, boxes: Any
) -> None:
    for m in range(np.uint64(count)):
        i = np.uint64(start) + found[m]
        for k in range(np.uint64(A_AT + 1)):
            table[i, k] = lanes[NUMBERS + k * STEP + m]
        column0, row0 = lanes[FROM_COLUMN + m], lanes[FROM_ROW + m]
        table[i, COLUMN0], table[i, ROW0] = column0, row0
        table[i, AMPLITUDE] = SQRT_2PI * density[i] * lanes[FACTOR + m]
        left, right = pixel_range(lanes[LOW + m] + column0, lanes[HIGH + m] + column0, width)
        top, bottom = pixel_range(lanes[UP + m] + row0, lanes[DEEP + m] + row0, height)
        boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3] = left, right, top, bottom
        table[i, LEFT], table[i, RIGHT], table[i, TOP], table[i, BOTTOM] = left, right, top, bottom


@njit(error_model="numpy", _nrt=False)
def geometry_backward(
    found: Any, count: Any, sums: Any, start: Any, means: Any, quats: Any, scales: Any, density: Any, view: Any,
    width: Any, height: Any, kind: Any, lanes: Any, grad_means: Any, grad_quats: Any, grad_scales: Any,
    grad_density: Any, grad_views: Any,
) -> None:  # fmt: skip
    """From some splats' sums over pixels to the gradients of their parameters and, where it has rows, of the view.

    With h = dL/dvalue, w = value / amplitude and τ = h·value / (2 den), a row of `sums` holds

    - [0] Σ h·w,
    - [1:4] Στ·x·z and [4:7] Στ·y·z with (x, y) = P z and z = (j − j₀, i − i₀, 1),
    - [7:13] Σγ·(z₀², z₀z₁, z₁², z₀, z₁, 1) with γ = τ·(num/den − 1) = dL/dden; where den is the same in all pixels
      only the last is read.

    dL/dG = 2·G·Σ(−τ) z zᵀ = −2·Q·[Στ x z; Στ y z]: the triangular factors need no derivative of their own.

    Args:
        found: (BATCH,) rows of `sums`, which begin with the splat `start`; the first `count` are meant.
        view: (4, 3) source or direction, center, u and v.
        lanes: (BUFFER,) float64.
    """
    _fetch(found, count, start, means, quats, scales, lanes)
    for m in range(np.uint64(count)):
        for k in range(np.uint64(SUMS)):
            lanes[SUMS_AT + k * STEP + m] = sums[found[m], k]
        lanes[DENSITY + m] = density[np.uint64(start) + found[m]]
    if kind == CONE:
        cone_backward(lanes, view, width, height)
    elif kind == PARALLEL:
        parallel_backward(lanes, view, width, height)
    else:
        affine_backward(lanes, view, width, height)
    for m in range(np.uint64(count)):
        i = np.uint64(start) + found[m]
        for k in range(np.uint64(3)):
            grad_means[i, k], grad_scales[i, k] = lanes[TO_MEAN + k * STEP + m], lanes[TO_SCALE + k * STEP + m]
        for k in range(np.uint64(4)):
            grad_quats[i, k] = lanes[TO_QUAT + k * STEP + m]
        grad_density[i] = lanes[TO_DENSITY + m]
        if len(grad_views):
            for k in range(np.uint64(12)):
                grad_views[i, k // np.uint64(3), k % np.uint64(3)] = lanes[TO_VIEW + k * STEP + m]
