"""The geometry of `radiograph_geometry` for a cone beam: to the pixel rows' numbers, and from sums back.

In the style of `radiograph_lanes`: LLVM carries out the loops over splats several splats at a time.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ....compiled import njit
from .math import cross, dot
from .radiograph_lanes import (
    BATCH,
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


class Cone(NamedTuple):
    """Where a splat stands in a cone beam.

    Attributes:
        right, down: what it projects to, in steps along u and v from the detector's middle; drawn in where that is
            further than two image sizes off the image.
        away, base: from the source to the splat and to that place.
        f, e_u, e_v, e_0, g_u, g_v, g_0: columns of E, F and G.
        kappa: κ.
        depth, t: the splat's distance from the source along u × v, and the detector's in units of that.
        q_1, q_2: basis of G's columns.
    """

    right: Any
    down: Any
    away: Any
    base: Any
    f: Any
    e_u: Any
    e_v: Any
    e_0: Any
    g_u: Any
    g_v: Any
    g_0: Any
    kappa: Any
    depth: Any
    t: Any
    q_1: Any
    q_2: Any


@njit(error_model="numpy", _nrt=False, forceinline=True)
def cone(mean: Any, rows: Any, view: Any, width: Any, height: Any) -> Any:
    """`Cone` of a splat with W's rows; `view` is source, center, u and v, three numbers each."""
    source, center, u, v = view
    normal = cross(u, v)
    per_area = 1.0 / dot(normal, normal)
    to_center = combine(1.0, center, -1.0, source)
    away = combine(1.0, mean, -1.0, source)
    depth = dot(away, normal)
    t = dot(to_center, normal) / depth
    on_plane = combine(t, away, -1.0, to_center)
    right, down = dot(on_plane, cross(v, normal)) * per_area, dot(on_plane, cross(normal, u)) * per_area
    right, down, inside = drawn_in(right, down, width, height)
    aside = combine(right, u, down, v)
    base = combine(1.0, to_center, 1.0, aside)
    f, e_u, e_v, e_0 = turned(rows, away), turned(rows, u), turned(rows, v), turned(rows, base)
    g_u, g_v = cross(f, e_u), cross(f, e_v)
    # At the projected centre what is left of the cross product is rounding.
    g_0 = choose(inside, (0.0, 0.0, 0.0), cross(f, e_0))
    size = dot(e_0, e_0)
    kappa = 1.0 / np.sqrt(size) if size > 0.0 else 1.0
    q_1, q_2 = plane_basis(g_u, g_v, f)
    return Cone(right, down, away, base, f, e_u, e_v, e_0, g_u, g_v, g_0, kappa, depth, t, q_1, q_2)


@njit(error_model="numpy", _nrt=False, forceinline=True)
def to_cone(c: Any, d_g: Any) -> Any:
    """What dL/dG says of E's columns and of F."""
    d_gu, d_gv, d_g0 = d_g
    d_f = combine(1.0, cross(c.e_u, d_gu), 1.0, cross(c.e_v, d_gv))
    return cross(d_gu, c.f), cross(d_gv, c.f), cross(d_g0, c.f), combine(1.0, d_f, 1.0, cross(c.e_0, d_g0))


@njit(error_model="numpy", _nrt=False, forceinline=True)
def through_columns(c: Any, white: Any, view: Any, d_eu: Any, d_ev: Any, d_e0: Any, d_f: Any) -> Any:
    """From the gradients of E's columns and F to those of the mean, of W's rows, and of the view."""
    to_mean, to_base = turned_back(white.rows, d_f), turned_back(white.rows, d_e0)
    d_white = (
        _row(d_eu[0], d_ev[0], d_e0[0], d_f[0], view, c),
        _row(d_eu[1], d_ev[1], d_e0[1], d_f[1], view, c),
        _row(d_eu[2], d_ev[2], d_e0[2], d_f[2], view, c),
    )
    to_u = combine(c.right, to_base, 1.0, turned_back(white.rows, d_eu))
    to_v = combine(c.down, to_base, 1.0, turned_back(white.rows, d_ev))
    return to_mean, d_white, (combine(-1.0, to_mean, -1.0, to_base), to_base, to_u, to_v)


