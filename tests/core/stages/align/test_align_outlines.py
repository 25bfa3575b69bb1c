"""Outlines in the photos correct what the splats' centres get wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from insideout.core.similarity import Similarity
from insideout.core.stages.align.icp import Anchors, turn_between
from insideout.core.stages.align.silhouettes import (
    Outline,
    mean_overlap,
    refine_by_outlines,
    signed_distance,
    silhouette_of,
)
from insideout.core.views import Camera


def _cameras(truth: Similarity, count: int = 8, side: int = 200) -> list[Camera]:
    """Cameras in the photo frame looking at the object from all around."""
    cameras = []
    for number in range(count):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("xyz", [0.7 * (-1) ** number, 2 * np.pi * number / count, 0.2]).as_matrix()
        pose[2, 3] = 230.0
        in_mm = Camera(side, side, 1.9 * side, 1.9 * side, 0.5 * side, 0.5 * side, pose)
        cameras.append(in_mm.transformed(truth.inverse()))
    return cameras


@pytest.fixture
def truth():
    return Similarity(40.0, Rotation.from_euler("xyz", [0.3, -0.8, 1.2]).as_matrix(), np.array([5.0, -9.0, 3.0]))


def _outlines(truth, surface, side=200):
    vertices = truth.inverse().apply(surface.vertices)
    cameras = _cameras(truth, side=side)
    return [Outline.of(camera, silhouette_of(vertices, surface.faces, camera)) for camera in cameras]


def test_a_start_off_by_two_percent_two_degrees_and_a_millimetre_is_mended(truth, bodies, lump_surface):
    outlines = _outlines(truth, lump_surface)
    turn = Rotation.from_rotvec(np.radians([1.0, -1.5, 0.8])).as_matrix()
    start = Similarity(truth.scale * 1.02, turn @ truth.rotation, truth.translation + np.array([0.6, -0.6, 0.5]))
    fit = refine_by_outlines(start, lump_surface, outlines)
    errors = bodies.errors(fit.similarity, truth, truth.inverse().apply(lump_surface.points))
    assert fit.accepted
    assert fit.overlap_after > 0.985 > fit.overlap_before
    assert errors.on_target, errors
    assert errors.mm < 0.25


def test_an_isovalue_set_too_high_shifts_the_surface_but_not_the_scale(truth, bodies, lump_surface):
    outlines = _outlines(truth, lump_surface)
    inner = replace(
        lump_surface,
        vertices=lump_surface.vertices - 0.4 * lump_surface.vertex_normals,
        points=lump_surface.points - 0.4 * lump_surface.normals,
    )
    fit = refine_by_outlines(truth, inner, outlines, iterations=15)
    assert fit.offset_mm == pytest.approx(0.4, abs=0.15)
    assert bodies.errors(fit.similarity, truth, truth.inverse().apply(lump_surface.points)).on_target


def test_landmarks_keep_holding_a_body_of_revolution(truth, bodies, vase_surface):
    """Outlines alone turn a vase by 16 degrees while they mend its size: their edges, pixel by pixel, are no relief."""
    outlines = _outlines(truth, vase_surface, side=50)
    start = Similarity(1.05 * truth.scale, truth.rotation, truth.translation)
    target = vase_surface.points[:: len(vase_surface.points) // 5]
    source = truth.inverse().apply(target)
    landmarks = Anchors(source, target, 0.005 * vase_surface.extent)
    fit = refine_by_outlines(start, vase_surface, outlines, landmarks=landmarks)
    assert fit.accepted
    assert bodies.errors(fit.similarity, truth, source).on_target
    adrift = refine_by_outlines(start, vase_surface, outlines).similarity
    assert turn_between(adrift, truth) > 5


def test_picks_that_scatter_leave_the_size_to_the_outlines(truth, vase_surface):
    outlines = _outlines(truth, vase_surface)
    target = vase_surface.points[:: len(vase_surface.points) // 5]
    source = truth.inverse().apply(1.02 * target)
    landmarks = Anchors(source, target, 0.02 * vase_surface.extent)
    start = Similarity(truth.scale / 1.02, truth.rotation, truth.translation)
    fit = refine_by_outlines(start, vase_surface, outlines, landmarks=landmarks)
    assert fit.accepted
    assert fit.similarity.scale == pytest.approx(truth.scale, rel=0.005)


def test_outlines_of_something_else_are_refused(truth, lump_surface):
    outlines = _outlines(truth, lump_surface)
    wrong = [Outline.of(outline.camera, np.roll(outline.mask, 60, axis=1)) for outline in outlines]
    fit = refine_by_outlines(truth, lump_surface, wrong)
    assert not fit.accepted
    assert fit.similarity is truth
    assert fit.offset_mm == 0.0


def test_signed_distance_crosses_zero_at_the_edge_with_slope_one():
    mask = np.zeros((20, 20), bool)
    mask[:, 10:] = True
    assert np.allclose(signed_distance(mask)[5, 7:13], [2.5, 1.5, 0.5, -0.5, -1.5, -2.5])
    assert (signed_distance(np.zeros((4, 4), bool)) > 0).all()
    assert (signed_distance(np.ones((4, 4), bool)) < 0).all()


def test_a_triangle_behind_the_camera_casts_no_silhouette():
    camera = Camera(20, 20, 20.0, 20.0, 10.0, 10.0, np.eye(4))
    triangle = np.array([[-1.0, -1, 4], [1, -1, 4], [0, 1, 4]])
    faces = np.array([[0, 1, 2]])
    assert silhouette_of(triangle, faces, camera).sum() > 10
    assert not silhouette_of(triangle * [1, 1, -1], faces, camera).any()


def test_the_overlap_with_itself_is_whole(truth, lump_surface):
    assert mean_overlap(truth, lump_surface, _outlines(truth, lump_surface)) == 1.0
