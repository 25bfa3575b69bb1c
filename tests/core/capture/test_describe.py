"""How far an object reaches beyond the detector."""

import numpy as np
import pytest

from insideout.core.capture.describe import cut_off_share


def views(width, height=6):
    """Four projections of a slab as wide as the detector, of which one ends before its sides."""
    images = np.ones((4, height, width), np.float32)
    images[0, :, :2] = images[0, :, -2:] = 0.0
    return images


def test_it_is_the_share_of_views_whose_object_reaches_the_side():
    assert cut_off_share(views(12), axis=2) == 0.75


@pytest.mark.parametrize(("width", "height"), [(1, 6), (2, 6), (6, 1), (1, 1)])
def test_a_detector_of_one_row_or_column_has_edges_too(width, height):
    images = np.ones((3, height, width), np.float32)
    assert cut_off_share(images, axis=2) == cut_off_share(images, axis=1) == 1.0
    assert cut_off_share(0 * images, axis=2) == 0.0
