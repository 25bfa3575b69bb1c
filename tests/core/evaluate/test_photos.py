"""What lies behind the object is judged by the training photos alone."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from insideout.core.capture.backdrop import write_plate
from insideout.core.capture.background import foreground_mask
from insideout.core.capture.model import Backdrop, Photo, Photos
from insideout.core.evaluate.photos import photo_background, read_views, shown_or_put_background
from insideout.core.views import Camera


def test_what_is_put_behind_an_object_that_was_cut_out_is_none_of_its_colours(tmp_path):
    """Its black half was taken for background where black was put behind it."""
    photos = []
    for index in range(3):
        image = np.zeros((30, 40, 4), np.uint8)
        image[8:22, 10:20], image[8:22, 20:30] = (0, 0, 0, 255), (200, 40, 40, 255)
        Image.fromarray(image).save(tmp_path / f"{index}.png")
        photos.append(Photo(tmp_path / f"{index}.png", Camera(40, 30, 50.0, 50.0, 20.0, 15.0, np.eye(4))))
    background = photo_background(Photos(photos))
    for _, image in read_views(photos, 40, background):
        np.testing.assert_array_equal(foreground_mask(image, background), image[..., 0] != background[0])
        assert foreground_mask(image, background).sum() == 14 * 20


def test_a_transparency_channel_that_hides_nothing_changes_nothing(tmp_path):
    photos = []
    for index in range(3):
        Image.new("RGBA", (40, 30), (200, 180, 160, 255)).save(tmp_path / f"{index}.png")
        photos.append(Photo(tmp_path / f"{index}.png", Camera(40, 30, 50.0, 50.0, 20.0, 15.0, np.eye(4))))
    np.testing.assert_allclose(photo_background(Photos(photos)), np.array([200, 180, 160]) / 255, atol=1e-6)


@pytest.mark.parametrize("some_shown", [False, True])
def test_what_is_put_in_the_place_of_a_room_was_not_photographed(tmp_path, some_shown):
    """So no exposure is of it; two heights of a camera in a room, one of them in half the light."""
    rng, put, photos = np.random.default_rng(0), (0.8, 0.2, 0.8), []
    for group, light in enumerate((0.5, 1.0)):
        plate, room = (
            tmp_path / f"room-{group}.png",
            light * np.kron(rng.uniform(0.3, 0.8, (6, 8, 3)), np.ones((8, 8, 1))),
        )
        write_plate(plate, room, np.ones((48, 64), bool))
        for index in range(3):
            image = room.copy()
            image[14:34, 20 + index : 44 + index] = light * np.array([0.1, 0.6, 0.2])
            path = tmp_path / f"{group}{index}.png"
            Image.fromarray(np.round(255 * image).astype(np.uint8)).save(path)
            photos.append(
                Photo(path, Camera(64, 48, 50.0, 50.0, 32.0, 24.0, np.eye(4)), backdrop=Backdrop(plate, put, 0.03))
            )
    if some_shown:
        Image.fromarray(np.full((48, 64, 3), np.round(255 * np.array(put)), np.uint8)).save(tmp_path / "plain.png")
        photos.append(Photo(tmp_path / "plain.png", Camera(64, 48, 50.0, 50.0, 32.0, 24.0, np.eye(4))))
    color, is_put = shown_or_put_background(Photos(photos))
    np.testing.assert_allclose(color, put, atol=0.01)
    assert is_put == (not some_shown)


def test_held_out_photos_do_not_decide_the_background(tmp_path):
    photos = []
    for index in range(8):
        held_out = index % 2 == 0
        path = tmp_path / f"{index}.png"
        Image.new("RGB", (40, 30), (0, 0, 0) if held_out else (200, 180, 160)).save(path)
        photos.append(Photo(path, Camera(40, 30, 50.0, 50.0, 20.0, 15.0, np.eye(4)), held_out))
    np.testing.assert_allclose(photo_background(Photos(photos)), np.array([200, 180, 160]) / 255, atol=1e-6)
