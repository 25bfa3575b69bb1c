"""One splat from the world to the screen and its gradient back; scalars in float64, shared by both directions.

Everything is written out in scalars because Numba turns a small array into a heap allocation.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from ....views import Camera
from ..reference.splat import LOW_PASS, QUAT_MIN, frustum_limits

# Entries of a packed view: world_to_camera's three rows (12), then these.
FX, FY, CX, CY, LEFT, RIGHT, TOP, BOTTOM, NEAR, ORTHOGRAPHIC, WIDTH, HEIGHT = range(12, 24)


class Screen(NamedTuple):
    """What `to_screen` finds; `to_screen_backward` goes on from it.

    Attributes:
        x, y, z: camera frame.
        u, v: clamped slopes x/z and y/z of the Jacobian; clamped_u, clamped_v whether the clamp held them.
        quat: (w, x, y, z) normalised; length before.
        turn: R row by row, 9 numbers.
        jw: J W, the two rows, 6 numbers.
        axes: J W R, the two rows, 6 numbers.
        center_x, center_y: pixels.
        xx, xy, yy: Σ'.
        l1, k, l2: B of Σ'⁻¹ = BᵀB, upper triangular.
    """

    x: Any
    y: Any
    z: Any
    u: Any
    v: Any
    clamped_u: Any
    clamped_v: Any
    quat: Any
    length: Any
    turn: Any
    jw: Any
    axes: Any
    center_x: Any
    center_y: Any
    xx: Any
    xy: Any
    yy: Any
    l1: Any
    k: Any
    l2: Any


def pack_view(camera: Camera, pose: np.ndarray) -> np.ndarray:
    """A camera as (24,) float64, so that one compiled kernel serves all."""
    numbers = [camera.fx, camera.fy, camera.cx, camera.cy, *frustum_limits(camera), camera.near]
    numbers += [float(camera.orthographic), camera.width, camera.height]
    return np.concatenate([np.asarray(pose, np.float64)[:3, :].reshape(-1), np.array(numbers, np.float64)])


@njit(error_model="numpy", _nrt=False)
def to_screen(mean: Any, quat: Any, scale: Any, view: Any) -> Any:
    """`Screen` of a splat; garbage, possibly not finite, when it lies in the camera's plane."""
    mx, my, mz = np.float64(mean[0]), np.float64(mean[1]), np.float64(mean[2])
    x = view[0] * mx + view[1] * my + view[2] * mz + view[3]
    y = view[4] * mx + view[5] * my + view[6] * mz + view[7]
    z = view[8] * mx + view[9] * my + view[10] * mz + view[11]
    fx, fy = view[FX], view[FY]
    if view[ORTHOGRAPHIC] != 0.0:
        u, v, clamped_u, clamped_v = 0.0, 0.0, True, True
        j00, j02, j11, j12 = fx, 0.0, fy, 0.0
        center_x, center_y = fx * x + view[CX], fy * y + view[CY]
    else:
        inverse = 1.0 / z
        slope_x, slope_y = x * inverse, y * inverse
        u = min(max(slope_x, view[LEFT]), view[RIGHT])
        v = min(max(slope_y, view[TOP]), view[BOTTOM])
        clamped_u, clamped_v = u != slope_x, v != slope_y
        j00, j02, j11, j12 = fx * inverse, -fx * u * inverse, fy * inverse, -fy * v * inverse
        center_x, center_y = fx * slope_x + view[CX], fy * slope_y + view[CY]
    jw = (
        j00 * view[0] + j02 * view[8],
        j00 * view[1] + j02 * view[9],
        j00 * view[2] + j02 * view[10],
        j11 * view[4] + j12 * view[8],
        j11 * view[5] + j12 * view[9],
        j11 * view[6] + j12 * view[10],
    )

    length = np.sqrt(
        np.float64(quat[0]) ** 2 + np.float64(quat[1]) ** 2 + np.float64(quat[2]) ** 2 + np.float64(quat[3]) ** 2
    )
    qw, qx, qy, qz = 1.0, 0.0, 0.0, 0.0
    if length > QUAT_MIN:
        qw, qx, qy, qz = quat[0] / length, quat[1] / length, quat[2] / length, quat[3] / length
    turn = (
        1 - 2 * (qy * qy + qz * qz),
        2 * (qx * qy - qw * qz),
        2 * (qx * qz + qw * qy),
        2 * (qx * qy + qw * qz),
        1 - 2 * (qx * qx + qz * qz),
        2 * (qy * qz - qw * qx),
        2 * (qx * qz - qw * qy),
        2 * (qy * qz + qw * qx),
        1 - 2 * (qx * qx + qy * qy),
    )
    axes = (
        jw[0] * turn[0] + jw[1] * turn[3] + jw[2] * turn[6],
        jw[0] * turn[1] + jw[1] * turn[4] + jw[2] * turn[7],
        jw[0] * turn[2] + jw[1] * turn[5] + jw[2] * turn[8],
        jw[3] * turn[0] + jw[4] * turn[3] + jw[5] * turn[6],
        jw[3] * turn[1] + jw[4] * turn[4] + jw[5] * turn[7],
        jw[3] * turn[2] + jw[4] * turn[5] + jw[5] * turn[8],
    )
    s0, s1, s2 = np.float64(scale[0]), np.float64(scale[1]), np.float64(scale[2])
    xx = (axes[0] * s0) ** 2 + (axes[1] * s1) ** 2 + (axes[2] * s2) ** 2 + LOW_PASS
    yy = (axes[3] * s0) ** 2 + (axes[4] * s1) ** 2 + (axes[5] * s2) ** 2 + LOW_PASS
    xy = axes[0] * axes[3] * s0 * s0 + axes[1] * axes[4] * s1 * s1 + axes[2] * axes[5] * s2 * s2
    # det(M Mᵀ + εI) by Cauchy-Binet: a sum of squares, where xx·yy − xy² of a needle is lost to rounding.
    det = (
        ((axes[1] * axes[5] - axes[2] * axes[4]) * s1 * s2) ** 2
        + ((axes[0] * axes[5] - axes[2] * axes[3]) * s0 * s2) ** 2
        + ((axes[0] * axes[4] - axes[1] * axes[3]) * s0 * s1) ** 2
        + LOW_PASS * (xx + yy - LOW_PASS)
    )
    l1 = np.sqrt(yy / det)
    return Screen(
        x, y, z, u, v, clamped_u, clamped_v, (qw, qx, qy, qz), length, turn, jw, axes,
        center_x, center_y, xx, xy, yy, l1, -l1 * xy / yy, 1.0 / np.sqrt(yy),
    )  # fmt: skip


