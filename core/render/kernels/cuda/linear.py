"""Small linear algebra of one splat in float64, for the kernels of additive renderers."""

from __future__ import annotations

import warp as wp

from .rotations import ONE, ZERO

_INFINITE = wp.constant(wp.float64(wp.inf))


@wp.struct
class PlaneBasis:
    """Two orthonormal vectors."""

    q_1: wp.vec3d
    q_2: wp.vec3d


@wp.struct
class Triangular:
    """A QR factorisation: Q's columns, 0 where R's diagonal is, and R."""

    q_1: wp.vec3d
    q_2: wp.vec3d
    q_3: wp.vec3d
    r11: wp.float64
    r12: wp.float64
    r13: wp.float64
    r22: wp.float64
    r23: wp.float64
    r33: wp.float64


@wp.func
def unit_of(vector: wp.vec3d) -> wp.vec3d:
    """0 for a length of 0."""
    length = wp.length(vector)
    unit = wp.vec3d()
    if length > ZERO:
        unit = vector / length
    return unit


@wp.func
def plane_basis(first: wp.vec3d, second: wp.vec3d, normal: wp.vec3d) -> PlaneBasis:
    """Spans the plane at right angles to `normal`, `first` along q_1.

    `first` and `second` lie in that plane; if `first` is zero, q_2 is along `second`, and if both are (or the normal
    is), any two directions do, because nothing is left to be measured in them.
    """
    basis = PlaneBasis()
    upright = unit_of(normal)
    basis.q_1 = unit_of(first)
    basis.q_2 = wp.cross(upright, basis.q_1)
    if wp.length(first) == ZERO:
        basis.q_2 = unit_of(second)
        basis.q_1 = wp.cross(basis.q_2, upright)
    if wp.length(normal) == ZERO or (wp.length(first) == ZERO and wp.length(second) == ZERO):
        basis.q_1 = wp.vec3d(ONE, ZERO, ZERO)
        basis.q_2 = wp.vec3d(ZERO, ONE, ZERO)
    return basis


@wp.func
def triangular(first: wp.vec3d, second: wp.vec3d, third: wp.vec3d) -> Triangular:
    """By Gram-Schmidt of three columns; the second pass keeps the small part of nearly parallel ones (needles)."""
    t = Triangular()
    t.r11 = wp.length(first)
    t.q_1 = unit_of(first)
    part = wp.dot(t.q_1, second)
    left = second - part * t.q_1
    more = wp.dot(t.q_1, left)
    left -= more * t.q_1
    t.r12 = part + more
    t.r22 = wp.length(left)
    t.q_2 = unit_of(left)
    part = wp.dot(t.q_1, third)
    left = third - part * t.q_1
    other = wp.dot(t.q_2, left)
    left -= other * t.q_2
    more = wp.dot(t.q_1, left)
    left -= more * t.q_1
    another = wp.dot(t.q_2, left)
    left -= another * t.q_2
    t.r13 = part + more
    t.r23 = other + another
    t.r33 = wp.length(left)
    t.q_3 = unit_of(left)
    return t


@wp.func
def quadratic_range(a: wp.float64, b: wp.float64, c: wp.float64) -> wp.vec2d:
    """Where a·x² + 2b·x + c ≤ 0: the interval, everything if a ≤ 0, and (∞, −∞) if it is nowhere."""
    found = wp.vec2d(-_INFINITE, _INFINITE)
    if a > ZERO:
        discriminant = b * b - a * c
        half = wp.sqrt(discriminant)
        found = wp.vec2d((-b - half) / a, (-b + half) / a)
        if discriminant < ZERO:
            found = wp.vec2d(_INFINITE, -_INFINITE)
    return found
