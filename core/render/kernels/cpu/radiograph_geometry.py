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

`radiograph_cone` has the geometry of the exact cone beam, this module that of parallel beams and of the affine form.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, prange

from ....threads import loops_only
from .radiograph_cone import project_cone
from .radiograph_table import AMPLITUDE, BOTTOM, COLUMN0, COLUMNS, LEFT, RIGHT, ROW0, SQRT_2PI, TOP, coefficients
from .vectors import aligned
from .whitening import (
    add_cross,
    add_outer,
    cross,
    dot,
    fill_whitening,
    multiply,
    multiply_transposed,
    pixel_range,
    plane_basis,
    quadratic_range,
    usable,
    whitening_backward,
)

SPLATS_A_TASK = 256
CONE, PARALLEL, AFFINE = 0, 1, 2
LARGEST_AFFINE_T = 100.0

# Rows of the (15, 3) scratch of one splat; the last three are for intermediate vectors.
E_U, E_V, E_0, F_U, F_V, F_0, G_U, G_V, G_0, Q_1, Q_2, AWAY, NORMAL, SIDE, SPARE = range(15)


@njit(error_model="numpy", cache=True, _nrt=False)
def place(mean: Any, view: Any, width: int, height: int, kind: int, g: Any) -> tuple[float, float, float]:
    """Where a centre projects to: steps along u and v from the detector's middle, and t.

    `view` is (4, 3): source or direction, center, u, v. The scratch's AWAY becomes the centre relative to the
    source (affine form) or to the detector's middle (parallel). A place further than two image sizes off the image is
    drawn in to there: the pixel loop then has a G·z that is not 0 at the reference, but is far from cancelling.
    """
    source, center, u, v = view[0], view[1], view[2], view[3]
    away, normal, side, on_plane = g[AWAY], g[NORMAL], g[SIDE], g[SPARE]
    cross(u, v, normal)
    area = dot(normal, normal)
    if kind == PARALLEL:
        for k in range(3):
            away[k] = mean[k] - center[k]
        slope = dot(source, normal)
        t = -dot(away, normal) / slope if slope != 0 else np.inf
        for k in range(3):
            on_plane[k] = away[k] + t * source[k]
    else:
        reach = 0.0
        for k in range(3):
            away[k] = mean[k] - source[k]
            reach += (center[k] - source[k]) * normal[k]
        depth = dot(away, normal)
        t = reach / depth if depth != 0 else np.inf
        for k in range(3):
            on_plane[k] = t * away[k] - (center[k] - source[k])
    cross(v, normal, side)
    right = dot(on_plane, side) / area
    cross(normal, u, side)
    down = dot(on_plane, side) / area
    inside = abs(right) <= 2.5 * width + 100 and abs(down) <= 2.5 * height + 100
    if inside:
        return right, down, t
    right = min(max(right, -2.5 * width), 2.5 * width) if np.isfinite(right) else 0.0
    down = min(max(down, -2.5 * height), 2.5 * height) if np.isfinite(down) else 0.0
    return right, down, t if kind == AFFINE else np.nan


@njit(error_model="numpy", cache=True, _nrt=False)
def fill_columns(whiten: Any, view: Any, right: float, down: float, t: float, kind: int, g: Any) -> float:
    """Fills E, F, G and the basis Q (2, 3) of G's columns in the scratch `g` (15, 3); returns κ.

    `t` is NaN where the reference is not the projected centre (the affine form knows by its own geometry).
    """
    source, center, u, v = view[0], view[1], view[2], view[3]
    base = g[SPARE]
    axis = F_0
    g[:AWAY] = 0.0
    if kind == PARALLEL:
        axis = E_0
        multiply(whiten, source, g[E_0])
        multiply(whiten, u, g[F_U])
        multiply(whiten, v, g[F_V])
        for k in range(3):
            g[F_U, k] = -g[F_U, k]
            g[F_V, k] = -g[F_V, k]
            base[k] = g[AWAY, k] - right * u[k] - down * v[k]
        multiply(whiten, base, g[F_0])
        cross(g[F_U], g[E_0], g[G_U])
        cross(g[F_V], g[E_0], g[G_V])
    else:
        multiply(whiten, g[AWAY], g[F_0])
        multiply(whiten, u, g[E_U])
        multiply(whiten, v, g[E_V])
        for k in range(3):
            base[k] = center[k] + right * u[k] + down * v[k] - source[k]
        multiply(whiten, base, g[E_0])
        cross(g[F_0], g[E_U], g[G_U])
        cross(g[F_0], g[E_V], g[G_V])
    cross(g[F_0], g[E_0], g[G_0])
    size = np.sqrt(dot(g[E_0], g[E_0]))
    if not np.isnan(t) and kind != AFFINE:
        # The reference is the projected centre: what is left of the cross product is rounding.
        g[G_0] = 0.0
    if kind == AFFINE:
        size = t * np.sqrt(dot(g[F_0], g[F_0]))
    plane_basis(g[G_U], g[G_V], g[axis], g[Q_1], g[Q_2])
    return 1.0 / size if size > 0 else 1.0


