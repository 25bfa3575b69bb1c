"""From splats to the few numbers a pixel of a radiograph needs and back, a thread a splat, in float64.

As in `kernels.cpu.radiograph_geometry`: with z = (j − j₀, i − i₀, 1) measured from where the centre projects to, a
pixel's line integral is amplitude · den^(−1/2) · exp(−½·num/den), num = ‖P z‖², den = ‖E z‖² (1 unless the beam is
a cone). P = κ·Q·G with an orthonormal basis Q of the plane that G's columns lie in, and E is R, its triangular factor,
as far as pixels can tell. The pixel (j₀, i₀), Q, R and a cone beam's κ only say how the numbers are written, so no
gradient goes through them.
"""

from __future__ import annotations

from typing import Any

import warp as wp
from torch import Tensor

from ..reference.radiograph import NEAREST_AFFINE_DEPTH, SQRT_2PI
from .blocks import launch_threads, view
from .linear import plane_basis, quadratic_range, triangular
from .pixels import OnImage, drawn_in, nearest_pixel, pixel_range, rest_of
from .radiograph_raster import Row, Sums64
from .rotations import ONE, TWO, ZERO
from .whitening import White, scales_backward, white_backward, white_of

CONE, PARALLEL, AFFINE = range(3)

_HALF, _FAR, _MARGIN = (wp.constant(wp.float64(number)) for number in (0.5, 2.5, 100.0))
_INFINITE, _SQRT_2PI = wp.constant(wp.float64(wp.inf)), wp.constant(wp.float64(SQRT_2PI))
_LARGEST_T = wp.constant(wp.float64(1.0 / NEAREST_AFFINE_DEPTH))

_Vectors = wp.types.matrix(shape=(4, 3), dtype=wp.float64)


@wp.struct
class Beam:
    """A detector without its vectors: kind CONE, PARALLEL or AFFINE, pixels, and the cutoff in standard deviations.

    keep_empty: whether splats without density are kept, for its gradient.
    """

    kind: wp.int32
    width: wp.float64
    height: wp.float64
    cutoff: wp.float64
    keep_empty: wp.bool


def project(parameters: tuple[Tensor, ...], beam: Any) -> OnImage:
    """Splats that cannot be drawn are left out, and those without density unless the beam keeps them for its gradient.

    Args:
        parameters: means (N, 3), quats (N, 4), scales (N, 3), density (N,) and the detector's vectors (4, 3): source
            (unit direction of a parallel beam), center, u and v; all float64.
        beam: `Beam`.
    """
    count, device = len(parameters[0]), parameters[0].device
    rays = OnImage.unset(count, Row, device)
    outputs = [view(rays.boxes, wp.vec4i), *rays.of_pixels(Row)]
    launch_threads(_project, count, [*_views(parameters), beam, *outputs], device)
    return rays


def project_backward(
    parameters: tuple[Tensor, ...], beam: Any, slot_starts: Tensor, totals: Tensor, want_vectors: bool
) -> list[Tensor]:
    """Gradients of the `parameters` of `project`, of the detector's vectors only if wanted.

    Args:
        slot_starts: of `tiles.Tiles`.
        totals: (N, SUMS) float64 sums over pixels; see `radiograph_raster`.
    """
    gradients = [parameter.new_empty(parameter.shape) for parameter in parameters[:4]]
    count = len(totals)
    # A row for each splat, summed up by torch: the same bits every time.
    rows = totals.new_empty(count if want_vectors else 0, 4, 3)
    inputs = [*_views(parameters), beam, view(slot_starts), view(totals, Sums64)]
    outputs = [*_views((*gradients, rows))]
    launch_threads(_project_backward, count, [*inputs, *outputs], totals.device)
    return [*gradients, rows.sum(0)] if want_vectors else gradients


def _views(parameters: tuple[Tensor, ...]) -> list[Any]:
    """Warp arrays of means, quats, scales, density and vectors, which may be of many splats."""
    *of_splats, vectors = parameters
    arrays = [
        view(tensor, dtype) for tensor, dtype in zip(of_splats, (wp.vec3d, wp.vec4d, wp.vec3d, None), strict=True)
    ]
    return [*arrays, view(vectors.reshape(-1, 4, 3), _Vectors)]


