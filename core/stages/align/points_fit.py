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
from .icp import Anchors, disc_distance, plane_step, tells_offset_from_scale, turn_between
from .surfaces import OuterSurface, in_foreground, project

_LEAST_POINTS = 300
# Share of the X-ray surface that has a triangulated point within 5 % of the extent.
_LEAST_COVERAGE = 0.5
# Outliers among triangulated points: this share of the nearest is used.
_KEEP = 0.85
# A start that was as good already may come out better by this factor.
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
        residual_before_mm, residual_after_mm: median distance of the points from their median height over the surface.
        misfit_before_mm, misfit_after_mm: mean distance of all but outliers from the surface at that height.
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
    scatter_before_mm, before_mm = _off_surface(start, points, surface)
    scatter_mm, after_mm = _off_surface(current, points, surface)
    small = abs(np.log(current.scale / start.scale)) < 0.06 and turn_between(current, start) < 6.0
    accepted = bool(small and after_mm <= _SLACK * before_mm)
    heights = f"triangulated points lie {after_mm:.3f} mm off the surface at their height, {before_mm:.3f} mm before"
    return PointsFit(
        current if accepted else start,
        len(points),
        scatter_before_mm,
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


def _off_surface(similarity: Similarity, points: np.ndarray, surface: OuterSurface) -> tuple[float, float]:
    """How far in mm points lie from their median height over the surface, along its normals and in the median, and from
    the surface moved out to there, on average without outliers.

    Its own points lie a voxel or more apart. That counts for nothing: the nearest of them were 1.3 % nearer for a
    pharaoh whose scale was 0.8 % off than for the true one.
    """
    moved = similarity.apply(points)
    nearest = surface.tree.query(moved)[1]
    away, normals = moved - surface.points[nearest], surface.normals[nearest]
    heights = (away * normals).sum(axis=1)
    height = float(np.median(heights))
    distance = np.sort(disc_distance(away - height * normals, normals, surface.spacing))
    kept = distance[: max(1, round(_KEEP * len(distance)))]
    return float(np.median(np.abs(heights - height))), float(kept.mean())
