"""Splats of a body that bends: each follows the map as it is around its own centre. Numpy alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .affine import principal_axes
from .gaussians import GaussianSet
from .rotations import normalize_quats, quats_to_matrices
from .spherical_harmonics import rotate_sh_each

MOST_STRETCH = 10.0
"""How many times thinner than its thinnest axis, or longer than its longest, a deformed splat's axes may get."""

# Gradients of single precision are the identity only to this: it would turn the axes of round splats at random.
_ROUNDING = 1e-5
# Of the product of a shape's three columns, a volume below which their directions are lost in rounding.
_FLAT = 1e-9
_TINY = float(np.finfo(np.float32).tiny)


def deformed(gaussians: GaussianSet, means: np.ndarray, gradients: np.ndarray) -> GaussianSet:
    """The numpy set under a map whose gradient F differs from splat to splat, linearised at each centre.

    Covariances become F Σ Fᵀ, and colours turn by the rotation nearest to F (PhysGaussian, arXiv 2311.12198). The
    integral of each splat's attenuation, ρ·(2π)^{3/2}·s₁s₂s₃, stays: matter that is pressed together is denser, by
    1 / |det F|. Opacities stay.

    Any F has a splat for an answer. Mirrored it is the same ellipsoid, for that has no handedness. Axes that F would
    squeeze to nothing or pull to a thread end at `MOST_STRETCH`, and the density with them. Where F or the new centre
    is no number, or an axis of the splat, it stays as it was.

    Args:
        gaussians: N splats; results have its precision.
        means: (N, 3) centres after the map.
        gradients: (N, 3, 3), F[n, i, j] the change of coordinate i along axis j.
    """
    means, gradients = np.asarray(means, np.float64), np.asarray(gradients, np.float64)
    sound = np.isfinite(means).all(axis=1) & np.isfinite(gradients).all(axis=(1, 2))
    sound &= np.isfinite(gaussians.scales).all(axis=1)
    still = ~sound | (np.abs(gradients - np.eye(3)) < _ROUNDING).all(axis=(1, 2))
    gradients = np.where(still[:, None, None], np.eye(3), gradients)
    before = np.maximum(gaussians.scales, _TINY).astype(np.float64)
    turns = normalize_quats(gaussians.quats.astype(np.float64))
    shapes = quats_to_matrices(turns) * np.where(sound[:, None], before, 1.0)[:, None, :]
    quats, lengths = _ellipsoids(gradients @ shapes)
    # Of the two quaternions of a rotation the one that is nearer to what was there.
    quats *= np.where((quats * turns).sum(axis=1) < 0, -1.0, 1.0)[:, None]
    lengths = np.clip(
        lengths, before.min(axis=1, keepdims=True) / MOST_STRETCH, before.max(axis=1, keepdims=True) * MOST_STRETCH
    )
    quats[still], lengths[still] = turns[still], before[still]
    lengths = lengths.astype(gaussians.scales.dtype)
    # By the axes as they are kept, so that rounding them loses no mass.
    squeezed = np.where(still, 1.0, np.prod(before / lengths.astype(np.float64), axis=1))
    return replace(
        gaussians,
        means=np.where(sound[:, None], means, gaussians.means).astype(gaussians.means.dtype),
        quats=quats.astype(gaussians.quats.dtype),
        scales=lengths,
        sh=turned_colors(gaussians.sh, gradients),
        density=(gaussians.density * squeezed).astype(gaussians.density.dtype),
    )


def _ellipsoids(shapes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """As `principal_axes`, for shapes (N, 3, 3) that may be flat or nothing at all: lengths may be 0."""
    columns = np.linalg.norm(shapes, axis=1)
    flat = ~(np.abs(np.linalg.det(shapes)) > _FLAT * columns.prod(axis=1))
    if not flat.any():
        return principal_axes(shapes)
    quats, lengths = principal_axes(np.where(flat[:, None, None], np.eye(3), shapes))
    left, lengths[flat], _ = np.linalg.svd(shapes[flat])
    quats[flat] = principal_axes(left)[0]
    return quats, lengths


def turned_colors(sh: np.ndarray, gradients: np.ndarray) -> np.ndarray:
    """Colour functions (N, K, 3) turned by the orthogonal matrix nearest to each gradient (N, 3, 3), mirrored where it
    mirrors; where a gradient is no number they stay."""
    if sh.shape[1] == 1:
        return sh
    known = np.isfinite(gradients).all(axis=(1, 2))
    left, _, right = np.linalg.svd(np.where(known[:, None, None], gradients, np.eye(3)))
    orthogonal = left @ right
    sign = np.sign(np.linalg.det(orthogonal))
    turned = rotate_sh_each(sh, orthogonal * sign[:, None, None])
    # A mirror is a rotation and the inversion d -> -d, which changes the sign of odd bands.
    odd = np.sqrt(np.arange(sh.shape[1])).astype(int) % 2 == 1
    turned[:, odd] *= sign[:, None, None].astype(sh.dtype)
    return turned
