"""Splats to the screen and their gradients back, a thread a splat, in float64; colours in float32.

The numbers are those of `kernels.reference.splat.project`; the gradients are written out as in
`kernels.cpu.splat_geometry`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
import warp as wp
from torch import Tensor

from ....views import Camera
from ..reference.splat import ALPHA_MIN, QUAT_MIN, frustum_limits
from .blocks import launch_threads, view
from .pixels import nearest_pixel, rest_of
from .rotations import ONE, TWO, ZERO, Turn, quat_backward, turn_of
from .spherical_harmonics import Basis, basis_backward, basis_of
from .splat_raster import Sums64

# Added to a splat's reach where tiles are chosen, so that rounding never leaves a pixel out.
_SLACK = wp.constant(wp.float64(1e-3))
_HALF, _THREE = wp.constant(wp.float64(0.5)), wp.constant(wp.float64(3.0))
_ALPHA_MIN, _QUAT_MIN = wp.constant(wp.float64(ALPHA_MIN)), wp.constant(wp.float64(QUAT_MIN))
_INFINITE, _LARGEST = wp.constant(wp.float64(wp.inf)), wp.constant(wp.float64(3.4028234663852886e38))

_PoseRows = wp.types.matrix(shape=(3, 4), dtype=wp.float64)


@wp.struct
class Lens:
    """A `Camera` without its pose: pixels, slopes of the field of view, near in units of length, low_pass in px².

    mip_filter: whether what low_pass makes wider becomes fainter.
    """

    fx: wp.float64
    fy: wp.float64
    cx: wp.float64
    cy: wp.float64
    left: wp.float64
    right: wp.float64
    top: wp.float64
    bottom: wp.float64
    near: wp.float64
    orthographic: wp.bool
    width: wp.float64
    height: wp.float64
    low_pass: wp.float64
    mip_filter: wp.bool


def lens_of(camera: Camera, low_pass: float, mip_filter: bool = False) -> Lens:
    left, right, top, bottom = frustum_limits(camera)
    numbers = {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "near", "width", "height")}
    numbers |= {"left": left, "right": right, "top": top, "bottom": bottom, "low_pass": low_pass}
    lens = Lens()
    for name, number in numbers.items():
        setattr(lens, name, float(number))
    lens.orthographic, lens.mip_filter = bool(camera.orthographic), mip_filter
    return lens


class Projected(NamedTuple):
    """N splats on the screen; of those that are not drawn depth is ∞ and reach 0, and what follows is unset.

    Attributes:
        depths: (N,) float64 camera z.
        reach: (N,) float64 standard deviations at which α falls to 1/255, and a little more.
        visible: (N,) bool, of `SplatInfo`.
        radii: (N,) float32 pixels, of `SplatInfo`.
        centers: (N, 2) float64 pixels.
        factors: (N, 3) float64 l1, k, l2 of B = [[l1, k], [0, l2]] with BᵀB = Σ'⁻¹.
        whole, rests: (N, 2) int32 and float32, the centre counted from the first pixel's: nearest pixel and the rest.
        shapes: (N, 4) float32 l1, k, l2 and opacity.
        features: (N, 4) float32 colour and camera z.
    """

    depths: Tensor
    reach: Tensor
    visible: Tensor
    radii: Tensor
    centers: Tensor
    factors: Tensor
    whole: Tensor
    rests: Tensor
    shapes: Tensor
    features: Tensor

    def of_pixels(self) -> tuple[Any, ...]:
        """What the kernels over pixels take."""
        places = (view(self.whole, wp.vec2i), view(self.rests, wp.vec2))
        return (*places, view(self.shapes, wp.vec4), view(self.features, wp.vec4))


def project(parameters: tuple[Tensor, ...], lens: Any, degree: int) -> Projected:
    """Splats as a camera sees them.

    Args:
        parameters: means (N, 3), quats (N, 4), scales (N, 3), opacities (N,), all float64, sh (N, K, 3) float32, and
            the camera's pose (4, 4) float64.
        lens: `lens_of` the camera.
        degree: of the colour functions in use.
    """
    count, device = len(parameters[0]), parameters[0].device

    def empty(dtype: torch.dtype, *columns: int) -> Tensor:
        return torch.empty(count, *columns, dtype=dtype, device=device)

    double, single = torch.float64, torch.float32
    screen = (empty(double), empty(double), empty(torch.bool), empty(single), empty(double, 2), empty(double, 3))
    found = Projected(*screen, empty(torch.int32, 2), empty(single, 2), empty(single, 4), empty(single, 4))
    numbers = [view(tensor) for tensor in found[:4]]
    places = (view(found.centers, wp.vec2d), view(found.factors, wp.vec3d))
    inputs = [*_views(parameters), (degree + 1) ** 2, lens, *numbers, *places, *found.of_pixels()]
    launch_threads(_project, count, inputs, device)
    return found


def project_backward(
    parameters: tuple[Tensor, ...], lens: Any, degree: int, order: Tensor, slot_starts: Tensor, totals: Tensor,
    want_pose: bool,
) -> tuple[list[Tensor], Tensor]:  # fmt: skip
    """Gradients of the `parameters` of `project`, of the pose only if wanted, and of the centres (N, 2) in pixels.

    Args:
        order: (N,) int64 splats, nearest first.
        slot_starts: of `tiles.Tiles`, in that order.
        totals: (N, SUMS) float64 sums over pixels, in that order.
    """
    gradients = [parameter.new_empty(parameter.shape) for parameter in parameters[:5]]
    pose, count = parameters[5], len(order)
    centers = torch.empty(count, 2, device=pose.device)
    # A row for each splat, summed up by torch: the same bits every time.
    rows = pose.new_empty(count if want_pose else 0, 3, 4)
    inputs = [*_views(parameters), (degree + 1) ** 2, lens, view(order), view(slot_starts), view(totals, Sums64)]
    outputs = [*_views(gradients), view(centers, wp.vec2), view(rows, _PoseRows)]
    launch_threads(_project_backward, count, [*inputs, *outputs], pose.device)
    if want_pose:
        gradients.append(torch.nn.functional.pad(rows.sum(0), (0, 0, 0, 1)))
    return gradients, centers


def _views(parameters: Sequence[Tensor]) -> list[Any]:
    """Warp arrays of means, quats, scales, opacities, sh and, if there is one, a pose."""
    vectors = (wp.vec3d, wp.vec4d, wp.vec3d, None, wp.vec3)
    arrays = [view(tensor, dtype) for tensor, dtype in zip(parameters[:5], vectors, strict=True)]
    return arrays + [view(pose[None], wp.mat44d) for pose in parameters[5:]]


@wp.struct
class _Screen:
    """One splat on the screen.

    local: camera frame. slopes: x/z and y/z, clamped for the Jacobian, held_x, held_y: whether the clamp holds them.
    j00, j02, j11, j12: the Jacobian, pixels per unit of length. turn: R. jw_x, jw_y and axes_x, axes_y: the rows of J W
    and J W R. center: pixels. xx, xy, yy, det: Σ', px² and px⁴. l1, k, l2: B of Σ'⁻¹ = BᵀB, upper triangular.
    minors: X × Y of the rows of J W R diag(scale). share: of its opacity that it is drawn with.
    """

    local: wp.vec3d
    slopes: wp.vec2d
    held_x: wp.bool
    held_y: wp.bool
    j00: wp.float64
    j02: wp.float64
    j11: wp.float64
    j12: wp.float64
    turn: Turn
    jw_x: wp.vec3d
    jw_y: wp.vec3d
    axes_x: wp.vec3d
    axes_y: wp.vec3d
    center: wp.vec2d
    xx: wp.float64
    xy: wp.float64
    yy: wp.float64
    det: wp.float64
    l1: wp.float64
    k: wp.float64
    l2: wp.float64
    minors: wp.vec3d
    share: wp.float64


@wp.func
def _axis(pose: wp.mat44d, row: int) -> wp.vec3d:
    return wp.vec3d(pose[row, 0], pose[row, 1], pose[row, 2])


@wp.func
def _shift(pose: wp.mat44d) -> wp.vec3d:
    return wp.vec3d(pose[0, 3], pose[1, 3], pose[2, 3])


@wp.func
def _turned(pose: wp.mat44d, vector: wp.vec3d) -> wp.vec3d:
    """From the world to the camera's axes."""
    return wp.vec3d(wp.dot(_axis(pose, 0), vector), wp.dot(_axis(pose, 1), vector), wp.dot(_axis(pose, 2), vector))


