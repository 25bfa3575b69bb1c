"""Where a model's material begins and ends, and the cells that tell it."""

from __future__ import annotations

import numpy as np
import pytest

from insideout.core.gaussians import GaussianSet, Modality
from insideout.core.render.section_numpy import SectionSplats
from insideout.core.steps import run_through
from insideout.insideout_addon.measure.material_box import material_box_in_steps, sample_box_in_steps

CENTER, SIGMAS = np.array([3.0, -2.0, 10.0]), np.array([4.0, 2.0, 8.0])


@pytest.fixture(scope="module")
def egg():
    return SectionSplats(GaussianSet.create([CENTER], [SIGMAS], density=0.04, modality=Modality.XRAY))


def test_cells_are_where_they_should_be(egg):
    box = np.array([CENTER - 2 * SIGMAS, CENTER + 2 * SIGMAS])
    values, steps = run_through(sample_box_in_steps(egg, box, 32))
    assert values.shape == (16, 8, 32)
    np.testing.assert_allclose(steps, 1.0)
    middles = np.stack(np.meshgrid(*(box[0, i] + np.arange(n) + 0.5 for i, n in enumerate((16, 8, 32))), indexing="ij"))
    apart = (np.moveaxis(middles, 0, -1) - CENTER) / SIGMAS
    np.testing.assert_allclose(values, 0.04 * np.exp(-0.5 * (apart**2).sum(axis=-1)), rtol=1e-4)


def test_the_box_reaches_as_far_as_the_level(egg):
    """Half of 0.04 mm⁻¹ is 1.18 σ from the middle."""
    around = np.array([CENTER - SIGMAS, CENTER + SIGMAS])
    box = run_through(material_box_in_steps(egg, around, 0.02))
    reach = np.sqrt(2 * np.log(2)) * SIGMAS
    assert (box[0] <= CENTER - reach).all()
    assert (box[1] >= CENTER + reach).all()
    np.testing.assert_allclose(box[1] - box[0], 2 * reach, atol=0.8)


def test_it_is_never_smaller_than_the_box_of_the_splats(egg):
    around = np.array([CENTER - 2 * SIGMAS, CENTER + 2 * SIGMAS])
    for level in (0.02, 1.0):
        np.testing.assert_array_equal(run_through(material_box_in_steps(egg, around, level)), around)