@njit(error_model="numpy", fastmath={"contract"}, _nrt=False, forceinline=True)
def cone_backward(lanes: Any, packed: Any, width: Any, height: Any) -> None:
    """The gradients of a batch; see `radiograph_geometry.geometry_backward`."""
    view = view_of(packed)
    for n in range(np.uint64(BATCH)):
        scale = three(lanes, SCALE, n)
        white = whitening(quaternion(lanes, n), scale)
        c = cone(three(lanes, MEAN, n), white.rows, view, width, height)
        s_uu, s_uv, s_vv = three(lanes, SUMS_AT + np.uint64(7 * BATCH), n)
        s_u, s_v, s_1 = three(lanes, SUMS_AT + np.uint64(10 * BATCH), n)
        square = 2 * c.kappa * c.kappa
        d_eu = combine(1.0, combine(square * s_uu, c.e_u, square * s_uv, c.e_v), square * s_u, c.e_0)
        d_ev = combine(1.0, combine(square * s_uv, c.e_u, square * s_vv, c.e_v), square * s_v, c.e_0)
        d_e0 = combine(1.0, combine(square * s_u, c.e_u, square * s_v, c.e_v), square * s_1, c.e_0)
        more_u, more_v, more_0, d_f = to_cone(c, to_cross_products(lanes, n, c, c.kappa))
        d_eu, d_ev = combine(1.0, d_eu, 1.0, more_u), combine(1.0, d_ev, 1.0, more_v)
        d_e0 = combine(1.0, d_e0, 1.0, more_0)
        to_mean, d_white, to_view = through_columns(c, white, view, d_eu, d_ev, d_e0, d_f)
        to_density = SQRT_2PI * c.kappa * lanes[SUMS_AT + n]
        put_gradients(lanes, n, to_mean, white, scale, d_white, to_density, to_view)


@njit(error_model="numpy", _nrt=False, forceinline=True)
def _row(to_u: Any, to_v: Any, to_base: Any, to_away: Any, view: Any, c: Any) -> Any:
    """A row of dL/dW."""
    return combine(1.0, combine(to_u, view[2], to_v, view[3]), 1.0, combine(to_base, c.base, to_away, c.away))


@njit(error_model="numpy", _nrt=False, forceinline=True)
def _less(x: Any, part: Any, q: Any) -> Any:
    return x[0] - part * q[0], x[1] - part * q[1], x[2] - part * q[2]


@njit(error_model="numpy", _nrt=False, forceinline=True)
def _unit(x: Any) -> Any:
    """Length and direction, which is 0 for a length of 0."""
    length = np.sqrt(dot(x, x))
    per = 1.0 / length if length > 0.0 else 0.0
    return length, (x[0] * per, x[1] * per, x[2] * per)


@njit(error_model="numpy", _nrt=False, forceinline=True)
def _triangular(first: Any, second: Any, third: Any) -> Any:
    """R's numbers r₁₁, r₁₂, r₁₃, r₂₂, r₂₃, r₃₃; as `whitening.triangular`, each column in two passes."""
    r11, q_1 = _unit(first)
    r12 = dot(q_1, second)
    second = _less(second, r12, q_1)
    more = dot(q_1, second)
    r22, q_2 = _unit(_less(second, more, q_1))
    r13 = dot(q_1, third)
    third = _less(third, r13, q_1)
    r23 = dot(q_2, third)
    third = _less(third, r23, q_2)
    more_1 = dot(q_1, third)
    third = _less(third, more_1, q_1)
    more_2 = dot(q_2, third)
    r33, _ = _unit(_less(third, more_2, q_2))
    return r11, r12 + more, r13 + more_1, r22, r23 + more_2, r33


@njit(error_model="numpy", _nrt=False, forceinline=True)
def _bounds(c: Any, along: Any, across: Any, k2: Any) -> Any:
    """Interval of (j − j₀), or (i − i₀), outside of which no ray comes within √k2 of the splat; exact.

    The rays of one pixel column span a plane with normal n(j) = a + j·b; its distance from the whitened centre is
    |α + β·j| / ‖n(j)‖. If the ellipsoid meets the plane through the source parallel to the detector, it is seen
    everywhere.
    """
    a, b = cross(c.e_0, across), cross(along, across)
    # In this order α is exactly 0 where the reference is the projected centre.
    alpha, beta = dot(c.g_0, across), dot(c.f, b)
    x2 = beta * beta - k2 * dot(b, b)
    x1, x0 = alpha * beta - k2 * dot(a, b), alpha * alpha - k2 * dot(a, a)
    return within(x2, x1, x0)


@njit(error_model="numpy", fastmath={"contract"}, _nrt=False, forceinline=True)
def cone_rows(lanes: Any, packed: Any, width: Any, height: Any, k2: Any) -> None:
    """What a batch becomes in the table of `radiograph_geometry.project`."""
    view = view_of(packed)
    for n in range(np.uint64(BATCH)):
        white = whitening(quaternion(lanes, n), three(lanes, SCALE, n))
        c = cone(three(lanes, MEAN, n), white.rows, view, width, height)
        kappa = c.kappa
        r11, r12, r13, r22, r23, r33 = _triangular(c.e_u, c.e_v, c.e_0)
        r = kappa * r11, kappa * r12, kappa * r13, kappa * r22, kappa * r23, kappa * r33
        across, downward = _bounds(c, c.e_u, c.e_v, k2), _bounds(c, c.e_v, c.e_u, k2)
        put_rows(lanes, n, c, (width, height), kappa, across, downward, coefficients(factor(c, kappa), r, k2))
