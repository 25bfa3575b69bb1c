"""Backgrounds that are the same image, and that image without what stands before it."""

import numpy as np
import pytest

from insideout.core.effects.look.still import (
    alike,
    groups,
    in_one_light,
    is_background,
    is_covered,
    most_common,
    tolerance_of,
)
from insideout.core.phantoms.photos import exposed
from insideout.core.phantoms.room import room

SIZE, COUNT = 48, 12


def still(seed=0, count=COUNT, noise=0.0):
    """Bytes of photos of one room, before which a square goes from left to right."""
    rng = np.random.default_rng(seed)
    behind = room(SIZE, SIZE, 0.1, rng)
    photos = np.tile(behind, (count, 1, 1, 1)) + noise * rng.standard_normal((count, SIZE, SIZE, 3))
    for index, photo in enumerate(photos):
        left = 6 + round(24 * index / (count - 1))
        photo[16:32, left : left + 12] = rng.random(3)
    return np.round(255 * photos.clip(0, 1)).astype(np.uint8), behind


def as_floats(levels):
    return [image / 255 for image in levels]


def test_patterns_at_the_same_pixels_are_alike_and_others_are_not():
    same, textures = alike(as_floats(still(noise=0.01)[0]))
    other, _ = alike([room(SIZE, SIZE, 0.1, np.random.default_rng(seed)) for seed in range(COUNT)])
    apart = ~np.eye(COUNT, dtype=bool)
    assert same[apart].min() > 0.8
    assert np.abs(other[apart]).max() < 0.4
    assert np.isnan(np.diag(same)).all()
    assert (textures > 0.02).all()


def test_photos_of_several_sizes_are_not_compared():
    images = [*as_floats(still()[0]), *[np.zeros((SIZE, 2 * SIZE, 3))] * 2]
    correlations, _ = alike(images)
    assert np.isnan(correlations[:COUNT, COUNT:]).all()
    assert np.isfinite(correlations[0, 1])


def test_a_camera_that_stood_at_two_heights_has_two_backgrounds():
    images = [image for seed in (0, 1) for image in as_floats(still(seed)[0])]
    images.append(room(SIZE, SIZE, 0.1, np.random.default_rng(7)))
    found = groups(alike(images)[0], 0.5)
    assert [members.tolist() for members in found] == [list(range(COUNT)), list(range(COUNT, 2 * COUNT))]
    assert groups(np.full((1, 1), np.nan), 0.5) == []


def test_few_photos_that_are_alike_by_chance_are_no_group():
    correlations = np.full((30, 30), 0.1)
    correlations[:4, :4] = 0.9
    np.fill_diagonal(correlations, np.nan)
    assert groups(correlations, 0.5) == []


def test_the_background_is_what_most_photos_show():
    levels, behind = still()
    plate, share = most_common(levels, 0.03)
    assert np.abs(plate - behind).max() < 0.01
    assert share.min() > 0.3
    assert is_background(share, COUNT).all()
    assert 0.1 < is_covered(share) < 0.6


def test_it_is_found_where_hardly_a_third_of_the_photos_show_it():
    levels, behind = still()
    rng = np.random.default_rng(3)
    for image in levels[4:]:
        image[20:28, 20:28] = np.round(255 * rng.random(3))
    plate, _ = most_common(levels, 0.03)
    assert np.abs(plate - behind)[20:28, 20:28].max() < 0.01


def test_what_looks_the_same_from_all_sides_is_the_objects_unless_it_reaches_the_border():
    share = np.ones((20, 20))
    share[4:16, 4:16] = 0.5
    share[7:13, 7:13] = 1.0
    known = is_background(share, 12)
    assert not known[7:13, 7:13].any()
    assert known[0].all()
    assert known[5, 5]
    share[4:16, 4:16] = 1 / 12
    assert not is_background(share, 12)[5, 5]


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.02])
def test_the_tolerance_is_above_noise(noise):
    tolerance = tolerance_of(still(noise=noise)[0])
    assert tolerance == pytest.approx(max(0.03, 4 * noise), rel=0.15)


def test_exposures_are_evened_out_before_photos_are_compared():
    levels, behind = still()
    assert in_one_light(levels) is levels
    gains = np.exp2(np.linspace(-0.5, 0.5, COUNT))
    differing = np.stack([exposed(image, (gain,) * 3) for image, gain in zip(levels, gains, strict=True)])
    assert np.abs(in_one_light(differing)[:, 0].astype(int) - np.round(255 * behind[0])).max() <= 4
    plate, share = most_common(in_one_light(differing), 0.03)
    assert np.abs(plate - behind).max() < 0.02
    assert share[0].min() == 1


def test_looking_can_be_stopped():
    class StoppedError(Exception):
        pass

    def tick():
        raise StoppedError

    with pytest.raises(StoppedError):
        most_common(still()[0], 0.03, tick)
