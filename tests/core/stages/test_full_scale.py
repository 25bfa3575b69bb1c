"""What projections are divided by before they are compared, and how differences count then, by what is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from insideout.core.capture.model import CountingNoise, Projections
from insideout.core.stages.internal.joint import JointTrainer
from insideout.core.stages.internal.joint_settings import JointSettings
from insideout.core.stages.internal.targets import SectionSeries
from insideout.core.stages.internal.xray import DensityLoss
from insideout.core.stages.surface import PRESETS
from insideout.core.stages.surface.xray import XraySettings, XrayTrainer, body_scale
from insideout.core.train.schedule import shuffled


@pytest.fixture
def screwed(shells_context):
    """The shells' projections, and those with one ray of 8 times the largest line integral.

    It is in another projection than both fits show first: nothing but the full scale changes for those.
    """
    projections = shells_context.capture.projections
    images, training = projections.images.copy(), np.flatnonzero(~projections.held_out).tolist()
    first = {shuffled(training, 0, 0), shuffled(training, 0, 0, 2)}
    images[next(index for index in training if index not in first), 0, 0] = 8 * images.max()
    return projections, replace(projections, images=images)


@pytest.fixture
def pull(shells_context):
    """Gradient (N,) by the densities of one projection, of settings and projections that are changed."""

    def of(projections=None, **changes):
        capture, run = shells_context.capture, shells_context.run
        start, series = run.read_set("surface", "xray"), SectionSeries(run.volume(), ("axial",))
        shown = projections or capture.projections
        settings = replace(JointSettings(smooth_weight=0.0, photos_attenuate=False), **changes)
        colored = np.zeros(len(start), bool)
        trainer = JointTrainer(start, None, shown, series, settings, 0.08, colored, seed=0, kernel="cpu")
        trainer._step_projection(0)
        return trainer.parameters.gradient("density").copy()

    return of


def test_rays_through_a_screw_hardly_shrink_what_all_others_weigh(shells_context, screwed):
    start = shells_context.run.read_set("surface", "xray")

    def shrinks(full_scale):
        settings = XraySettings(full_scale=full_scale, squares_weight=30.0, structure_weight=0.0, smooth_weight=0.0)
        plain, steel = (XrayTrainer(start, one, 4 / 3, 0.08, settings, 0, "cpu").step(0) for one in screwed)
        return steel / plain

    assert shrinks("peak") == pytest.approx(1 / 64, rel=1e-3)
    assert shrinks("body") > 0.3


def test_nor_in_the_joint_refinement(pull, screwed):
    plain, steel = (np.abs(pull(one, radiograph_structure_weight=0.0, straight_from=None)).max() for one in screwed)
    assert plain > 0
    assert steel > 0.3 * plain


def test_large_differences_count_straight_on(pull):
    squared = pull(straight_from=None, radiograph_structure_weight=0.0)
    nearly = pull(straight_from=1e-6, radiograph_structure_weight=0.0)
    assert np.abs(nearly).max() < 0.01 * np.abs(squared).max()


def test_full_scale_of_the_shorter_presets_is_the_body_s_and_never_more_than_the_largest():
    """Half of a toy gun's rays measure a 25th of what a few through its steel do."""
    plain = np.full((1, 40, 40), 0.4, np.float32)
    steel = plain.copy()
    steel[0, 0, :2] = 10.0
    box = np.array([[-4.0] * 3, [4.0] * 3])
    with_steel, without = (Projections(i, [], np.zeros(1, bool), np.zeros(1), box, (8, 8, 8)) for i in (steel, plain))
    assert body_scale(with_steel, [0]) < 2.0
    assert body_scale(without, [0]) == without.peak([0])
    assert all(PRESETS[name].xray.full_scale == "body" for name in ("draft", "standard"))


class TestNoisyRays:
    """Of a photon in a pixel of air as good as nothing is known; of a million nearly all."""

    @pytest.fixture
    def counted(self, shells_context):
        projections = shells_context.capture.projections
        return lambda photons: replace(projections, noise=CountingNoise(1 / photons, 0.0, usual=0.01))

    def test_the_fit_of_projections_looks_at_what_is_known(self, shells_context, counted):
        start = shells_context.run.read_set("surface", "xray")
        settings = XraySettings(squares_weight=30.0, smooth_weight=0.0)

        def left(projections):
            return XrayTrainer(start, projections, 4 / 3, 0.08, settings, 0, "cpu").step(0)

        plain = left(shells_context.capture.projections)
        assert plain > 0
        assert left(counted(1e9)) == pytest.approx(plain, rel=1e-2)
        assert left(counted(1.0)) < 1e-3 * plain

    def test_of_smaller_projections_more_is_known(self, counted):
        small = counted(1000.0).in_blocks(2)
        assert small.noise == CountingNoise(1 / 4000, 0.0, 0.01)

    def test_so_does_the_joint_refinement(self, pull, counted):
        plain, known, unknown = (np.abs(pull(one)).max() for one in (None, counted(1e9), counted(1.0)))
        assert known == pytest.approx(plain, rel=1e-2)
        assert unknown < 1e-3 * plain

    def test_and_the_paper_s_route(self, shells_context, counted):
        start = shells_context.run.read_set("surface", "xray").to_torch()
        series = SectionSeries(shells_context.run.volume(), ("axial",))

        def left(projections):
            loss = DensityLoss(series, projections, 1.0, 0.2, "cpu", 0)
            return float(loss._projection_loss(start, 0))

        plain = left(shells_context.capture.projections)
        assert left(counted(1e9)) == pytest.approx(plain, rel=1e-2)
        assert left(counted(1.0)) < 1e-3 * plain
