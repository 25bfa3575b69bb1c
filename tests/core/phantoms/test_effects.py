"""Each effect is there when it is chosen, and leaves no trace when it is not."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from insideout.core.capture.read import read_capture
from insideout.core.errors import SettingError
from insideout.core.phantoms.distance_grid import DistanceGrid
from insideout.core.phantoms.make import make_capture
from insideout.core.phantoms.part_tables import PartTables
from insideout.core.phantoms.photos import BACKGROUND, render_photo
from insideout.core.phantoms.photos import _shot_rays as shot_rays
from insideout.core.phantoms.projections import add_scatter, path_lengths
from insideout.core.phantoms.scanner import scan_geometry
from insideout.core.phantoms.shots import Shot, camera_at, plan_shots
from insideout.core.phantoms.spectrum import monochromatic
from insideout.core.phantoms.truth import read_truth
from insideout.core.srgb import srgb_to_linear


@pytest.fixture
def projections(tmp_path, only_ball, ball_settings):
    """Makes a capture with effects and returns its first projection and scanner."""

    def make(*effects, **changes):
        folder = tmp_path / "-".join(("capture", *effects))
        make_capture("ball", folder, replace(ball_settings, effects=effects, **changes))
        meta = json.loads((folder / "xray" / "meta_data.json").read_text())
        image = np.load(folder / "xray" / meta["proj_train"][0]["file_path"]).astype(float)
        return image, meta["scanner"], folder

    return make


@pytest.fixture
def exact(ball, ball_settings):
    """The same projection without any effect, straight from path lengths."""
    scan = scan_geometry(ball, ball_settings.detector_width, ball_settings.detector_height)
    tables = PartTables.bake(ball, ball_settings.table_mm)
    lengths = path_lengths(tables, scan.detector(0.0))
    return monochromatic(ball.energy_kev).line_integrals(tables.materials, lengths), lengths, tables.materials


def test_no_effect_is_the_line_integral_of_the_attenuation(projections, exact):
    image, scanner, _ = projections()

    np.testing.assert_allclose(image, exact[0], rtol=1e-3, atol=1e-4)
    assert scanner["effects"] == []
    assert scanner["noise"] is False
    assert scanner["beam"] == "60 keV"
    assert "photons" not in scanner


def test_noise_is_that_of_the_photons(projections, exact):
    image, scanner, _ = projections("noise", photons=2000.0)

    error = (image - exact[0]) / np.sqrt(np.exp(exact[0]) / 2000)
    assert scanner["noise"] is True
    assert scanner["photons"] == 2000
    assert error[exact[0] < 1].std() == pytest.approx(1.0, abs=0.15)


def test_beam_hardening_takes_less_away_behind_steel_and_the_truth_stays(projections, exact):
    image, scanner, folder = projections("beam_hardening")
    plain, lengths, materials = exact
    steel = lengths[[material.name for material in materials].index("steel")]

    assert image[steel > 5].mean() < 0.9 * plain[steel > 5].mean()
    assert "kV" in scanner["beam"]
    _, _, clean = projections()
    np.testing.assert_array_equal(read_truth(folder).volume.values, read_truth(clean).volume.values)


def test_scatter_is_smooth_and_makes_dense_things_look_thinner(projections, exact):
    image, scanner, _ = projections("scatter", scatter_share=0.5)
    plain = exact[0]

    scattered = np.exp(-image) - np.exp(-plain)
    assert scattered.min() > 0
    assert 0.01 < scattered.max() < 0.2
    assert np.abs(np.diff(scattered, axis=0)).max() < 0.2 * scattered.max()
    densest = np.unravel_index(plain.argmax(), plain.shape)
    assert image[densest] < 0.9 * plain[densest]
    assert scanner["scatter_share"] == 0.5


def test_nothing_in_the_beam_scatters_nothing():
    assert not add_scatter(np.zeros((2, 20, 20)), 0.5).any()


def sharpness(image):
    return np.abs(np.diff(image[..., 1], axis=0)).mean()


def test_a_lens_blurs_what_is_off_its_focus_and_nothing_at_it(ball):
    grid = DistanceGrid.bake(ball.surface, np.array(ball.size_mm), 0.5)
    camera = camera_at(0.4, 0.3, 32.0, 64, 64)
    pinhole = render_photo(ball, grid, camera, supersample=5)
    near, far = (render_photo(ball, grid, Shot(camera, 20.0, focus)) for focus in (128.0 - 13.0, 128.0 + 40.0))
    middle = (slice(24, 40), slice(24, 40))

    assert sharpness(near[middle]) == pytest.approx(sharpness(pinhole[middle]), rel=0.12)
    assert sharpness(far[middle]) < 0.7 * sharpness(pinhole[middle])


def test_blur_is_as_wide_as_a_thin_lens_makes_it(ball):
    """A disc slides over a straight edge: from 10 % to 90 % takes 0.687 of its diameter."""
    grid = DistanceGrid.bake(ball.surface, np.array(ball.size_mm), 0.25)
    black = replace(ball, color=lambda points, normals: np.zeros_like(points))
    camera = camera_at(0.0, 0.0, 32.0, 160, 160)
    depth, aperture, focus = 128.0, 20.0, 150.0
    image = render_photo(black, grid, Shot(camera, aperture, focus))[80, :, 1] / BACKGROUND[1]
    left = image[:80] ** 2.2
    width = np.interp(0.1, left[::-1], np.arange(80)[::-1]) - np.interp(0.9, left[::-1], np.arange(80)[::-1])
    disc = aperture * camera.fx * (1 / depth - 1 / focus)
    assert width == pytest.approx(0.687 * disc, rel=0.2)


def test_rows_are_read_one_after_the_other(ball, ball_settings):
    moving = replace(ball_settings, photo_width=64, photo_height=64, effects=("rolling_shutter",), shutter_share=0.5)
    shot = plan_shots(32.0, moving, np.random.default_rng(1))[0]
    grid = DistanceGrid.bake(ball.surface, np.array(ball.size_mm), 0.5)

    image = render_photo(ball, grid, shot)

    first, last = (render_photo(ball, grid, replace(shot.camera, world_to_camera=end)) for end in shot.ends)
    still = render_photo(ball, grid, shot.camera)
    np.testing.assert_allclose(image[0], first[0], atol=1e-5)
    np.testing.assert_allclose(image[-1], last[-1], atol=1e-5)
    assert np.abs(image - still).mean() > 0.01
    middle = slice(30, 34)
    assert np.abs(image - still)[middle].mean() < 0.5 * np.abs(image - first)[middle].mean()


def test_an_open_shutter_takes_the_mean_light_of_the_way(ball, ball_settings):
    moving = replace(ball_settings, photo_width=64, photo_height=64, effects=("motion_blur",), blur_share=0.15)
    shot = plan_shots(32.0, moving, np.random.default_rng(1))[0]
    grid = DistanceGrid.bake(ball.surface, np.array(ball.size_mm), 0.5)

    image = render_photo(ball, grid, shot)

    light = []
    for center, turn in zip(*shot.poses_at((np.arange(16) + 0.5) / 16), strict=True):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn.T, -turn.T @ center
        light.append(srgb_to_linear(render_photo(ball, grid, replace(shot.camera, world_to_camera=pose))))
    off = np.abs(srgb_to_linear(image) - np.mean(light, axis=0)).mean()
    still = np.abs(srgb_to_linear(render_photo(ball, grid, shot.camera)) - np.mean(light, axis=0)).mean()
    assert off < 0.2 * still
    places = [replace(shot.camera, world_to_camera=end).pixels_of(np.zeros((1, 3))) for end in shot.ends]
    (way,) = np.hypot(*(places[1][axis] - places[0][axis] for axis in (0, 1)))
    assert 0.5 * 0.15 * 32 < way * 128 / shot.camera.fx < 1.5 * 0.15 * 32


def test_a_photo_of_the_open_shutter_has_its_camera_in_the_middle_of_the_way(ball_settings):
    moving = replace(ball_settings, effects=("motion_blur",))
    for shot in plan_shots(32.0, moving, np.random.default_rng(1)):
        (center,), (turn,) = shot.poses_at(np.array([0.5]))
        np.testing.assert_allclose(center, shot.camera.center, atol=1e-9)
        np.testing.assert_allclose(turn.T, np.asarray(shot.camera.world_to_camera)[:3, :3], atol=1e-9)


def test_all_else_of_a_capture_is_the_same_with_an_open_shutter(ball_settings):
    still, moving = (
        plan_shots(32.0, replace(ball_settings, effects=effects), np.random.default_rng(1))
        for effects in (("exposure",), ("exposure", "motion_blur"))
    )
    for one, other in zip(still, moving, strict=True):
        assert one.gain == other.gain
        np.testing.assert_array_equal(one.camera.world_to_camera, other.camera.world_to_camera)


@pytest.mark.parametrize("share", [-0.12, -0.08, 0.25])
def test_a_lens_shows_corners_farther_in_or_out(ball, ball_settings, share):
    """Each ray is one that OpenCV's lens shows where it starts."""
    bent = replace(ball_settings, photo_width=96, photo_height=72, effects=("lens",), lens_share=share)
    shot = plan_shots(32.0, bent, np.random.default_rng(1))[0]
    camera = shot.camera
    inner = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])

    def shown(directions):
        return cv2.projectPoints(directions, np.zeros(3), np.zeros(3), inner, np.array(shot.lens))[0][:, 0]

    corner = np.array([[0.5 * 96 / camera.fx, 0.5 * 72 / camera.fy, 1.0]])
    np.testing.assert_allclose(shown(corner)[0] - [48, 36], np.array([48, 36]) * (1 + share), rtol=1e-9)
    _, directions = shot_rays(shot, 2, slice(0, camera.height))
    seen = shown(directions @ np.asarray(camera.world_to_camera)[:3, :3].T).reshape(144, 192, 2)
    columns, rows = np.meshgrid((np.arange(192) + 0.5) / 2, (np.arange(144) + 0.5) / 2)
    np.testing.assert_allclose(seen, np.stack([columns, rows], axis=-1), atol=1e-3)