@wp.func
def _turned_back(pose: wp.mat44d, vector: wp.vec3d) -> wp.vec3d:
    return vector[0] * _axis(pose, 0) + vector[1] * _axis(pose, 1) + vector[2] * _axis(pose, 2)


@wp.func
def _to_screen(mean: wp.vec3d, quat: wp.vec4d, scale: wp.vec3d, pose: wp.mat44d, lens: Lens) -> _Screen:
    """Garbage, possibly not finite, of a splat in the camera's plane."""
    s = _Screen()
    s.local = _turned(pose, mean) + _shift(pose)
    x, y, z = s.local[0], s.local[1], s.local[2]
    if lens.orthographic:
        s.j00 = lens.fx
        s.j11 = lens.fy
        s.center = wp.vec2d(lens.fx * x + lens.cx, lens.fy * y + lens.cy)
    else:
        s.slopes = wp.vec2d(wp.clamp(x / z, lens.left, lens.right), wp.clamp(y / z, lens.top, lens.bottom))
        s.held_x = s.slopes[0] != x / z
        s.held_y = s.slopes[1] != y / z
        s.j00 = lens.fx / z
        s.j02 = -lens.fx * s.slopes[0] / z
        s.j11 = lens.fy / z
        s.j12 = -lens.fy * s.slopes[1] / z
        s.center = wp.vec2d(lens.fx * x / z + lens.cx, lens.fy * y / z + lens.cy)
    s.jw_x = s.j00 * _axis(pose, 0) + s.j02 * _axis(pose, 2)
    s.jw_y = s.j11 * _axis(pose, 1) + s.j12 * _axis(pose, 2)
    s.turn = turn_of(quat)
    s.axes_x = wp.transpose(s.turn.matrix) * s.jw_x
    s.axes_y = wp.transpose(s.turn.matrix) * s.jw_y
    spread_x, spread_y = wp.cw_mul(s.axes_x, scale), wp.cw_mul(s.axes_y, scale)
    s.xx = wp.dot(spread_x, spread_x) + lens.low_pass
    s.yy = wp.dot(spread_y, spread_y) + lens.low_pass
    s.xy = wp.dot(spread_x, spread_y)
    # det(M Mᵀ + εI) by Cauchy-Binet: a sum of squares, where xx·yy − xy² of a needle is lost to rounding.
    areas = wp.vec3d(scale[1] * scale[2], scale[0] * scale[2], scale[0] * scale[1])
    s.minors = wp.cw_mul(wp.cross(s.axes_x, s.axes_y), areas)
    narrow = wp.dot(s.minors, s.minors)
    s.det = narrow + lens.low_pass * (s.xx + s.yy - lens.low_pass)
    s.share = wp.where(lens.mip_filter, wp.sqrt(narrow / s.det), ONE)
    s.l1 = wp.sqrt(s.yy / s.det)
    s.k = -s.l1 * s.xy / s.yy
    s.l2 = ONE / wp.sqrt(s.yy)
    return s


