"""The colours of splats seen from one side and their gradients: spherical harmonics in float32, for a batch of splats.

The functions of a direction go through the batch number by number, so that LLVM takes several splats at a time; the
sums over coefficients, which lie splat by splat in memory, go splat by splat.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ....compiled import njit
from ....spherical_harmonics import C0, C1, C2, C3
from ..reference.splat import QUAT_MIN
from .splat_geometry import ORTHOGRAPHIC

COEFFICIENTS = 16
# Splats of a batch. Their numbers lie in planes of one buffer, each of `LANES`: LLVM then sees one pointer with fixed
# distances and vectorises the loops over splats. As many as let a batch's planes stay in the first-level cache.
LANES = 64

_C0, _C1 = np.float32(C0), np.float32(C1)
_C2, _C3 = tuple(np.float32(c) for c in C2), tuple(np.float32(c) for c in C3)
_TWO, _THREE, _FOUR, _EIGHT = np.float32(2), np.float32(3), np.float32(4), np.float32(8)
_HALF, _NONE = np.float32(0.5), np.float32(0.0)
# Planes of a direction, and of the coefficients' functions.
X, Y, Z = np.uint64(0), np.uint64(LANES), np.uint64(2 * LANES)
_BAND = tuple(np.uint64(band * LANES) for band in range(COEFFICIENTS))


@njit(error_model="numpy", _nrt=False, forceinline=True)
def direction(mean: Any, view: Any) -> Any:
    """Unit vector from the camera to a splat (the camera's axis if orthographic), and the length it had; float64."""
    if view[ORTHOGRAPHIC] != 0.0:
        x, y, z = view[8], view[9], view[10]
    else:
        x = mean[0] + (view[0] * view[3] + view[4] * view[7] + view[8] * view[11])
        y = mean[1] + (view[1] * view[3] + view[5] * view[7] + view[9] * view[11])
        z = mean[2] + (view[2] * view[3] + view[6] * view[7] + view[10] * view[11])
    length = max(np.sqrt(x * x + y * y + z * z), QUAT_MIN)
    return x / length, y / length, z / length, length


@njit(error_model="numpy", _nrt=False)
def fill_bases(directions: Any, count: Any, bases: Any) -> None:
    """`core.spherical_harmonics.sh_basis` of a batch, all degrees.

    Args:
        directions: planes X, Y, Z, float32.
        count: splats of the batch.
        bases: (COEFFICIENTS · LANES,) float32, written.
    """
    for n in range(np.uint64(count)):
        x, y, z = directions[X + n], directions[Y + n], directions[Z + n]
        xx, yy, zz = x * x, y * y, z * z
        bases[_BAND[0] + n] = _C0
        bases[_BAND[1] + n] = -_C1 * y
        bases[_BAND[2] + n] = _C1 * z
        bases[_BAND[3] + n] = -_C1 * x
        bases[_BAND[4] + n] = _C2[0] * x * y
        bases[_BAND[5] + n] = _C2[1] * y * z
        bases[_BAND[6] + n] = _C2[2] * (_TWO * zz - xx - yy)
        bases[_BAND[7] + n] = _C2[3] * x * z
        bases[_BAND[8] + n] = _C2[4] * (xx - yy)
        bases[_BAND[9] + n] = _C3[0] * y * (_THREE * xx - yy)
        bases[_BAND[10] + n] = _C3[1] * x * y * z
        bases[_BAND[11] + n] = _C3[2] * y * (_FOUR * zz - xx - yy)
        bases[_BAND[12] + n] = _C3[3] * z * (_TWO * zz - _THREE * xx - _THREE * yy)
        bases[_BAND[13] + n] = _C3[4] * x * (_FOUR * zz - xx - yy)
        bases[_BAND[14] + n] = _C3[5] * z * (xx - yy)
        bases[_BAND[15] + n] = _C3[6] * x * (xx - _THREE * yy)


@njit(error_model="numpy", _nrt=False, forceinline=True)
def color_of(bases: Any, n: Any, sh: Any, i: Any, used: Any) -> Any:
    """SH(direction) + 0.5 of splat i, the batch's n-th, from its first `used` coefficients; not clamped."""
    red, green, blue = _HALF, _HALF, _HALF
    for band in range(np.uint64(used)):
        value = bases[band * np.uint64(LANES) + n]
        red += value * sh[i, band, 0]
        green += value * sh[i, band, 1]
        blue += value * sh[i, band, 2]
    return red, green, blue


@njit(error_model="numpy", _nrt=False)
def colors_backward(
    rows: Any, count: Any, sh: Any, degree: Any, totals: Any, bases: Any, grad_bases: Any, grad_sh: Any,
    directions: Any,
) -> None:  # fmt: skip
    """Gradients of a batch's colours max(0, SH(direction) + 0.5).

    Args:
        rows: (LANES,) the splats of the batch, `count` of them.
        sh: (N, K, 3).
        totals: (LANES, 3) ∂L/∂colour.
        bases: of `fill_bases`.
        grad_bases: scratch of the same size.
        grad_sh: (N, K, 3), written; zero for bands above `degree`.
        directions: planes X, Y, Z; replaced by ∂L/∂(x, y, z).
    """
    used = np.uint64((degree + 1) * (degree + 1))
    for n in range(np.uint64(count)):
        i = rows[n]
        red, green, blue = color_of(bases, n, sh, i, used)
        to_red = np.float32(totals[n, 0]) if red >= _NONE else _NONE
        to_green = np.float32(totals[n, 1]) if green >= _NONE else _NONE
        to_blue = np.float32(totals[n, 2]) if blue >= _NONE else _NONE
        for band in range(used):
            place = band * np.uint64(LANES) + n
            value = bases[place]
            grad_bases[place] = sh[i, band, 0] * to_red + sh[i, band, 1] * to_green + sh[i, band, 2] * to_blue
            grad_sh[i, band, 0] = value * to_red
            grad_sh[i, band, 1] = value * to_green
            grad_sh[i, band, 2] = value * to_blue
        for band in range(used, np.uint64(sh.shape[1])):
            grad_sh[i, band, 0], grad_sh[i, band, 1], grad_sh[i, band, 2] = _NONE, _NONE, _NONE
    grad_bases[used * np.uint64(LANES) :] = _NONE
    _bases_backward(grad_bases, count, directions)


@njit(error_model="numpy", _nrt=False)
def _bases_backward(grad: Any, count: Any, directions: Any) -> None:
    for n in range(np.uint64(count)):
        x, y, z = directions[X + n], directions[Y + n], directions[Z + n]
        xx, yy, zz, xy, yz, xz = x * x, y * y, z * z, x * y, y * z, x * z
        dx, dy, dz = -_C1 * grad[_BAND[3] + n], -_C1 * grad[_BAND[1] + n], _C1 * grad[_BAND[2] + n]
        g4, g5, g6, g7, g8 = (
            _C2[0] * grad[_BAND[4] + n],
            _C2[1] * grad[_BAND[5] + n],
            _C2[2] * grad[_BAND[6] + n] * _TWO,
            _C2[3] * grad[_BAND[7] + n],
            _C2[4] * grad[_BAND[8] + n] * _TWO,
        )
        dx += y * g4 - x * g6 + z * g7 + x * g8
        dy += x * g4 + z * g5 - y * g6 - y * g8
        dz += y * g5 + _TWO * z * g6 + x * g7
        g9, g10, g11, g12 = (
            _C3[0] * grad[_BAND[9] + n] * _THREE,
            _C3[1] * grad[_BAND[10] + n],
            _C3[2] * grad[_BAND[11] + n],
            _C3[3] * grad[_BAND[12] + n] * _THREE,
        )
        g13, g14, g15 = (
            _C3[4] * grad[_BAND[13] + n],
            _C3[5] * grad[_BAND[14] + n],
            _C3[6] * grad[_BAND[15] + n] * _THREE,
        )
        dx += _TWO * xy * g9 + yz * g10 - _TWO * xy * g11 - _TWO * xz * g12
        dx += (_FOUR * zz - _THREE * xx - yy) * g13 + _TWO * xz * g14 + (xx - yy) * g15
        dy += (xx - yy) * g9 + xz * g10 + (_FOUR * zz - xx - _THREE * yy) * g11 - _TWO * yz * g12
        dy += -_TWO * xy * g13 - _TWO * yz * g14 - _TWO * xy * g15
        dz += xy * g10 + _EIGHT * yz * g11 + (_TWO * zz - xx - yy) * g12 + _EIGHT * xz * g13 + (xx - yy) * g14
        directions[X + n], directions[Y + n], directions[Z + n] = dx, dy, dz
