"""How long a step takes here: measured with splats that lie as a model's would, on the capture's own images."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from insideout.core.capture.model import Photo, Photos
from insideout.core.capture.read import read_capture
from insideout.core.effects import RollingShutter
from insideout.core.forecast.speed import before_the_object, measure_speed, object_cells, photo_size
from insideout.core.stages.surface.rgb import RgbSettings
from insideout.core.views import Camera


@pytest.fixture(scope="module")
def capture(tiny_capture):
    return read_capture(tiny_capture)


def test_a_photo_that_a_phone_took_upright_is_timed_as_it_is_trained(capture, tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.new("RGB", (64, 48), "red").save(tmp_path / "turned.jpg", exif=exif)
    photo = Photo(tmp_path / "turned.jpg", None, upright=True)
    assert photo_size(photo) == (48, 64)
    assert photo_size(replace(photo, upright=False)) == (64, 48)
    assert measure_speed(replace(capture.photos_only(), photos=Photos([photo])), 400).photo is not None


@pytest.mark.parametrize("radius_px", [6, 30])
def test_steps_on_photos_are_timed_with_an_object_as_large_as_they_show(tmp_path, radius_px):
    """Splats of a thin object cover few pixels: with a ball as wide as the photo a toy gun took too long."""
    camera = Camera(96, 80, 300.0, 300.0, 48.0, 40.0, np.eye(4))
    down, right = np.mgrid[:80, :96]
    disc = np.hypot(down - 39.5, right - 47.5) < radius_px
    Image.fromarray(np.where(disc[..., None], [200, 40, 40], [250, 250, 250]).astype(np.uint8)).save(tmp_path / "a.png")
    seen = before_the_object([Photo(tmp_path / "a.png", camera)] * 3).camera
    tangent = np.tan(np.arcsin(1 / seen.world_to_camera[2, 3]))
    assert tangent * camera.fx == pytest.approx(radius_px, rel=0.05)


def test_photos_that_do_not_tell_how_large_the_object_is_are_timed_as_usual(tmp_path):
    noise = np.random.default_rng(0).integers(0, 255, (80, 96, 3), np.uint8)
    usual = []
    for name, pixels in (("room", noise), ("nothing", np.full_like(noise, 250))):
        Image.fromarray(pixels).save(tmp_path / f"{name}.png")
        usual.append(before_the_object([Photo(tmp_path / f"{name}.png", None)]).camera.world_to_camera[2, 3])
    room, nothing = usual
    assert room == pytest.approx(4.0)
    assert 4 < nothing < 100


def test_steps_are_measured_on_the_capture_s_own_images(capture):
    speed = measure_speed(capture, 400)
    for step in (speed.photo, speed.projection, speed.section):
        assert 1e-5 < step.seconds(30_000, 10_000) < 60
        assert min(step.fixed, step.by_splat, step.by_pixel) >= 0
    assert speed.projection.seconds(60_000, 10_000) > speed.projection.seconds(3_000, 10_000)


@pytest.mark.parametrize("radius_mm", [3.0, 9.0])
def test_splats_crowd_where_projections_show_something(capture, radius_mm):
    """A ball in the box, seen from all sides; cells at its rim may be taken for either."""
    projections = capture.projections
    middle, half = projections.box_mm.mean(axis=0), 0.5 * (projections.box_mm[1] - projections.box_mm[0])
    shadows = []
    for detector in projections.detectors:
        rows, columns = np.mgrid[: detector.height, : detector.width] + 0.5
        u, v = np.asarray(detector.u), np.asarray(detector.v)
        places = (
            detector.center
            + (columns[..., None] - detector.width / 2) * u
            + (rows[..., None] - detector.height / 2) * v
        )
        rays = places - detector.source
        off = np.cross(rays, middle - detector.source)
        shadows.append(np.linalg.norm(off, axis=-1) / np.linalg.norm(rays, axis=-1) < radius_mm)
    inside = object_cells(replace(projections, images=np.array(shadows, np.float32)))
    counts = np.array(inside.shape)
    index = np.argwhere(np.ones(inside.shape, bool))
    away = np.linalg.norm(((index + 0.5) / counts - 0.5)[:, ::-1] * 2 * half, axis=1)
    cell = float(np.max(2 * half / counts[::-1]))
    assert inside.ravel()[away < radius_mm - cell].all()
    assert inside.sum() < 1.4 * (away < radius_mm + cell).sum()


def test_projections_of_nothing_tell_nothing(capture):
    empty = replace(capture.projections, images=np.zeros_like(capture.projections.images))
    assert object_cells(empty).all()


def test_what_photos_show_besides_the_object_is_timed_too(capture):
    """A rolling shutter is drawn in bands."""
    plain, effects = (
        measure_speed(capture.photos_only(), 400, rgb=RgbSettings(effects=effects))
        for effects in ((), (RollingShutter(),))
    )
    assert effects.photo.seconds(30_000, 3000) > 1.5 * plain.photo.seconds(30_000, 3000)
    assert plain.plain is None
    assert effects.photo.seconds(30_000, 3000) > 1.5 * effects.plain.seconds(30_000, 3000)