@wp.struct
class _Ray:
    """Where a splat stands in the beam.

    right, down: what it projects to, in steps along u and v from the detector's middle. away: from the source, or of a
    parallel beam from the detector's middle, to the splat. base: from the source to that place on the detector, or of
    a parallel beam from that place to the splat. axis: W·away, or W·direction. e_u, e_v, e_0: W times u, v and base,
    of a parallel beam W times −u, −v and base. g_u, g_v, g_0: their cross products with the axis. q_1, q_2: basis of
    these. kappa: κ. depth, t: distance from the source along u × v, and the detector's in units of that.
    """

    right: wp.float64
    down: wp.float64
    away: wp.vec3d
    base: wp.vec3d
    axis: wp.vec3d
    e_u: wp.vec3d
    e_v: wp.vec3d
    e_0: wp.vec3d
    g_u: wp.vec3d
    g_v: wp.vec3d
    g_0: wp.vec3d
    q_1: wp.vec3d
    q_2: wp.vec3d
    kappa: wp.float64
    depth: wp.float64
    t: wp.float64


@wp.func
def _row(vectors: _Vectors, row: int) -> wp.vec3d:
    return wp.vec3d(vectors[row, 0], vectors[row, 1], vectors[row, 2])


@wp.func
def _ray_of(mean: wp.vec3d, white: White, vectors: _Vectors, beam: Beam) -> _Ray:
    ray = _Ray()
    source, center, u, v = _row(vectors, 0), _row(vectors, 1), _row(vectors, 2), _row(vectors, 3)
    normal, to_center = wp.cross(u, v), center - source
    on_plane = wp.vec3d()
    if beam.kind == PARALLEL:
        ray.away = mean - center
        on_plane = ray.away - wp.dot(ray.away, normal) / wp.dot(source, normal) * source
    else:
        ray.away = mean - source
        ray.depth = wp.dot(ray.away, normal)
        ray.t = wp.dot(to_center, normal) / ray.depth
        on_plane = ray.t * ray.away - to_center
    ray.right = wp.dot(on_plane, wp.cross(v, normal)) / wp.dot(normal, normal)
    ray.down = wp.dot(on_plane, wp.cross(normal, u)) / wp.dot(normal, normal)
    far_x, far_y = _FAR * beam.width, _FAR * beam.height
    inside = wp.abs(ray.right) <= far_x + _MARGIN and wp.abs(ray.down) <= far_y + _MARGIN
    if not inside:
        # Further than two image sizes off: there what is not 0 at the reference is far from cancelling.
        ray.right = drawn_in(ray.right, -far_x, far_x)
        ray.down = drawn_in(ray.down, -far_y, far_y)
    aside = ray.right * u + ray.down * v
    size = ZERO
    if beam.kind == PARALLEL:
        ray.base = ray.away - aside
        ray.axis = white.matrix * source
        ray.e_u = -(white.matrix * u)
        ray.e_v = -(white.matrix * v)
        ray.e_0 = white.matrix * ray.base
        ray.g_u = wp.cross(ray.e_u, ray.axis)
        ray.g_v = wp.cross(ray.e_v, ray.axis)
        ray.g_0 = wp.cross(ray.e_0, ray.axis)
        size = wp.length(ray.axis)
    else:
        ray.base = to_center + aside
        ray.axis = white.matrix * ray.away
        ray.e_u = white.matrix * u
        ray.e_v = white.matrix * v
        ray.e_0 = white.matrix * ray.base
        ray.g_u = wp.cross(ray.axis, ray.e_u)
        ray.g_v = wp.cross(ray.axis, ray.e_v)
        ray.g_0 = wp.cross(ray.axis, ray.e_0)
        if beam.kind == CONE:
            size = wp.length(ray.e_0)
        else:
            size = ray.t * wp.length(ray.axis)
    if inside:
        # At the projected centre what is left of the cross product is rounding, but its gradient is not.
        ray.g_0 = wp.vec3d()
    ray.kappa = ONE
    if size > ZERO:
        ray.kappa = ONE / size
    basis = plane_basis(ray.g_u, ray.g_v, ray.axis)
    ray.q_1 = basis.q_1
    ray.q_2 = basis.q_2
    return ray