@wp.func
def _is_on_screen(s: _Screen) -> bool:
    """Whether all numbers are finite."""
    factors, covariance = wp.vec3d(s.l1, s.k, s.l2), wp.vec4d(s.xx, s.xy, s.yy, s.det)
    return wp.isfinite(s.center) and wp.isfinite(factors) and wp.isfinite(covariance)


@wp.func
def _meets(center: wp.float64, half: wp.float64, size: wp.float64) -> bool:
    """Whether a pixel centre of 0..size lies within `half` of `center`."""
    first = wp.max(wp.ceil(center - half - _HALF), ZERO)
    return first <= wp.min(wp.floor(center + half - _HALF), size - ONE)


@wp.func
def _seen_from(mean: wp.vec3d, pose: wp.mat44d, lens: Lens) -> wp.vec3d:
    """From the camera to a splat, not normalised; the camera's axis in an orthographic view."""
    way = _axis(pose, 2)
    if not lens.orthographic:
        # Wᵀ·shift is the camera's place with the other sign.
        way = mean + _turned_back(pose, _shift(pose))
    return way


@wp.func
def _unclipped(basis: Basis, sh: wp.array2d(dtype=wp.vec3), i: int, bands: int) -> wp.vec3:
    color = wp.vec3(0.5, 0.5, 0.5)
    for band in range(bands):
        color += basis[band] * sh[i, band]
    return color


