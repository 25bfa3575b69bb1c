"""A room's texture, and photos of a phantom that turns before it."""

from dataclasses import replace

import numpy as np
import pytest

from insideout.core.errors import SettingError
from insideout.core.phantoms.distance_grid import DistanceGrid
from insideout.core.phantoms.make import make_capture
from insideout.core.phantoms.photos import BACKGROUND, render_photo
from insideout.core.phantoms.room import room
from insideout.core.phantoms.shots import plan_shots
from insideout.core.phantoms.truth import read_truth

STILL = ("moving_background",)


def test_a_room_has_patterns_of_all_sizes_and_the_contrast_that_is_asked_for():
    image = room(96, 64, 0.1, np.random.default_rng(0))
    assert image.shape == (64, 96, 3)
    assert 0 <= image.min() < image.max() <= 1
    np.testing.assert_allclose(image.std(axis=(0, 1)), 0.1, rtol=0.1)
    power = np.abs(np.fft.fft2(image[..., 0] - image[..., 0].mean())) ** 2
    frequency = np.hypot(np.fft.fftfreq(64)[:, None], np.fft.fftfreq(96)[None])
    slow, fast = (power[(frequency > low) & (frequency < 2 * low)].mean() for low in (0.05, 0.2))
    assert slow / fast == pytest.approx(16, rel=0.5)
    assert np.array_equal(image, room(96, 64, 0.1, np.random.default_rng(0)))
    assert not np.array_equal(image, room(96, 64, 0.1, np.random.default_rng(1)))


def test_all_photos_show_the_same_room_and_nothing_else_is_different(ball, ball_settings):
    plain, still = (
        plan_shots(32.0, replace(ball_settings, effects=effects), np.random.default_rng(1))
        for effects in (("exposure",), ("exposure", *STILL))
    )
    grid = DistanceGrid.bake(ball.surface, np.array(ball.size_mm), 0.5)
    for one, other in zip(plain, still, strict=True):
        assert one.gain == other.gain
        assert one.backdrop is None
        np.testing.assert_array_equal(other.backdrop, still[0].backdrop)
        np.testing.assert_array_equal(one.camera.world_to_camera, other.camera.world_to_camera)
    before, behind = (render_photo(ball, grid, replace(shots[0], gain=None)) for shots in (plain, still))
    away = np.abs(before - BACKGROUND).max(axis=-1) < 1e-6
    assert 0.1 < away.mean() < 0.9
    np.testing.assert_allclose(behind[away], still[0].backdrop[away], atol=1e-6)
    inside = np.abs(before - BACKGROUND).max(axis=-1) > 0.2
    assert np.median(np.abs(behind - before)[inside]) < 1e-6


def test_truth_says_so(tmp_path, only_ball, ball_settings):
    make_capture("ball", tmp_path / "still", replace(ball_settings, effects=STILL))
    assert read_truth(tmp_path / "still").effects == STILL


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"effects": (*STILL, "motion_blur")}, "needs a camera that stands still, and motion_blur moves it"),
        ({"effects": (*STILL, "rolling_shutter")}, "and rolling_shutter moves it; leave one of them out"),
        ({"effects": STILL, "photos_by": "cycles"}, "needs --photos-by rays"),
        ({"effects": STILL, "room_contrast": 0.0}, "room_contrast"),
    ],
)
def test_what_does_not_fit_is_named(ball_settings, changes, message):
    with pytest.raises(SettingError, match=message):
        replace(ball_settings, **changes).check()
