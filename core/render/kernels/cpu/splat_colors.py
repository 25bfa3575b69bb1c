"""The colour of a splat seen from one side and its gradient; spherical harmonics in scalars for Numba."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from ....spherical_harmonics import C0, C1, C2, C3
from ..reference.splat import QUAT_MIN
from .splat_geometry import ORTHOGRAPHIC

COEFFICIENTS = 16


@njit(error_model="numpy", _nrt=False)
def direction(mean: Any, view: Any) -> Any:
    """Unit vector from the camera to a splat (the camera's axis if orthographic), and the length it had."""
    if view[ORTHOGRAPHIC] != 0.0:
        x, y, z = view[8], view[9], view[10]
    else:
        x = mean[0] + (view[0] * view[3] + view[4] * view[7] + view[8] * view[11])
        y = mean[1] + (view[1] * view[3] + view[5] * view[7] + view[9] * view[11])
        z = mean[2] + (view[2] * view[3] + view[6] * view[7] + view[10] * view[11])
    length = max(np.sqrt(x * x + y * y + z * z), QUAT_MIN)
    return x / length, y / length, z / length, length


@njit(error_model="numpy", _nrt=False)
def fill_basis(x: Any, y: Any, z: Any, degree: Any, basis: Any) -> None:
    """`core.spherical_harmonics.sh_basis` of one direction, into `basis` (16,)."""
    basis[0] = C0
    if degree < 1:
        return
    basis[1], basis[2], basis[3] = -C1 * y, C1 * z, -C1 * x
    if degree < 2:
        return
    xx, yy, zz = x * x, y * y, z * z
    basis[4] = C2[0] * x * y
    basis[5] = C2[1] * y * z
    basis[6] = C2[2] * (2 * zz - xx - yy)
    basis[7] = C2[3] * x * z
    basis[8] = C2[4] * (xx - yy)
    if degree < 3:
        return
    basis[9] = C3[0] * y * (3 * xx - yy)
    basis[10] = C3[1] * x * y * z
    basis[11] = C3[2] * y * (4 * zz - xx - yy)
    basis[12] = C3[3] * z * (2 * zz - 3 * xx - 3 * yy)
    basis[13] = C3[4] * x * (4 * zz - xx - yy)
    basis[14] = C3[5] * z * (xx - yy)
    basis[15] = C3[6] * x * (xx - 3 * yy)


@njit(error_model="numpy", _nrt=False)
def basis_backward(x: Any, y: Any, z: Any, degree: Any, grad: Any) -> Any:
    """∂L/∂(x, y, z) from ∂L/∂basis in `grad` (16,)."""
    if degree < 1:
        return 0.0, 0.0, 0.0
    dx, dy, dz = -C1 * grad[3], -C1 * grad[1], C1 * grad[2]
    if degree < 2:
        return dx, dy, dz
    xx, yy, zz, xy, yz, xz = x * x, y * y, z * z, x * y, y * z, x * z
    dx += C2[0] * y * grad[4] - 2 * C2[2] * x * grad[6] + C2[3] * z * grad[7] + 2 * C2[4] * x * grad[8]
    dy += C2[0] * x * grad[4] + C2[1] * z * grad[5] - 2 * C2[2] * y * grad[6] - 2 * C2[4] * y * grad[8]
    dz += C2[1] * y * grad[5] + 4 * C2[2] * z * grad[6] + C2[3] * x * grad[7]
    if degree < 3:
        return dx, dy, dz
    dx += C3[0] * 6 * xy * grad[9] + C3[1] * yz * grad[10] - C3[2] * 2 * xy * grad[11]
    dx += -C3[3] * 6 * xz * grad[12] + C3[4] * (4 * zz - 3 * xx - yy) * grad[13]
    dx += C3[5] * 2 * xz * grad[14] + C3[6] * 3 * (xx - yy) * grad[15]
    dy += C3[0] * 3 * (xx - yy) * grad[9] + C3[1] * xz * grad[10] + C3[2] * (4 * zz - xx - 3 * yy) * grad[11]
    dy += -C3[3] * 6 * yz * grad[12] - C3[4] * 2 * xy * grad[13]
    dy += -C3[5] * 2 * yz * grad[14] - C3[6] * 6 * xy * grad[15]
    dz += C3[1] * xy * grad[10] + C3[2] * 8 * yz * grad[11] + C3[3] * 3 * (2 * zz - xx - yy) * grad[12]
    dz += C3[4] * 8 * xz * grad[13] + C3[5] * (xx - yy) * grad[14]
    return dx, dy, dz


@njit(error_model="numpy", _nrt=False)
def color_backward(
    mean: Any, sh: Any, view: Any, degree: Any, grad: Any, basis: Any, grad_basis: Any, grad_sh: Any,
    grad_mean: Any, grad_pose: Any,
) -> None:  # fmt: skip
    """Gradients of one splat's colour max(0, SH(direction) + 0.5).

    Args:
        sh: (K, 3).
        grad: ∂L/∂colour, 3 numbers.
        basis, grad_basis: (16,) scratch.
        grad_sh: (K, 3), written; zero for bands above `degree`.
        grad_mean: (3,), grad_pose: (12,), added to.
    """
    used = (degree + 1) * (degree + 1)
    x, y, z, length = direction(mean, view)
    fill_basis(x, y, z, degree, basis)
    red, green, blue = 0.5, 0.5, 0.5
    for band in range(used):
        red += basis[band] * sh[band, 0]
        green += basis[band] * sh[band, 1]
        blue += basis[band] * sh[band, 2]
    to_red = grad[0] if red >= 0.0 else 0.0
    to_green = grad[1] if green >= 0.0 else 0.0
    to_blue = grad[2] if blue >= 0.0 else 0.0
    for band in range(used):
        grad_sh[band, 0], grad_sh[band, 1] = basis[band] * to_red, basis[band] * to_green
        grad_sh[band, 2] = basis[band] * to_blue
        grad_basis[band] = sh[band, 0] * to_red + sh[band, 1] * to_green + sh[band, 2] * to_blue
    grad_sh[used:] = 0.0
    if degree < 1:
        return
    dx, dy, dz = basis_backward(x, y, z, degree, grad_basis)
    along = x * dx + y * dy + z * dz
    to_center = ((dx - x * along) / length, (dy - y * along) / length, (dz - z * along) / length)
    for j in range(3):
        if view[ORTHOGRAPHIC] != 0.0:
            grad_pose[8 + j] += to_center[j]
        else:
            grad_mean[j] += to_center[j]
            # direction = mean + Wᵀ T
            for row in range(3):
                grad_pose[4 * row + j] += view[4 * row + 3] * to_center[j]
                grad_pose[4 * row + 3] += view[4 * row + j] * to_center[j]