@njit(error_model="numpy", cache=True, _nrt=False)
def _bounds(g: Any, axis_u: bool, k2: float) -> tuple[float, float]:
    """Interval of (j − j₀), or (i − i₀), outside of which no parallel ray comes within √k2 of the splat; exact.

    The rays of one pixel column span a plane; all of these are parallel, and its distance from the whitened centre is
    |α + β·j| / ‖n‖ with n their normal.
    """
    along, across = (F_U, F_V) if axis_u else (F_V, F_U)
    normal = g[SIDE]
    cross(g[E_0], g[across], normal)
    beta = dot(g[along], normal)
    # α = F₀·(E₀ × across) in this order is exactly 0 where the reference is the projected centre.
    alpha = dot(g[G_0], g[across])
    return quadratic_range(beta * beta, alpha * beta, alpha * alpha - k2 * dot(normal, normal))


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
        first = np.int64(task) * SPLATS_A_TASK
        table[first : first + SPLATS_A_TASK] = 0.0
        if kind == CONE:
            project_cone(
                first, min(count, first + SPLATS_A_TASK), means, quats, scales, density, view, width, height, k2,
                keep_empty, table, boxes,
            )  # fmt: skip
            continue
        unit, whiten, g = np.empty(4), np.empty((3, 3)), np.empty((15, 3))
        for n in range(first, min(count, first + SPLATS_A_TASK)):
            if (density[n] == 0 and not keep_empty) or not usable(means[n], quats[n], scales[n], density[n]):
                continue
            right, down, t = place(means[n], view, width, height, kind, g)
            if kind == AFFINE and not (0 < t < LARGEST_AFFINE_T):
                continue
            fill_whitening(quats[n], scales[n], unit, whiten)
            kappa = fill_columns(whiten, view, right, down, t, kind, g)
            column0, row0 = right - 0.5 + 0.5 * width, down - 0.5 + 0.5 * height
            p = _factor(g, kappa)
            if kind == AFFINE:
                _affine_box(p, column0, row0, width, height, k2, boxes[n])
            else:
                low, high = _bounds(g, True, k2)
                boxes[n, 0], boxes[n, 1] = pixel_range(low + column0, high + column0, width)
                low, high = _bounds(g, False, k2)
                boxes[n, 2], boxes[n, 3] = pixel_range(low + row0, high + row0, height)
            numbers = coefficients(p, (0.0, 0.0, 0.0, 0.0, 0.0, 1.0), k2)
            for k in range(len(numbers)):
                table[n, k] = numbers[k]
            table[n, COLUMN0], table[n, ROW0] = column0, row0
            table[n, LEFT], table[n, RIGHT], table[n, TOP], table[n, BOTTOM] = boxes[n]
            table[n, AMPLITUDE] = SQRT_2PI * density[n] * kappa
            if kind == AFFINE:
                table[n, AMPLITUDE] *= np.sqrt(dot(g[AWAY], g[AWAY])) * t
    return table, boxes


@njit(error_model="numpy", cache=True, _nrt=False)
def _factor(g: Any, kappa: float) -> Any:
    """P's numbers p₁₁, p₁₂, p₁₃, p₂₂, p₂₃."""
    return (
        kappa * dot(g[Q_1], g[G_U]),
        kappa * dot(g[Q_1], g[G_V]),
        kappa * dot(g[Q_1], g[G_0]),
        kappa * dot(g[Q_2], g[G_V]),
        kappa * dot(g[Q_2], g[G_0]),
    )


@njit(error_model="numpy", cache=True, _nrt=False)
def _affine_box(p: Any, column0: float, row0: float, width: int, height: int, k2: float, box: Any) -> None:
    """The box of the ellipse (p₁₁x + p₁₂y + p₁₃)² + (p₂₂y + p₂₃)² ≤ k2."""
    box[1], box[3] = width, height
    p11, p12, p13, p22, p23 = p
    area = abs(p11 * p22)
    if not area > 0:
        return
    k = np.sqrt(k2)
    center_x, center_y = (p12 * p23 / p22 - p13) / p11 + column0, row0 - p23 / p22
    half_x, half_y = k * np.hypot(p12, p22) / area, k * abs(p11) / area
    box[0], box[1] = pixel_range(center_x - half_x, center_x + half_x, width)
    box[2], box[3] = pixel_range(center_y - half_y, center_y + half_y, height)


