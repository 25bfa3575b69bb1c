"""How much photos show: edges by their length and contrast, at the size that they are trained at, and no noise."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from insideout.core.capture.model import Photo
from insideout.core.errors import Cancelled
from insideout.core.forecast.detail import photo_detail
from insideout.core.forecast.speed import _camera


@pytest.fixture
def photo(tmp_path):
    """`photo(image)` (H, W) of 0..255, in a file that loses nothing, with a camera."""

    def saved(image):
        path = tmp_path / f"{len(list(tmp_path.iterdir()))}.png"
        Image.fromarray(np.repeat(image[..., None], 3, axis=-1).astype(np.uint8)).save(path)
        bare = Photo(path, None)
        return replace(bare, camera=_camera(bare))

    return saved


def square(side, size=96, bright=255):
    image = np.zeros((size, size))
    image[8 : 8 + side, 8 : 8 + side] = bright
    return image


def test_edges_count_by_their_length_and_contrast(photo):
    small, long, faint = (photo_detail([photo(square(*of))], 800) for of in ((20,), (40,), (40, 96, 128)))
    assert small == pytest.approx(80, rel=0.05)
    assert long == pytest.approx(2 * small, rel=0.05)
    assert faint == pytest.approx(0.5 * long, rel=0.05)


def test_photos_count_as_they_are_trained_on(photo):
    whole = photo(square(64, 192))
    assert photo_detail([whole], 96) == pytest.approx(0.5 * photo_detail([whole], 192), rel=0.1)


def test_a_little_noise_is_no_detail(photo):
    rng = np.random.default_rng(0)
    noisy = square(40) * 0.9 + 10 + rng.normal(0, 1.0, (96, 96))
    clean = square(40) * 0.9 + 10
    assert photo_detail([photo(noisy)], 800) == pytest.approx(photo_detail([photo(clean)], 800), rel=0.1)


def test_it_is_the_mean_of_a_few_photos_and_can_be_stopped(photo):
    photos = [photo(square(20)), photo(square(40))]
    assert photo_detail(photos, 800) == pytest.approx(np.mean([photo_detail([one], 800) for one in photos]))

    def stop():
        raise Cancelled

    with pytest.raises(Cancelled):
        photo_detail(photos, 800, stop)
