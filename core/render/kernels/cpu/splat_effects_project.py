"""Splats that are integrated over pixels, to the screen and back; see `reference.pixel_integral`.

In the frame (x − k·y, y) a projected splat lies along the axes. Its footprint there, an ellipse, is what the plain
kernel's tiles and rows are given.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ....compiled import njit, prange
from ....threads import loops_only
from ..reference.pixel_integral import LEAST_SHARE, LEAST_VARIANCE, MARGIN, PIXEL_VARIANCE, SLACK
from ..reference.splat import ALPHA_MIN
from .math import cross, dot
from .splat_colors import COEFFICIENTS, LANES, X, Y, Z, color_of, colors_backward, direction, fill_bases
from .splat_effects_raster import AMPLITUDE, INVERSE_X, INVERSE_Y, SHAPES, TILT
from .splat_geometry import HEIGHT, NEAR, WIDTH, from_axes, rows_of, to_screen, unpacked
from .splat_project import (
    _CENTER_X,
    _CENTER_Y,
    _CHUNK,
    _FARTHEST,
    _FORWARD,
    _K,
    _L1,
    _L2,
    _LARGEST,
    _LENGTH,
    _MX,
    _MY,
    _MZ,
    _PLANES,
    _POSE,
    _QW,
    _QX,
    _QY,
    _QZ,
    _S0,
    _S1,
    _S2,
    _TO_X,
    _TO_Y,
    _X,
    _XX,
    _XY,
    _Y,
    _YY,
    _Z,
    _add_poses,
    _add_up,
    _directions_backward,
    _drawable,
    _gather,
    _meets,
    _scatter,
    _seen,
)
from .splat_raster import (
    ATTRIBUTES,
    BLUE,
    CENTER_X,
    CENTER_Y,
    DEEP,
    DEPTH,
    GREEN,
    L1,
    L2,
    LEAN,
    OPACITY,
    REACH,
    RED,
    SLOPE,
    SUMS,
    K,
)  # fmt: skip
from .vectors import aligned

# A plane that is free on the way to the screen; those of the ellipse's numbers hold 1/σx, k and 1/σy.
_RATIO = np.uint64(19 * LANES)
_INVERSE_X, _TILT, _INVERSE_Y = _L1, _K, _L2
_ROOT_2PI = float(np.sqrt(2 * np.pi))
# Pixels beyond which a footprint need not reach, with room for squares and quotients in float32.
_WIDEST = 1e15


@njit(parallel=loops_only(), cache=True, error_model="numpy")
def project(means: Any, quats: Any, scales: Any, opacities: Any, sh: Any, view: Any, degree: Any) -> Any:
    """Per-splat tables for binning and blending; see `splat_project.project`.

    Returns:
        centers (N, 2) float64 pixels, attributes (N, ATTRIBUTES) float32 with the footprint's ellipse, shapes
        (N, SHAPES) float32, reach (N,) float32 (0: not drawn) and radii (N,) float32 pixels.
    """
    count = len(means)
    centers = np.zeros((count, 2), np.float64)
    attributes = aligned(count * ATTRIBUTES).reshape(count, ATTRIBUTES)
    shapes = np.zeros((count, SHAPES), np.float32)
    reach, radii = np.zeros(count, np.float32), np.zeros(count, np.float32)
    for task in prange((count + _CHUNK - 1) // _CHUNK):
        first = np.int64(task) * _CHUNK
        rows, lanes = np.empty(LANES, np.uint64), np.empty(_PLANES * LANES, np.float64)
        directions, bases = np.empty(3 * LANES, np.float32), np.empty(COEFFICIENTS * LANES, np.float32)
        for start in range(first, min(first + _CHUNK, count), LANES):
            found = _drawable(start, min(start + LANES, count), means, quats, scales, opacities, rows)
            _gather(rows, found, means, quats, scales, lanes)
            _to_screens(lanes, found, view, directions)
            fill_bases(directions, found, bases)
            _tabulate(
                rows, found, lanes, bases, opacities, sh, view, degree, centers, attributes, shapes, reach, radii,
            )  # fmt: skip
    return centers, attributes, shapes, reach, radii


@njit(error_model="numpy", _nrt=False)
def _to_screens(lanes: Any, count: Any, packed: Any, directions: Any) -> None:
    view = unpacked(packed)
    for n in range(np.uint64(count)):
        mean = (lanes[_MX + n], lanes[_MY + n], lanes[_MZ + n])
        quat = (lanes[_QW + n], lanes[_QX + n], lanes[_QY + n], lanes[_QZ + n])
        scale = (lanes[_S0 + n], lanes[_S1 + n], lanes[_S2 + n])
        screen = to_screen(mean, quat, scale, view)
        first, second, minors = rows_of(screen.axes, scale)
        xx, xy, yy, det = dot(first, first), dot(first, second), dot(second, second), dot(minors, minors)
        row, of_y = yy + PIXEL_VARIANCE, yy + LEAST_VARIANCE
        of_x = (det + PIXEL_VARIANCE * xx) / row + LEAST_VARIANCE
        lanes[_CENTER_X + n], lanes[_CENTER_Y + n], lanes[_Z + n] = screen.center_x, screen.center_y, screen.z
        lanes[_XX + n], lanes[_XY + n], lanes[_YY + n] = xx, xy, yy
        lanes[_INVERSE_X + n], lanes[_INVERSE_Y + n] = 1.0 / np.sqrt(of_x), 1.0 / np.sqrt(of_y)
        lanes[_TILT + n], lanes[_RATIO + n] = xy / row, np.sqrt(det / of_x / of_y)
        x, y, z, _ = direction(mean, view)
        directions[X + n], directions[Y + n], directions[Z + n] = x, y, z


@njit(error_model="numpy", _nrt=False)
def _tabulate(
    rows: Any, count: Any, lanes: Any, bases: Any, opacities: Any, sh: Any, view: Any, degree: Any, centers: Any,
    attributes: Any, shapes: Any, reach: Any, radii: Any,
) -> None:  # fmt: skip
    """Fills in the tables' rows of those splats of a batch that can be seen."""
    places = attributes.view(np.float64)
    for n in range(np.uint64(count)):
        i = rows[n]
        x, y, xx, xy, yy = lanes[_CENTER_X + n], lanes[_CENTER_Y + n], lanes[_XX + n], lanes[_XY + n], lanes[_YY + n]
        inverse_x, inverse_y, tilt = lanes[_INVERSE_X + n], lanes[_INVERSE_Y + n], lanes[_TILT + n]
        ratio, z = lanes[_RATIO + n], np.float32(lanes[_Z + n])
        shapes[i, INVERSE_Y], shapes[i, INVERSE_X] = inverse_y, inverse_x
        shapes[i, TILT], shapes[i, AMPLITUDE] = tilt, opacities[i] * ratio
        finite = 0.0 * x + 0.0 * y + 0.0 * (xx + yy) + 0.0 * ratio + 0.0 * z + 0.0 * shapes[i, TILT]
        largest = opacities[i] * ratio * min(_ROOT_2PI / inverse_y, 1.0) * min(_ROOT_2PI / inverse_x, 1.0)
        if not (lanes[_Z + n] > view[NEAR] and finite == 0.0 and largest >= ALPHA_MIN):
            continue
        squared = 2 * np.log(MARGIN / ALPHA_MIN * largest)
        of_x, of_y = squared / (inverse_x * inverse_x), squared / (inverse_y * inverse_y)
        share = max(np.sqrt(of_x + of_y), LEAST_SHARE)
        across = (1 + 1 / share) * of_x + 0.5 * (1 + share)
        down = (1 + 1 / share) * of_y + 0.5 * (1 + share)
        half_x, half_y = (1 + SLACK) * np.sqrt(across + tilt * tilt * down), (1 + SLACK) * np.sqrt(down)
        if not (_meets(x, half_x, view[WIDTH]) and _meets(y, half_y, view[HEIGHT])):
            continue
        red, green, blue = color_of(bases, n, sh, i, (degree + 1) * (degree + 1))
        if not (np.isfinite(red) and np.isfinite(green) and np.isfinite(blue)):
            continue
        attributes[i, RED], attributes[i, GREEN] = max(red, np.float32(0.0)), max(green, np.float32(0.0))
        attributes[i, BLUE] = max(blue, np.float32(0.0))
        attributes[i, OPACITY], attributes[i, DEPTH] = opacities[i], z
        _place_ellipse(min(np.sqrt(across), _WIDEST), min(np.sqrt(down), _WIDEST), tilt, attributes[i])
        centers[i, 0], centers[i, 1] = x, y
        places[i, CENTER_X], places[i, CENTER_Y] = x, y
        reach[i] = attributes[i, REACH]
        longest = 0.5 * (xx + yy) + np.sqrt(0.25 * (xx - yy) * (xx - yy) + xy * xy)
        radii[i] = min(3 * np.sqrt(longest), _LARGEST)


