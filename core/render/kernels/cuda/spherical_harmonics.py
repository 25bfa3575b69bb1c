"""Colours of splats seen from one side and their gradients: spherical harmonics in float32."""

from __future__ import annotations

import warp as wp

from ....spherical_harmonics import C0, C1, C2, C3

Basis = wp.types.vector(length=16, dtype=wp.float32)

_C0, _C1 = wp.constant(wp.float32(C0)), wp.constant(wp.float32(C1))
_C20, _C21, _C22, _C23, _C24 = (wp.constant(wp.float32(c)) for c in C2)
_C30, _C31, _C32, _C33, _C34, _C35, _C36 = (wp.constant(wp.float32(c)) for c in C3)


@wp.func
def basis_of(direction: wp.vec3) -> Basis:
    """`core.spherical_harmonics.sh_basis` at a unit direction, all degrees."""
    x, y, z = direction[0], direction[1], direction[2]
    xx, yy, zz = x * x, y * y, z * z
    return Basis(
        _C0, -_C1 * y, _C1 * z, -_C1 * x,
        _C20 * x * y, _C21 * y * z, _C22 * (2.0 * zz - xx - yy), _C23 * x * z, _C24 * (xx - yy),
        _C30 * y * (3.0 * xx - yy), _C31 * x * y * z, _C32 * y * (4.0 * zz - xx - yy),
        _C33 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy), _C34 * x * (4.0 * zz - xx - yy),
        _C35 * z * (xx - yy), _C36 * x * (xx - 3.0 * yy),
    )  # fmt: skip


@wp.func
def basis_backward(direction: wp.vec3, grad: Basis) -> wp.vec3:
    """From ∂L/∂basis to the direction."""
    x, y, z = direction[0], direction[1], direction[2]
    xx, yy, zz, xy, yz, xz = x * x, y * y, z * z, x * y, y * z, x * z
    first = _C1 * wp.vec3(-grad[3], -grad[1], grad[2])
    g4, g5, g6 = _C20 * grad[4], _C21 * grad[5], 2.0 * _C22 * grad[6]
    g7, g8 = _C23 * grad[7], 2.0 * _C24 * grad[8]
    second = wp.vec3(
        y * g4 - x * g6 + z * g7 + x * g8, x * g4 + z * g5 - y * g6 - y * g8, y * g5 + 2.0 * z * g6 + x * g7
    )
    g9, g10, g11, g12 = 3.0 * _C30 * grad[9], _C31 * grad[10], _C32 * grad[11], 3.0 * _C33 * grad[12]
    g13, g14, g15 = _C34 * grad[13], _C35 * grad[14], 3.0 * _C36 * grad[15]
    third = wp.vec3(
        2.0 * xy * g9 + yz * g10 - 2.0 * xy * g11 - 2.0 * xz * g12
        + (4.0 * zz - 3.0 * xx - yy) * g13 + 2.0 * xz * g14 + (xx - yy) * g15,
        (xx - yy) * g9 + xz * g10 + (4.0 * zz - xx - 3.0 * yy) * g11 - 2.0 * yz * g12
        - 2.0 * xy * g13 - 2.0 * yz * g14 - 2.0 * xy * g15,
        xy * g10 + 8.0 * yz * g11 + (2.0 * zz - xx - yy) * g12 + 8.0 * xz * g13 + (xx - yy) * g14,
    )  # fmt: skip
    return first + second + third
