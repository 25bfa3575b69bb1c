"""What projections are divided by before they are compared, and how differences count then, by what is known."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from insideout.core.capture.model import CountingNoise, Projections
from insideout.core.render import radiograph
from insideout.core.stages.internal import joint
from insideout.core.stages.internal.joint import JointTrainer
from insideout.core.stages.internal.joint_settings import JointSettings
from insideout.core.stages.internal.targets import SectionSeries
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
    """Where counting noise is known, a fit pulls as if what was measured lay as much nearer to what it shows."""

    NOISE = CountingNoise(1e-4, 1e-5, most=1e9, known=0.01)

    @pytest.fixture
    def shrunk(self, shells_context):
        """The projections with the view of this index drawn towards what the first splats show, by hand."""
        projections = shells_context.capture.projections
        start = shells_context.run.read_set("surface", "xray").to_torch()

        def of(index, cutoff_sigmas):
            images = projections.images.copy()
            shown = radiograph(start, projections.detectors[index], "cpu", "exact", cutoff_sigmas).numpy()
            share = 1e-4 / (1e-4 + 1e-5 + 1e-4 * np.exp(shown))
            assert 0.1 < share.min() < share.max() < 0.6
            images[index] = shown + share * (images[index] - shown)
            return replace(projections, images=images)

        return of

    def test_the_fit_of_projections(self, shells_context, shrunk):
        projections, start = shells_context.capture.projections, shells_context.run.read_set("surface", "xray")
        # What projections are divided by is the same, whatever they are.
        settings = XraySettings(full_scale="box", squares_weight=30.0, smooth_weight=0.0)

        def pull(given):
            trainer = XrayTrainer(start, given, 4 / 3, 0.08, settings, 0, "cpu")
            gradients = []
            trainer.parameters.step = lambda rates: gradients.append(trainer.parameters.gradient("density").copy())
            trainer.step(0)
            return gradients[0]

        known = pull(replace(projections, noise=self.NOISE))
        index = shuffled(np.flatnonzero(~projections.held_out), 0, 0, 2)
        np.testing.assert_allclose(
            known, pull(shrunk(index, settings.cutoff_sigmas)), rtol=1e-3, atol=1e-4 * np.abs(known).max()
        )
        assert np.abs(known).max() < 0.7 * np.abs(pull(projections)).max()

    @pytest.mark.parametrize("cutoff", [None, 4.5])
    def test_the_joint_refinement(self, shells_context, pull, shrunk, monkeypatch, cutoff):
        """Also where splats end farther out in projections than in sections."""
        monkeypatch.setattr(joint, "body_scale", lambda *_: 2.0)
        projections, pull = shells_context.capture.projections, partial(pull, ray_cutoff_sigmas=cutoff)
        known = pull(replace(projections, noise=self.NOISE))
        index = shuffled(np.flatnonzero(~projections.held_out).tolist(), 0, 0)
        by_hand = pull(shrunk(index, cutoff or JointSettings().cutoff_sigmas))
        np.testing.assert_allclose(known, by_hand, rtol=1e-3, atol=1e-4 * np.abs(known).max())
        assert np.abs(known).max() < 0.7 * np.abs(pull(projections)).max()

    def test_of_smaller_projections_more_is_known(self, shells_context):
        small = replace(shells_context.capture.projections, noise=self.NOISE).in_blocks(2)
        assert small.noise == CountingNoise(2.5e-5, 2.5e-6, most=2.5e8, known=0.01)