@wp.kernel(enable_backward=False)
def _project(
    means: wp.array(dtype=wp.vec3d),
    quats: wp.array(dtype=wp.vec4d),
    scales: wp.array(dtype=wp.vec3d),
    opacities: wp.array(dtype=wp.float64),
    sh: wp.array2d(dtype=wp.vec3),
    poses: wp.array(dtype=wp.mat44d),
    bands: int,
    lens: Lens,
    depths: wp.array(dtype=wp.float64),
    reach: wp.array(dtype=wp.float64),
    visible: wp.array(dtype=wp.bool),
    radii: wp.array(dtype=wp.float32),
    centers: wp.array(dtype=wp.vec2d),
    factors: wp.array(dtype=wp.vec3d),
    wholes: wp.array(dtype=wp.vec2i),
    rests: wp.array(dtype=wp.vec2),
    shapes: wp.array(dtype=wp.vec4),
    features: wp.array(dtype=wp.vec4),
):
    i = wp.tid()
    depths[i] = _INFINITE
    reach[i] = ZERO
    visible[i] = False
    radii[i] = wp.float32(0.0)
    mean, quat, scale, pose = means[i], quats[i], scales[i], poses[0]
    finite = wp.isfinite(mean) and wp.isfinite(quat) and wp.isfinite(scale) and wp.isfinite(opacities[i])
    for band in range(bands):
        finite = finite and wp.isfinite(sh[i, band])
    if not (finite and opacities[i] >= _ALPHA_MIN):
        return
    s = _to_screen(mean, quat, scale, pose, lens)
    z, opacity = s.local[2], s.share * opacities[i]
    if not (z > lens.near and _is_on_screen(s) and opacity >= _ALPHA_MIN):
        return
    far = wp.sqrt(TWO * wp.log(opacity / _ALPHA_MIN))
    if _meets(s.center[0], far * wp.sqrt(s.xx), lens.width) and _meets(s.center[1], far * wp.sqrt(s.yy), lens.height):
        apart = _HALF * (s.xx - s.yy)
        longest = _HALF * (s.xx + s.yy) + wp.sqrt(apart * apart + s.xy * s.xy)
        visible[i] = True
        radii[i] = wp.float32(wp.min(_THREE * wp.sqrt(longest), _LARGEST))
    way = _seen_from(mean, pose, lens)
    direction = wp.vec3(way / wp.max(wp.length(way), _QUAT_MIN))
    color = _unclipped(basis_of(direction), sh, i, bands)
    shape = wp.vec4(wp.float32(s.l1), wp.float32(s.k), wp.float32(s.l2), wp.float32(opacity))
    feature = wp.vec4(wp.max(color[0], 0.0), wp.max(color[1], 0.0), wp.max(color[2], 0.0), wp.float32(z))
    # What float32 cannot hold is not drawn.
    if not (wp.isfinite(shape) and wp.isfinite(feature) and wp.isfinite(color)):
        return
    depths[i] = z
    centers[i] = s.center
    factors[i] = wp.vec3d(s.l1, s.k, s.l2)
    reach[i] = far + _SLACK
    # Pixel (row i, column j) has its centre at j + 0.5.
    place = s.center - wp.vec2d(_HALF, _HALF)
    whole = nearest_pixel(place)
    wholes[i] = whole
    rests[i] = rest_of(place, whole)
    shapes[i] = shape
    features[i] = feature


@wp.struct
class _ToShape:
    """∂L/∂ a splat's scale, and by the two rows of J W R: axes_x and axes_y."""

    scale: wp.vec3d
    axes_x: wp.vec3d
    axes_y: wp.vec3d