@njit(error_model="numpy", _nrt=False)
def _place_ellipse(across: Any, down: Any, tilt: Any, attribute: Any) -> None:
    """The ellipse of those half axes in (x − tilt · y, y), as the plain kernel's tiles and rows take it."""
    far = 1 + SLACK
    l1, k, l2 = 1 / across, -tilt / across, 1 / down
    deep = min(1 / np.sqrt(k * k + l2 * l2), _FARTHEST)
    attribute[L1], attribute[K], attribute[L2], attribute[REACH] = l1, k, l2, far
    attribute[SLOPE] = min(max(-l1 * k * deep * deep, -_FARTHEST), _FARTHEST)
    attribute[LEAN] = min(max(-k * far / (l1 * l2), -_FARTHEST), _FARTHEST)
    attribute[DEEP] = deep


@njit(parallel=loops_only(), cache=True, error_model="numpy")
def project_backward(
    means: Any, quats: Any, scales: Any, opacities: Any, sh: Any, view: Any, degree: Any, sums: Any, pairs: Any,
    slot_starts: Any,
) -> Any:  # fmt: skip
    """`splat_project.project_backward` from the sums of integrated splats."""
    count = len(means)
    grad_means, grad_quats, grad_scales = np.empty_like(means), np.empty_like(quats), np.empty_like(scales)
    grad_opacities, grad_sh = np.empty_like(opacities), np.empty_like(sh)
    grad_screen = np.empty((count, 2), np.float32)
    tasks = (count + _CHUNK - 1) // _CHUNK
    grad_pose = np.zeros((tasks, 12), np.float64)
    for task in prange(tasks):
        first = np.int64(task) * _CHUNK
        rows, lanes = np.empty(LANES, np.uint64), np.empty(_PLANES * LANES, np.float64)
        totals, directions = np.empty((LANES, SUMS), np.float64), np.empty(3 * LANES, np.float32)
        bases, grad_bases = np.empty(COEFFICIENTS * LANES, np.float32), np.empty(COEFFICIENTS * LANES, np.float32)
        for start in range(first, min(first + _CHUNK, count), LANES):
            found = _seen(
                start, min(start + LANES, count), slot_starts, rows, grad_means, grad_quats, grad_scales,
                grad_opacities, grad_sh, grad_screen,
            )  # fmt: skip
            _add_up(rows, found, sums, pairs, slot_starts, totals)
            _gather(rows, found, means, quats, scales, lanes)
            _to_screens_backward(lanes, found, view, totals, directions)
            fill_bases(directions, found, bases)
            colors_backward(rows, found, sh, degree, totals[:, 6:9], bases, grad_bases, grad_sh, directions)
            _directions_backward(lanes, found, view, directions, grad_pose[task])
            _add_poses(lanes, found, grad_pose[task])
            _scatter(
                rows, found, lanes, totals, opacities, grad_means, grad_quats, grad_scales, grad_opacities, grad_screen,
            )  # fmt: skip
    pose = np.zeros((3, 4), np.float64)
    for task in range(tasks):
        for j in range(12):
            pose[j // 4, j % 4] += grad_pose[task, j]
    return grad_means, grad_quats, grad_scales, grad_opacities, grad_sh, pose, grad_screen


@njit(error_model="numpy", _nrt=False)
def _to_screens_backward(lanes: Any, count: Any, packed: Any, totals: Any, directions: Any) -> None:
    view = unpacked(packed)
    for n in range(np.uint64(count)):
        mean = (lanes[_MX + n], lanes[_MY + n], lanes[_MZ + n])
        quat = (lanes[_QW + n], lanes[_QX + n], lanes[_QY + n], lanes[_QZ + n])
        scale = (lanes[_S0 + n], lanes[_S1 + n], lanes[_S2 + n])
        screen = to_screen(mean, quat, scale, view)
        sums = (totals[n, 0], totals[n, 1], totals[n, 2], totals[n, 3], totals[n, 4], totals[n, 5])
        gx, gy, first, second, third = _axes_backward(screen.axes, scale, sums)
        to = from_axes(screen, mean, view, (gx, gy), first, second, third, totals[n, 9])
        lanes[_MX + n], lanes[_MY + n], lanes[_MZ + n] = to.mean
        lanes[_QW + n], lanes[_QX + n], lanes[_QY + n], lanes[_QZ + n] = to.quat
        lanes[_S0 + n], lanes[_S1 + n], lanes[_S2 + n] = to.scale
        lanes[_TO_X + n], lanes[_TO_Y + n] = to.center_x, to.center_y
        for j in range(12):
            lanes[_POSE + np.uint64(j * LANES) + n] = to.pose[j]
        x, y, z, length = direction(mean, view)
        lanes[_X + n], lanes[_Y + n], lanes[_FORWARD + n], lanes[_LENGTH + n] = x, y, z, length
        directions[X + n], directions[Y + n], directions[Z + n] = x, y, z


@njit(error_model="numpy", _nrt=False, forceinline=True)
def _axes_backward(axes: Any, scale: Any, sums: Any) -> Any:
    """∂L/∂(x, y) of the centre, and for each axis ∂L/∂scale and ∂L/∂(x, y) of its direction on the screen.

    log α = ½ log |Σ'| + (log Fy − log σy) + (log Fx − log σx) up to constants, with σy² = yy + ε, row = yy + 1/12,
    σx² = (|Σ'| + xx/12)/row + ε and Fx at x − (xy/row)·y. ½ log |Σ'| goes back by the pseudo-inverse of M, written as
    cross products: the inverse of a needle's Σ' is lost to rounding.

    Args:
        sums: of `splat_effects_raster.rasterize_backward`.
    """
    h, h_x, h_y, h_width_x, h_width_y, h_tilt = sums
    m0, m1, c = rows_of(axes, scale)
    xx, xy, yy, det = dot(m0, m0), dot(m0, m1), dot(m1, m1), dot(c, c)
    row, of_y = yy + PIXEL_VARIANCE, yy + LEAST_VARIANCE
    spread = det + PIXEL_VARIANCE * xx
    of_x = spread / row + LEAST_VARIANCE
    tilt = xy / row
    # By the variances, then by xx, xy, yy and log |Σ'|/2.
    by_x, by_y = 0.5 * (h_width_x - h) / (of_x * row), 0.5 * (h_width_y - h) / of_y
    by_xx, by_xy = by_x * PIXEL_VARIANCE, -h_tilt / row
    by_yy = by_y - by_x * (of_x - LEAST_VARIANCE) + h_tilt * tilt / row
    by_det = (h + 2 * det * by_x) / det
    by_m0, by_m1 = cross(m1, c), cross(c, m0)
    d0 = (
        by_det * by_m0[0] + 2 * by_xx * m0[0] + by_xy * m1[0],
        by_det * by_m0[1] + 2 * by_xx * m0[1] + by_xy * m1[1],
        by_det * by_m0[2] + 2 * by_xx * m0[2] + by_xy * m1[2],
    )
    d1 = (
        by_det * by_m1[0] + 2 * by_yy * m1[0] + by_xy * m0[0],
        by_det * by_m1[1] + 2 * by_yy * m1[1] + by_xy * m0[1],
        by_det * by_m1[2] + 2 * by_yy * m1[2] + by_xy * m0[2],
    )
    return (
        -h_x, tilt * h_x - h_y,
        (d0[0] * axes[0] + d1[0] * axes[3], d0[0] * scale[0], d1[0] * scale[0]),
        (d0[1] * axes[1] + d1[1] * axes[4], d0[1] * scale[1], d1[1] * scale[1]),
        (d0[2] * axes[2] + d1[2] * axes[5], d0[2] * scale[2], d1[2] * scale[2]),
    )  # fmt: skip
