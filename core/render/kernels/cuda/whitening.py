"""W = S⁻¹Rᵀ, which turns a splat into a unit ball, and the way back from ∂L/∂W, in float64."""

from __future__ import annotations

import warp as wp

from ..reference.radiograph import LARGEST_SCALE, SMALLEST_SCALE
from .rotations import ONE, Turn, quat_backward, turn_of

_SMALLEST, _LARGEST = wp.constant(wp.float64(SMALLEST_SCALE)), wp.constant(wp.float64(LARGEST_SCALE))


@wp.struct
class White:
    """W, R with its quaternion, and 1 / scales."""

    matrix: wp.mat33d
    turn: Turn
    inverse: wp.vec3d


@wp.func
def _kept(scale: wp.float64) -> wp.float64:
    return wp.clamp(scale, _SMALLEST, _LARGEST)


@wp.func
def white_of(quat: wp.vec4d, scale: wp.vec3d) -> White:
    """Scales are kept within 1e-12..1e12."""
    white = White()
    white.turn = turn_of(quat)
    white.inverse = wp.vec3d(ONE / _kept(scale[0]), ONE / _kept(scale[1]), ONE / _kept(scale[2]))
    white.matrix = wp.diag(white.inverse) * wp.transpose(white.turn.matrix)
    return white


@wp.func
def white_backward(white: White, grad: wp.mat33d) -> wp.vec4d:
    """From ∂L/∂W to the quaternion."""
    return quat_backward(white.turn, wp.transpose(wp.diag(white.inverse) * grad))


@wp.func
def scales_backward(white: White, scale: wp.vec3d, grad: wp.mat33d) -> wp.vec3d:
    """From ∂L/∂W to the scales; 0 for those that are not kept as they are."""
    to_scale = wp.vec3d()
    for axis in range(3):
        if scale[axis] == _kept(scale[axis]):
            along = wp.dot(
                wp.vec3d(grad[axis, 0], grad[axis, 1], grad[axis, 2]),
                wp.vec3d(white.matrix[axis, 0], white.matrix[axis, 1], white.matrix[axis, 2]),
            )
            to_scale[axis] = -along * white.inverse[axis]
    return to_scale
