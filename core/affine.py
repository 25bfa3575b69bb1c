"""Splats under any affine map: moved, turned, scaled unevenly, sheared or mirrored. Numpy alone."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from .errors import SettingError
from .gaussians import GaussianSet
from .rotations import matrices_to_quats, matrix_to_quat, multiply_quats, normalize_quats, quats_to_matrices
from .spherical_harmonics import rotate_sh

# Matrices of single precision are similarities only to this.
_ROUNDING = 1e-6
# A map that squeezes one direction this much more than another leaves no third dimension.
_FLAT = 1e-6
# Cosine between two columns that counts as a right angle: a product of two rotations has some 1e-15 of rounding. Then
# the sweeps that three columns need at the very most.
_RIGHT_ANGLE, _MOST_SWEEPS = 1e-14, 20
# Splats that are transformed between two steps: some tenths of a second.
_AT_ONCE = 1 << 16
_TINY, _HUGE = float(np.finfo(np.float32).tiny), float(np.finfo(np.float32).max)


class Kept(Enum):
    """What of the attenuation stays when lengths change."""

    LINE_INTEGRALS = "line integrals"
    MATERIAL = "material"


@dataclass(frozen=True, eq=False)
class Affine:
    """The map x -> linear · x + translation.

    Attributes:
        linear: (3, 3) of any determinant but 0; negative for a mirror.
        translation: (3,) in the target frame's units.
    """

    linear: np.ndarray
    translation: np.ndarray

    @classmethod
    def of_matrix(cls, matrix: np.ndarray) -> Affine:
        """From a homogeneous matrix (4, 4) whose last row is 0 0 0 1."""
        matrix = np.asarray(matrix, np.float64)
        return cls(matrix[:3, :3], matrix[:3, 3])

    def apply(self, points: np.ndarray) -> np.ndarray:
        """(..., 3) points of the source frame in the target frame."""
        return np.asarray(points) @ self.linear.T + self.translation

    def polar(self) -> tuple[np.ndarray, np.ndarray]:
        """The orthogonal matrix (3, 3) nearest to the linear part, det +1 or -1, and the three stretches, falling.

        Raises:
            SettingError: the map leaves no volume, or is not finite.
        """
        if not (np.isfinite(self.linear).all() and np.isfinite(self.translation).all()):
            raise SettingError("The transform of the model is not finite; clear its location, rotation and scale.")
        left, stretches, right = np.linalg.svd(np.asarray(self.linear, np.float64))
        if stretches[2] <= _FLAT * stretches[0]:
            raise SettingError(
                "The transform of the model squeezes it flat (it stretches by {most:.3g}, {middle:.3g} and "
                "{least:.3g}); give it a size in every direction again.",
                most=stretches[0],
                middle=stretches[1],
                least=stretches[2],
            )
        return left @ right, stretches


def affine_transformed(gaussians: GaussianSet, affine: Affine, kept: Kept = Kept.LINE_INTEGRALS) -> GaussianSet:
    """The numpy set under an affine map A; the same as `GaussianSet.transformed` where the map is a similarity.

    Means go with the map and covariances become A Σ Aᵀ, exactly. Colours are functions of the direction of view, and
    those of an unevenly stretched function are no spherical harmonics any more: they turn by the orthogonal part of
    the polar decomposition A = Q·P, the rotation nearest to A, and a mirror mirrors them.

    Density is a matter of what the change of size means. `Kept.LINE_INTEGRALS`, as `GaussianSet.transformed`, is for
    a set in another unit, or of a scale that was wrong: the X-rays have measured the integrals, which have no unit. It
    divides by |det A|^⅓, the scale of a similarity; of an uneven map, where one number cannot keep the integrals in all
    directions, it keeps their geometric mean over the three axes of stretch. `Kept.MATERIAL` is for an object that was
    made larger: it is of the same material, attenuates as much in each millimetre, and its integrals grow.

    A map within 1e-6 of a similarity is taken for one: a rounded matrix would turn the axes of round splats at random.

    Raises:
        SettingError: the map leaves no volume, or is not finite.
    """
    orthogonal, stretches = affine.polar()
    size = float(np.prod(stretches)) ** (1 / 3)
    linear = np.asarray(affine.linear, np.float64)
    if np.ptp(stretches) < _ROUNDING * size:
        if abs(size - 1.0) < _ROUNDING and np.abs(orthogonal - np.eye(3)).max() < _ROUNDING:
            # Nothing but moved: all else stays to the last bit.
            means = gaussians.means.astype(np.float64) + affine.translation
            return replace(gaussians, means=means.astype(np.float32))
        linear = size * orthogonal
    means = gaussians.means.astype(np.float64) @ linear.T + affine.translation
    # Unit to double precision: else the axes are at right angles only nearly.
    before = normalize_quats(gaussians.quats.astype(np.float64))
    shapes = linear @ quats_to_matrices(before)
    quats, scales = principal_axes(shapes * np.maximum(gaussians.scales, _TINY).astype(np.float64)[:, None, :])
    turn = orthogonal if np.linalg.det(orthogonal) > 0 else -orthogonal
    # Of the two quaternions of a rotation the one that continues what was there.
    nearer = multiply_quats(matrix_to_quat(turn), before)
    quats *= np.where((quats * nearer).sum(axis=1) < 0, -1.0, 1.0)[:, None]
    density = gaussians.density / size if kept is Kept.LINE_INTEGRALS else gaussians.density
    return replace(
        gaussians,
        means=means.astype(np.float32),
        quats=quats.astype(np.float32),
        scales=np.clip(scales, _TINY, _HUGE).astype(np.float32),
        sh=orthogonal_sh(gaussians.sh, orthogonal),
        density=density.astype(np.float32),
    )


def affine_in_steps(
    gaussians: GaussianSet, affine: Affine, kept: Kept = Kept.LINE_INTEGRALS
) -> Generator[float, None, GaussianSet]:
    """As `affine_transformed`, with breaks that tell the share that is done, 0 to 1."""
    count, parts = len(gaussians), []
    for first in range(0, max(count, 1), _AT_ONCE):
        yield first / max(count, 1)
        parts.append(affine_transformed(gaussians.select(slice(first, first + _AT_ONCE)), affine, kept))
    return GaussianSet.concatenate(parts)


def orthogonal_sh(sh: np.ndarray, orthogonal: np.ndarray) -> np.ndarray:
    """Coefficients (N, K, 3) of the same colour functions after the object is turned, or mirrored, by a matrix (3, 3).

    A mirror is a rotation and the inversion d -> -d, under which harmonics of band l change by (-1)^l.
    """
    if np.linalg.det(orthogonal) > 0:
        return rotate_sh(sh, orthogonal)
    turned = rotate_sh(sh, -np.asarray(orthogonal))
    bands = np.sqrt(np.arange(sh.shape[1])).astype(int)
    turned[:, bands % 2 == 1] *= -1
    return turned


def principal_axes(shapes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotations as quaternions (N, 4), w first, and lengths (N, 3) > 0 of the ellipsoids that `shapes` make of a ball.

    One-sided Jacobi rotations (Hestenes 1958): M·V = R·S, so that M·Mᵀ = R·S²·Rᵀ. The columns are turned against one
    another until they are at right angles, and their product M·Mᵀ, whose thin directions would drown in rounding, is
    never formed: the shortest axis of a needle is as exact as its longest (Demmel and Veselić 1992). Columns that are
    at right angles already stay, so axes keep their order and equal ones their direction.

    Args:
        shapes: (N, 3, 3) float64 of any determinant but 0.
    """
    columns = [np.ascontiguousarray(shapes[:, :, axis]) for axis in range(3)]
    for _ in range(_MOST_SWEEPS):
        turned = [_at_right_angles(columns, *pair) for pair in ((0, 1), (0, 2), (1, 2))]
        if not any(turned):
            break
    scales = np.stack([np.linalg.norm(column, axis=1) for column in columns], axis=-1)
    axes = np.stack(columns, axis=-1) / scales[:, None, :]
    # An ellipsoid has no handedness: mirrored axes are as good.
    axes *= np.sign(np.linalg.det(axes))[:, None, None]
    return matrices_to_quats(axes), scales


def _at_right_angles(columns: list[np.ndarray], first: int, second: int) -> bool:
    """Turns two columns (N, 3) against each other where they are not at right angles; False if all of them were."""
    a, b = columns[first], columns[second]
    product = np.einsum("ni,ni->n", a, b)
    lengths_a, lengths_b = np.einsum("ni,ni->n", a, a), np.einsum("ni,ni->n", b, b)
    rows = np.flatnonzero(np.abs(product) > _RIGHT_ANGLE * np.sqrt(lengths_a) * np.sqrt(lengths_b))
    if len(rows) == 0:
        return False
    cotangent = (lengths_b[rows] - lengths_a[rows]) / (2 * product[rows])
    tangent = np.copysign(1.0, cotangent) / (np.abs(cotangent) + np.hypot(1.0, cotangent))
    cosine = (1 / np.hypot(1.0, tangent))[:, None]
    sine = cosine * tangent[:, None]
    a[rows], b[rows] = cosine * a[rows] - sine * b[rows], sine * a[rows] + cosine * b[rows]
    return True