@wp.func
def _shape_backward(s: _Screen, scale: wp.vec3d, lens: Lens, sums: Sums64) -> _ToShape:
    """From H = Σ h (p, q)(p, q)ᵀ, which is 2 B⁻ᵀ ∂L/∂Σ' B⁻¹.

    Of the columns of M = axes · diag(scale), ∂L/∂M = 2 ∂L/∂Σ' M = Bᵀ H (B M), and B M has entries of 1 at most. The
    first row of B · axes, l1·axes_x + k·axes_y, as a cross product: of a long needle the difference has no digits.

    The logarithm of the share, log ‖m‖ − ½ log |Σ'| with m = X × Y of the rows of M, has Σh as its gradient: the second
    term takes Σh off H's diagonal, the first is Y × m / ‖m‖² by X and m × X / ‖m‖² by Y. What is drawn has an ‖m‖ of a
    255th of √|Σ'| and more.
    """
    lever = wp.cross(wp.cw_mul(wp.cw_mul(scale, scale), s.axes_y), wp.cross(s.axes_x, s.axes_y))
    first, second = s.l1 / s.yy * (lens.low_pass * s.axes_x + lever), s.l2 * s.axes_y
    to_share = wp.where(lens.mip_filter, sums[0], ZERO)
    third = wp.cw_mul((sums[3] - to_share) * first + sums[4] * second, scale)
    fourth = wp.cw_mul(sums[4] * first + (sums[5] - to_share) * second, scale)
    spread_x, spread_y = s.l1 * third, s.k * third + s.l2 * fourth
    to = _ToShape()
    to.scale = wp.cw_mul(third, first) + wp.cw_mul(fourth, second)
    if lens.mip_filter:
        over = to_share / wp.dot(s.minors, s.minors) * s.minors
        narrow_x = wp.cross(wp.cw_mul(s.axes_y, scale), over)
        narrow_y = wp.cross(over, wp.cw_mul(s.axes_x, scale))
        to.scale += wp.cw_mul(narrow_x, s.axes_x) + wp.cw_mul(narrow_y, s.axes_y)
        spread_x += narrow_x
        spread_y += narrow_y
    to.axes_x = wp.cw_mul(spread_x, scale)
    to.axes_y = wp.cw_mul(spread_y, scale)
    return to


@wp.func
def _local_backward(
    s: _Screen, pose: wp.mat44d, lens: Lens, to_center: wp.vec2d, to_jw_x: wp.vec3d, to_jw_y: wp.vec3d, to_z: wp.float64
) -> wp.vec3d:
    """∂L/∂ the place in the camera frame: by the centre, by the Jacobian, and `to_z` by the depth image."""
    to_slope_x, to_slope_y = lens.fx * to_center[0], lens.fy * to_center[1]
    if lens.orthographic:
        return wp.vec3d(to_slope_x, to_slope_y, to_z)
    to_j00, to_j02 = wp.dot(to_jw_x, _axis(pose, 0)), wp.dot(to_jw_x, _axis(pose, 2))
    to_j11, to_j12 = wp.dot(to_jw_y, _axis(pose, 1)), wp.dot(to_jw_y, _axis(pose, 2))
    if not s.held_x:
        to_slope_x -= s.j00 * to_j02
    if not s.held_y:
        to_slope_y -= s.j11 * to_j12
    inverse = ONE / s.local[2]
    to_inverse = (
        lens.fx * (to_j00 - s.slopes[0] * to_j02)
        + lens.fy * (to_j11 - s.slopes[1] * to_j12)
        + to_slope_x * s.local[0]
        + to_slope_y * s.local[1]
    )
    return wp.vec3d(to_slope_x * inverse, to_slope_y * inverse, to_z - inverse * inverse * to_inverse)


@wp.func
def _color_backward(
    way: wp.vec3d, sh: wp.array2d(dtype=wp.vec3), i: int, bands: int, sums: Sums64, to_sh: wp.array2d(dtype=wp.vec3)
) -> wp.vec3d:
    """Writes ∂L/∂sh of the `bands` in use; returns ∂L/∂`way`, of `_seen_from`. What is clipped at 0 has no gradient."""
    length = wp.max(wp.length(way), _QUAT_MIN)
    unit = way / length
    basis = basis_of(wp.vec3(unit))
    color = _unclipped(basis, sh, i, bands)
    to_color = wp.vec3()
    for channel in range(3):
        if color[channel] >= 0.0:
            to_color[channel] = wp.float32(sums[6 + channel])
    to_basis = Basis()
    for band in range(bands):
        to_basis[band] = wp.dot(sh[i, band], to_color)
        to_sh[i, band] = basis[band] * to_color
    to_unit = wp.vec3d(basis_backward(wp.vec3(unit), to_basis))
    return (to_unit - wp.dot(unit, to_unit) * unit) / length


