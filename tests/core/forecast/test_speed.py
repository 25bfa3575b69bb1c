"""How long a step takes here: measured with splats that lie as a model's would, on the capture's own images."""

from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import numba
import numpy as np
import pytest
from PIL import Image

from insideout.core.capture.model import Photo, Photos
from insideout.core.capture.read import read_capture
from insideout.core.effects import Exposure, MotionBlur, RollingShutter
from insideout.core.forecast.crowd import object_cells
from insideout.core.forecast.detail import look_at_photos
from insideout.core.forecast.speed import StepTime, before_the_object, measure_speed, photo_size
from insideout.core.render import radiograph, section
from insideout.core.sections import choose_planes
from insideout.core.stages.surface.rgb import RgbSettings, RgbTrainer
from insideout.core.stages.surface.xray import XrayTrainer
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
    photo = Photo(tmp_path / "a.png", camera)
    seen = before_the_object(photo, look_at_photos([photo] * 3, 400).covered).camera
    tangent = np.tan(np.arcsin(1 / seen.world_to_camera[2, 3]))
    assert tangent * camera.fx == pytest.approx(radius_px, rel=0.05)


def test_photos_that_do_not_tell_how_large_the_object_is_are_timed_as_usual(tmp_path):
    noise = np.random.default_rng(0).integers(0, 255, (80, 96, 3), np.uint8)
    usual = []
    for name, pixels in (("room", noise), ("nothing", np.full_like(noise, 250))):
        Image.fromarray(pixels).save(tmp_path / f"{name}.png")
        photo = Photo(tmp_path / f"{name}.png", None)
        usual.append(before_the_object(photo, look_at_photos([photo], 400).covered).camera.world_to_camera[2, 3])
    room, nothing = usual
    assert room == pytest.approx(4.0)
    assert 4 < nothing < 100


def test_steps_are_measured_on_the_capture_s_own_images(capture, monkeypatch):
    """By a clock that each image turns by its splats and its pixels: how long they take is told apart, in steps on the
    images that the capture has."""
    clock, largest = [0.0], dict.fromkeys(("photo", "projection", "section"), 0)

    def turned(kind, splats, pixels):
        clock[0] += 0.2 + 1e-5 * splats + 1e-4 * pixels
        largest[kind] = max(largest[kind], pixels)

    class Photos(RgbTrainer):
        def _draw(self, gaussians, camera, *rest, **how):
            turned("photo", len(gaussians), camera.width * camera.height)
            return super()._draw(gaussians, camera, *rest, **how)

    def projected(gaussians, detector, *rest):
        turned("projection", len(gaussians), detector.width * detector.height)
        return radiograph(gaussians, detector, *rest)

    def cut(gaussians, plane, *rest):
        turned("section", len(gaussians), plane.width * plane.height)
        return section(gaussians, plane, *rest)

    monkeypatch.setattr("insideout.core.stages.surface.rgb.RgbTrainer", Photos)
    monkeypatch.setattr("insideout.core.stages.surface.xray.radiograph", projected)
    monkeypatch.setattr("insideout.core.render.section", cut)
    monkeypatch.setattr("insideout.core.forecast.speed._cube_time", lambda tick: 0.01)
    monkeypatch.setattr("insideout.core.forecast.speed.time", SimpleNamespace(perf_counter=lambda: clock[0]))
    speed = measure_speed(capture, 400)
    camera, detector = capture.photos.photos[0].camera, capture.projections.detectors[0]
    planes = [view.plane for view in choose_planes(capture.projections.box_mm, planes=("axial",))]
    assert largest["photo"] == camera.width * camera.height
    assert largest["projection"] == detector.width * detector.height
    assert largest["section"] == max(plane.width * plane.height for plane in planes)
    # In a training they take a little more, or less, than the fastest ones.
    longer = {"photo": 1.2, "projection": 0.9, "section": 1.8}
    for kind, pixels in largest.items():
        step, times = getattr(speed, kind), longer[kind]
        assert step.by_splat == pytest.approx(times * 1e-5, rel=0.1)
        assert step.seconds(10_000, pixels) == pytest.approx(times * (0.2 + 0.1 + 1e-4 * pixels), rel=0.1)
        # A detector as small as this one is not halved: there what pixels take is the same for all steps.
        assert step.by_pixel == pytest.approx(0.0 if kind == "projection" else times * 1e-4, rel=0.1)


def test_how_slow_a_machine_is_every_capture_tells_alike(capture, monkeypatch):
    """By a section of a cube or, where nothing was X-rayed, a photo of a ball; effects make no machine slow."""
    monkeypatch.setattr("insideout.core.forecast.speed._cube_time", lambda tick: 0.03)
    monkeypatch.setattr("insideout.core.forecast.speed._ball_time", lambda tick: 0.032)
    blurred = RgbSettings(effects=(RollingShutter(),))
    for one, rgb, slowness in (
        (capture, None, 3.0),
        (capture.xrays_only(), None, 3.0),
        (capture.photos_only(), None, 2.0),
        (capture.photos_only(), blurred, 2.0),
    ):
        assert measure_speed(one, 100, rgb=rgb).slowness == pytest.approx(slowness)