def test_all_else_of_a_capture_is_the_same_with_a_lens(ball_settings):
    plain, bent = (
        plan_shots(32.0, replace(ball_settings, effects=effects), np.random.default_rng(1))
        for effects in (("exposure", "motion_blur"), ("exposure", "motion_blur", "lens"))
    )
    for one, other in zip(plain, bent, strict=True):
        assert (one.gain, one.lens, other.lens) == (other.gain, None, bent[0].lens)
        np.testing.assert_array_equal(one.ends, other.ends)
        np.testing.assert_array_equal(one.camera.world_to_camera, other.camera.world_to_camera)


def test_truth_says_which_lens_and_transforms_does_not(projections):
    _, _, folder = projections("lens")
    truth, photos = read_truth(folder), read_capture(folder).photos.photos
    assert truth.effects == ("lens",)
    assert truth.lens.shape == (2, 4)
    camera = photos[0].camera
    corner = (0.5 * camera.width / camera.fx) ** 2 + (0.5 * camera.height / camera.fy) ** 2
    np.testing.assert_allclose(truth.lens, [[-0.08 / corner, 0, 0, 0]] * 2)
    assert all(photo.lens is None for photo in photos)


def test_truth_says_how_lens_and_shutter_were(projections):
    _, _, folder = projections("defocus", "rolling_shutter")
    truth = read_truth(folder)
    photos = read_capture(folder).photos.photos

    assert truth.effects == ("defocus", "rolling_shutter")
    assert truth.aperture_mm.shape == truth.focus_mm.shape == (2,)
    assert truth.aperture_mm[0] == pytest.approx(0.25 * 32)
    assert truth.shutter_poses.shape == (2, 2, 4, 4)
    for photo, (first, last) in zip(photos, truth.shutter_poses, strict=True):
        np.testing.assert_allclose(photo.camera.center, 0.5 * (first[:3, 3] + last[:3, 3]), atol=1e-6)
        assert np.linalg.norm(last[:3, 3] - first[:3, 3]) * truth.photo_to_world.scale == pytest.approx(0.06 * 32)


