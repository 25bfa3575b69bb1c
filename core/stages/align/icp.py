"""Trimmed two-way ICP for similarities: points of a shell against an oriented surface."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ...progress import Tick, unstopped
from ...similarity import Similarity
from .surfaces import OuterSurface, ShellPoints

# The surface counts as this many independent measurements of its noise, however densely it is sampled.
_INDEPENDENT = 300.0
# An offset whose standard deviation is inflated more than this (engine block 1.3, lump 3.7, vase 9) is not fitted.
_MOST_INFLATION = 4.0


@dataclass(frozen=True, eq=False)
class Fit:
    """A similarity and how well it lays the shell on the surface.

    Attributes:
        similarity: photo frame to mm.
        score_mm: two-way trimmed mean distance.
        overlap: share of points within 2 % of the extent of the other side, the smaller of the two ways; below 0.3
            the shapes do not match.
        offset_mm: how far the splats' centres lie outside of the isosurface on average (negative: inside).
    """

    similarity: Similarity
    score_mm: float
    overlap: float
    offset_mm: float = 0.0

    @property
    def overlaps(self) -> bool:
        return self.overlap >= 0.3

    def to_json(self) -> dict[str, Any]:
        return {**vars(self), "similarity": self.similarity.to_json()}

    @classmethod
    def from_json(cls, content: dict[str, Any]) -> Fit:
        return cls(**{**content, "similarity": Similarity.from_json(content["similarity"])})


@dataclass(frozen=True, eq=False)
class Anchors:
    """Picked pairs that hold a fit in place, with their noise.

    Attributes:
        source, target: (L, 3) in the photo frame and in mm.
        sigma_mm: how exactly they were picked.
    """

    source: np.ndarray
    target: np.ndarray
    sigma_mm: float

    def to_json(self) -> dict[str, Any]:
        return {"source": self.source.tolist(), "target": self.target.tolist(), "sigma_mm": self.sigma_mm}

    @classmethod
    def from_json(cls, content: dict[str, Any]) -> Anchors:
        return cls(np.array(content["source"], float), np.array(content["target"], float), content["sigma_mm"])


def umeyama(source: np.ndarray, target: np.ndarray, weights: np.ndarray | None = None) -> Similarity:
    """The similarity (det +1) that maps (N, 3) `source` to `target` with the least weighted squared error.

    Umeyama, PAMI 13(4), 1991. Points without extent get the identity rotation and scale 1.
    """
    weights = np.ones(len(source)) if weights is None else weights
    weights = weights / weights.sum()
    middle, goal = weights @ source, weights @ target
    a, b = source - middle, target - goal
    spread = float(weights @ (a * a).sum(axis=1))
    if not spread > 1e-24:
        return Similarity(1.0, np.eye(3), goal - middle)
    u, d, vt = np.linalg.svd((b * weights[:, None]).T @ a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt)) or 1.0])
    rotation = (u * sign) @ vt
    scale = max(float((d * sign).sum()) / spread, 1e-9)
    return Similarity(scale, rotation, goal - scale * rotation @ middle)


def trimmed_mean(values: np.ndarray, keep: float) -> float:
    """Mean of the smallest `keep` share of the values; 0 for none."""
    if len(values) == 0:
        return 0.0
    count = max(1, round(keep * len(values)))
    return float(np.partition(values, count - 1)[:count].mean())


def two_way_score(
    similarity: Similarity, shell: ShellPoints, surface: OuterSurface, keep: float = 0.8
) -> tuple[float, float]:
    """Two-way trimmed mean distance in mm, and the share of points within 2 % of the extent (smaller way).

    Distances are to small discs, not to points: the part along the normal counts whole, the part across it only
    where it exceeds the sampling distance. So two samplings of one surface score near 0.
    """
    there, back = _distances(similarity, shell, surface)
    score = 0.5 * (trimmed_mean(there, keep) + trimmed_mean(back, keep))
    near = 0.02 * surface.extent
    return score, float(min((there < near).mean(), (back < near).mean()))


def whole_score(similarity: Similarity, shell: ShellPoints, surface: OuterSurface) -> float:
    """Two-way mean distance in mm, nothing trimmed but each distance cut at 3 % of the surface's extent.

    Unlike the trimmed score it sees a small feature (a notch, a handle) that only one of two fits gets right.
    """
    there, back = _distances(similarity, shell, surface)
    limit = 0.03 * surface.extent
    return 0.5 * float(np.minimum(there, limit).mean() + np.minimum(back, limit).mean())


def _distances(similarity: Similarity, shell: ShellPoints, surface: OuterSurface) -> tuple[np.ndarray, np.ndarray]:
    """Disc distances of shell points and of surface points, mm."""
    moved = similarity.apply(shell.points)
    index = surface.tree.query(moved)[1]
    there = disc_distance(moved - surface.points[index], surface.normals[index], surface.spacing)
    back_index = shell.tree.query(similarity.inverse().apply(surface.points))[1]
    reach = 1.5 * shell.spacing * similarity.scale
    return there, disc_distance(surface.points - moved[back_index], surface.normals, reach)


def disc_distance(offset: np.ndarray, normal: np.ndarray, radius: float) -> np.ndarray:
    """Distances (N,) to discs of a radius around the nearest points, from offsets (N, 3) and unit normals."""
    along = (offset * normal).sum(axis=1)
    across = np.sqrt(np.maximum((offset * offset).sum(axis=1) - along * along, 0.0))
    return np.hypot(along, np.maximum(across - radius, 0.0))


def refine(
    start: Similarity,
    shell: ShellPoints,
    surface: OuterSurface,
    *,
    iterations: int = 30,
    points: int = 4000,
    keep: float = 0.8,
    landmarks: Anchors | None = None,
    offset_sigma_mm: float = 0.0,
    tick: Tick = unstopped,
    to_planes: bool = True,
) -> Fit:
    """Trimmed ICP over the seven parameters of a similarity, in both directions at once.

    Correspondences from the surface back to the shell keep the scale from collapsing (Open3D #2126), trimming
    the worst of each direction lets either side miss a part (a bottom that no photo shows).

    Args:
        to_planes: distances to tangent planes (fast close to the goal); else to points (sure from far away).
        landmarks: picked pairs added to the least squares, weighted by their noise.
        offset_sigma_mm: above 0 the offset of the splats' centres from the isosurface is fitted along, expected
            within this. Splats have a thickness and their centres lie inside of what they show; taken for scale,
            that is an error of percents. Only with `to_planes`.
        tick: called between iterations; may raise to stop.
    """
    shell = thinned_shell(shell, points)
    surface = thinned_surface(surface, points)
    current, offset, level = start, 0.0, surface
    for _ in range(iterations):
        tick()
        source, target, normals = _correspondences(current, shell, level, keep)
        if to_planes:
            prior = (offset, offset_sigma_mm)
            updated, growth = plane_step(current, source, target, normals, surface.extent, landmarks, prior)
            if offset_sigma_mm > 0:
                offset = float(np.clip(offset + growth, -2 * offset_sigma_mm, 2 * offset_sigma_mm))
                level = offset_surface(surface, offset)
        else:
            updated = _point_step(source, target, landmarks)
        if not _sane(updated):
            break
        change = _largest_move(current, updated, shell.points)
        current = updated
        if change < 1e-5 * surface.extent:
            break
    score, overlap = two_way_score(current, shell, level, keep)
    return Fit(current, score, overlap, offset)


def tells_offset_from_scale(surface: OuterSurface) -> bool:
    """Whether the surface's shape lets an offset along its normals be told from the seven other parameters.

    A ball grows the same by either, and a body of revolution nearly so; thin walls and hollows tell them apart.
    Judged by how much the seven inflate the offset's standard deviation.
    """
    normals = surface.normals
    arm = (surface.points - surface.points.mean(axis=0)) / surface.extent
    along = (normals * arm).sum(axis=1, keepdims=True)
    jacobian = np.concatenate([np.cross(arm, normals), normals, along, -np.ones_like(along)], axis=1)
    information = jacobian.T @ jacobian / len(jacobian) + 1e-6 * np.eye(8)
    return bool(np.sqrt(np.linalg.inv(information)[7, 7]) < _MOST_INFLATION)


def mean_offset(similarity: Similarity, shell: ShellPoints, surface: OuterSurface, limit_mm: float) -> float:
    """How far the splats' centres lie outside of the isosurface: the median along its normals, within a limit."""
    moved = similarity.apply(shell.points)
    nearest = surface.tree.query(moved)[1]
    height = ((moved - surface.points[nearest]) * surface.normals[nearest]).sum(axis=1)
    return float(np.clip(np.median(height), -limit_mm, limit_mm))


def offset_surface(surface: OuterSurface, offset_mm: float) -> OuterSurface:
    """The surface's sample points moved out along their normals (the mesh stays)."""
    return replace(surface, points=surface.points + offset_mm * surface.normals)


def thinned_shell(shell: ShellPoints, count: int) -> ShellPoints:
    """Every n-th point; the spacing grows with what is left out."""
    step = len(shell.points) // max(count, 1)
    if step < 2:
        return shell
    return replace(shell, points=shell.points[::step], index=shell.index[::step], spacing=shell.spacing * np.sqrt(step))


def thinned_surface(surface: OuterSurface, count: int) -> OuterSurface:
    step = len(surface.points) // max(count, 1)
    if step < 2:
        return surface
    return replace(
        surface,
        points=surface.points[::step],
        normals=surface.normals[::step],
        spacing=surface.spacing * np.sqrt(step),
    )


def _correspondences(
    current: Similarity, shell: ShellPoints, surface: OuterSurface, keep: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Kept pairs of both directions: shell points (photo frame), surface points and normals."""
    moved = current.apply(shell.points)
    distance, index = surface.tree.query(moved)
    there = _nearest_share(distance, keep)
    back_distance, back_index = shell.tree.query(current.inverse().apply(surface.points))
    back = _nearest_share(back_distance, keep)
    return (
        np.concatenate([shell.points[there], shell.points[back_index[back]]]),
        np.concatenate([surface.points[index[there]], surface.points[back]]),
        np.concatenate([surface.normals[index[there]], surface.normals[back]]),
    )


def _nearest_share(distance: np.ndarray, keep: float) -> np.ndarray:
    count = max(1, round(keep * len(distance)))
    return np.argpartition(distance, count - 1)[:count]


def _point_step(source: np.ndarray, target: np.ndarray, landmarks: Anchors | None) -> Similarity:
    if landmarks is None:
        return umeyama(source, target)
    share = np.full(len(landmarks.source), 0.5 * len(source) / len(landmarks.source))
    return umeyama(
        np.concatenate([source, landmarks.source]),
        np.concatenate([target, landmarks.target]),
        np.concatenate([np.ones(len(source)), share]),
    )


def plane_step(
    current: Similarity,
    source: np.ndarray,
    target: np.ndarray,
    normals: np.ndarray,
    extent: float,
    landmarks: Anchors | None,
    prior: tuple[float, float],
) -> tuple[Similarity, float]:
    """One Gauss-Newton step on point-to-plane distances, robustly weighted: the similarity, and the offset's change.

    Args:
        prior: the current offset of the surface and its expected size in mm; a size of 0 holds it.
    """
    moved = current.apply(source)
    middle = moved.mean(axis=0)
    arm = (moved - middle) / extent
    residual = ((moved - target) * normals).sum(axis=1)
    sigma = 1.4826 * float(np.median(np.abs(residual))) + 1e-6 * extent
    weights = 1.0 / np.maximum(1.0, (residual / (1.5 * sigma)) ** 2)
    along = (normals * arm).sum(axis=1, keepdims=True)
    jacobian = np.concatenate([np.cross(arm, normals), normals, along, -np.ones_like(along)], axis=1)
    # In units of variance: neighbouring points err alike.
    share = _INDEPENDENT / (weights.sum() * sigma**2)
    hessian = share * (jacobian * weights[:, None]).T @ jacobian
    gradient = share * (jacobian * weights[:, None]).T @ residual
    if landmarks is not None:
        held, error = picked_rows(current, landmarks.source, landmarks.target, middle, extent)
        hessian[:7, :7] += held.T @ held / landmarks.sigma_mm**2
        gradient[:7] += held.T @ error / landmarks.sigma_mm**2
    # Directions that the surface leaves open (a body of revolution) must not run away.
    hessian += np.eye(8) * 1e-5 * np.trace(hessian) / 8
    offset, expected = prior
    if expected > 0:
        hessian[7, 7] += 1.0 / expected**2
        gradient[7] += offset / expected**2
    else:
        hessian[7, :], hessian[:, 7], gradient[7] = 0.0, 0.0, 0.0
        hessian[7, 7] = 1.0
    step = -np.linalg.solve(hessian, gradient)
    return moved_by(current, step[:3] / extent, step[3:6], step[6] / extent, middle), float(step[7])


def picked_rows(
    current: Similarity, source: np.ndarray, target: np.ndarray, middle: np.ndarray, extent: float
) -> tuple[np.ndarray, np.ndarray]:
    """Jacobian (3L, 7) and residual (3L,) of picked pairs (L, 3), in the unit of `target`.

    Columns: turn about `middle` times `extent`, shift, logarithm of scale times `extent`.
    """
    moved = current.apply(source)
    arm = (moved - middle) / extent
    count = len(moved)
    rows = np.zeros((count, 3, 7))
    for axis in range(3):
        unit = np.eye(3)[axis]
        rows[:, axis, :3] = np.cross(arm, unit)
        rows[:, axis, 3 + axis] = 1.0
        rows[:, axis, 6] = arm[:, axis]
    return rows.reshape(3 * count, 7), (moved - target).reshape(-1)


def moved_by(current: Similarity, turn: np.ndarray, shift: np.ndarray, growth: float, middle: np.ndarray) -> Similarity:
    """`current` followed by a small turn (rotation vector), growth (log scale) about `middle`, and a shift."""
    rotation = Rotation.from_rotvec(turn).as_matrix()
    scale = float(np.exp(np.clip(growth, -0.3, 0.3)))
    step = Similarity(scale, rotation, middle + shift - scale * rotation @ middle)
    return step.after(current)


def turn_between(first: Similarity, second: Similarity) -> float:
    """The angle in degrees between the rotations of two similarities."""
    return float(np.degrees(Rotation.from_matrix(first.rotation @ second.rotation.T).magnitude()))


def _sane(similarity: Similarity) -> bool:
    numbers = np.concatenate([[similarity.scale], similarity.rotation.ravel(), similarity.translation])
    return bool(np.isfinite(numbers).all()) and similarity.scale > 0


def _largest_move(before: Similarity, after: Similarity, points: np.ndarray) -> float:
    some = points[:: max(1, len(points) // 100)]
    return float(np.linalg.norm(before.apply(some) - after.apply(some), axis=1).max())