@njit(error_model="numpy", _nrt=False)
def to_screen_backward(
    screen: Any, mean: Any, scale: Any, view: Any, sums: Any, grad_z: Any, grad_mean: Any, grad_quat: Any,
    grad_scale: Any, grad_pose: Any, grad_screen: Any,
) -> None:  # fmt: skip
    """Gradients of one splat's geometry from the pixel sums of its pairs.

    With h = ∂L/∂(log α) and (p, q) = B·(pixel − center), ∂L/∂center = Bᵀ Σ h(p, q) and
    ∂L/∂Σ' = ½ Bᵀ (Σ h (p, q)(p, q)ᵀ) B: no inverse, no determinant.

    Args:
        sums: Σh, Σhp, Σhq, Σhp², Σhpq, Σhq².
        grad_z: ∂L/∂z from the depth image.
        grad_mean, grad_quat, grad_scale, grad_screen: written.
        grad_pose: (12,) added to.
    """
    l1, k, l2 = screen.l1, screen.k, screen.l2
    gx, gy = l1 * sums[1], k * sums[1] + l2 * sums[2]
    grad_screen[0], grad_screen[1] = gx, gy

    # M = axes · diag(scale); ∂L/∂M = 2 ∂L/∂Σ' M = Bᵀ H (B M), and B M has entries around 1.
    dj0, dj1, dj2, dj3, dj4, dj5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    axes, turn, jw = screen.axes, screen.turn, screen.jw
    dturn0, dturn1, dturn2 = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    for j in range(3):
        s = np.float64(scale[j])
        a0, a1 = axes[j], axes[3 + j]
        b0, b1 = (l1 * a0 + k * a1) * s, l2 * a1 * s
        c0, c1 = sums[3] * b0 + sums[4] * b1, sums[4] * b0 + sums[5] * b1
        dm0, dm1 = l1 * c0, k * c0 + l2 * c1
        grad_scale[j] = dm0 * a0 + dm1 * a1
        da0, da1 = dm0 * s, dm1 * s
        column = (jw[0] * da0 + jw[3] * da1, jw[1] * da0 + jw[4] * da1, jw[2] * da0 + jw[5] * da1)
        if j == 0:
            dturn0 = column
        elif j == 1:
            dturn1 = column
        else:
            dturn2 = column
        dj0 += da0 * turn[j]
        dj1 += da0 * turn[3 + j]
        dj2 += da0 * turn[6 + j]
        dj3 += da1 * turn[j]
        dj4 += da1 * turn[3 + j]
        dj5 += da1 * turn[6 + j]
    _quat_backward(screen.quat, screen.length, dturn0, dturn1, dturn2, grad_quat)

    fx, fy = view[FX], view[FY]
    d00 = dj0 * view[0] + dj1 * view[1] + dj2 * view[2]
    d02 = dj0 * view[8] + dj1 * view[9] + dj2 * view[10]
    d11 = dj3 * view[4] + dj4 * view[5] + dj5 * view[6]
    d12 = dj3 * view[8] + dj4 * view[9] + dj5 * view[10]
    if view[ORTHOGRAPHIC] != 0.0:
        j00, j02, j11, j12 = fx, 0.0, fy, 0.0
        dx, dy, dz = fx * gx, fy * gy, grad_z
    else:
        inverse = 1.0 / screen.z
        j00, j02 = fx * inverse, -fx * screen.u * inverse
        j11, j12 = fy * inverse, -fy * screen.v * inverse
        du = fx * gx + (0.0 if screen.clamped_u else -j00 * d02)
        dv = fy * gy + (0.0 if screen.clamped_v else -j11 * d12)
        dinverse = fx * (d00 - screen.u * d02) + fy * (d11 - screen.v * d12) + du * screen.x + dv * screen.y
        dx, dy, dz = du * inverse, dv * inverse, grad_z - inverse * inverse * dinverse
    for j in range(3):
        grad_mean[j] = view[j] * dx + view[4 + j] * dy + view[8 + j] * dz
        grad_pose[j] += dx * mean[j]
        grad_pose[4 + j] += dy * mean[j]
        grad_pose[8 + j] += dz * mean[j]
    grad_pose[3] += dx
    grad_pose[7] += dy
    grad_pose[11] += dz
    dj = (dj0, dj1, dj2, dj3, dj4, dj5)
    for j in range(3):
        grad_pose[j] += j00 * dj[j]
        grad_pose[4 + j] += j11 * dj[3 + j]
        grad_pose[8 + j] += j02 * dj[j] + j12 * dj[3 + j]