@wp.func
def _bounds(ray: _Ray, along: wp.vec3d, across: wp.vec3d, beam: Beam) -> wp.vec2d:
    """Interval of j − j₀ (or i − i₀, with the two exchanged) outside of which no ray comes within the cutoff; exact.

    The rays of one pixel column span a plane with normal n(j) = a + j·b; its distance from the whitened centre is
    |α + β·j| / ‖n(j)‖. An ellipsoid that meets the plane through the source parallel to the detector is seen
    everywhere.
    """
    a, b = wp.cross(ray.e_0, across), wp.cross(along, across)
    beta = wp.dot(ray.axis, b)
    if beam.kind == PARALLEL:
        a = wp.cross(ray.axis, across)
        b = wp.vec3d()
        beta = wp.dot(along, a)
    # In this order α is exactly 0 where the reference is the projected centre.
    alpha, square = wp.dot(ray.g_0, across), beam.cutoff * beam.cutoff
    return quadratic_range(
        beta * beta - square * wp.dot(b, b),
        alpha * beta - square * wp.dot(a, b),
        alpha * alpha - square * wp.dot(a, a),
    )


@wp.kernel(enable_backward=False)
def _project(
    means: wp.array(dtype=wp.vec3d),
    quats: wp.array(dtype=wp.vec4d),
    scales: wp.array(dtype=wp.vec3d),
    density: wp.array(dtype=wp.float64),
    vectors: wp.array(dtype=_Vectors),
    beam: Beam,
    boxes: wp.array(dtype=wp.vec4i),
    wholes: wp.array(dtype=wp.vec2i),
    rests: wp.array(dtype=wp.vec2),
    rows: wp.array(dtype=Row),
):
    i = wp.tid()
    boxes[i] = wp.vec4i(0, 0, 0, 0)
    mean, quat, scale, amount = means[i], quats[i], scales[i], density[i]
    finite = wp.isfinite(mean) and wp.isfinite(quat) and wp.isfinite(amount)
    if not finite or wp.isnan(scale) or (amount == ZERO and not beam.keep_empty):
        return
    ray = _ray_of(mean, white_of(quat, scale), vectors[0], beam)
    if beam.kind == AFFINE and not (ray.t > ZERO and ray.t < _LARGEST_T):
        return
    p11, p12, p13 = (
        ray.kappa * wp.dot(ray.q_1, ray.g_u),
        ray.kappa * wp.dot(ray.q_1, ray.g_v),
        ray.kappa * wp.dot(ray.q_1, ray.g_0),
    )
    p22, p23 = ray.kappa * wp.dot(ray.q_2, ray.g_v), ray.kappa * wp.dot(ray.q_2, ray.g_0)
    amplitude = _SQRT_2PI * amount * ray.kappa
    across, downward = wp.vec2d(-_INFINITE, _INFINITE), wp.vec2d(-_INFINITE, _INFINITE)
    row = Row()
    row[10] = wp.float32(1.0)
    if beam.kind == AFFINE:
        amplitude *= wp.length(ray.away) * ray.t
        # The ellipse ‖P z‖ ≤ cutoff; one without an end is seen everywhere.
        area = wp.abs(p11 * p22)
        if area > ZERO:
            y = -p23 / p22
            x = -(p13 + p12 * y) / p11
            half_x, half_y = beam.cutoff * wp.sqrt(p12 * p12 + p22 * p22) / area, beam.cutoff * wp.abs(p11) / area
            across = wp.vec2d(x - half_x, x + half_x)
            downward = wp.vec2d(y - half_y, y + half_y)
    else:
        across = _bounds(ray, ray.e_u, ray.e_v, beam)
        downward = _bounds(ray, ray.e_v, ray.e_u, beam)
        if beam.kind == CONE:
            r = triangular(ray.kappa * ray.e_u, ray.kappa * ray.e_v, ray.kappa * ray.e_0)
            row[5] = wp.float32(r.r11)
            row[6] = wp.float32(r.r12)
            row[7] = wp.float32(r.r13)
            row[8] = wp.float32(r.r22)
            row[9] = wp.float32(r.r23)
            row[10] = wp.float32(r.r33)
    row[0] = wp.float32(p11)
    row[1] = wp.float32(p12)
    row[2] = wp.float32(p13)
    row[3] = wp.float32(p22)
    row[4] = wp.float32(p23)
    row[11] = wp.float32(amplitude)
    rows[i] = row
    place = wp.vec2d(ray.right + _HALF * beam.width - _HALF, ray.down + _HALF * beam.height - _HALF)
    whole = nearest_pixel(place)
    wholes[i] = whole
    rests[i] = rest_of(place, whole)
    columns = pixel_range(across[0] + place[0], across[1] + place[0], beam.width)
    lines = pixel_range(downward[0] + place[1], downward[1] + place[1], beam.height)
    boxes[i] = wp.vec4i(columns[0], columns[1], lines[0], lines[1])


