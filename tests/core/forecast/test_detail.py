"""What photos show: edges by their length and contrast as they are trained on, no noise, and the object's size."""

import numpy as np
import pytest
from PIL import Image

from insideout.core.capture.model import Photo
from insideout.core.errors import Cancelled
from insideout.core.forecast.detail import look_at_photos


@pytest.fixture
def photo(tmp_path):
    """`photo(image)` (H, W) of 0..255, in a file that loses nothing."""

    def saved(image):
        path = tmp_path / f"{len(list(tmp_path.iterdir()))}.png"
        Image.fromarray(np.repeat(image[..., None], 3, axis=-1).astype(np.uint8)).save(path)
        return Photo(path, None)

    return saved


def square(side, size=96, bright=255):
    image = np.zeros((size, size))
    image[size // 4 : size // 4 + side, size // 4 : size // 4 + side] = bright
    return image


def detail(photos, long_side=800):
    return look_at_photos(photos, long_side).detail


def test_edges_count_by_their_length_and_contrast(photo):
    small, long, faint = (detail([photo(square(*of))]) for of in ((20,), (40,), (40, 96, 128)))
    assert small == pytest.approx(80, rel=0.05)
    assert long == pytest.approx(2 * small, rel=0.05)
    assert faint == pytest.approx(0.5 * long, rel=0.05)


def test_photos_count_as_they_are_trained_on(photo):
    whole = [photo(square(64, 192))]
    assert detail(whole, 96) == pytest.approx(0.5 * detail(whole, 192), rel=0.1)
    assert detail(whole, 800) == detail(whole, 192), "they are never enlarged"


def test_a_little_noise_is_no_detail(photo):
    clean = square(40) * 0.9 + 10
    noisy = clean + np.random.default_rng(0).normal(0, 1.0, clean.shape)
    assert detail([photo(noisy)]) == pytest.approx(detail([photo(clean)]), rel=0.1)


def test_of_many_photos_four_are_looked_at(photo, tmp_path):
    photos = [photo(square(8 * index)) for index in range(1, 6)]
    expected = np.mean([detail([photos[index]]) for index in (0, 1, 3, 4)])
    assert detail(photos) == pytest.approx(expected)


def test_before_a_plain_background_the_object_has_a_size(photo):
    assert look_at_photos([photo(square(40))] * 3, 800).covered == pytest.approx((40 / 96) ** 2, rel=0.1)
    noise = np.random.default_rng(0).integers(0, 255, (96, 96))
    assert look_at_photos([photo(noise)], 800).covered is None


def test_it_can_be_stopped(photo):
    def stop():
        raise Cancelled

    with pytest.raises(Cancelled):
        look_at_photos([photo(square(20))], 800, stop)