@njit(error_model="numpy", _nrt=False)
def _quat_backward(quat: Any, length: Any, c0: Any, c1: Any, c2: Any, grad: Any) -> None:
    """From ∂L/∂R, given by its columns, to the quaternion before it was normalised."""
    if length <= QUAT_MIN:
        grad[:] = 0.0
        return
    w, x, y, z = quat
    r00, r10, r20 = c0
    r01, r11, r21 = c1
    r02, r12, r22 = c2
    dw = 2 * (-z * r01 + y * r02 + z * r10 - x * r12 - y * r20 + x * r21)
    dx = 2 * (y * r01 + z * r02 + y * r10 - 2 * x * r11 - w * r12 + z * r20 + w * r21 - 2 * x * r22)
    dy = 2 * (-2 * y * r00 + x * r01 + w * r02 + x * r10 + z * r12 - w * r20 + z * r21 - 2 * y * r22)
    dz = 2 * (-2 * z * r00 - w * r01 + x * r02 + w * r10 - 2 * z * r11 + y * r12 + x * r20 + y * r21)
    along = w * dw + x * dx + y * dy + z * dz
    grad[0] = (dw - w * along) / length
    grad[1] = (dx - x * along) / length
    grad[2] = (dy - y * along) / length
    grad[3] = (dz - z * along) / length