@wp.struct
class _ToInputs:
    """∂L/∂W (`white`), ∂L/∂mean, and ∂L/∂ the detector's vectors."""

    white: wp.mat33d
    mean: wp.vec3d
    source: wp.vec3d
    center: wp.vec3d
    u: wp.vec3d
    v: wp.vec3d


@wp.func
def _parallel_backward(
    ray: _Ray, matrix: wp.mat33d, vectors: _Vectors, to_g_u: wp.vec3d, to_g_v: wp.vec3d, to_g_0: wp.vec3d, sums: Sums64
) -> _ToInputs:
    """From ∂L/∂ the columns of G; `matrix` is W, `sums` those over pixels. Of a parallel beam."""
    back, source, u, v = wp.transpose(matrix), _row(vectors, 0), _row(vectors, 2), _row(vectors, 3)
    to_e_u, to_e_v = wp.cross(ray.axis, to_g_u), wp.cross(ray.axis, to_g_v)
    to_e_0 = wp.cross(ray.axis, to_g_0)
    to_axis = TWO * ray.kappa * ray.kappa * sums[12] * ray.axis
    to_axis += wp.cross(to_g_u, ray.e_u)
    to_axis += wp.cross(to_g_v, ray.e_v)
    to_axis += wp.cross(to_g_0, ray.e_0)
    to = _ToInputs()
    to.white = wp.outer(to_e_0, ray.base) + wp.outer(to_axis, source) - wp.outer(to_e_u, u) - wp.outer(to_e_v, v)
    to.mean = back * to_e_0
    to.source = back * to_axis
    to.center = -to.mean
    to.u = -ray.right * to.mean - back * to_e_u
    to.v = -ray.down * to.mean - back * to_e_v
    return to


@wp.func
def _central_backward(
    ray: _Ray, matrix: wp.mat33d, vectors: _Vectors, to_g_u: wp.vec3d, to_g_v: wp.vec3d, to_g_0: wp.vec3d, sums: Sums64,
    cone: bool,
) -> _ToInputs:  # fmt: skip
    """As `_parallel_backward`, of a cone beam, or of its affine approximation but for its amplitude."""
    back, u, v = wp.transpose(matrix), _row(vectors, 2), _row(vectors, 3)
    to_e_u, to_e_v = wp.cross(to_g_u, ray.axis), wp.cross(to_g_v, ray.axis)
    to_e_0 = wp.cross(to_g_0, ray.axis)
    to_axis = wp.cross(ray.e_u, to_g_u) + wp.cross(ray.e_v, to_g_v) + wp.cross(ray.e_0, to_g_0)
    if cone:
        square = TWO * ray.kappa * ray.kappa
        to_e_u += square * (sums[7] * ray.e_u + sums[8] * ray.e_v + sums[10] * ray.e_0)
        to_e_v += square * (sums[8] * ray.e_u + sums[9] * ray.e_v + sums[11] * ray.e_0)
        to_e_0 += square * (sums[10] * ray.e_u + sums[11] * ray.e_v + sums[12] * ray.e_0)
    else:
        to_axis += TWO * sums[12] / wp.dot(ray.axis, ray.axis) * ray.axis
    to_base = back * to_e_0
    to = _ToInputs()
    to.white = wp.outer(to_e_u, u) + wp.outer(to_e_v, v) + wp.outer(to_e_0, ray.base) + wp.outer(to_axis, ray.away)
    to.mean = back * to_axis
    to.source = -to.mean - to_base
    to.center = to_base
    to.u = ray.right * to_base + back * to_e_u
    to.v = ray.down * to_base + back * to_e_v
    return to