def test_without_them_cameras_are_pinholes_that_stand_still(projections, ball_settings):
    truth = read_truth(projections()[2])

    assert truth.effects == ()
    assert truth.aperture_mm is truth.focus_mm is truth.shutter_poses is truth.lens is None
    for shot in plan_shots(32.0, ball_settings, np.random.default_rng(0)):
        assert shot.aperture_mm == 0
        assert shot.ends is None


def test_cameras_on_a_table_look_from_above(ball_settings):
    many = replace(ball_settings, photos=30)
    heights = {
        effects: [
            shot.camera.center[2] / np.linalg.norm(shot.camera.center)
            for shot in plan_shots(32.0, replace(many, effects=effects), np.random.default_rng(0))
        ]
        for effects in ((), ("table",))
    }
    assert min(heights["table",]) > np.sin(np.radians(11))
    assert min(heights[()]) < 0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"effects": ("fog",)}, "'fog' is not known; choose any of: noise, beam_hardening"),
        ({"effects": ("table",)}, "needs --photos-by cycles"),
        ({"effects": ("motion_blur", "rolling_shutter")}, "move the camera in two ways"),
        ({"effects": ("lens",), "photos_by": "cycles"}, "effect 'lens' needs --photos-by rays"),
        ({"lens_share": -0.2}, "lens_share is -0.2; give -0.12 to 0.25"),
        ({"photos_by": "paint"}, "choose rays or cycles"),
        ({"shells": 3}, "shells is for the matryoshka"),
        ({"shells": 12}, "give 1 to 9"),
        ({"scatter_share": 0.0}, "scatter_share"),
        ({"photo_quality": 100}, "photo_quality is 100; give 1 to 95"),
    ],
)
def test_what_does_not_fit_is_named(tmp_path, only_ball, ball_settings, changes, message):
    with pytest.raises(SettingError, match=message):
        make_capture("ball", tmp_path / "new", replace(ball_settings, **changes))
    assert not (tmp_path / "new").exists()
