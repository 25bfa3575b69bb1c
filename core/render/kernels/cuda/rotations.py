"""Quaternions of splats in float64: to a rotation matrix and its gradient back, for the kernels of all renderers."""

from __future__ import annotations

import warp as wp

from ..reference.splat import QUAT_MIN

# In Warp a bare number is a float32.
ZERO, ONE, TWO = (wp.constant(wp.float64(number)) for number in (0.0, 1.0, 2.0))
_QUAT_MIN = wp.constant(wp.float64(QUAT_MIN))


@wp.struct
class Turn:
    """R, the unit quaternion (w, x, y, z), and the length it had: 0 where a zero quaternion means the identity."""

    matrix: wp.mat33d
    unit: wp.vec4d
    length: wp.float64


@wp.func
def turn_of(quat: wp.vec4d) -> Turn:
    turn = Turn()
    turn.unit = wp.vec4d(ONE, ZERO, ZERO, ZERO)
    length = wp.length(quat)
    if length > _QUAT_MIN:
        turn.unit = quat / length
        turn.length = length
    w, x, y, z = turn.unit[0], turn.unit[1], turn.unit[2], turn.unit[3]
    turn.matrix = wp.mat33d(
        ONE - TWO * (y * y + z * z), TWO * (x * y - w * z), TWO * (x * z + w * y),
        TWO * (x * y + w * z), ONE - TWO * (x * x + z * z), TWO * (y * z - w * x),
        TWO * (x * z - w * y), TWO * (y * z + w * x), ONE - TWO * (x * x + y * y),
    )  # fmt: skip
    return turn


@wp.func
def quat_backward(turn: Turn, grad: wp.mat33d) -> wp.vec4d:
    """From ∂L/∂R to the quaternion before it was normalised."""
    w, x, y, z = turn.unit[0], turn.unit[1], turn.unit[2], turn.unit[3]
    # ∂R/∂q is made of differences and sums of entries that mirror each other.
    less = wp.vec3d(grad[2, 1] - grad[1, 2], grad[0, 2] - grad[2, 0], grad[1, 0] - grad[0, 1])
    xy, xz, yz = grad[0, 1] + grad[1, 0], grad[0, 2] + grad[2, 0], grad[1, 2] + grad[2, 1]
    to_unit = TWO * wp.vec4d(
        x * less[0] + y * less[1] + z * less[2],
        w * less[0] + y * xy + z * xz - TWO * x * (grad[1, 1] + grad[2, 2]),
        w * less[1] + x * xy + z * yz - TWO * y * (grad[0, 0] + grad[2, 2]),
        w * less[2] + x * xz + y * yz - TWO * z * (grad[0, 0] + grad[1, 1]),
    )
    to_quat = wp.vec4d()
    if turn.length > ZERO:
        to_quat = (to_unit - wp.dot(turn.unit, to_unit) * turn.unit) / turn.length
    return to_quat
