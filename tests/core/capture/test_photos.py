"""Photos are read upright, undistorted, and no larger than asked for."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from insideout.core.capture import photos
from insideout.core.capture.model import Lens, Photo
from insideout.core.capture.photos import (
    exif_focal_px,
    image_facts,
    list_images,
    pinhole_for,
    posed_photo,
    read_photo,
    read_pixels,
    undistort,
    verify_images,
)
from insideout.core.errors import CaptureError
from insideout.core.views import Camera

EYE = np.eye(4)


@pytest.fixture
def gradient():
    """(60, 80, 3) uint8, red to the right, green downwards."""
    rows, columns = np.mgrid[0:60, 0:80]
    return np.stack([columns * 3, rows * 4, np.full_like(rows, 30)], axis=-1).astype(np.uint8)


def camera(width, height):
    return Camera(width, height, 100.0, 100.0, width / 2, height / 2, EYE)


def save_turned(path, upright, orientation):
    """Saves an image the way a turned phone does: stored turned, with the EXIF tag that undoes it."""
    turns = {1: None, 3: Image.Transpose.ROTATE_180, 6: Image.Transpose.ROTATE_90, 8: Image.Transpose.ROTATE_270}
    image = Image.fromarray(upright)
    image = image if turns[orientation] is None else image.transpose(turns[orientation])
    exif = Image.Exif()
    exif[0x0112] = orientation
    image.save(path, quality=98, exif=exif, subsampling=0)


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_orientation_is_applied_once(tmp_path, gradient, orientation):
    path = tmp_path / "turned.jpg"
    save_turned(path, gradient, orientation)
    assert image_facts(path).upright == (80, 60)
    pixels, _ = read_photo(Photo(path, camera(80, 60)))
    assert np.abs(pixels - gradient / 255).max() < 0.05


def test_poses_of_stored_pixels_leave_a_photo_as_stored(tmp_path, gradient):
    path = tmp_path / "turned.jpg"
    save_turned(path, gradient, 6)
    stored = posed_photo(path, Lens(60, 80, 100, 100, 30, 40, (0.0,) * 8), EYE)
    upright = posed_photo(path, Lens(80, 60, 100, 100, 40, 30, (0.0,) * 8), EYE)
    assert (stored.upright, upright.upright) == (False, True)
    assert read_photo(stored)[0].shape == (80, 60, 3)
    assert read_photo(upright)[0].shape == (60, 80, 3)


def test_long_side_limits_the_size_and_resizes_the_camera(tmp_path, gradient):
    path = tmp_path / "a.png"
    Image.fromarray(gradient).save(path)
    pixels, small = read_photo(Photo(path, camera(80, 60)), long_side=40)
    assert pixels.shape == (30, 40, 3)
    assert (small.width, small.height, small.fx, small.cx) == (40, 30, 50, 20)
    assert np.abs(pixels - gradient.reshape(30, 2, 40, 2, 3).mean((1, 3)) / 255).max() < 1e-3
    assert read_photo(Photo(path, camera(80, 60)), long_side=1000)[0].shape == (60, 80, 3)


def test_a_downscaled_copy_fits_the_camera_of_the_original(tmp_path, gradient):
    path = tmp_path / "a.png"
    Image.fromarray(gradient).save(path)
    photo = posed_photo(path, Lens(320, 240, 400, 400, 160, 120, (0.0,) * 8), EYE)
    assert (photo.camera.width, photo.camera.fx, photo.camera.cy) == (80, 100, 30)


def test_a_photo_of_another_shape_than_its_camera_is_refused(tmp_path, gradient):
    path = tmp_path / "a.png"
    Image.fromarray(gradient).save(path)
    with pytest.raises(CaptureError, match=r"a\.png: is 80 x 60 but its camera is for 100 x 100"):
        posed_photo(path, Lens(100, 100, 400, 400, 50, 50, (0.0,) * 8), EYE)


def test_transparent_pixels_show_the_background(tmp_path):
    rgba = np.zeros((10, 10, 4), np.uint8)
    rgba[:, :5] = [255, 0, 0, 255]
    rgba[:, 5:] = [255, 0, 0, 0]
    path = tmp_path / "a.png"
    Image.fromarray(rgba).save(path)
    pixels, _ = read_photo(Photo(path, camera(10, 10)), background=(0.0, 1.0, 0.0))
    assert np.allclose(pixels[0, 0], [1, 0, 0])
    assert np.allclose(pixels[0, 9], [0, 1, 0])


@pytest.mark.parametrize("mode", ["L", "P", "CMYK", "I;16"])
def test_other_pixel_formats_become_rgb(tmp_path, mode):
    path = tmp_path / ("a.tif" if mode in ("CMYK", "I;16") else "a.png")
    if mode == "I;16":
        Image.fromarray(np.full((8, 8), 32768, np.uint16)).save(path)
    else:
        gray = Image.new("RGB", (8, 8), (128, 128, 128))
        (gray.quantize(4) if mode == "P" else gray.convert(mode)).save(path)
    pixels, _ = read_photo(Photo(path, camera(8, 8)))
    assert pixels.shape == (8, 8, 3)
    assert np.allclose(pixels, 0.5, atol=0.02)


@pytest.mark.parametrize("fisheye", [False, True])
def test_undistortion_puts_points_where_the_pinhole_camera_sees_them(fisheye):
    import cv2

    size = (200, 150)
    lens = Lens(
        *size,
        180.0,
        180.0,
        100.0,
        75.0,
        (-0.2, 0.05, 0.0, 0.0) if fisheye else (-0.3, 0.1, 0.001, -0.002, 0, 0, 0, 0),
        fisheye,
    )
    pinhole = pinhole_for(lens, EYE)
    target = np.array([[0.1, 0.05, 1.0], [-0.25, 0.1, 1.0], [0.2, -0.2, 1.0]])
    matrix = np.array([[180, 0, 99.5], [0, 180, 74.5], [0, 0, 1.0]])
    project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    points = target[:, None] if fisheye else target
    seen = project(points, np.zeros(3), np.zeros(3), matrix, np.array(lens.coefficients))[0].reshape(-1, 2)
    rows, columns = np.mgrid[0:150, 0:200]
    for (x, y), point in zip(seen, target, strict=True):
        spot = np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / 8).astype(np.float32)
        straight = undistort(np.repeat(spot[..., None], 3, axis=-1), lens, pinhole)[..., 0]
        found = np.array([(straight * columns).sum(), (straight * rows).sum()]) / straight.sum() + 0.5
        expected = [pinhole.fx * point[0] + pinhole.cx, pinhole.fy * point[1] + pinhole.cy]
        assert np.allclose(found, expected, atol=0.3)


def test_a_photo_that_is_made_smaller_stays_sharp_where_its_lens_is_taken_out(tmp_path):
    """As the mean over pixels of what a pinhole shows, not blurred by the place between pixels of the small image."""

    def shown(x, y):
        fine = 0.5 + 0.25 * np.sin(2.1 * x) * np.sin(1.9 * y + 0.3 * x)
        return np.repeat(fine[..., None], 3, axis=-1).astype(np.float32)

    lens = Lens(400, 400, 400.0, 400.0, 200.0, 200.0, (-0.2, 0.0, 0.0, 0.0))
    columns, rows = np.meshgrid(np.arange(400) + 0.5, np.arange(400) + 0.5)
    seen = np.stack([columns - 200, rows - 200], axis=-1) / 400
    ideal = seen
    for _ in range(30):
        ideal = seen / (1 - 0.2 * (ideal**2).sum(axis=-1, keepdims=True))
    Image.fromarray(np.round(255 * shown(*(100 * np.moveaxis(ideal, -1, 0)))).astype(np.uint8)).save(tmp_path / "a.png")
    photo = Photo(tmp_path / "a.png", Camera(400, 400, 400.0, 400.0, 200.0, 200.0, EYE), lens=lens)
    truth = shown(*(100 * np.moveaxis(seen, -1, 0))).reshape(100, 4, 100, 4, 3).mean(axis=(1, 3))
    small, _ = read_photo(photo, 100)
    bent = read_photo(replace(photo, lens=None), 100)[0]
    at_once = undistort(bent, lens, photo.camera.resized(100, 100))
    assert np.abs(small - truth).mean() < 0.5 * np.abs(at_once - truth).mean()
    assert np.abs(small - truth).mean() < 0.2 * np.abs(bent - truth).mean()


@pytest.mark.parametrize("lens", [None, Lens(600, 400, 600.0, 600.0, 300.0, 200.0, (-0.1, 0.0, 0.0, 0.0))])
def test_a_jpeg_is_decoded_large_enough_for_its_lens_to_be_taken_out(lens, tmp_path, monkeypatch):
    """JPEG decodes at 1/2, 1/4 or 1/8, hardly larger than it is asked to: 150 pixels where 80 are wanted."""
    decoded, shrink = [], photos.resized
    monkeypatch.setattr(photos, "resized", lambda *given: decoded.append(given[0].shape[1]) or shrink(*given))
    Image.fromarray(np.zeros((400, 600, 3), np.uint8)).save(tmp_path / "a.jpg")
    photo = Photo(tmp_path / "a.jpg", Camera(600, 400, 600.0, 600.0, 300.0, 200.0, EYE), lens=lens)
    small, camera = read_photo(photo, 80)
    assert small.shape[1] == camera.width == 80
    assert decoded == ([150] if lens is None else [300, 160])


@pytest.mark.parametrize(("width", "height"), [(1601, 1201), (1600, 1200), (1203, 1607)])
@pytest.mark.parametrize("orientation", [1, 6])
def test_a_jpeg_whose_sides_do_not_divide_by_8_shows_what_its_camera_sees(tmp_path, width, height, orientation):
    """Decoded at an eighth, 1601 columns become 201, the last of which is made up but for an eighth."""
    asked = 150
    rows, columns = np.mgrid[:height, :width]
    # A soft disc far from the corner that all sizes share.
    far = np.hypot(columns + 0.5 - 0.9 * width, rows + 0.5 - 0.9 * height)
    image = np.repeat(np.rint(255 * np.exp(-((far / 60) ** 2)))[..., None], 3, axis=2).astype(np.uint8)
    save_turned(tmp_path / "a.jpg", image, orientation)
    size = (width, height)
    photo = posed_photo(tmp_path / "a.jpg", Lens(*size, 900, 900, 0, 0, (0.0,) * 8), EYE)
    with Image.open(tmp_path / "a.jpg") as stored:
        stored.draft("RGB", (asked, asked))
        assert stored.size == tuple(-(-side // 8) for side in (size if orientation == 1 else size[::-1]))
    pixels, small = read_photo(photo, long_side=asked)
    shade = pixels[..., 0] - pixels[..., 0].min()
    rows, columns = np.mgrid[: small.height, : small.width] + 0.5
    middle = np.array([(columns * shade).sum(), (rows * shade).sum()]) / shade.sum()
    assert middle == pytest.approx(0.9 * np.array([small.width, small.height]), abs=0.05)


def test_undistorted_photos_have_no_empty_border():
    lens = Lens(200, 150, 180.0, 180.0, 100.0, 75.0, (-0.3, 0.1, 0, 0, 0, 0, 0, 0))
    import cv2

    pinhole = pinhole_for(lens, EYE)
    source = np.array([[180, 0, 99.5], [0, 180, 74.5], [0, 0, 1.0]])
    target = np.array([[pinhole.fx, 0, pinhole.cx - 0.5], [0, pinhole.fy, pinhole.cy - 0.5], [0, 0, 1]])
    maps = cv2.initUndistortRectifyMap(source, np.array(lens.coefficients), np.eye(3), target, (200, 150), cv2.CV_32FC1)
    assert maps[0].min() > -2
    assert maps[0].max() < 201


def test_focal_length_from_the_35_mm_equivalent():
    # 26 mm on a phone with a 4:3 sensor: diagonals are compared.
    assert exif_focal_px({0xA405: 26}, (4032, 3024)) == pytest.approx(26 / 43.2666 * 5040)


def test_focal_length_from_the_sensors_pixel_pitch():
    # Canon EOS Rebel T3 at 55 mm, the photo scaled from 4272 to 1024 pixels.
    exif = {0x920A: 55.0, 0xA20E: 4720.44, 0xA210: 2, 0xA002: 4272, 0xA003: 2848}
    assert exif_focal_px(exif, (1024, 683)) == pytest.approx(2450, abs=1)


@pytest.mark.parametrize("exif", [{}, {0x920A: 55.0}, {0x920A: 55.0, 0xA20E: 0.0}, {0xA405: 0}, {0xA405: "x"}])
def test_too_little_exif_gives_no_focal_length(exif):
    assert exif_focal_px(exif, (1024, 683)) is None


def test_truncated_and_fake_images_are_named(tmp_path, gradient):
    noise = np.random.default_rng(0).integers(0, 255, (300, 300, 3)).astype(np.uint8)
    buffer = io.BytesIO()
    Image.fromarray(noise).save(buffer, "JPEG")
    (tmp_path / "half.jpg").write_bytes(buffer.getvalue()[: len(buffer.getvalue()) // 2])
    (tmp_path / "text.png").write_text("not an image")
    (tmp_path / "empty.jpg").write_bytes(b"")
    Image.fromarray(gradient).save(tmp_path / "good.jpg")
    problems = [str(problem) for problem in verify_images(list_images(tmp_path))]
    assert len(problems) == 3
    assert "empty.jpg: cannot be read as an image" in problems[0]
    assert "half.jpg: is damaged or truncated" in problems[1]
    assert "text.png: cannot be read as an image" in problems[2]
    with pytest.raises(CaptureError, match=r"half\.jpg: is damaged or truncated"):
        read_photo(Photo(tmp_path / "half.jpg", camera(300, 300)))


def test_hidden_files_and_masks_are_not_photos(tmp_path, gradient):
    for name in ("a.jpg", ".hidden.jpg", "masks/a.png", "sub/B.JPG", "notes.txt"):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        if path.suffix.lower() in (".jpg", ".png"):
            Image.fromarray(gradient).save(path)
        else:
            path.write_text("x")
    assert [path.name for path in list_images(tmp_path)] == ["a.jpg", "B.JPG"]


@pytest.mark.parametrize("name", ["a.webp", "a.jpg", "a.png"])
def test_a_photo_with_an_odd_tag_is_turned_all_the_same(tmp_path, gradient, name):
    """The tag of a number that holds text: writing its EXIF anew fails."""
    exif = Image.Exif()
    exif[0x0112], exif[0x010F] = 6, "maker"
    odd = exif.tobytes().replace(b"\x01\x0f", b"\x01\x25", 1)
    Image.fromarray(gradient).save(tmp_path / name, exif=odd, quality=98)
    assert image_facts(tmp_path / name).upright == (60, 80)
    turned = np.rot90(gradient, -1) / 255
    assert np.abs(read_pixels(tmp_path / name) - turned).max() < 0.1
