"""All splats to the screen and their gradients back, in chunks shared out among threads."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, prange

from ..reference.splat import ALPHA_MIN
from .splat_colors import COEFFICIENTS, color_backward, direction, fill_basis
from .splat_geometry import HEIGHT, NEAR, WIDTH, to_screen, to_screen_backward
from .splat_raster import ATTRIBUTES, BLUE, DEPTH, GREEN, HALF, L1, L2, OPACITY, RED, SUMS, K

# Splats a task works through: fixed, so that sums over chunks do not depend on the number of threads.
_CHUNK = 512
# Added to a splat's reach where tiles and rows are chosen, so that rounding never leaves a pixel out.
_SLACK = 1e-3
_LARGEST = float(np.finfo(np.float32).max)


@njit(parallel=True, cache=True, error_model="numpy")
def project(means: Any, quats: Any, scales: Any, opacities: Any, sh: Any, view: Any, degree: Any) -> Any:
    """Per-splat tables for binning and blending.

    Returns:
        centers (N, 2) float64 pixels, attributes (N, ATTRIBUTES) float32, reach (N,) float32 standard deviations
        at which α falls to 1/255 (0: not drawn) and radii (N,) float32 pixels.
    """
    count = len(means)
    centers = np.zeros((count, 2), np.float64)
    attributes = np.zeros((count, ATTRIBUTES), np.float32)
    reach = np.zeros(count, np.float32)
    radii = np.zeros(count, np.float32)
    for task in prange((count + _CHUNK - 1) // _CHUNK):
        first = np.int64(task) * _CHUNK
        basis = np.empty(COEFFICIENTS, np.float64)
        _project_some(
            first, min(first + _CHUNK, count), means, quats, scales, opacities, sh, view, degree, basis, centers,
            attributes, reach, radii,
        )  # fmt: skip
    return centers, attributes, reach, radii


@njit(error_model="numpy", _nrt=False)
def _project_some(
    first: Any, last: Any, means: Any, quats: Any, scales: Any, opacities: Any, sh: Any, view: Any, degree: Any,
    basis: Any, centers: Any, attributes: Any, reach: Any, radii: Any,
) -> None:  # fmt: skip
    for i in range(first, last):
        if not (opacities[i] >= ALPHA_MIN and _finite(means[i], quats[i], scales[i], opacities[i])):
            continue
        screen = to_screen(means[i], quats[i], scales[i], view)
        if not (screen.z > view[NEAR] and _on_screen(screen, centers[i], attributes[i])):
            continue
        far = np.sqrt(2 * np.log(opacities[i] / ALPHA_MIN)) + _SLACK
        half_x, half_y = far * np.sqrt(screen.xx), far * np.sqrt(screen.yy)
        if not (_meets(screen.center_x, half_x, view[WIDTH]) and _meets(screen.center_y, half_y, view[HEIGHT])):
            continue
        x, y, z, _ = direction(means[i], view)
        fill_basis(x, y, z, degree, basis)
        if not _fill_color(basis, sh[i], (degree + 1) * (degree + 1), attributes[i]):
            continue
        attributes[i, OPACITY] = opacities[i]
        attributes[i, HALF] = half_y
        reach[i] = far
        longest = 0.5 * (screen.xx + screen.yy) + np.hypot(0.5 * (screen.xx - screen.yy), screen.xy)
        radii[i] = min(3 * np.sqrt(longest), _LARGEST)


@njit(parallel=True, cache=True, error_model="numpy")
def project_backward(
    means: Any, quats: Any, scales: Any, opacities: Any, sh: Any, view: Any, degree: Any, sums: Any, pairs: Any,
    slot_starts: Any,
) -> Any:  # fmt: skip
    """Gradients of means, quats, scales, opacities, sh, world_to_camera (3, 4) float64, and screen centres (N, 2).

    Args:
        sums: (P, SUMS) of `rasterize_backward`.
        pairs: (P,) int32, those of splat i at slot_starts[i] : slot_starts[i + 1].
    """
    count = len(means)
    grad_means, grad_quats, grad_scales = np.empty_like(means), np.empty_like(quats), np.empty_like(scales)
    grad_opacities, grad_sh = np.empty_like(opacities), np.empty_like(sh)
    grad_screen = np.empty((count, 2), np.float32)
    tasks = (count + _CHUNK - 1) // _CHUNK
    grad_pose = np.zeros((tasks, 12), np.float64)
    for task in prange(tasks):
        first = np.int64(task) * _CHUNK
        last: Any = min(first + _CHUNK, count)
        totals = np.zeros((last - first, SUMS), np.float64)
        basis, grad_basis = np.empty(COEFFICIENTS, np.float64), np.empty(COEFFICIENTS, np.float64)
        _add_up(sums, pairs, slot_starts, first, last, totals)
        _project_some_backward(
            first, last, means, quats, scales, opacities, sh, view, degree, slot_starts, totals, basis, grad_basis,
            grad_means, grad_quats, grad_scales, grad_opacities, grad_sh, grad_pose[task], grad_screen,
        )  # fmt: skip
    pose = np.zeros(12, np.float64)
    for task in range(tasks):
        pose += grad_pose[task]
    return grad_means, grad_quats, grad_scales, grad_opacities, grad_sh, pose.reshape(3, 4), grad_screen


@njit(error_model="numpy", _nrt=False)
def _add_up(sums: Any, pairs: Any, slot_starts: Any, first: Any, last: Any, totals: Any) -> None:
    """Adds the pairs of splats first..last up in `totals`, in a loop of its own so that waits for memory overlap."""
    for i in range(first, last):
        for slot in range(slot_starts[i], slot_starts[i + 1]):
            pair = np.uint64(pairs[slot])
            for j in range(SUMS):
                totals[i - first, j] += sums[pair, j]


@njit(error_model="numpy", _nrt=False)
def _project_some_backward(
    first: Any, last: Any, means: Any, quats: Any, scales: Any, opacities: Any, sh: Any, view: Any, degree: Any,
    slot_starts: Any, totals: Any, basis: Any, grad_basis: Any, grad_means: Any, grad_quats: Any, grad_scales: Any,
    grad_opacities: Any, grad_sh: Any, grad_pose: Any, grad_screen: Any,
) -> None:  # fmt: skip
    for i in range(first, last):
        if slot_starts[i] == slot_starts[i + 1]:
            grad_means[i, :], grad_quats[i, :], grad_scales[i, :], grad_screen[i, :] = 0.0, 0.0, 0.0, 0.0
            grad_opacities[i] = 0.0
            grad_sh[i, :, :] = 0.0
            continue
        total = totals[i - first]
        screen = to_screen(means[i], quats[i], scales[i], view)
        to_screen_backward(
            screen, means[i], scales[i], view, total, total[9], grad_means[i], grad_quats[i], grad_scales[i],
            grad_pose, grad_screen[i],
        )  # fmt: skip
        grad_opacities[i] = total[0] / opacities[i]
        color_backward(
            means[i], sh[i], view, degree, total[6:9], basis, grad_basis, grad_sh[i], grad_means[i], grad_pose,
        )  # fmt: skip


@njit(error_model="numpy", _nrt=False)
def _finite(mean: Any, quat: Any, scale: Any, opacity: Any) -> bool:
    total = 0.0 * opacity
    for j in range(3):
        total += 0.0 * mean[j] + 0.0 * scale[j]
    for j in range(4):
        total += 0.0 * quat[j]
    return total == 0.0


@njit(error_model="numpy", _nrt=False)
def _on_screen(screen: Any, center: Any, attribute: Any) -> bool:
    """Fills in the geometry; False if a number of it is not finite in float32."""
    center[0], center[1] = screen.center_x, screen.center_y
    attribute[L1], attribute[K], attribute[L2], attribute[DEPTH] = screen.l1, screen.k, screen.l2, screen.z
    total = 0.0 * center[0] + 0.0 * center[1] + 0.0 * screen.xx + 0.0 * screen.xy + 0.0 * screen.yy
    for column in (L1, K, L2, DEPTH):
        total += 0.0 * attribute[column]
    return total == 0.0


@njit
def _meets(center: Any, half: Any, size: Any) -> bool:
    """Whether a pixel centre of 0..size lies within `half` of `center`."""
    return max(np.ceil(center - half - 0.5), 0.0) <= min(np.floor(center + half - 0.5), size - 1.0)


@njit(error_model="numpy", _nrt=False)
def _fill_color(basis: Any, sh: Any, used: Any, attribute: Any) -> bool:
    finite = True
    for c, column in enumerate((RED, GREEN, BLUE)):
        value = 0.5
        for band in range(used):
            value += basis[band] * sh[band, c]
        finite = finite and np.isfinite(value)
        attribute[column] = max(value, 0.0)
    return finite
