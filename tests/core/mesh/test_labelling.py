"""Connected components against scipy's."""

from __future__ import annotations

import numpy as np
import pytest

from insideout.core.mesh.labelling import label_components


@pytest.mark.parametrize("share", [0.05, 0.3, 0.5, 0.9])
@pytest.mark.parametrize("shape", [(12, 17, 9), (1, 30, 30), (20, 1, 1), (1, 1, 20)])
def test_the_same_parts_in_the_same_order_as_scipy(share, shape):
    ndimage = pytest.importorskip("scipy.ndimage")
    mask = np.random.default_rng(4).random(shape) < share

    labels, count = label_components(mask)

    expected, expected_count = ndimage.label(mask)
    assert count == expected_count
    np.testing.assert_array_equal(labels, expected)


def test_a_spiral_is_one_part():
    mask = np.zeros((1, 9, 9), bool)
    mask[0, ::4] = mask[0, :, 0] = True
    mask[0, 2, 2:] = mask[0, 2:5, 8] = True

    labels, count = label_components(mask)

    assert count == 1
    np.testing.assert_array_equal(labels > 0, mask)


def test_rows_and_slices_do_not_run_into_each_other():
    mask = np.zeros((2, 2, 3), bool)
    mask[0, 0, 2] = mask[0, 1, 0] = mask[1, 0, 1] = True

    assert label_components(mask)[1] == 3


def test_nothing_and_everything():
    assert label_components(np.zeros((3, 3, 3), bool))[1] == 0
    labels, count = label_components(np.ones((3, 4, 5), bool))
    assert count == 1
    assert (labels == 1).all()