@pytest.mark.parametrize("threads", [1, 2])
def test_how_slow_one_thread_is_is_told_apart(capture, monkeypatch, threads):
    if threads > numba.config.NUMBA_NUM_THREADS:
        pytest.skip("numba has one thread here")
    before = numba.get_num_threads()
    numba.set_num_threads(threads)
    monkeypatch.setattr("insideout.core.forecast.speed._cube_time", lambda tick: 0.03 / numba.get_num_threads())
    try:
        speed = measure_speed(capture, 100)
        assert numba.get_num_threads() == threads
    finally:
        numba.set_num_threads(before)
    assert (speed.slowness, speed.alone) == (pytest.approx(3.0 / threads), pytest.approx(3.0))


def test_half_of_the_splats_that_steps_on_projections_are_timed_with_crowd_in_the_object(capture, monkeypatch):
    timed = []

    class Watched(XrayTrainer):
        def __init__(self, splats, *rest):
            timed.append(splats)
            super().__init__(splats, *rest)

    monkeypatch.setattr("insideout.core.stages.surface.xray.XrayTrainer", Watched)
    measure_speed(capture.xrays_only(), 400)
    cells, box = object_cells(capture.projections), capture.projections.box_mm
    for splats in timed:
        # Cells are whole along each axis.
        assert min(abs(len(splats) / count - 1) for count in (3_000, 30_000)) < 0.1
        index = ((splats.means - box[0]) / (box[1] - box[0]) * cells.shape[::-1]).astype(int)
        inside = cells[tuple(np.clip(index, 0, np.array(cells.shape)[::-1] - 1).T[::-1])]
        assert 0.5 <= inside.mean() < 0.5 + 0.6 * cells.mean() + 0.05


def test_what_photos_show_besides_the_object_is_timed_too(capture, monkeypatch):
    """A rolling shutter is drawn in bands, by a clock that nothing but drawing moves on."""
    draws = []

    class Counted(RgbTrainer):
        def _draw(self, *drawn, **how):
            draws.append(1)
            return super()._draw(*drawn, **how)

    monkeypatch.setattr("insideout.core.stages.surface.rgb.RgbTrainer", Counted)
    monkeypatch.setattr("insideout.core.forecast.speed.time", SimpleNamespace(perf_counter=lambda: len(draws) / 10))
    monkeypatch.setattr("insideout.core.forecast.speed._ball_time", lambda tick: 0.016)
    plain, effects = (
        measure_speed(capture.photos_only(), 400, rgb=RgbSettings(effects=effects))
        for effects in ((), (RollingShutter(),))
    )
    assert effects.photo.seconds(30_000, 3000) >= 2 * plain.photo.seconds(30_000, 3000) > 0


def test_colours_are_timed_as_they_are_trained(capture, monkeypatch):
    """By a clock that goes by how many numbers are learnt; as 3DGS has 16, steps were estimated a fifth too long."""
    learnt, drawn = [], []

    class Counted(RgbTrainer):
        def step(self, iteration):
            learnt.append(len(self.parameters) * self.parameters.to_set().sh.shape[1])
            return super().step(iteration)

        def _draw(self, *rest, **how):
            drawn.append(how["sh_degree"])
            return super()._draw(*rest, **how)

    monkeypatch.setattr("insideout.core.stages.surface.rgb.RgbTrainer", Counted)
    monkeypatch.setattr("insideout.core.forecast.speed.time", SimpleNamespace(perf_counter=lambda: sum(learnt) * 1e-6))
    monkeypatch.setattr("insideout.core.forecast.speed._ball_time", lambda tick: 0.016)
    four, sixteen = (
        measure_speed(capture.photos_only(), 400, rgb=RgbSettings(degree=degree)).photo.by_splat for degree in (1, 3)
    )
    assert sixteen == pytest.approx(4 * four, rel=0.01)
    assert sorted(set(drawn)) == [1, 3]


def test_steps_of_a_training_gain_less_by_threads_than_those_that_are_timed(capture, monkeypatch):
    """With a gain of three they take 1.56 times as long over these; with none, as long."""

    def steps(alone):
        monkeypatch.setattr("insideout.core.forecast.speed.Alone", lambda wanted: nullcontext())
        times = iter([0.01, alone])
        monkeypatch.setattr("insideout.core.forecast.speed._cube_time", lambda tick: next(times))
        monkeypatch.setattr("numba.get_num_threads", lambda: 2)
        for kind in ("photo", "projection", "section"):
            monkeypatch.setattr(f"insideout.core.forecast.speed._{kind}_time", lambda *_: StepTime(1.0, 0.1, 0.01))
        speed = measure_speed(capture, 64)
        return speed.photo, speed.projection, speed.section

    assert steps(0.01) == (StepTime(1.0, 0.1, 0.01),) * 3
    for step in steps(0.03):
        assert (step.fixed, step.by_splat, step.by_pixel) == pytest.approx((1.56, 0.156, 0.0156))


def test_a_camera_that_moves_is_timed_as_far_on_its_way_as_photos_show_it(capture, monkeypatch):
    """A training begins with a pixel of motion, which is drawn as five views; what is found has moved by more."""
    views = []

    class Watched(RgbTrainer):
        def __init__(self, start, photos, heldout, background, settings, *rest):
            views.append(settings.effects)
            super().__init__(start, photos, heldout, background, settings, *rest)

    monkeypatch.setattr("insideout.core.stages.surface.rgb.RgbTrainer", Watched)
    measure_speed(capture.photos_only(), 64, rgb=RgbSettings(effects=(MotionBlur(), Exposure())))
    (timed,) = set(views)
    assert timed[0].start_px > 2 * MotionBlur().start_px
    assert timed[1] == Exposure()
