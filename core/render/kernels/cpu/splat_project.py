"""All splats to the screen and their gradients back, in chunks shared out among threads, batch by batch.

Splats lie number by number in a batch's buffer (see `splat_colors.LANES`): they are gathered there, worked on side by
side, and put back.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ....compiled import njit, prange
from ....threads import loops_only
from ..reference.splat import ALPHA_MIN
from .splat_colors import COEFFICIENTS, LANES, X, Y, Z, color_of, colors_backward, direction, fill_bases
from .splat_geometry import HEIGHT, NEAR, ORTHOGRAPHIC, WIDTH, to_screen, to_screen_backward, unpacked
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

# Splats a task works through: fixed, so that sums over chunks do not depend on the number of threads.
_CHUNK = 8 * LANES
# Added to a splat's reach where tiles and rows are chosen, so that rounding never leaves a pixel out.
_SLACK = 1e-3
_LARGEST = float(np.finfo(np.float32).max)
# Pixels, with room for a product by a small number.
_FARTHEST = 1e36

# Planes of a batch's float64 buffer: mean, quat and scale, on the way back replaced by their gradients.
_MX, _MY, _MZ, _QW, _QX, _QY, _QZ, _S0, _S1, _S2 = (np.uint64(i * LANES) for i in range(10))
# What is found on the screen.
_CENTER_X, _CENTER_Y, _XX, _XY, _YY, _L1, _K, _L2, _Z, _SHARE = (np.uint64(i * LANES) for i in range(10, 20))
# On the way back: direction and distance from the camera, the gradients of the projected centre and of the pose.
_X, _Y, _FORWARD, _LENGTH, _TO_X, _TO_Y, _POSE = (np.uint64(i * LANES) for i in range(10, 17))
_PLANES = 28


@njit(parallel=loops_only(), cache=True, error_model="numpy")
def project(means: Any, quats: Any, scales: Any, opacities: Any, sh: Any, view: Any, degree: Any) -> Any:
    """Per-splat tables for binning and blending.

    Args:
        view: of `pack_view`, by which splats are widened, too.

    Returns:
        centers (N, 2) float64 pixels, attributes (N, ATTRIBUTES) float32, reach (N,) float32 standard deviations
        at which α falls to 1/255 (0: not drawn) and radii (N,) float32 pixels.
    """
    count = len(means)
    centers = np.zeros((count, 2), np.float64)
    attributes = aligned(count * ATTRIBUTES).reshape(count, ATTRIBUTES)
    reach = np.zeros(count, np.float32)
    radii = np.zeros(count, np.float32)
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
                rows, found, lanes, bases, opacities, sh, view, degree, centers, attributes, reach, radii,
            )  # fmt: skip
    return centers, attributes, reach, radii


@njit(error_model="numpy", _nrt=False)
def _drawable(start: Any, stop: Any, means: Any, quats: Any, scales: Any, opacities: Any, rows: Any) -> int:
    """Puts the splats of start..stop that are opaque enough, all of whose numbers are finite, into `rows`."""
    count = 0
    for i in range(start, stop):
        if opacities[i] >= ALPHA_MIN and _finite(means[i], quats[i], scales[i], opacities[i]):
            rows[count] = i
            count += 1
    return count


@njit(error_model="numpy", _nrt=False)
def _gather(rows: Any, count: Any, means: Any, quats: Any, scales: Any, lanes: Any) -> None:
    for n in range(np.uint64(count)):
        i = rows[n]
        lanes[_MX + n], lanes[_MY + n], lanes[_MZ + n] = means[i, 0], means[i, 1], means[i, 2]
        lanes[_QW + n], lanes[_QX + n] = quats[i, 0], quats[i, 1]
        lanes[_QY + n], lanes[_QZ + n] = quats[i, 2], quats[i, 3]
        lanes[_S0 + n], lanes[_S1 + n], lanes[_S2 + n] = scales[i, 0], scales[i, 1], scales[i, 2]


@njit(error_model="numpy", _nrt=False)
def _to_screens(lanes: Any, count: Any, packed: Any, directions: Any) -> None:
    view = unpacked(packed)
    for n in range(np.uint64(count)):
        mean = (lanes[_MX + n], lanes[_MY + n], lanes[_MZ + n])
        quat = (lanes[_QW + n], lanes[_QX + n], lanes[_QY + n], lanes[_QZ + n])
        screen = to_screen(mean, quat, (lanes[_S0 + n], lanes[_S1 + n], lanes[_S2 + n]), view)
        lanes[_CENTER_X + n], lanes[_CENTER_Y + n] = screen.center_x, screen.center_y
        lanes[_XX + n], lanes[_XY + n], lanes[_YY + n] = screen.xx, screen.xy, screen.yy
        lanes[_L1 + n], lanes[_K + n], lanes[_L2 + n] = screen.l1, screen.k, screen.l2
        lanes[_Z + n], lanes[_SHARE + n] = screen.z, screen.share
        x, y, z, _ = direction(mean, view)
        directions[X + n], directions[Y + n], directions[Z + n] = x, y, z


@njit(error_model="numpy", _nrt=False)
def _tabulate(
    rows: Any, count: Any, lanes: Any, bases: Any, opacities: Any, sh: Any, view: Any, degree: Any, centers: Any,
    attributes: Any, reach: Any, radii: Any,
) -> None:  # fmt: skip
    """Fills in the tables' rows of those splats of a batch that can be seen."""
    places = attributes.view(np.float64)
    for n in range(np.uint64(count)):
        i = rows[n]
        opacity = opacities[i] * lanes[_SHARE + n]
        if not (
            lanes[_Z + n] > view[NEAR] and opacity >= ALPHA_MIN and _on_screen(lanes, n, centers[i], attributes[i])
        ):
            continue
        far = np.sqrt(2 * np.log(opacity / ALPHA_MIN)) + _SLACK
        xx, xy, yy = lanes[_XX + n], lanes[_XY + n], lanes[_YY + n]
        half_x, half_y = far * np.sqrt(xx), far * np.sqrt(yy)
        if not (_meets(centers[i, 0], half_x, view[WIDTH]) and _meets(centers[i, 1], half_y, view[HEIGHT])):
            continue
        red, green, blue = color_of(bases, n, sh, i, (degree + 1) * (degree + 1))
        if not (np.isfinite(red) and np.isfinite(green) and np.isfinite(blue)):
            continue
        attributes[i, RED], attributes[i, GREEN] = max(red, np.float32(0.0)), max(green, np.float32(0.0))
        attributes[i, BLUE] = max(blue, np.float32(0.0))
        attributes[i, OPACITY] = opacity
        attributes[i, REACH] = far
        l1, k, l2 = lanes[_L1 + n], lanes[_K + n], lanes[_L2 + n]
        # Cut where a float32 ends, beyond which no image is large enough to tell.
        deep = min(1 / np.sqrt(k * k + l2 * l2), _FARTHEST)
        attributes[i, SLOPE] = min(max(-l1 * k * deep * deep, -_FARTHEST), _FARTHEST)
        attributes[i, LEAN] = min(max(-k * far / (l1 * l2), -_FARTHEST), _FARTHEST)
        attributes[i, DEEP] = deep
        places[i, CENTER_X], places[i, CENTER_Y] = centers[i, 0], centers[i, 1]
        reach[i] = far
        # No `np.hypot`: a call of the library for each splat, to be safe from squares beyond 1e308.
        longest = 0.5 * (xx + yy) + np.sqrt(0.25 * (xx - yy) * (xx - yy) + xy * xy)
        radii[i] = min(3 * np.sqrt(longest), _LARGEST)


