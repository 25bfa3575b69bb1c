"""Local and fine fitting: clusters of splats, then single splats, moved onto the X-rayed surface."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from ...gaussians import GaussianSet
from ...rotations import multiply_quats, normalize_quats
from .kmeans import kmeans
from .surfaces import OuterSurface

# Below this many splats a cluster has no shape of its own and is only shifted.
_LEAST_FOR_RIGID = 6
# How many neighbouring clusters a splat's move is blended from.
_BLENDED = 6


@dataclass(frozen=True, eq=False)
class Moves:
    """What a step wants to do with each splat.

    Attributes:
        shift: (N, 3) mm.
        turn: (N, 3) rotation vectors.
        clusters, matched: how many there were, and how many found a partner.
    """

    shift: np.ndarray
    turn: np.ndarray
    clusters: int
    matched: int

    def applied(self, gaussians: GaussianSet, strength: float = 1.0) -> GaussianSet:
        """The set moved by a share of the step; colours stay as they are, the turns are of a degree or so."""
        turn = Rotation.from_rotvec(strength * self.turn).as_quat()[:, [3, 0, 1, 2]]
        return replace(
            gaussians,
            means=(gaussians.means + strength * self.shift).astype(np.float32),
            quats=normalize_quats(multiply_quats(turn, gaussians.quats.astype(np.float64))).astype(np.float32),
        )


def cluster_moves(
    rgb: GaussianSet, members: np.ndarray, surface: OuterSurface, divisor: int, limit: int, seed: int
) -> Moves:
    """One level of local fitting (paper, Alg. 1) with K = N / divisor clusters.

    RGB splats and surface points are clustered separately; clusters whose centroids are mutually nearest belong
    together, and each is moved on its own to the tangent planes of the surface: turned and shifted, or only
    shifted when it has fewer than six splats. Moves along the surface would follow where the centroids happened
    to fall, so only what brings a cluster nearer to the surface counts. The moves are blended over neighbouring
    clusters with Gaussian weights, and no splat moves further than one local spacing of the clusters.

    Args:
        rgb: numpy set in mm.
        members: (N,) bool, the splats on the object.
        divisor: 10, 2 or 1.
        limit: at most this many splats and surface points are clustered.
    """
    random = np.random.default_rng(seed)
    means = rgb.means.astype(np.float64)
    index = np.flatnonzero(members)
    count = min(len(index), len(surface.points), limit)
    index = np.sort(random.choice(index, count, replace=False))
    chosen = np.sort(random.choice(len(surface.points), count, replace=False))
    points = means[index]
    clusters = max(1, count // divisor)
    centroids, labels = kmeans(points, clusters, seed)
    goals, _ = kmeans(surface.points[chosen], clusters, seed + 1)
    spacing = _spacing(centroids, surface.extent)
    matched = _mutual(centroids, goals, 2.0 * spacing)
    nothing = Moves(np.zeros_like(means), np.zeros_like(means), len(centroids), int(matched.sum()))
    if not matched.any():
        return nothing
    turns, shifts = _cluster_steps(points, labels, centroids, surface, spacing)
    shift, turn = _blended(means, centroids[matched], turns[matched], shifts[matched], spacing)
    return replace(nothing, shift=_limited(shift, spacing), turn=turn)


def normal_moves(rgb: GaussianSet, members: np.ndarray, surface: OuterSurface) -> Moves:
    """Fine fitting: each splat on the object moves along the surface's normal, by at most half a local spacing."""
    means = rgb.means.astype(np.float64)
    shift = np.zeros_like(means)
    index = np.flatnonzero(members)
    spacing = _spacing(means[index], surface.extent)
    distance, nearest = surface.tree.query(means[index])
    normals = surface.normals[nearest]
    height = ((means[index] - surface.points[nearest]) * normals).sum(axis=1)
    near = distance < 2.0 * spacing + surface.spacing
    shift[index[near]] = -(np.clip(height, -0.5 * spacing, 0.5 * spacing)[:, None] * normals)[near]
    return Moves(shift, np.zeros_like(shift), len(index), int(near.sum()))


def _spacing(points: np.ndarray, fallback: float) -> float:
    """Median distance to the nearest other point."""
    if len(points) < 2:
        return 0.02 * fallback
    return float(np.median(cKDTree(points).query(points, k=2)[0][:, 1]))


def _mutual(first: np.ndarray, second: np.ndarray, reach: float) -> np.ndarray:
    """Which of `first` have a partner in `second` that is nearest both ways and within reach."""
    distance, there = cKDTree(second).query(first)
    back = cKDTree(first).query(second)[1]
    return (back[there] == np.arange(len(first))) & (distance < reach)


def _cluster_steps(
    points: np.ndarray, labels: np.ndarray, centroids: np.ndarray, surface: OuterSurface, spacing: float
) -> tuple[np.ndarray, np.ndarray]:
    """Each cluster's rotation vector (K, 3) about its centroid, and shift (K, 3): damped point-to-plane."""
    nearest = surface.tree.query(points)[1]
    normals = surface.normals[nearest]
    residual = ((points - surface.points[nearest]) * normals).sum(axis=1)
    # A splat far off (a hole that only one side shows) must not tilt its cluster.
    weight = 1.0 / (1.0 + (residual / max(spacing, 1e-9)) ** 2)
    arm = (points - centroids[labels]) / max(spacing, 1e-9)
    rows = np.concatenate([np.cross(arm, normals), normals], axis=1)
    count = len(centroids)
    hessian, gradient = np.zeros((count, 6, 6)), np.zeros((count, 6))
    np.add.at(hessian, labels, weight[:, None, None] * rows[:, :, None] * rows[:, None, :])
    np.add.at(gradient, labels, (weight * residual)[:, None] * rows)
    sizes = np.bincount(labels, minlength=count)
    rigid = (sizes >= _LEAST_FOR_RIGID).astype(float)
    hessian[:, :3] *= rigid[:, None, None]
    hessian[:, :, :3] *= rigid[:, None, None]
    gradient[:, :3] *= rigid[:, None]
    # Damping: turns a clump of points hardly fixes, and shifts along the surface, stay near zero.
    damping = np.diag([1.0, 1.0, 1.0, 0.1, 0.1, 0.1]) * (0.3 * np.maximum(sizes, 1))[:, None, None]
    steps = -np.linalg.solve(hessian + damping, gradient[..., None])[..., 0]
    return steps[:, :3] / max(spacing, 1e-9), steps[:, 3:]


def _blended(
    means: np.ndarray, centroids: np.ndarray, turns: np.ndarray, shifts: np.ndarray, spacing: float
) -> tuple[np.ndarray, np.ndarray]:
    """Shift and turn (N, 3) of each splat from its neighbouring clusters; fades out away from all clusters."""
    distance, near = cKDTree(centroids).query(means, k=min(_BLENDED, len(centroids)))
    distance, near = distance.reshape(len(means), -1), near.reshape(len(means), -1)
    weight = np.exp(-0.5 * (distance / (1.5 * spacing)) ** 2)
    total = weight.sum(axis=1, keepdims=True)
    share = weight / np.maximum(total, 1e-12) * np.minimum(1.0, total)
    turned = np.cross(turns[near], means[:, None, :] - centroids[near])
    shift = (share[..., None] * (shifts[near] + turned)).sum(axis=1)
    return shift, (share[..., None] * turns[near]).sum(axis=1)


def _limited(shift: np.ndarray, limit: float) -> np.ndarray:
    length = np.linalg.norm(shift, axis=1, keepdims=True)
    return shift * np.minimum(1.0, limit / np.maximum(length, 1e-12))
