"""Gaussians on a voxel grid and the way back, in Numba; threaded as the other additive renderers.

With W = S⁻¹Rᵀ = Q·U and p − μ = spacing · (d_x, d_y, d_z), a voxel's value is exp(−½‖U·spacing·d‖²), U upper
triangular: along a row of voxels only its first component changes.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ....compiled import njit, prange
from .bands import BAND_ROWS, bell
from .math import FAST
from .whitening import (
    add_outer,
    fill_whitening,
    multiply_transposed,
    pixel_range,
    triangular,
    usable,
    whitening_backward,
)

SPLATS_A_TASK = 256
STRETCH = 1024
LANES = 8
"""Half of a radiograph's: most rows of voxels are shorter than its rows of pixels."""

# Columns of the coefficient table.
U11, U12, U13, U22, U23, U33, DENSITY = range(7)


@njit(error_model="numpy", cache=True)
def _factor(whiten: Any, spacing: Any, columns: Any, upper: Any, basis: Any) -> None:
    for k in range(3):
        for a in range(3):
            columns[k, a] = whiten[a, k] * spacing[k]
    triangular(columns, upper, basis)


@njit(parallel=True, error_model="numpy", cache=True)
def project(
    means: Any,
    quats: Any,
    scales: Any,
    density: Any,
    origin: Any,
    spacing: Any,
    shape: Any,
    k2: float,
    keep_empty: bool,
) -> Any:
    """Coefficients (N, 7) float32, centres in voxels (N, 3) float64, boxes (N, 6) int32: first and end in x, y, z.

    Splats outside the grid have an empty box, and so have those without density unless `keep_empty`.

    Args:
        origin, spacing, shape: (3,) each, in the order x, y, z.
    """
    count = len(means)
    table = np.zeros((count, 7), np.float32)
    centers = np.zeros((count, 3))
    boxes = np.zeros((count, 6), np.int32)
    sigmas = np.sqrt(k2)
    for task in prange((count + SPLATS_A_TASK - 1) // SPLATS_A_TASK):
        unit, whiten = np.empty(4), np.empty((3, 3))
        columns, upper, basis = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
        for n in range(task * SPLATS_A_TASK, min(count, (task + 1) * SPLATS_A_TASK)):
            if (density[n] == 0 and not keep_empty) or not usable(means[n], quats[n], scales[n], density[n]):
                continue
            widest, near = sigmas * max(scales[n, 0], scales[n, 1], scales[n, 2]), True
            for k in range(3):
                centers[n, k] = (means[n, k] - origin[k]) / spacing[k]
                reach = widest / spacing[k]
                near &= centers[n, k] + reach >= 0 and centers[n, k] - reach <= shape[k] - 1
            if not near:
                continue
            fill_whitening(quats[n], scales[n], unit, whiten)
            _factor(whiten, spacing, columns, upper, basis)
            row = table[n]
            row[U11], row[U12], row[U13] = upper[0, 0], upper[0, 1], upper[0, 2]
            row[U22], row[U23], row[U33] = upper[1, 1], upper[1, 2], upper[2, 2]
            row[DENSITY] = density[n]
            for k in range(3):
                # √Σ_kk; the rows of W are those of Rᵀ over the scales, so W⁻¹ = Wᵀ·S².
                spread = 0.0
                for a in range(3):
                    spread += (whiten[a, k] * scales[n, a] * scales[n, a]) ** 2
                half = sigmas * np.sqrt(spread) / spacing[k]
                boxes[n, 2 * k], boxes[n, 2 * k + 1] = pixel_range(centers[n, k] - half, centers[n, k] + half, shape[k])
                if boxes[n, 2 * k] >= boxes[n, 2 * k + 1]:
                    boxes[n, 1] = boxes[n, 0]
    return table, centers, boxes


@njit(error_model="numpy", cache=True)
def _row_start(row: Any, center: Any, j: int, slice_: int, k2: float, left: int, right: int) -> Any:
    """First and last voxel of a row within reach, d_y, d_z, and x at d_x = 0, y, z in float64."""
    d_y, d_z = j - center[1], slice_ - center[2]
    x, y, z = row[U12] * d_y + row[U13] * d_z, row[U22] * d_y + row[U23] * d_z, row[U33] * d_z
    room = k2 - y * y - z * z
    if room < 0:
        return left, left, d_y, d_z, x, y, z
    half, middle = np.sqrt(room) / row[U11], -x / row[U11]
    first, last = pixel_range(middle - half + center[0], middle + half + center[0], right)
    return max(first, left), last, d_y, d_z, x, y, z


@njit(parallel=True, error_model="numpy", cache=True)
def rasterize(table: Any, centers: Any, boxes: Any, starts: Any, splats: Any, k2: float, shape: Any) -> Any:
    """Σ ρ·w, (nz, ny, padded nx) float32; `starts`, `splats` from `list_bands` over z."""
    volume = np.zeros((shape[2], shape[1], shape[0] + LANES), np.float32)
    for band in prange(len(starts) - 1):
        for entry in range(starts[band], starts[band + 1]):
            n = splats[entry]
            low, high = max(boxes[n, 4], band * BAND_ROWS), min(boxes[n, 5], (band + 1) * BAND_ROWS)
            for slice_ in range(low, high):
                for j in range(boxes[n, 2], boxes[n, 3]):
                    first, last, _, _, x, y, z = _row_start(
                        table[n], centers[n], j, slice_, k2, boxes[n, 0], boxes[n, 1]
                    )
                    if first < last:
                        count = (last - first + LANES - 1) // LANES * LANES
                        start = table[n, U11] * (first - centers[n, 0]) + x
                        _add_row(volume[slice_, j, first : first + count], table[n], start, y * y + z * z)
    return volume


@njit(fastmath=FAST, error_model="numpy", cache=True)
def _add_row(out: Any, row: Any, start: float, squared: float) -> None:
    x0, rest, step, density = np.float32(start), np.float32(squared), row[U11], row[DENSITY]
    for k in range(len(out)):
        x = x0 + step * np.float32(k)
        q = x * x + rest
        out[k] += density * bell(q)


@njit(parallel=True, error_model="numpy", cache=True)
def rasterize_backward(
    grad: Any,
    means: Any,
    quats: Any,
    scales: Any,
    spacing: Any,
    table: Any,
    centers: Any,
    boxes: Any,
    k2: float,
) -> Any:
    """Gradients of means, quats, scales, density (float64) from dL/dvolume (nz, ny, padded nx), 0 in the padding."""
    count = len(means)
    grad_means, grad_quats = np.zeros((count, 3)), np.zeros((count, 4))
    grad_scales, grad_density = np.zeros((count, 3)), np.zeros(count)
    for task in prange((count + SPLATS_A_TASK - 1) // SPLATS_A_TASK):
        sums, voxels = np.zeros(13), np.empty((7, STRETCH), np.float32)
        unit, whiten, d_whiten = np.empty(4), np.empty((3, 3)), np.empty((3, 3))
        columns, upper, basis = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
        d_y, side = np.empty(3), np.empty(3)
        for n in range(task * SPLATS_A_TASK, min(count, (task + 1) * SPLATS_A_TASK)):
            if boxes[n, 0] >= boxes[n, 1]:
                continue
            sums[:] = 0.0
            _gather(grad, table[n], centers[n], boxes[n], k2, voxels, sums)
            grad_density[n] = sums[0]
            length = fill_whitening(quats[n], scales[n], unit, whiten)
            _factor(whiten, spacing, columns, upper, basis)
            d_whiten[:] = 0.0
            for k in range(4):
                # Σ τ·(x, y, z) times d_x, d_y, d_z and 1, turned back by Q.
                for a in range(3):
                    d_y[a] = 0.0
                    for b in range(3):
                        d_y[a] += basis[b, a] * sums[1 + 4 * b + k]
                if k == 3:
                    multiply_transposed(whiten, d_y, grad_means[n])
                else:
                    side[:] = 0.0
                    side[k] = -spacing[k]
                    add_outer(d_whiten, d_y, side)
            whitening_backward(scales[n], unit, length, whiten, d_whiten, grad_quats[n], grad_scales[n])
    return grad_means, grad_quats, grad_scales, grad_density


@njit(error_model="numpy", cache=True)
def _gather(grad: Any, row: Any, center: Any, box: Any, k2: float, voxels: Any, sums: Any) -> None:
    """[0] Σ h·w and [1:13] Σ τ·(x, y, z) ⊗ (d_x, d_y, d_z, 1), τ = h·ρ·w, rows laid end to end in stretches."""
    filled = 0
    for slice_ in range(box[4], box[5]):
        for j in range(box[2], box[3]):
            first, last, d_y, d_z, x, y, z = _row_start(row, center, j, slice_, k2, box[0], box[1])
            while first < last:
                count = min((last - first + LANES - 1) // LANES * LANES, STRETCH - filled)
                right = first - center[0]
                part = voxels[:, filled : filled + count]
                _fill_row(part, row[U11], right, row[U11] * right + x, d_y, d_z, y, z)
                part[6] = grad[slice_, j, first : first + count]
                filled += count
                first += count
                if filled == STRETCH:
                    _reduce(row, voxels, filled, sums)
                    filled = 0
    if filled:
        _reduce(row, voxels, filled, sums)


@njit(fastmath=FAST, error_model="numpy", cache=True)
def _fill_row(part: Any, step: Any, right: float, x: float, d_y: float, d_z: float, y: float, z: float) -> None:
    right32, x32 = np.float32(right), np.float32(x)
    for k in range(part.shape[1]):
        part[0, k] = right32 + np.float32(k)
        part[1, k] = x32 + step * np.float32(k)
    part[2] = np.float32(d_y)
    part[3] = np.float32(d_z)
    part[4] = np.float32(y)
    part[5] = np.float32(z)


@njit(fastmath=FAST, error_model="numpy", cache=True)
def _reduce(row: Any, voxels: Any, filled: int, sums: Any) -> None:
    rights, xs, downs, depths, ys, zs, hs = (
        voxels[0],
        voxels[1],
        voxels[2],
        voxels[3],
        voxels[4],
        voxels[5],
        voxels[6],
    )
    density = row[DENSITY]
    s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = s8 = s9 = s10 = s11 = s12 = np.float32(0.0)
    for k in range(filled):
        d_x, d_y, d_z, x, y, z = rights[k], downs[k], depths[k], xs[k], ys[k], zs[k]
        q = x * x + y * y + z * z
        w = hs[k] * bell(q)
        tau = density * w
        tau_x, tau_y, tau_z = tau * x, tau * y, tau * z
        s0 += w
        s1 += tau_x * d_x
        s2 += tau_x * d_y
        s3 += tau_x * d_z
        s4 += tau_x
        s5 += tau_y * d_x
        s6 += tau_y * d_y
        s7 += tau_y * d_z
        s8 += tau_y
        s9 += tau_z * d_x
        s10 += tau_z * d_y
        s11 += tau_z * d_z
        s12 += tau_z
    for place, value in enumerate((s0, s1, s2, s3, s4, s5, s6, s7, s8, s9, s10, s11, s12)):
        sums[place] += value