@wp.kernel(enable_backward=False)
def _project_backward(
    means: wp.array(dtype=wp.vec3d),
    quats: wp.array(dtype=wp.vec4d),
    scales: wp.array(dtype=wp.vec3d),
    opacities: wp.array(dtype=wp.float64),
    sh: wp.array2d(dtype=wp.vec3),
    poses: wp.array(dtype=wp.mat44d),
    bands: int,
    lens: Lens,
    order: wp.array(dtype=wp.int64),
    slot_starts: wp.array(dtype=wp.int64),
    totals: wp.array(dtype=Sums64),
    to_means: wp.array(dtype=wp.vec3d),
    to_quats: wp.array(dtype=wp.vec4d),
    to_scales: wp.array(dtype=wp.vec3d),
    to_opacities: wp.array(dtype=wp.float64),
    to_sh: wp.array2d(dtype=wp.vec3),
    to_centers: wp.array(dtype=wp.vec2),
    to_poses: wp.array(dtype=_PoseRows),
):
    """Gradients of all splats, those that no tile has included, from the pixel sums `totals` of the ones in `order`.

    With h = ∂L/∂(log α) and (p, q) = B·(pixel − center), ∂L/∂center = Bᵀ Σ h(p, q) and
    ∂L/∂Σ' = ½ Bᵀ (Σ h (p, q)(p, q)ᵀ) B: no inverse, no determinant. `to_poses` may be empty.
    """
    place = wp.tid()
    i = int(order[place])
    seen = slot_starts[place] < slot_starts[place + 1]
    used = wp.where(seen, bands, 0)
    for band in range(used, sh.shape[1]):
        to_sh[i, band] = wp.vec3()
    if not seen:
        to_means[i] = wp.vec3d()
        to_quats[i] = wp.vec4d()
        to_scales[i] = wp.vec3d()
        to_opacities[i] = ZERO
        to_centers[i] = wp.vec2()
        if to_poses.shape[0] > 0:
            to_poses[i] = _PoseRows()
        return
    mean, scale, pose, sums = means[i], scales[i], poses[0], totals[place]
    s = _to_screen(mean, quats[i], scale, pose, lens)
    to_opacities[i] = sums[0] / opacities[i]
    to_center = wp.vec2d(s.l1 * sums[1], s.k * sums[1] + s.l2 * sums[2])
    to_centers[i] = wp.vec2(to_center)
    to_shape = _shape_backward(s, scale, lens, sums)
    to_scales[i] = to_shape.scale
    to_quats[i] = quat_backward(s.turn, wp.outer(s.jw_x, to_shape.axes_x) + wp.outer(s.jw_y, to_shape.axes_y))
    to_jw_x, to_jw_y = s.turn.matrix * to_shape.axes_x, s.turn.matrix * to_shape.axes_y
    to_local = _local_backward(s, pose, lens, to_center, to_jw_x, to_jw_y, sums[9])
    to_mean = _turned_back(pose, to_local)
    row_x, row_y = to_local[0] * mean + s.j00 * to_jw_x, to_local[1] * mean + s.j11 * to_jw_y
    row_z = to_local[2] * mean + s.j02 * to_jw_x + s.j12 * to_jw_y
    to_way = _color_backward(_seen_from(mean, pose, lens), sh, i, bands, sums, to_sh)
    shift = to_local
    if lens.orthographic:
        row_z += to_way
    else:
        to_mean += to_way
        row_x += pose[0, 3] * to_way
        row_y += pose[1, 3] * to_way
        row_z += pose[2, 3] * to_way
        shift += _turned(pose, to_way)
    to_means[i] = to_mean
    if to_poses.shape[0] > 0:
        to_poses[i] = _PoseRows(
            row_x[0], row_x[1], row_x[2], shift[0],
            row_y[0], row_y[1], row_y[2], shift[1],
            row_z[0], row_z[1], row_z[2], shift[2],
        )  # fmt: skip
