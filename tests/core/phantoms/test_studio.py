"""Photos by Cycles show the same geometry as those by the ray caster; what is missing or fails is said."""

from __future__ import annotations

import importlib.util
import sys
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from insideout.core.capture.background import foreground_mask, plain_background
from insideout.core.errors import Cancelled, SettingError
from insideout.core.evaluate.metrics import psnr
from insideout.core.phantoms import studio
from insideout.core.phantoms.distance_grid import DistanceGrid
from insideout.core.phantoms.matryoshka import matryoshka
from insideout.core.phantoms.photos import BACKGROUND, render_photo
from insideout.core.phantoms.settings import CaptureSettings
from insideout.core.phantoms.shots import Shot, plan_shots
from insideout.core.phantoms.studio import blender_command, take_photos
from insideout.core.progress import Reporter
from insideout.core.srgb import srgb_to_linear

needs_blender = pytest.mark.skipif(importlib.util.find_spec("bpy") is None, reason="the package bpy is not installed")
SETTINGS = CaptureSettings(
    photos=1, photo_width=48, photo_height=48, photos_by="cycles", samples=8, effects=(), shutter_share=0.6
)


def shown(image):
    return np.abs(image - np.asarray(BACKGROUND)).max(axis=-1) > 0.15


@pytest.fixture(scope="module")
def by_cycles(ball):
    """Photos of the ball: still, by a moving camera, out of focus; what they were taken with."""
    (still,) = plan_shots(32.0, SETTINGS, np.random.default_rng(3))
    (moving,) = plan_shots(32.0, replace(SETTINGS, effects=("rolling_shutter",)), np.random.default_rng(3))
    shots = [still, moving, Shot(still.camera, aperture_mm=16.0, focus_mm=200.0)]
    photos = [photo / 255.0 for photo in take_photos(ball, shots, SETTINGS, 0, Reporter())]
    return photos, shots, DistanceGrid.bake(ball.surface, np.array(ball.size_mm), 0.5)


@needs_blender
@pytest.mark.parametrize("index", [0, 1, 2])
def test_cycles_sees_what_the_ray_caster_sees(ball, by_cycles, index):
    photos, shots, grid = by_cycles

    rays = render_photo(ball, grid, shots[index])

    assert photos[index].shape == (48, 48, 3)
    assert np.mean(shown(photos[index]) != shown(rays)) < 0.02
    others = [shown(render_photo(ball, grid, shots[other])) for other in range(3) if other != index]
    if index == 1:
        assert min(np.mean(shown(photos[1]) != other) for other in others) > 0.04
    np.testing.assert_allclose(photos[index][0, 0], BACKGROUND, atol=0.01)


@needs_blender
def test_cycles_opens_its_shutter_evenly_for_all_of_the_way(ball):
    """The mean light of as many still photos."""
    moving = replace(SETTINGS, samples=48, effects=("motion_blur",), blur_share=0.2)
    (swept,) = plan_shots(32.0, moving, np.random.default_rng(3))
    still = []
    for center, turn in zip(*swept.poses_at((np.arange(8) + 0.5) / 8), strict=True):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn.T, -turn.T @ center
        still.append(Shot(replace(swept.camera, world_to_camera=pose)))
    shots = [swept, Shot(swept.camera), *still]
    seen, middle, *way = (srgb_to_linear(photo / 255.0) for photo in take_photos(ball, shots, moving, 0, Reporter()))
    assert np.abs(seen - np.mean(way, axis=0)).mean() < 0.35 * np.abs(seen - middle).mean()


@needs_blender
def test_cycles_blurs_what_is_out_of_focus(by_cycles):
    sharp, _, blurred = by_cycles[0]
    middle = (slice(16, 32), slice(16, 32), 1)

    assert np.abs(np.diff(blurred[middle], axis=0)).mean() < 0.6 * np.abs(np.diff(sharp[middle], axis=0)).mean()