@wp.func
def _with_amplitude(to: _ToInputs, ray: _Ray, vectors: _Vectors, through: wp.float64, total: wp.float64) -> _ToInputs:
    """`to` of an affine view with what goes through t and the distance from the source, to whose product the amplitude
    is proportional: `through` is ∂L/∂ that product, `total` Σγ."""
    u, v = _row(vectors, 2), _row(vectors, 3)
    normal, distance = wp.cross(u, v), wp.length(ray.away)
    to_t = (TWO * total / ray.t + through * distance) / ray.depth
    change = through * ray.t / distance * ray.away - ray.t * to_t * normal
    to_normal = to_t * (_row(vectors, 1) - _row(vectors, 0) - ray.t * ray.away)
    to.mean += change
    to.source -= change + to_t * normal
    to.center += to_t * normal
    to.u += wp.cross(v, to_normal)
    to.v += wp.cross(to_normal, u)
    return to


@wp.kernel(enable_backward=False)
def _project_backward(
    means: wp.array(dtype=wp.vec3d),
    quats: wp.array(dtype=wp.vec4d),
    scales: wp.array(dtype=wp.vec3d),
    density: wp.array(dtype=wp.float64),
    vectors: wp.array(dtype=_Vectors),
    beam: Beam,
    slot_starts: wp.array(dtype=wp.int64),
    totals: wp.array(dtype=Sums64),
    to_means: wp.array(dtype=wp.vec3d),
    to_quats: wp.array(dtype=wp.vec4d),
    to_scales: wp.array(dtype=wp.vec3d),
    to_density: wp.array(dtype=wp.float64),
    to_vectors: wp.array(dtype=_Vectors),
):
    """From sums over pixels to gradients; zero for splats that no tile has. `to_vectors` may be empty.

    ∂L/∂G = 2·G·Σ(−τ) z zᵀ = −2·κ·Qᵀ·[Στ x z; Στ y z] and ∂L/∂E = 2·κ²·E·Σγ z zᵀ: the triangular factors need no
    derivative of their own. Where den is the same in all pixels only Σγ is read, which holds what goes through κ.
    """
    i = wp.tid()
    if slot_starts[i] == slot_starts[i + 1]:
        to_means[i] = wp.vec3d()
        to_quats[i] = wp.vec4d()
        to_scales[i] = wp.vec3d()
        to_density[i] = ZERO
        if to_vectors.shape[0] > 0:
            to_vectors[i] = _Vectors()
        return
    scale, sums = scales[i], totals[i]
    white = white_of(quats[i], scale)
    ray = _ray_of(means[i], white, vectors[0], beam)
    to_g_u = -TWO * ray.kappa * (sums[1] * ray.q_1 + sums[4] * ray.q_2)
    to_g_v = -TWO * ray.kappa * (sums[2] * ray.q_1 + sums[5] * ray.q_2)
    to_g_0 = -TWO * ray.kappa * (sums[3] * ray.q_1 + sums[6] * ray.q_2)
    peak = _SQRT_2PI * ray.kappa * sums[0]
    to = _ToInputs()
    if beam.kind == PARALLEL:
        to = _parallel_backward(ray, white.matrix, vectors[0], to_g_u, to_g_v, to_g_0, sums)
    else:
        to = _central_backward(ray, white.matrix, vectors[0], to_g_u, to_g_v, to_g_0, sums, beam.kind == CONE)
    if beam.kind == AFFINE:
        to = _with_amplitude(to, ray, vectors[0], density[i] * peak, sums[12])
        peak *= wp.length(ray.away) * ray.t
    to_means[i] = to.mean
    to_quats[i] = white_backward(white, to.white)
    to_scales[i] = scales_backward(white, scale, to.white)
    to_density[i] = peak
    if to_vectors.shape[0] > 0:
        to_vectors[i] = _Vectors(
            to.source[0], to.source[1], to.source[2],
            to.center[0], to.center[1], to.center[2],
            to.u[0], to.u[1], to.u[2],
            to.v[0], to.v[1], to.v[2],
        )  # fmt: skip
