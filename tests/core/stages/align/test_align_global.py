"""Global fitting finds the photo frame's similarity from shape, or says why it cannot."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from insideout.core.gaussians import GaussianSet
from insideout.core.similarity import Similarity
from insideout.core.stages.align import global_fit
from insideout.core.stages.align.global_fit import (
    cube_rotations,
    describe_ambiguity,
    fit_globally,
    fit_to_landmarks,
    landmarks_problem,
    principal_axes,
    uniform_rotations,
)
from insideout.core.stages.align.icp import refine, umeyama
from insideout.core.stages.align.surfaces import outer_surface, shell_points


def _fit(rgb, surface, rotations=24):
    shell = shell_points(rgb)
    fit = fit_globally(shell, surface, rotations=rotations)
    return fit, describe_ambiguity(fit, shell, surface, decided=False)


@pytest.mark.parametrize(("seed", "rotations"), [(0, 576), (1, 24), (2, 24)])
def test_random_frames_are_found_to_half_a_percent_one_degree_half_a_millimetre(seed, rotations, bodies, lump_surface):
    rgb, truth = bodies.shell(bodies.lump, seed)
    fit, ambiguity = _fit(rgb, lump_surface, rotations)
    errors = bodies.errors(fit.best.similarity, truth, rgb.means)
    assert errors.on_target, errors
    assert fit.best.overlaps
    assert ambiguity["kind"] == "none"


@pytest.mark.slow
def test_twenty_of_twenty_random_frames_are_found(bodies, lump_surface):
    missed = []
    for seed in range(20):
        rgb, truth = bodies.shell(bodies.lump, seed)
        errors = bodies.errors(_fit(rgb, lump_surface, 576)[0].best.similarity, truth, rgb.means)
        if not errors.on_target:
            missed.append((seed, errors))
    assert not missed


def test_a_bottom_that_no_photo_shows_does_no_harm(bodies, lump_surface):
    rgb, truth = bodies.shell(bodies.lump, 3, missing_bottom=0.2)
    fit, _ = _fit(rgb, lump_surface)
    assert bodies.errors(fit.best.similarity, truth, rgb.means).on_target


def test_floaters_are_left_out_of_the_shell_and_do_no_harm(bodies, lump_surface):
    rgb, truth = bodies.shell(bodies.lump, 4, floaters=0.05)
    members = shell_points(rgb).members
    assert members[:5000].mean() > 0.99
    assert members[5000:].mean() < 0.1
    fit, _ = _fit(rgb, lump_surface)
    assert bodies.errors(fit.best.similarity, truth, rgb.means[:5000]).on_target


def test_a_body_of_revolution_is_said_to_be_undecidable_and_landmarks_decide_it(bodies, vase_surface):
    rgb, truth = bodies.shell(bodies.vase, 5)
    _, ambiguity = _fit(rgb, vase_surface)
    assert ambiguity["kind"] == "continuous"
    assert "landmarks" in ambiguity["message"]
    assert abs(ambiguity["axis"][2]) > 0.99
    random = np.random.default_rng(0)
    picked = rgb.means[random.choice(len(rgb), 4, replace=False)].astype(np.float64)
    shell = shell_points(rgb)
    noisy = truth.apply(picked) + random.normal(0, 0.3, picked.shape)
    by_landmarks = fit_to_landmarks(shell, vase_surface, picked, noisy)
    alone = bodies.errors(umeyama(picked, noisy), truth, rgb.means)
    errors = bodies.errors(by_landmarks.best.similarity, truth, rgb.means)
    assert errors.on_target, errors
    assert errors.mm < alone.mm
    assert describe_ambiguity(by_landmarks, shell, vase_surface, decided=True)["decided_by_landmarks"]


def test_a_relief_of_a_fifth_of_a_millimetre_does_not_decide_the_turn(bodies):
    """A carved Matryoshka: turned, it lies worse than the fit by more than a smooth vase does, and still too well."""

    def carved(points):
        relief = 1 + 0.013 * np.cos(3 * np.arctan2(points[..., 1], points[..., 0]) + points[..., 2] / 15)
        return bodies.vase(points / np.stack([relief, relief, np.ones_like(relief)], axis=-1))

    rgb, _ = bodies.shell(carved, 5)
    _, ambiguity = _fit(rgb, outer_surface(bodies.volume(carved), 8000, seed=0))
    assert 1.3 < ambiguity["score_ratio_turned"][1] < 1.5
    assert ambiguity["kind"] == "continuous"


def test_a_box_reports_its_runner_up(bodies, box_surface):
    rgb, _ = bodies.shell(bodies.box, 6)
    fit, ambiguity = _fit(rgb, box_surface)
    assert ambiguity["kind"] == "discrete"
    assert fit.runner_up is not None
    assert fit.runner_up.score_mm < 1.25 * fit.best.score_mm


@pytest.mark.parametrize(("scores", "expected"), [((1.0, 2.0), (0, 90)), ((1.0, 0.5), (90, 0))])
def test_a_start_that_slides_into_the_best_fit_is_no_runner_up(scores, expected, monkeypatch):
    """Of starts at 0, 40 and 90 degrees the refinement brings the second to within a degree of the first."""

    def turned(degrees):
        return SimpleNamespace(
            similarity=Similarity(1.0, Rotation.from_euler("z", degrees, degrees=True).as_matrix()), degrees=degrees
        )

    monkeypatch.setattr(global_fit, "_finish", lambda fit, *_: turned(1 if fit.degrees == 40 else fit.degrees))
    known = {0: scores[0], 1: scores[0] + 0.1, 90: scores[1]}
    monkeypatch.setattr(global_fit, "_whole", lambda fit, *_: known[fit.degrees])
    best, runner_up = global_fit._two_best([turned(degrees) for degrees in (0, 40, 90)], None, None, lambda: None)
    assert (best.degrees, runner_up.degrees) == expected
    alone = global_fit._two_best([turned(0), turned(40)], None, None, lambda: None)
    assert (alone[0].degrees, alone[1]) == (0, None)


def test_a_mirrored_body_is_never_answered_with_a_reflection(bodies, lump_surface):
    rgb, _ = bodies.shell(bodies.lump, 7)
    mirrored = GaussianSet.create(rgb.means * np.array([-1, 1, 1], np.float32), rgb.scales, opacities=0.8)
    fit, _ = _fit(mirrored, lump_surface)
    for one in filter(None, (fit.best, fit.runner_up)):
        assert np.linalg.det(one.similarity.rotation) == pytest.approx(1.0, abs=1e-6)
        assert one.similarity.scale > 0


def test_the_rotations_tried_are_all_proper():
    for rotations in (cube_rotations(), uniform_rotations(576)):
        assert np.allclose(np.linalg.det(rotations), 1.0)
        assert np.allclose(rotations @ rotations.swapaxes(1, 2), np.eye(3), atol=1e-9)
    assert len(np.unique(cube_rotations().round(6), axis=0)) == 24


@pytest.mark.parametrize(
    "covariance",
    [np.eye(3), np.diag([1.0, 0, 0]), np.diag([1.0, 1.0, 0]), np.zeros((3, 3)), np.full((3, 3), np.nan)],
    ids=["sphere", "line", "plane", "point", "nan"],
)
def test_principal_axes_of_degenerate_shapes_are_a_proper_rotation(covariance):
    axes = principal_axes(covariance)
    assert np.allclose(axes.T @ axes, np.eye(3), atol=1e-9)
    assert np.linalg.det(axes) == pytest.approx(1.0)


@pytest.mark.parametrize("to_planes", [True, False])
def test_icp_between_shapes_that_share_nothing_stays_finite_and_says_so(to_planes, bodies, lump_surface):
    random = np.random.default_rng(0)
    line = np.outer(np.linspace(-1, 1, 2000), [1.0, 2.0, 3.0]) + random.normal(0, 1e-3, (2000, 3))
    shell = shell_points(GaussianSet.create(line, 0.01, opacities=0.8))
    fit = refine(Similarity(1.0, np.eye(3), np.full(3, 5000.0)), shell, lump_surface, iterations=1, to_planes=to_planes)
    assert np.isfinite(fit.similarity.apply(line)).all()
    assert np.isfinite(fit.score_mm)
    assert not fit.overlaps


def test_the_scale_does_not_collapse_when_the_start_is_too_small(bodies, lump_surface):
    rgb, truth = bodies.shell(bodies.lump, 8)
    start = Similarity(0.6 * truth.scale, truth.rotation, np.zeros(3))
    start = Similarity(start.scale, start.rotation, -start.apply(rgb.means.astype(np.float64)).mean(axis=0))
    shell = shell_points(rgb)
    rough = refine(start, shell, lump_surface, to_planes=False, iterations=40)
    fit = refine(rough.similarity, shell, lump_surface)
    assert bodies.errors(fit.similarity, truth, rgb.means).on_target


def test_umeyama_recovers_a_similarity_and_survives_identical_points():
    random = np.random.default_rng(1)
    points = random.normal(size=(10, 3))
    truth = Similarity(2.5, uniform_rotations(50)[17], np.array([1.0, -2.0, 3.0]))
    found = umeyama(points, truth.apply(points))
    assert np.allclose(found.apply(points), truth.apply(points), atol=1e-9)
    same = umeyama(np.ones((5, 3)), np.zeros((5, 3)))
    assert np.allclose(same.apply(np.ones((5, 3))), 0.0)


def test_landmarks_that_decide_nothing_are_named():
    line = np.outer([0.0, 1.0, 2.0, 3.0], [1.0, 1.0, 0.0])
    triangle = np.array([[0.0, 0, 0], [10, 0, 0], [0, 10, 0]])
    assert "line" in str(landmarks_problem(line, line))
    assert "three" in str(landmarks_problem(triangle[:2], triangle[:2]))
    assert landmarks_problem(triangle, triangle) is None
