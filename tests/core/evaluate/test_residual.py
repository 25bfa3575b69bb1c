"""Residuals of splats against their definition, ray by ray, and on models that are wrong in one place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from insideout.core.capture.model import Projections
from insideout.core.errors import Cancelled
from insideout.core.evaluate.residual import residual_figures, splat_residuals
from insideout.core.gaussians import GaussianSet, Modality
from insideout.core.render import radiograph
from insideout.core.views import Detector


def _detectors(count, pixels=24, pitch=2.4):
    found = []
    for angle in np.arange(count) * 2 * np.pi / count:
        out = np.array([np.cos(angle), np.sin(angle), 0.0])
        across = np.array([-np.sin(angle), np.cos(angle), 0.0])
        found.append(Detector(pixels, pixels, 100 * out, -50 * out, pitch * across, np.array([0, 0, -pitch])))
    return found


def _projections(model, count=12, **pixels):
    detectors = _detectors(count, **pixels)
    images = np.stack([radiograph(model.to_torch(), detector).numpy() for detector in detectors])
    box = np.array([[-15.0] * 3, [15.0] * 3])
    return Projections(images, detectors, np.zeros(count, bool), np.zeros(count), box, (32, 32, 32), 100.0, 150.0)


@pytest.fixture(scope="module")
def ball():
    rng = np.random.default_rng(4)
    directions = rng.normal(size=(1200, 3))
    means = 12 * directions / np.linalg.norm(directions, axis=1, keepdims=True) * rng.random((1200, 1)) ** (1 / 3)
    quats = rng.normal(size=(1200, 4))
    return GaussianSet.create(
        means, rng.uniform(0.6, 1.4, (1200, 3)), quats=quats, density=0.01, modality=Modality.XRAY
    )


def _by_definition(model, projections):
    """Σ w |m - p| / Σ w with w of each splat alone, in float64."""
    exact = model.to_torch(torch.float64)
    above, below = np.zeros((2, len(model)))
    for image, detector in zip(projections.images, projections.detectors, strict=True):
        apart = np.abs(image - radiograph(exact, detector, "reference").numpy())
        for index in range(len(model)):
            one = exact.select(slice(index, index + 1))
            one = replace(one, density=torch.ones(1, dtype=torch.float64), modality=torch.ones(1, dtype=torch.uint8))
            weights = radiograph(one, detector, "reference").numpy()
            above[index] += (weights * apart).sum()
            below[index] += weights.sum()
    return 100 * above / below / projections.images.max()


@pytest.mark.parametrize("kernel", ["reference", "cpu"])
def test_it_is_what_its_definition_says(ball, kernel):
    few = ball.select(slice(0, 40))
    few = replace(few, modality=np.resize([0, 1, 2], 40).astype(np.uint8))
    projections = _projections(replace(few, density=few.density * np.linspace(0.5, 1.5, 40)), count=3)
    found = splat_residuals(few, projections, kernel, lambda: None)
    np.testing.assert_allclose(found, _by_definition(few, projections), rtol=2e-4)


def test_a_model_that_is_right_has_none(ball):
    assert splat_residuals(ball, _projections(ball), "cpu", lambda: None).max() < 1e-3


@pytest.mark.parametrize("factor", [0.0, 2.5])
@pytest.mark.parametrize("place", [(0.0, 0, 0), (6.0, -3, 4)])
def test_it_is_largest_where_density_is_missing_or_too_much(ball, factor, place):
    away = np.linalg.norm(ball.means - np.array(place), axis=1)
    wrong = replace(ball, density=np.where(away < 2.5, factor * ball.density, ball.density).astype(np.float32))
    found = splat_residuals(wrong, _projections(ball, pixels=32, pitch=1.6), "cpu", lambda: None)
    assert away[np.argmax(found)] < 2.5
    assert away[np.argsort(found)[-10:]].max() < 4
    assert np.median(found[away < 2]) > 4 * np.median(found[away > 6])


def test_a_constant_difference_is_the_same_everywhere(ball):
    projections = _projections(ball)
    off = replace(projections, images=projections.images + 0.02)
    found = splat_residuals(ball, off, "cpu", lambda: None)
    np.testing.assert_allclose(found, 100 * 0.02 / off.images.max(), rtol=1e-3)


def test_what_no_ray_passes_has_none(ball):
    aside = replace(ball, means=ball.means + np.float32([0, 0, 500]))
    both = GaussianSet.concatenate([ball, aside])
    found = splat_residuals(both, _projections(ball), "cpu", lambda: None)
    assert np.isfinite(found[: len(ball)]).all()
    assert np.isnan(found[len(ball) :]).all()


def test_dead_pixels_count_for_nothing(ball):
    projections = _projections(ball)
    projections.images[:, 3:9, 4:20] = np.nan
    found = splat_residuals(ball, projections, "cpu", lambda: None)
    known = np.isfinite(found)
    assert found[known].max() < 1e-3
    # Of splats that dead pixels alone would show nothing is known.
    assert 0.8 < known.mean() < 1


def test_many_projections_are_sampled_evenly(ball, monkeypatch):
    monkeypatch.setattr("insideout.core.evaluate.residual.MOST_VIEWS", 4)
    looked = []
    splat_residuals(ball, _projections(ball, count=10), "cpu", lambda: looked.append(1))
    assert len(looked) == 4


def test_it_can_be_stopped(ball):
    def stop():
        raise Cancelled("stopped")

    with pytest.raises(Cancelled):
        splat_residuals(ball, _projections(ball), "cpu", stop)


def test_the_figures_weigh_splats_by_their_attenuation():
    splats = GaussianSet.create(np.zeros((4, 3)), 1.0, density=[0.0, 0.01, 0.03, 0.01], modality=Modality.XRAY)
    figures = residual_figures(np.array([50.0, 1.0, 2.0, np.nan]), splats)
    assert figures["mean"] == pytest.approx(1.75)
    assert figures["p95"] == 2.0
    assert residual_figures(np.full(4, np.nan), splats)["mean"] is None
