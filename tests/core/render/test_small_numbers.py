"""Small weights times small gradients: under 1.2e-38 float32 loses digits, and processors calculate far slower."""

import numpy as np
import pytest

from insideout.core.render.kernels.cpu.bands import FARTHEST
from insideout.core.render.kernels.cpu.section_raster import LEAST_EMPTY
from insideout.core.render.radiograph import CUTOFF_SIGMAS
from insideout.core.settings import PRESETS, Settings

farthest_weight = np.exp(-0.5 * float(FARTHEST))


def test_the_least_there_is_of_everything_is_a_number_of_full_precision():
    gradient_of_a_pixel, opacity = 1e-4, 1e-6
    least = farthest_weight * float(LEAST_EMPTY) * gradient_of_a_pixel * opacity
    assert least > np.finfo(np.float32).tiny


def test_what_far_pixels_are_given_cannot_be_seen():
    assert farthest_weight < 0.1 * np.finfo(np.float32).eps
    assert float(LEAST_EMPTY) < 0.1 * np.finfo(np.float32).eps


def test_colours_of_cuts_which_reach_farthest_end_before_that():
    assert CUTOFF_SIGMAS**2 + 2 * np.log(100) < FARTHEST


@pytest.mark.parametrize("preset", PRESETS)
def test_splats_of_all_presets_end_before_that(preset):
    stages = Settings.of(preset).stages
    assert stages["surface"].xray.cutoff_sigmas ** 2 < FARTHEST
    assert stages["internal"].joint.cutoff_sigmas ** 2 < FARTHEST
