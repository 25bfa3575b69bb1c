"""How the joint refinement compares projections: as `surface` does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from insideout.core.stages.internal.joint import JointTrainer
from insideout.core.stages.internal.joint_settings import JointSettings
from insideout.core.stages.internal.targets import SectionSeries
from insideout.core.train.schedule import shuffled


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


def test_rays_through_a_screw_do_not_shrink_what_all_others_weigh(pull, shells_context):
    projections = shells_context.capture.projections
    images, training = projections.images.copy(), np.flatnonzero(~projections.held_out)
    other = next(index for index in training if index != shuffled(training.tolist(), 0, 0))
    images[other, 0, 0] = 8 * images.max()
    untouched = pull(radiograph_structure_weight=0.0, straight_from=None)
    assert np.abs(untouched).max() > 0
    # As shares of the largest line integral it would be a 64th.
    screwed = pull(replace(projections, images=images), radiograph_structure_weight=0.0, straight_from=None)
    assert np.abs(screwed).max() > 0.3 * np.abs(untouched).max()


def test_large_differences_count_straight_on(pull):
    squared = pull(straight_from=None, radiograph_structure_weight=0.0)
    nearly = pull(straight_from=1e-6, radiograph_structure_weight=0.0)
    assert np.abs(nearly).max() < 0.01 * np.abs(squared).max()