@njit(error_model="numpy", cache=True, _nrt=False)
def geometry_backward(
    sums: Any,
    mean: Any,
    quat: Any,
    scale: Any,
    density: float,
    view: Any,
    width: int,
    height: int,
    kind: int,
    scratch: Any,
    grad_mean: Any,
    grad_quat: Any,
    grad_scale: Any,
    grad_view: Any,
) -> float:
    """From a splat's sums over pixels to the gradients of its parameters and of the view; returns dL/dρ.

    Of a parallel beam and of the affine form; `radiograph_cone` has the exact cone beam's.

    With h = dL/dvalue, w = value / amplitude and τ = h·value / (2 den), `sums` (13,) holds

    - [0] Σ h·w,
    - [1:4] Στ·x·z and [4:7] Στ·y·z with (x, y) = P z and z = (j − j₀, i − i₀, 1),
    - [7:13] Σγ·(z₀², z₀z₁, z₁², z₀, z₁, 1) with γ = τ·(num/den − 1) = dL/dden.

    dL/dG = 2·G·Σ(−τ) z zᵀ = −2·Q·[Στ x z; Στ y z]: the triangular factors need no derivative of their own.
    """
    unit, whiten, g, d_g, d_e, d_f, d_whiten, base, side = scratch
    right, down, t = place(mean, view, width, height, kind, g)
    length = fill_whitening(quat, scale, unit, whiten)
    kappa = fill_columns(whiten, view, right, down, t, kind, g)
    source, center, u, v = view[0], view[1], view[2], view[3]
    for k in range(3):
        for c in range(3):
            d_g[k, c] = -2 * kappa * (g[Q_1, c] * sums[1 + k] + g[Q_2, c] * sums[4 + k])
    d_e[:] = 0.0
    d_f[:] = 0.0
    d_whiten[:] = 0.0
    grad_view[:] = 0.0
    grad_mean[:] = 0.0
    grad_density = SQRT_2PI * kappa * sums[0]
    if kind == PARALLEL:
        for c in range(3):
            d_e[2, c] = 2 * kappa * kappa * sums[12] * g[E_0, c]
            base[c] = g[AWAY, c] - right * u[c] - down * v[c]
        for k in range(3):
            cross(g[E_0], d_g[k], d_f[k])
            add_cross(d_g[k], g[F_U + k], d_e[2])
        for c in range(3):
            for k in range(3):
                d_whiten[c, k] = -d_f[0, c] * u[k] - d_f[1, c] * v[k] + d_f[2, c] * base[k] + d_e[2, c] * source[k]
        multiply_transposed(whiten, d_e[2], grad_view[0])
        multiply_transposed(whiten, d_f[2], grad_mean)
        multiply_transposed(whiten, d_f[0], grad_view[2])
        multiply_transposed(whiten, d_f[1], grad_view[3])
        for c in range(3):
            grad_view[1, c] = -grad_mean[c]
            grad_view[2, c] = -grad_view[2, c] - right * grad_mean[c]
            grad_view[3, c] = -grad_view[3, c] - down * grad_mean[c]
        whitening_backward(scale, unit, length, whiten, d_whiten, grad_quat, grad_scale)
        return grad_density
    for k in range(3):
        add_cross(g[E_U + k], d_g[k], d_f[2])
        add_cross(d_g[k], g[F_0], d_e[k])
    grad_density = _affine_backward(sums, density, kappa, t, view, g, d_f[2], base, grad_mean, grad_view)
    multiply_transposed(whiten, d_f[2], side)
    for c in range(3):
        grad_mean[c] += side[c]
        grad_view[0, c] -= side[c]
        base[c] = center[c] + right * u[c] + down * v[c] - source[c]
    add_outer(d_whiten, d_e[0], u)
    add_outer(d_whiten, d_e[1], v)
    add_outer(d_whiten, d_e[2], base)
    add_outer(d_whiten, d_f[2], g[AWAY])
    multiply_transposed(whiten, d_e[2], side)
    for c in range(3):
        grad_view[0, c] -= side[c]
        grad_view[1, c] += side[c]
        grad_view[2, c] += right * side[c]
        grad_view[3, c] += down * side[c]
    for k in range(2):
        multiply_transposed(whiten, d_e[k], side)
        for c in range(3):
            grad_view[2 + k, c] += side[c]
    whitening_backward(scale, unit, length, whiten, d_whiten, grad_quat, grad_scale)
    return grad_density


@njit(error_model="numpy", cache=True, _nrt=False)
def _affine_backward(
    sums: Any,
    density: float,
    kappa: float,
    t: float,
    view: Any,
    g: Any,
    d_f: Any,
    base: Any,
    grad_mean: Any,
    grad_view: Any,
) -> float:
    """The part of the affine form that goes through t, ‖f‖ and ‖μ − s‖; returns dL/dρ."""
    source, center, u, v = view[0], view[1], view[2], view[3]
    away = g[AWAY]
    distance = np.sqrt(dot(away, away))
    square = dot(g[F_0], g[F_0])
    peak = SQRT_2PI * kappa * sums[0]
    d_t = 2 * sums[12] / t + density * peak * distance
    normal = g[NORMAL]
    depth = dot(away, normal)
    for c in range(3):
        d_f[c] += 2 * sums[12] * g[F_0, c] / square
        through_t = d_t / depth * normal[c]
        change = density * peak * t * away[c] / distance - t * through_t
        grad_mean[c] += change
        grad_view[0, c] -= change + through_t
        grad_view[1, c] += through_t
        base[c] = (center[c] - source[c] - t * away[c]) * d_t / depth
    add_cross(v, base, grad_view[2])
    add_cross(base, u, grad_view[3])
    return peak * distance * t
