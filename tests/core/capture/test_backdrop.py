"""A background that stands still is taken out of photos, and outlines stay as soft as they were."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from PIL import Image

from insideout.core.capture.backdrop import in_light, light_ratio, object_mask, without_backdrop, write_plate
from insideout.core.capture.model import Backdrop, Lens, Photo
from insideout.core.capture.photos import read_bare, read_photo, undistort
from insideout.core.errors import RunFolderError
from insideout.core.phantoms.room import room
from insideout.core.srgb import linear_to_srgb, srgb_to_linear
from insideout.core.views import Camera

WIDTH, HEIGHT = 72, 60
PLAIN, RED = (0.2, 0.8, 0.8), np.array([0.75, 0.15, 0.1])
ROOM = room(WIDTH, HEIGHT, 0.1, np.random.default_rng(0))
ALL = np.ones((HEIGHT, WIDTH), bool)


def disc(radius=18.0, middle=(36.0, 30.0), finer=8):
    """(HEIGHT, WIDTH) how much of each pixel a disc covers."""
    y, x = (np.mgrid[: HEIGHT * finer, : WIDTH * finer] + 0.5) / finer
    inside = np.hypot(x - middle[0], y - middle[1]) < radius
    return inside.reshape(HEIGHT, finer, WIDTH, finer).mean(axis=(1, 3))


def before(behind, share, color=RED):
    """What a camera sees of an object that covers `share` of each pixel: light is mixed."""
    light = share[..., None] * srgb_to_linear(color) + (1 - share[..., None]) * srgb_to_linear(np.asarray(behind))
    return linear_to_srgb(light).astype(np.float32)


@pytest.fixture
def backdrop(tmp_path):
    write_plate(tmp_path / "backdrop-1.png", ROOM, ALL)
    return Backdrop(tmp_path / "backdrop-1.png", PLAIN, 0.03)


def test_the_object_stands_before_the_plain_colour_with_the_outline_that_it_had(backdrop):
    share = disc()
    found = without_backdrop(before(ROOM, share), backdrop, (WIDTH, HEIGHT))
    wanted = before(np.broadcast_to(PLAIN, (HEIGHT, WIDTH, 3)), share)
    assert found.dtype == np.float32
    assert np.abs(found - wanted).max() < 0.15, "of a share that is not told from background"
    mixed = (share > 0) & (share < 1)
    assert np.abs(found - wanted)[mixed].mean() < 0.02
    hard = np.where(share[..., None] > 0.5, before(ROOM, share), PLAIN)
    assert np.abs(found - wanted)[mixed].mean() < 0.2 * np.abs(hard - wanted)[mixed].mean()
    far = disc(22.0) == 0
    assert (found[far] == np.float32(PLAIN)).all()


def test_what_has_the_backgrounds_colour_by_chance_is_filled_and_a_hole_is_not():
    share = disc()
    image = before(ROOM, share)
    image[28:33, 34:39] = ROOM[28:33, 34:39].mean(axis=(0, 1))
    assert object_mask(image, ROOM, ALL, 0.03)[disc(16.0) == 1].all()
    hole = disc(7.0)
    ring = before(ROOM, share - hole)
    mask = object_mask(ring, ROOM, ALL, 0.03)
    assert not mask[disc(5.0) == 1].any()
    assert mask[(share == 1) & (disc(9.0) == 0)].all()


def test_noise_alone_is_no_object():
    rng = np.random.default_rng(1)
    noisy = ROOM + 0.01 * rng.standard_normal(ROOM.shape)
    assert not object_mask(noisy, ROOM, ALL, 0.04).any()


def test_what_is_not_known_stays_as_it_is(tmp_path):
    known = ALL.copy()
    known[:, 30:40] = False
    write_plate(tmp_path / "backdrop-1.png", ROOM, known)
    image = before(ROOM, disc())
    found = without_backdrop(image, Backdrop(tmp_path / "backdrop-1.png", PLAIN, 0.03), (WIDTH, HEIGHT))
    np.testing.assert_array_equal(found[:, 31:39], image[:, 31:39])


def test_a_brighter_photo_is_made_as_bright_as_the_backdrop(backdrop):
    gain = np.array([1.3, 1.2, 1.25])
    share = disc()
    image = in_light(before(ROOM, share), gain)
    np.testing.assert_allclose(light_ratio(image, ROOM, ALL), gain, rtol=0.01)
    found = without_backdrop(image, backdrop, (WIDTH, HEIGHT))
    wanted = before(np.broadcast_to(PLAIN, (HEIGHT, WIDTH, 3)), share)
    assert np.abs(found - wanted).mean() < 0.005


def test_light_that_hardly_differs_is_the_same():
    assert (light_ratio(in_light(ROOM, np.full(3, 1.02)), ROOM, ALL) == 1).all()
    assert in_light(ROOM, np.ones(3)) is ROOM


@pytest.mark.parametrize("middle", [0.08, 0.05, 0.03, 0.0])
def test_a_dark_photo_has_the_light_that_it_has_itself(middle):
    dark = np.clip(0.3 * (ROOM - 0.49) + middle, 0, 1).astype(np.float32)
    assert (light_ratio(dark, dark, ALL) == 1).all()
    assert (light_ratio(np.zeros_like(dark), np.zeros_like(dark), ALL) == 1).all()


def test_an_object_before_a_room_with_a_dark_channel_keeps_its_colour(tmp_path):
    behind = ROOM * np.array([1, 1, 0], np.float32)
    behind[::3, ::2, 2] = 3 / 255
    assert (light_ratio(behind, behind, ALL) == 1).all()
    np.testing.assert_allclose(light_ratio(in_light(behind, np.full(3, 1.25)), behind, ALL), 1.25, rtol=0.01)
    write_plate(tmp_path / "backdrop-1.png", behind, ALL)
    image = before(behind, disc(), np.array([0.6, 0.4, 0.3]))
    found = without_backdrop(image, Backdrop(tmp_path / "backdrop-1.png", PLAIN, 0.03), (WIDTH, HEIGHT))
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found[disc(14.0) == 1], image[disc(14.0) == 1], atol=0.005)


def test_light_is_not_told_by_what_is_cut_off_or_by_a_few_pixels():
    bright = np.where(np.median(ROOM) < ROOM, 1.0, ROOM).astype(np.float32)
    assert light_ratio(in_light(bright, np.full(3, 0.8)), bright, ALL) == pytest.approx(0.8, rel=0.01)
    known, image = np.zeros((HEIGHT, WIDTH), bool), ROOM.copy()
    known[0, :9], image[0, :9] = True, 0.9
    assert (light_ratio(image, ROOM, known) == 1).all()
    assert (light_ratio(np.full_like(ROOM, 0.9), np.full_like(ROOM, 0.15), ALL) == 1).all(), "no exposures"


def test_photos_of_other_sizes_than_the_backdrop(backdrop):
    image = before(ROOM, disc())
    larger = cv2.resize(image, (2 * WIDTH, 2 * HEIGHT), interpolation=cv2.INTER_LINEAR)
    assert without_backdrop(larger, backdrop, (WIDTH, HEIGHT)).shape == (HEIGHT, WIDTH, 3), "no more than is needed"
    for size in ((2 * WIDTH, 2 * HEIGHT), (WIDTH // 2, HEIGHT // 2)):
        given = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        found = without_backdrop(given, backdrop, size)
        wanted = cv2.resize(disc(), size, interpolation=cv2.INTER_AREA)
        assert found.shape == given.shape
        assert (np.abs(found - PLAIN).max(axis=-1) < 0.02)[wanted < 0.01].mean() > 0.98
        assert np.abs(found - given)[wanted > 0.99].mean() < 0.01


def test_photos_are_read_without_it_before_their_lens_is_taken_out(backdrop, tmp_path):
    image = np.round(255 * before(ROOM, disc())).astype(np.uint8)
    Image.fromarray(image).save(tmp_path / "one.png")
    camera = Camera(WIDTH, HEIGHT, 80.0, 80.0, WIDTH / 2, HEIGHT / 2, np.eye(4))
    lens = Lens(WIDTH, HEIGHT, 80.0, 80.0, WIDTH / 2, HEIGHT / 2, (-0.2, 0.0, 0.0, 0.0))
    photo = Photo(tmp_path / "one.png", camera, lens=lens, backdrop=backdrop)
    bare = read_bare(replace(photo, camera=None), max(WIDTH, HEIGHT))
    assert np.abs(bare[0] - PLAIN).max() < 1e-6
    seen, _ = read_photo(photo)
    np.testing.assert_allclose(seen, undistort(bare, lens, camera), atol=1e-6)
    assert np.abs(read_photo(replace(photo, backdrop=None))[0] - seen).max() > 0.2


def test_a_backdrop_that_is_gone_or_damaged_says_what_to_do(backdrop):
    image = before(ROOM, disc())
    backdrop.path.write_bytes(b"no image")
    with pytest.raises(RunFolderError, match="run the stage initialize again"):
        without_backdrop(image, backdrop, (WIDTH, HEIGHT))
    backdrop.path.unlink()
    with pytest.raises(RunFolderError, match="run the stage initialize again"):
        without_backdrop(image, backdrop, (WIDTH, HEIGHT))