@needs_blender
def test_on_a_table_there_is_a_shadow_and_the_object_is_still_found(ball):
    settings = replace(SETTINGS, photos=2, effects=("table",))
    shots = plan_shots(32.0, settings, np.random.default_rng(0))

    photos = [photo / 255.0 for photo in take_photos(ball, shots, settings, 0, Reporter())]

    background = plain_background(photos)
    np.testing.assert_allclose(background, BACKGROUND, atol=0.02)
    grid = DistanceGrid.bake(ball.surface, np.array(ball.size_mm), 0.5)
    for photo, shot in zip(photos, shots, strict=True):
        exact = shown(render_photo(ball, grid, shot.camera))
        assert np.mean(foreground_mask(photo, background) != exact) < 0.05
        around = photo[~exact].mean(axis=-1)
        assert around.min() < np.mean(BACKGROUND) - 0.015


def test_photos_by_rays_show_fine_paint_as_pixels_average_it():
    """With two rays along each axis: 31 dB, and a model goes after errors that no other photo has."""
    doll = matryoshka(1)
    settings = CaptureSettings(photos=1, photo_width=96, photo_height=128, photos_by="rays", effects=(), table_mm=2.0)
    (shot,) = plan_shots(max(doll.size_mm), settings, np.random.default_rng(0))
    (photo,) = (photo / 255.0 for photo in take_photos(doll, [shot], settings, 0, Reporter()))

    grid = DistanceGrid.bake(doll.surface, np.array(doll.size_mm), settings.table_mm)
    assert psnr(photo, render_photo(doll, grid, shot, supersample=8), 1.0) > 38


@needs_blender
def test_cancelling_ends_blender(ball, monkeypatch):
    started = []
    popen = studio.subprocess.Popen

    def remember(*arguments, **options):
        started.append(popen(*arguments, **options))
        return started[0]

    monkeypatch.setattr(studio.subprocess, "Popen", remember)
    stop = threading.Event()
    shots = plan_shots(32.0, replace(SETTINGS, photos=50, samples=4000), np.random.default_rng(0))
    threading.Timer(1.0, stop.set).start()
    begin = time.monotonic()
    with pytest.raises(Cancelled):
        list(take_photos(ball, shots, replace(SETTINGS, samples=4000), 0, Reporter(is_cancelled=stop.is_set)))

    assert time.monotonic() - begin < 20
    assert started[0].poll() is not None


def test_without_blender_it_says_what_to_install(monkeypatch):
    monkeypatch.setattr(studio.importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr(studio.shutil, "which", lambda name: None)
    with pytest.raises(SettingError, match=r"pip install bpy==5\.0\.1.*--photos-by rays"):
        blender_command()
    monkeypatch.setattr(studio.shutil, "which", lambda name: "/opt/blender")
    assert blender_command()[:2] == ["/opt/blender", "--background"]


def test_blender_that_fails_is_quoted(ball, monkeypatch):
    failing = [sys.executable, "-c", "import sys; print('no such engine', file=sys.stderr); sys.exit(3)"]
    monkeypatch.setattr(studio, "blender_command", lambda: failing)
    shots = plan_shots(32.0, SETTINGS, np.random.default_rng(0))
    with pytest.raises(SettingError, match=r"Blender stopped \(no such engine\)"):
        list(take_photos(ball, shots, SETTINGS, 0, Reporter()))


def test_the_exception_is_quoted_and_not_what_blender_says_after_it(ball, monkeypatch):
    log = "Traceback\\nKeyError: 'Specular'\\nError: script failed, file: 'studio.py', exiting.\\n\\nBlender quit"
    failing = [sys.executable, "-c", f'import sys; print("{log}"); sys.exit(1)']
    monkeypatch.setattr(studio, "blender_command", lambda: failing)
    shots = plan_shots(32.0, SETTINGS, np.random.default_rng(0))
    with pytest.raises(SettingError, match=r"Blender stopped \(KeyError: 'Specular'\)"):
        list(take_photos(ball, shots, SETTINGS, 0, Reporter()))


@needs_blender
@pytest.mark.slow
def test_the_same_seed_gives_the_same_photo(ball):
    shots = plan_shots(32.0, SETTINGS, np.random.default_rng(0))
    first, again, other = (next(take_photos(ball, shots, SETTINGS, seed, Reporter())) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert np.any(first != other)
