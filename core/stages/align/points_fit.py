"""Refining the similarity by triangulated points: where there is texture, the sharpest measure of a surface.

Centres of splats lie inside of what they show, by a thickness that differs from place to place; a feature that
several photos see is triangulated on the surface itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ...similarity import Similarity
from ...views import Camera
from .icp import Anchors, plane_step, tells_offset_from_scale, turn_between
from .surfaces import OuterSurface, in_foreground, project

_LEAST_POINTS = 300
# Share of the X-ray surface that has a triangulated point within 5 % of the extent.
_LEAST_COVERAGE = 0.5
# Outliers among triangulated points: this share of the nearest is used.
_KEEP = 0.85
# A fit that begins where it ends may come out as much worse.
_SLACK = 1.01
# How far (voxels) an isosurface may well lie off the true one.
_OFFSET_SIGMA = 0.3
# Features that lie on the surface scatter about it by less than this share of a voxel or pixel, whichever is larger:
# 0.2 on painted wood; 0.8 on plain plastic, where what is matched are highlights and shades, and their mean is off too.
_SHARP = 0.5


@dataclass(frozen=True, eq=False)
class PointsFit:
    """What the refinement found.

    Attributes:
        similarity: refined, or the start when it was not accepted.
        points: how many points were used.
        residual_before_mm, residual_after_mm: median distance of the points from a surface at their median height.
        misfit_before_mm, misfit_after_mm: root mean square of that distance, without outliers.
        offset_mm: how far outside of the isosurface they lie.
        accepted, reason: whether the refinement is an improvement, and why.
        sharp: whether the points lie on a surface as well as outlines tell it.
    """

    similarity: Similarity
    points: int
    residual_before_mm: float
    residual_after_mm: float
    misfit_before_mm: float
    misfit_after_mm: float
    offset_mm: float
    accepted: bool
    reason: str
    sharp: bool = False


def refine_by_points(
    start: Similarity,
    points: np.ndarray,
    views: Sequence[tuple[Camera, np.ndarray | None]],
    surface: OuterSurface,
    *,
    landmarks: Anchors | None = None,
    iterations: int = 60,
    on_iteration: Callable[[], None] = lambda: None,
) -> PointsFit:
    """Point-to-plane ICP from triangulated points to the X-ray surface, one way, from a start that is close.

    Args:
        start: photo frame to mm.
        points: (P, 3) sparse points in the photo frame.
        views: cameras with foreground masks, to leave out points of the background.
        landmarks: picked pairs that hold a body of revolution.
        on_iteration: called between iterations; may raise to stop.
    """
    points = np.asarray(points, np.float64)
    points = points[np.isfinite(points).all(axis=1)]
    points = points[in_foreground(points, views)] if views else points
    distance = surface.tree.query(start.apply(points))[0] if len(points) else np.zeros(0)
    points = points[distance < 0.05 * surface.extent]

    def refused(reason: str) -> PointsFit:
        nan = float("nan")
        return PointsFit(start, len(points), nan, nan, nan, nan, 0.0, False, reason)

    if len(points) < _LEAST_POINTS:
        return refused(f"left out: only {len(points)} triangulated points lie near the X-ray surface")
    reach = cKDTree(start.apply(points)).query(surface.points)[0]
    if (reach < 0.05 * surface.extent).mean() < _LEAST_COVERAGE:
        return refused("left out: triangulated points cover too little of the surface")
    expected = _OFFSET_SIGMA * surface.voxel if tells_offset_from_scale(surface) else 0.0
    current, offset = start, 0.0
    for _ in range(iterations):
        on_iteration()
        moved = current.apply(points)
        distance, nearest = surface.tree.query(moved)
        kept = np.argsort(distance, kind="stable")[: round(_KEEP * len(points))]
        goal = surface.points[nearest[kept]] + offset * surface.normals[nearest[kept]]
        before = current
        current, growth = plane_step(
            current, points[kept], goal, surface.normals[nearest[kept]], surface.extent, landmarks, (offset, expected)
        )
        offset += growth
        if np.abs(current.apply(points[:100]) - before.apply(points[:100])).max() < 1e-5 * surface.extent:
            break
    before, after = (_off_height(similarity, points, surface) for similarity in (start, current))
    before_mm, after_mm = _misfit(before), _misfit(after)
    small = abs(np.log(current.scale / start.scale)) < 0.06 and turn_between(current, start) < 6.0
    scatter_mm = float(np.median(after))
    accepted = bool(small and after_mm <= _SLACK * before_mm)
    heights = f"triangulated points lie {after_mm:.3f} mm off the surface at their height, {before_mm:.3f} mm before"
    return PointsFit(
        current if accepted else start,
        len(points),
        float(np.median(before)),
        scatter_mm,
        before_mm,
        after_mm,
        offset,
        accepted,
        f"kept: {heights}" if accepted else f"taken back: {heights}",
        scatter_mm < _SHARP * max(surface.voxel, _pixel_mm(current, surface, [camera for camera, _ in views])),
    )


def _pixel_mm(similarity: Similarity, surface: OuterSurface, cameras: Sequence[Camera]) -> float:
    """A pixel's side at the object's middle, of the median perspective camera, in the photos' size for outlines; 0
    without one."""
    middle = similarity.inverse().apply(surface.points.mean(axis=0))[None]
    sides = [project(middle, camera)[1][0] / camera.fx for camera in cameras if not camera.orthographic]
    return similarity.scale * float(np.median(sides)) if sides else 0.0


def _off_height(similarity: Similarity, points: np.ndarray, surface: OuterSurface) -> np.ndarray:
    """(P,) distances in mm of the points from the median height over the surface at which this similarity lays them.

    Along the surface's normals: it is told by points of its own that lie a voxel or more apart, and the distance to the
    nearest of those is a percent less with a scale that is 0.8 to 1.6 % off than with the true one.
    """
    moved = similarity.apply(points)
    nearest = surface.tree.query(moved)[1]
    height = ((moved - surface.points[nearest]) * surface.normals[nearest]).sum(axis=1)
    return np.abs(height - np.median(height))


def _misfit(off_height: np.ndarray) -> float:
    """Root mean square in mm, outliers left out."""
    kept = np.sort(off_height)[: max(1, round(_KEEP * len(off_height)))]
    return float(np.sqrt(np.square(kept).mean()))