@njit(parallel=loops_only(), cache=True, error_model="numpy")
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
def _seen(
    start: Any, stop: Any, slot_starts: Any, rows: Any, grad_means: Any, grad_quats: Any, grad_scales: Any,
    grad_opacities: Any, grad_sh: Any, grad_screen: Any,
) -> int:  # fmt: skip
    """Puts the splats of start..stop that some tile has into `rows`; the others' gradients become 0."""
    count = 0
    for i in range(start, stop):
        if slot_starts[i] < slot_starts[i + 1]:
            rows[count] = i
            count += 1
        else:
            grad_means[i, :], grad_quats[i, :], grad_scales[i, :], grad_screen[i, :] = 0.0, 0.0, 0.0, 0.0
            grad_opacities[i] = 0.0
            grad_sh[i, :, :] = 0.0
    return count


@njit(error_model="numpy", _nrt=False)
def _add_up(rows: Any, count: Any, sums: Any, pairs: Any, slot_starts: Any, totals: Any) -> None:
    """Adds the pairs of each splat up in `totals`, in a loop of its own so that waits for memory overlap."""
    for n in range(np.uint64(count)):
        i = rows[n]
        totals[n, :] = 0.0
        for slot in range(slot_starts[i], slot_starts[i + np.uint64(1)]):
            pair = np.uint64(pairs[np.uint64(slot)])
            for j in range(SUMS):
                totals[n, j] += sums[pair, j]


@njit(error_model="numpy", _nrt=False)
def _to_screens_backward(lanes: Any, count: Any, packed: Any, totals: Any, directions: Any) -> None:
    view = unpacked(packed)
    for n in range(np.uint64(count)):
        mean = (lanes[_MX + n], lanes[_MY + n], lanes[_MZ + n])
        quat = (lanes[_QW + n], lanes[_QX + n], lanes[_QY + n], lanes[_QZ + n])
        scale = (lanes[_S0 + n], lanes[_S1 + n], lanes[_S2 + n])
        sums = (totals[n, 0], totals[n, 1], totals[n, 2], totals[n, 3], totals[n, 4], totals[n, 5])
        screen = to_screen(mean, quat, scale, view)
        to = to_screen_backward(screen, mean, scale, view, sums, totals[n, 9])
        lanes[_MX + n], lanes[_MY + n], lanes[_MZ + n] = to.mean
        lanes[_QW + n], lanes[_QX + n], lanes[_QY + n], lanes[_QZ + n] = to.quat
        lanes[_S0 + n], lanes[_S1 + n], lanes[_S2 + n] = to.scale
        lanes[_TO_X + n], lanes[_TO_Y + n] = to.center_x, to.center_y
        for j in range(12):
            lanes[_POSE + np.uint64(j * LANES) + n] = to.pose[j]
        x, y, z, length = direction(mean, view)
        lanes[_X + n], lanes[_Y + n], lanes[_FORWARD + n], lanes[_LENGTH + n] = x, y, z, length
        directions[X + n], directions[Y + n], directions[Z + n] = x, y, z


