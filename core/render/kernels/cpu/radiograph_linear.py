"""The geometry of `radiograph_geometry` where den is the same in all pixels: parallel beams and the affine form.

In the style of `radiograph_lanes`: LLVM carries out the loops over splats several splats at a time.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ....compiled import njit
from .math import cross, dot
from .radiograph_cone import cone, through_columns, to_cone
from .radiograph_lanes import (
    BATCH,
    DENSITY,
    MEAN,
    SCALE,
    SUMS_AT,
    choose,
    combine,
    drawn_in,
    factor,
    plane_basis,
    put_gradients,
    put_rows,
    quaternion,
    three,
    to_cross_products,
    turned,
    turned_back,
    view_of,
    whitening,
    within,
)
from .radiograph_table import SQRT_2PI, coefficients

LARGEST_AFFINE_T = 100.0
# R, scaled such that den is 1.
_ONE_DEN = (0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


class Beam(NamedTuple):
    """Where a splat stands in a parallel beam.

    Attributes:
        right, down: what it projects to, in steps along u and v from the detector's middle; drawn in where that is
            further than two image sizes off the image.
        base: from that place to the splat.
        e, f_u, f_v, f_0, g_u, g_v, g_0: column of E that is not 0, columns of F and G.
        kappa: κ.
        q_1, q_2: basis of G's columns.
    """

    right: Any
    down: Any
    base: Any
    e: Any
    f_u: Any
    f_v: Any
    f_0: Any
    g_u: Any
    g_v: Any
    g_0: Any
    kappa: Any
    q_1: Any
    q_2: Any


@njit(error_model="numpy", _nrt=False, forceinline=True)
def beam(mean: Any, rows: Any, view: Any, width: Any, height: Any) -> Any:
    """`Beam` of a splat with W's rows; `view` is direction, center, u and v, three numbers each."""
    direction, center, u, v = view
    normal = cross(u, v)
    per_area = 1.0 / dot(normal, normal)
    away = combine(1.0, mean, -1.0, center)
    t = -dot(away, normal) / dot(direction, normal)
    on_plane = combine(1.0, away, t, direction)
    right, down = dot(on_plane, cross(v, normal)) * per_area, dot(on_plane, cross(normal, u)) * per_area
    right, down, inside = drawn_in(right, down, width, height)
    base = combine(1.0, away, -1.0, combine(right, u, down, v))
    e, f_0 = turned(rows, direction), turned(rows, base)
    f_u, f_v = turned(rows, (-u[0], -u[1], -u[2])), turned(rows, (-v[0], -v[1], -v[2]))
    g_u, g_v = cross(f_u, e), cross(f_v, e)
    # At the projected centre what is left of the cross product is rounding.
    g_0 = choose(inside, (0.0, 0.0, 0.0), cross(f_0, e))
    size = dot(e, e)
    kappa = 1.0 / np.sqrt(size) if size > 0.0 else 1.0
    q_1, q_2 = plane_basis(g_u, g_v, e)
    return Beam(right, down, base, e, f_u, f_v, f_0, g_u, g_v, g_0, kappa, q_1, q_2)


@njit(error_model="numpy", _nrt=False, forceinline=True)
def _bounds(b: Any, along: Any, across: Any, k2: Any) -> Any:
    """Interval of (j − j₀), or (i − i₀), outside of which no parallel ray comes within √k2 of the splat; exact.

    The rays of one pixel column span a plane; all of these are parallel, and its distance from the whitened centre is
    |α + β·j| / ‖n‖ with n their normal.
    """
    normal = cross(b.e, across)
    # In this order α is exactly 0 where the reference is the projected centre.
    alpha, beta = dot(b.g_0, across), dot(along, normal)
    return within(beta * beta, alpha * beta, alpha * alpha - k2 * dot(normal, normal))


@njit(error_model="numpy", fastmath={"contract"}, _nrt=False, forceinline=True)
def parallel_rows(lanes: Any, packed: Any, width: Any, height: Any, k2: Any) -> None:
    """What a batch becomes in the table of `radiograph_geometry.project`, in a parallel beam."""
    view = view_of(packed)
    for n in range(np.uint64(BATCH)):
        white = whitening(quaternion(lanes, n), three(lanes, SCALE, n))
        b = beam(three(lanes, MEAN, n), white.rows, view, width, height)
        across, downward = _bounds(b, b.f_u, b.f_v, k2), _bounds(b, b.f_v, b.f_u, k2)
        put_rows(
            lanes, n, b, (width, height), b.kappa, across, downward, coefficients(factor(b, b.kappa), _ONE_DEN, k2)
        )


