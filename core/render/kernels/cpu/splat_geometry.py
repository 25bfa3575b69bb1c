"""One splat from the world to the screen and its gradient back; scalars in float64, shared by both directions.

Everything is written out in scalars, without a branch or a library call, so that LLVM carries out the loop over splats
around it several splats at a time.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ....compiled import njit
from ....views import Camera
from ...splat import PUBLISHED_LOW_PASS
from ..reference.splat import QUAT_MIN, frustum_limits
from .math import cross, dot

# Entries of a packed view: world_to_camera's three rows (12), then these.
FX, FY, CX, CY, LEFT, RIGHT, TOP, BOTTOM, NEAR, ORTHOGRAPHIC, WIDTH, HEIGHT, LOW, MIP = range(12, 26)


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
        share: of its opacity that it is drawn with.
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
    share: Any


class ScreenGradient(NamedTuple):
    """What `to_screen_backward` finds.

    Attributes:
        mean, quat, scale: 3, 4 and 3 numbers.
        center_x, center_y: of the projected centre in pixels.
        pose: of world_to_camera's three rows, 12 numbers.
    """

    mean: Any
    quat: Any
    scale: Any
    center_x: Any
    center_y: Any
    pose: Any


def pack_view(
    camera: Camera, pose: np.ndarray, low_pass: float = PUBLISHED_LOW_PASS, mip_filter: bool = False
) -> np.ndarray:
    """A camera, and how splats are widened in its image, as (26,) float64, so that one compiled kernel serves all."""
    numbers = [camera.fx, camera.fy, camera.cx, camera.cy, *frustum_limits(camera), camera.near]
    numbers += [float(camera.orthographic), camera.width, camera.height, low_pass, float(mip_filter)]
    return np.concatenate([np.asarray(pose, np.float64)[:3, :].reshape(-1), np.array(numbers, np.float64)])


@njit(error_model="numpy", _nrt=False)
def unpacked(view: Any) -> Any:
    """A packed view as a tuple: numbers that no store can be thought to change."""
    return (
        view[0], view[1], view[2], view[3], view[4], view[5], view[6], view[7], view[8], view[9], view[10], view[11],
        view[12], view[13], view[14], view[15], view[16], view[17], view[18], view[19], view[20], view[21], view[22],
        view[23], view[24], view[25],
    )  # fmt: skip


@njit(error_model="numpy", _nrt=False, forceinline=True)
def rows_of(axes: Any, scale: Any) -> Any:
    """Both rows of M with M Mᵀ = Σ', if nothing widens it, and their cross product, whose square is |Σ'|."""
    a0, a1, a2 = axes[0] * scale[0], axes[1] * scale[1], axes[2] * scale[2]
    b0, b1, b2 = axes[3] * scale[0], axes[4] * scale[1], axes[5] * scale[2]
    c0 = (axes[1] * axes[5] - axes[2] * axes[4]) * scale[1] * scale[2]
    c1 = (axes[2] * axes[3] - axes[0] * axes[5]) * scale[0] * scale[2]
    c2 = (axes[0] * axes[4] - axes[1] * axes[3]) * scale[0] * scale[1]
    return (a0, a1, a2), (b0, b1, b2), (c0, c1, c2)


@njit(error_model="numpy", _nrt=False, forceinline=True)
def to_screen(mean: Any, quat: Any, scale: Any, view: Any) -> Any:
    """`Screen` of a splat; garbage, possibly not finite, when it lies in the camera's plane.

    Args:
        mean, quat, scale: tuples of float64, 3, 4 and 3.
        view: `unpacked`.
    """
    mx, my, mz = mean
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

    length = np.sqrt(quat[0] ** 2 + quat[1] ** 2 + quat[2] ** 2 + quat[3] ** 2)
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
    s0, s1, s2 = scale
    low = view[LOW]
    xx = (axes[0] * s0) ** 2 + (axes[1] * s1) ** 2 + (axes[2] * s2) ** 2 + low
    yy = (axes[3] * s0) ** 2 + (axes[4] * s1) ** 2 + (axes[5] * s2) ** 2 + low
    xy = axes[0] * axes[3] * s0 * s0 + axes[1] * axes[4] * s1 * s1 + axes[2] * axes[5] * s2 * s2
    # det(M Mᵀ + εI) by Cauchy-Binet: a sum of squares, where xx·yy − xy² of a needle is lost to rounding.
    narrow = (
        ((axes[1] * axes[5] - axes[2] * axes[4]) * s1 * s2) ** 2
        + ((axes[0] * axes[5] - axes[2] * axes[3]) * s0 * s2) ** 2
        + ((axes[0] * axes[4] - axes[1] * axes[3]) * s0 * s1) ** 2
    )
    det = narrow + low * (xx + yy - low)
    share = np.sqrt(narrow / det) if view[MIP] != 0.0 else 1.0
    l1 = np.sqrt(yy / det)
    return Screen(
        x, y, z, u, v, clamped_u, clamped_v, (qw, qx, qy, qz), length, turn, jw, axes,
        center_x, center_y, xx, xy, yy, l1, -l1 * xy / yy, 1.0 / np.sqrt(yy), share,
    )  # fmt: skip


@njit(error_model="numpy", _nrt=False, forceinline=True)
def to_screen_backward(screen: Any, mean: Any, scale: Any, view: Any, sums: Any, grad_z: Any) -> Any:
    """`ScreenGradient` of one splat from the pixel sums of its pairs.

    With h = ∂L/∂(log α) and (p, q) = B·(pixel − center), ∂L/∂center = Bᵀ Σ h(p, q) and
    ∂L/∂Σ' = ½ Bᵀ (Σ h (p, q)(p, q)ᵀ) B: no inverse, no determinant.

    The logarithm of the share, ½ log |Σ' − εI| − ½ log |Σ'|, has Σh as its gradient: the second term takes Σh off the
    diagonal of Σ h (p, q)(p, q)ᵀ, of the first see `_narrow_backward`.

    Args:
        sums: Σh, Σhp, Σhq, Σhp², Σhpq, Σhq².
        grad_z: ∂L/∂z from the depth image.
    """
    center = screen.l1 * sums[1], screen.k * sums[1] + screen.l2 * sums[2]
    to_share = sums[0] if view[MIP] != 0.0 else 0.0
    spread = sums[3] - to_share, sums[4], sums[5] - to_share
    x0, x1, x2, y0, y1, y2 = screen.axes
    # (yy·x − xy·y)·l1/yy by the minors of the axes: of a long needle the difference has no digits.
    minor01, minor02, minor12 = x0 * y1 - x1 * y0, x0 * y2 - x2 * y0, x1 * y2 - x2 * y1
    spread0, spread1, spread2 = scale[0] ** 2 * y0, scale[1] ** 2 * y1, scale[2] ** 2 * y2
    low, over = view[LOW], screen.l1 / screen.yy
    lean0 = over * (low * x0 + spread1 * minor01 + spread2 * minor02)
    lean1 = over * (low * x1 - spread0 * minor01 + spread2 * minor12)
    lean2 = over * (low * x2 - spread0 * minor02 - spread1 * minor12)
    first = _axis_backward(screen, lean0, y0, scale[0], spread)
    second = _axis_backward(screen, lean1, y1, scale[1], spread)
    third = _axis_backward(screen, lean2, y2, scale[2], spread)
    narrow = _narrow_backward(screen.axes, scale, to_share)
    first, second, third = _added(first, narrow[0]), _added(second, narrow[1]), _added(third, narrow[2])
    return from_axes(screen, mean, view, center, first, second, third, grad_z)


@njit(error_model="numpy", _nrt=False, forceinline=True)
def from_axes(screen: Any, mean: Any, view: Any, center: Any, first: Any, second: Any, third: Any, grad_z: Any) -> Any:
    """`ScreenGradient` of one splat from the gradients of what lies on the screen.

    Args:
        center: ∂L/∂(x, y) of the projected centre in pixels.
        first, second, third: of each axis ∂L/∂scale, and ∂L/∂x and ∂L/∂y of its direction on the screen.
        grad_z: ∂L/∂z from the depth image.
    """
    gx, gy = center
    turn, jw = screen.turn, screen.jw
    scale0, a0, b0 = first
    scale1, a1, b1 = second
    scale2, a2, b2 = third
    quat = _quat_backward(
        screen.quat,
        screen.length,
        (jw[0] * a0 + jw[3] * b0, jw[1] * a0 + jw[4] * b0, jw[2] * a0 + jw[5] * b0),
        (jw[0] * a1 + jw[3] * b1, jw[1] * a1 + jw[4] * b1, jw[2] * a1 + jw[5] * b1),
        (jw[0] * a2 + jw[3] * b2, jw[1] * a2 + jw[4] * b2, jw[2] * a2 + jw[5] * b2),
    )
    dj0 = a0 * turn[0] + a1 * turn[1] + a2 * turn[2]
    dj1 = a0 * turn[3] + a1 * turn[4] + a2 * turn[5]
    dj2 = a0 * turn[6] + a1 * turn[7] + a2 * turn[8]
    dj3 = b0 * turn[0] + b1 * turn[1] + b2 * turn[2]
    dj4 = b0 * turn[3] + b1 * turn[4] + b2 * turn[5]
    dj5 = b0 * turn[6] + b1 * turn[7] + b2 * turn[8]

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
    mx, my, mz = mean
    return ScreenGradient(
        (
            view[0] * dx + view[4] * dy + view[8] * dz,
            view[1] * dx + view[5] * dy + view[9] * dz,
            view[2] * dx + view[6] * dy + view[10] * dz,
        ),
        quat,
        (scale0, scale1, scale2),
        gx,
        gy,
        (
            dx * mx + j00 * dj0, dx * my + j00 * dj1, dx * mz + j00 * dj2, dx,
            dy * mx + j11 * dj3, dy * my + j11 * dj4, dy * mz + j11 * dj5, dy,
            dz * mx + j02 * dj0 + j12 * dj3, dz * my + j02 * dj1 + j12 * dj4, dz * mz + j02 * dj2 + j12 * dj5, dz,
        ),
    )  # fmt: skip


@njit(error_model="numpy", _nrt=False, forceinline=True)
def _axis_backward(screen: Any, lean: Any, y: Any, scale: Any, spread: Any) -> Any:
    """∂L/∂scale of one axis, and ∂L/∂(x, y) of its direction on the screen.

    A column of M = axes · diag(scale); ∂L/∂M = 2 ∂L/∂Σ' M = Bᵀ H (B M), and B M has entries of 1 at most.

    Args:
        lean: the first entry of B·(x, y), l1·x + k·y.
        spread: Σhp², Σhpq, Σhq².
    """
    a0, a1 = lean, screen.l2 * y
    c0, c1 = (spread[0] * a0 + spread[1] * a1) * scale, (spread[1] * a0 + spread[2] * a1) * scale
    dm0, dm1 = screen.l1 * c0, screen.k * c0 + screen.l2 * c1
    return c0 * a0 + c1 * a1, dm0 * scale, dm1 * scale


@njit(error_model="numpy", _nrt=False, forceinline=True)
def _narrow_backward(axes: Any, scale: Any, weight: Any) -> Any:
    """`weight` times the gradient of ½ log |M Mᵀ| = log ‖m‖, for each axis as `_axis_backward` has it.

    With X and Y the rows of M, m = X × Y: by X it is Y × m / ‖m‖², by Y m × X / ‖m‖². What is drawn has an ‖m‖ of a
    255th of √|Σ'| and more.
    """
    x, y, m = rows_of(axes, scale)
    over = weight / dot(m, m) if weight != 0.0 else 0.0
    by_x, by_y = cross(y, m), cross(m, x)
    return (
        (over * (by_x[0] * axes[0] + by_y[0] * axes[3]), over * by_x[0] * scale[0], over * by_y[0] * scale[0]),
        (over * (by_x[1] * axes[1] + by_y[1] * axes[4]), over * by_x[1] * scale[1], over * by_y[1] * scale[1]),
        (over * (by_x[2] * axes[2] + by_y[2] * axes[5]), over * by_x[2] * scale[2], over * by_y[2] * scale[2]),
    )


@njit(error_model="numpy", _nrt=False, forceinline=True)
def _added(one: Any, other: Any) -> Any:
    return one[0] + other[0], one[1] + other[1], one[2] + other[2]


@njit(error_model="numpy", _nrt=False, forceinline=True)
def _quat_backward(quat: Any, length: Any, c0: Any, c1: Any, c2: Any) -> Any:
    """From ∂L/∂R, given by its columns, to the quaternion before it was normalised."""
    w, x, y, z = quat
    r00, r10, r20 = c0
    r01, r11, r21 = c1
    r02, r12, r22 = c2
    dw = 2 * (-z * r01 + y * r02 + z * r10 - x * r12 - y * r20 + x * r21)
    dx = 2 * (y * r01 + z * r02 + y * r10 - 2 * x * r11 - w * r12 + z * r20 + w * r21 - 2 * x * r22)
    dy = 2 * (-2 * y * r00 + x * r01 + w * r02 + x * r10 + z * r12 - w * r20 + z * r21 - 2 * y * r22)
    dz = 2 * (-2 * z * r00 - w * r01 + x * r02 + w * r10 - 2 * z * r11 + y * r12 + x * r20 + y * r21)
    along = w * dw + x * dx + y * dy + z * dz
    over = 1.0 / length if length > QUAT_MIN else 0.0
    return (dw - w * along) * over, (dx - x * along) * over, (dy - y * along) * over, (dz - z * along) * over