@njit(error_model="numpy", _nrt=False)
def _directions_backward(lanes: Any, count: Any, view: Any, directions: Any, grad_pose: Any) -> None:
    """Adds what the colours' gradient by the direction, in `directions`, means for means and pose."""
    total_x, total_y, total_z = 0.0, 0.0, 0.0
    for n in range(np.uint64(count)):
        x, y, z, length = lanes[_X + n], lanes[_Y + n], lanes[_FORWARD + n], lanes[_LENGTH + n]
        dx, dy, dz = directions[X + n], directions[Y + n], directions[Z + n]
        along = x * dx + y * dy + z * dz
        dx, dy, dz = (dx - x * along) / length, (dy - y * along) / length, (dz - z * along) / length
        if view[ORTHOGRAPHIC] == 0.0:
            lanes[_MX + n] += dx
            lanes[_MY + n] += dy
            lanes[_MZ + n] += dz
        total_x += dx
        total_y += dy
        total_z += dz
    total = (total_x, total_y, total_z)
    for j in range(3):
        if view[ORTHOGRAPHIC] != 0.0:
            grad_pose[8 + j] += total[j]
            continue
        # direction = mean + Wᵀ T
        for row in range(3):
            grad_pose[4 * row + j] += view[4 * row + 3] * total[j]
            grad_pose[4 * row + 3] += view[4 * row + j] * total[j]


@njit(fastmath={"reassoc"}, error_model="numpy", _nrt=False)
def _add_poses(lanes: Any, count: Any, grad_pose: Any) -> None:
    for j in range(12):
        plane, total = _POSE + np.uint64(j * LANES), 0.0
        for n in range(np.uint64(count)):
            total += lanes[plane + n]
        grad_pose[j] += total


@njit(error_model="numpy", _nrt=False)
def _scatter(
    rows: Any, count: Any, lanes: Any, totals: Any, opacities: Any, grad_means: Any, grad_quats: Any,
    grad_scales: Any, grad_opacities: Any, grad_screen: Any,
) -> None:  # fmt: skip
    for n in range(np.uint64(count)):
        i = rows[n]
        grad_means[i, 0], grad_means[i, 1], grad_means[i, 2] = lanes[_MX + n], lanes[_MY + n], lanes[_MZ + n]
        grad_quats[i, 0], grad_quats[i, 1] = lanes[_QW + n], lanes[_QX + n]
        grad_quats[i, 2], grad_quats[i, 3] = lanes[_QY + n], lanes[_QZ + n]
        grad_scales[i, 0], grad_scales[i, 1], grad_scales[i, 2] = lanes[_S0 + n], lanes[_S1 + n], lanes[_S2 + n]
        grad_screen[i, 0], grad_screen[i, 1] = lanes[_TO_X + n], lanes[_TO_Y + n]
        grad_opacities[i] = totals[n, 0] / opacities[i]


@njit(error_model="numpy", _nrt=False)
def _finite(mean: Any, quat: Any, scale: Any, opacity: Any) -> bool:
    total = 0.0 * opacity
    for j in range(3):
        total += 0.0 * mean[j] + 0.0 * scale[j]
    for j in range(4):
        total += 0.0 * quat[j]
    return total == 0.0


@njit(error_model="numpy", _nrt=False)
def _on_screen(lanes: Any, n: Any, center: Any, attribute: Any) -> bool:
    """Fills in the geometry; False if a number of it is not finite in float32."""
    center[0], center[1] = lanes[_CENTER_X + n], lanes[_CENTER_Y + n]
    attribute[L1], attribute[K], attribute[L2] = lanes[_L1 + n], lanes[_K + n], lanes[_L2 + n]
    attribute[DEPTH] = lanes[_Z + n]
    total = 0.0 * center[0] + 0.0 * center[1] + 0.0 * (lanes[_XX + n] + lanes[_YY + n]) + 0.0 * lanes[_XY + n]
    for column in (L1, K, L2, DEPTH):
        total += 0.0 * attribute[column]
    return total == 0.0


@njit
def _meets(center: Any, half: Any, size: Any) -> bool:
    """Whether a pixel centre of 0..size lies within `half` of `center`."""
    return max(np.ceil(center - half - 0.5), 0.0) <= min(np.floor(center + half - 0.5), size - 1.0)