@njit(error_model="numpy", fastmath={"contract"}, _nrt=False, forceinline=True)
def parallel_backward(lanes: Any, packed: Any, width: Any, height: Any) -> None:
    """The gradients of a batch in a parallel beam; see `radiograph_geometry.geometry_backward`."""
    view = view_of(packed)
    direction, _, u, v = view
    for n in range(np.uint64(BATCH)):
        scale = three(lanes, SCALE, n)
        white = whitening(quaternion(lanes, n), scale)
        b = beam(three(lanes, MEAN, n), white.rows, view, width, height)
        d_gu, d_gv, d_g0 = to_cross_products(lanes, n, b, b.kappa)
        d_fu, d_fv, d_f0 = cross(b.e, d_gu), cross(b.e, d_gv), cross(b.e, d_g0)
        s_1 = lanes[SUMS_AT + np.uint64(12 * BATCH) + n]
        d_e = combine(2 * b.kappa * b.kappa * s_1, b.e, 1.0, cross(d_gu, b.f_u))
        d_e = combine(1.0, d_e, 1.0, combine(1.0, cross(d_gv, b.f_v), 1.0, cross(d_g0, b.f_0)))
        d_white = (
            combine(1.0, combine(-d_fu[0], u, -d_fv[0], v), 1.0, combine(d_f0[0], b.base, d_e[0], direction)),
            combine(1.0, combine(-d_fu[1], u, -d_fv[1], v), 1.0, combine(d_f0[1], b.base, d_e[1], direction)),
            combine(1.0, combine(-d_fu[2], u, -d_fv[2], v), 1.0, combine(d_f0[2], b.base, d_e[2], direction)),
        )
        to_mean = turned_back(white.rows, d_f0)
        to_view = (
            turned_back(white.rows, d_e),
            (-to_mean[0], -to_mean[1], -to_mean[2]),
            combine(-b.right, to_mean, -1.0, turned_back(white.rows, d_fu)),
            combine(-b.down, to_mean, -1.0, turned_back(white.rows, d_fv)),
        )
        to_density = SQRT_2PI * b.kappa * lanes[SUMS_AT + n]
        put_gradients(lanes, n, to_mean, white, scale, d_white, to_density, to_view)


@njit(error_model="numpy", _nrt=False, forceinline=True)
def _frozen(c: Any) -> Any:
    """Of a `Cone`, the κ that makes den 1 at the splat's own place, and the distance from the source."""
    size = c.t * np.sqrt(dot(c.f, c.f))
    return 1.0 / size if size > 0.0 else 1.0, np.sqrt(dot(c.away, c.away))


@njit(error_model="numpy", _nrt=False, forceinline=True)
def _box(p: Any, k2: Any) -> Any:
    """The intervals of columns and rows of the ellipse (p₁₁x + p₁₂y + p₁₃)² + (p₂₂y + p₂₃)² ≤ k2."""
    p11, p12, p13, p22, p23 = p
    k, area = np.sqrt(k2), abs(p11 * p22)
    bounded = area > 0.0
    center_x, center_y = (p12 * p23 / p22 - p13) / p11, -p23 / p22
    half_x, half_y = k * np.sqrt(p12 * p12 + p22 * p22) / area, k * abs(p11) / area
    return (
        (center_x - half_x if bounded else -np.inf, center_x + half_x if bounded else np.inf),
        (center_y - half_y if bounded else -np.inf, center_y + half_y if bounded else np.inf),
    )


@njit(error_model="numpy", fastmath={"contract"}, _nrt=False, forceinline=True)
def affine_rows(lanes: Any, packed: Any, width: Any, height: Any, k2: Any) -> None:
    """What a batch becomes in the table of `radiograph_geometry.project`, in the affine form."""
    view = view_of(packed)
    for n in range(np.uint64(BATCH)):
        white = whitening(quaternion(lanes, n), three(lanes, SCALE, n))
        c = cone(three(lanes, MEAN, n), white.rows, view, width, height)
        kappa, distance = _frozen(c)
        p = factor(c, kappa)
        (left, right), (top, bottom) = _box(p, k2)
        seen = (c.t > 0.0) & (c.t < LARGEST_AFFINE_T)
        across = left if seen else 1.0, right if seen else 0.0
        downward = top if seen else 1.0, bottom if seen else 0.0
        amplitude = kappa * distance * c.t
        put_rows(lanes, n, c, (width, height), amplitude, across, downward, coefficients(p, _ONE_DEN, k2))


@njit(error_model="numpy", fastmath={"contract"}, _nrt=False, forceinline=True)
def affine_backward(lanes: Any, packed: Any, width: Any, height: Any) -> None:
    """The gradients of a batch in the affine form; see `radiograph_geometry.geometry_backward`.

    To what a cone beam has comes what goes through t, ‖f‖ and ‖μ − s‖.
    """
    view = view_of(packed)
    source, center, u, v = view
    normal, to_center = cross(u, v), combine(1.0, center, -1.0, source)
    for n in range(np.uint64(BATCH)):
        scale = three(lanes, SCALE, n)
        white = whitening(quaternion(lanes, n), scale)
        c = cone(three(lanes, MEAN, n), white.rows, view, width, height)
        kappa, distance = _frozen(c)
        d_eu, d_ev, d_e0, d_f = to_cone(c, to_cross_products(lanes, n, c, kappa))
        s_1 = lanes[SUMS_AT + np.uint64(12 * BATCH) + n]
        d_f = combine(1.0, d_f, 2 * s_1 / dot(c.f, c.f), c.f)
        to_mean, d_white, (to_source, to_middle, to_u, to_v) = through_columns(c, white, view, d_eu, d_ev, d_e0, d_f)
        peak = SQRT_2PI * kappa * lanes[SUMS_AT + n]
        amplitude = lanes[DENSITY + n] * peak
        d_t = (2 * s_1 / c.t + amplitude * distance) / c.depth
        change = combine(amplitude * c.t / distance, c.away, -c.t * d_t, normal)
        moved = combine(d_t, to_center, -d_t * c.t, c.away)
        to_view = (
            combine(1.0, to_source, -1.0, combine(1.0, change, d_t, normal)),
            combine(1.0, to_middle, d_t, normal),
            combine(1.0, to_u, 1.0, cross(v, moved)),
            combine(1.0, to_v, 1.0, cross(moved, u)),
        )
        to_mean = combine(1.0, to_mean, 1.0, change)
        put_gradients(lanes, n, to_mean, white, scale, d_white, peak * distance * c.t, to_view)
