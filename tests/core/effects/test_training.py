"""Photos made with an effect are fitted better with it than without; nothing else changes."""

import subprocess
import sys
import textwrap
from dataclasses import replace

import numpy as np
import pytest
import torch

from insideout.core.effects import Defocus, Exposure, MotionBlur, PhotoEffects, RollingShutter, effects_named
from insideout.core.effects.paths import row_poses
from insideout.core.errors import SettingError
from insideout.core.evaluate.metrics import psnr
from insideout.core.gaussians import GaussianSet
from insideout.core.render import splat
from insideout.core.stages.surface.rgb import RgbSettings, RgbTrainer
from insideout.core.train.schedule import Decay
from insideout.core.train.strategy import DefaultStrategy

HELD = (0, 4, 8, 12)
DISTANCE, DEPTH, RADIUS = 200.0, 25.0, 30.0
SETTINGS = RgbSettings(
    iterations=400,
    degree=0,
    means_rate=Decay(1e-3, 1e-5),
    sh_rate=0.02,
    scale_rate=0.01,
    strategy=DefaultStrategy(start=0.1, stop=0.6, every=50, most=900),
)


@pytest.fixture(scope="module")
def defocused(walls, optics):
    """Photos focused on one wall or the other, and the focuses' depths."""
    rng = np.random.default_rng(1)
    focuses = [DISTANCE + rng.choice([-DEPTH, DEPTH]) + rng.uniform(-5, 5) for _ in walls.cameras]
    photos = [
        optics.through_lens(lambda view: optics.pinhole(walls.set, view), camera, RADIUS, focus, 32)
        for camera, focus in zip(walls.cameras, focuses, strict=True)
    ]
    return photos, focuses


@pytest.fixture(scope="module")
def skewed(walls, optics):
    """Photos of a camera that moves by some five pixels while they are read out, and by how much."""
    rng, photos, motions = np.random.default_rng(1), [], []
    for camera in walls.cameras:
        motion = torch.zeros(12, dtype=torch.float64)
        motion[:6] = torch.from_numpy(rng.normal(0, [0.03, 0.03, 0.02, 0.01, 0.01, 0.01]))
        poses = row_poses(camera.world_to_camera, motion, torch.arange(48) / 47, 70.0).numpy()
        photos.append(optics.row_by_row(lambda view: optics.pinhole(walls.set, view), camera, poses))
        motions.append(motion)
    return photos, motions


@pytest.fixture(scope="module")
def blurred(walls, optics):
    """Photos of a camera that moves by three to six pixels while its shutter is open."""
    rng, photos = np.random.default_rng(1), []
    for camera in walls.cameras:
        angle, turn = rng.uniform(0, 2 * np.pi), rng.uniform(3, 6) / camera.fx
        motion = torch.zeros(12, dtype=torch.float64)
        motion[:3] = torch.tensor([-turn * np.sin(angle), turn * np.cos(angle), rng.normal(0, 0.02)])
        poses = row_poses(camera.world_to_camera, motion, (torch.arange(16) + 0.5) / 16, 70.0).numpy()
        views = [optics.pinhole(walls.set, replace(camera, world_to_camera=pose)) for pose in poses]
        photos.append(optics.to_srgb(np.mean([optics.to_linear(view) for view in views], axis=0)).astype(np.float32))
    return photos


@pytest.fixture(scope="module")
def make_trainer(walls, optics):
    def make(photos, effects=(), start=None):
        def some(held):
            chosen = [i for i in range(len(photos)) if (i in HELD) == held]
            return optics.Pictures([walls.cameras[i] for i in chosen], [photos[i] for i in chosen])

        settings = replace(SETTINGS, effects=effects)
        first = walls.start if start is None else start
        return RgbTrainer(first, some(False), some(True), optics.background, settings, 0, "cpu")

    return make


def fit(trainer, iterations=SETTINGS.iterations):
    for iteration in range(iterations):
        trainer.step(iteration)
    return trainer


@pytest.fixture(scope="module")
def still(walls, optics):
    """Photos in focus of a still camera."""
    return [optics.pinhole(walls.set, camera) for camera in walls.cameras]


@pytest.fixture(scope="module")
def plain(make_trainer, still):
    """A training on these without effects: the best that others may come to."""
    return fit(make_trainer(still))


def sharpness(trainer, walls, optics, sharp):
    """Mean PSNR of what the splats alone show against photos that are all in focus or of a still camera."""
    current = trainer.parameters.to_set().to_torch()
    return np.mean([psnr(optics.pinhole(current, walls.cameras[i]), sharp[i], 1.0) for i in HELD])


def test_defocused_photos_are_shown_3_db_better_with_their_lens(make_trainer, defocused, still, walls, optics):
    """Held-out photos as they were taken: of each, aperture and focus alone are fitted, with the splats frozen."""
    photos, focuses = defocused
    without, within = fit(make_trainer(photos)), fit(make_trainer(photos, (Defocus(),)))
    assert within.measure()["photos"] > without.measure()["photos"] + 3
    # All in focus: 25.2 and 21.9 dB when this was written.
    assert sharpness(within, walls, optics, still) > sharpness(without, walls, optics, still) + 2.5
    report, shown = within.effects.report()["defocus"], [i for i in range(16) if i not in HELD]
    exact = walls.cameras[0].fx * RADIUS / (10 * within.extent)
    assert np.median(report["aperture_tenths_px"]) == pytest.approx(exact, rel=0.25)
    found = within.extent / np.array(report["focus_disparity"])
    assert np.median(np.abs(found - np.array(focuses)[shown])) < 0.4 * DEPTH


def test_skewed_photos_are_shown_3_db_better_with_their_motion(make_trainer, skewed, still, walls, optics):
    """Held-out photos as they were taken: of each, the motion alone is fitted, with the splats frozen."""
    photos, _ = skewed
    effect = RollingShutter(tolerance_px=0.4, least_bands=4)
    without, within = fit(make_trainer(photos)), fit(make_trainer(photos, (effect,)))
    assert within.measure()["photos"] > without.measure()["photos"] + 3
    # Motions that all photos share can hide in the shape of the walls, so that a still camera gains less.
    assert sharpness(within, walls, optics, still) > sharpness(without, walls, optics, still)


def test_blurred_photos_show_the_object_sharper_with_their_motion(make_trainer, blurred, still, plain, walls, optics):
    """More than three fifths of what blur costs come back within these few steps, as a still camera sees it: 27.5 dB
    from sharp photos, 22.9 from blurred ones, 26.3 with their motions; and photos as they are."""
    without, within = (fit(make_trainer(blurred, effects)) for effects in ((), (MotionBlur(),)))
    exact, lost, left = (sharpness(trainer, walls, optics, still) for trainer in (plain, without, within))
    assert exact - lost > 3
    assert exact - left < 0.4 * (exact - lost)
    assert within.measure()["photos"] > without.measure()["photos"] + 3


def test_photos_of_many_exposures_are_shown_as_well_as_those_of_one(make_trainer, still, plain, walls, optics):
    """Four fifths of what they cost without the effect, in photos that were not trained on, and in the splats."""
    rng = np.random.default_rng(1)
    stops = rng.normal(0, 0.4, len(walls.cameras))[:, None] + rng.normal(0, 0.05, (len(walls.cameras), 3))
    light = [optics.to_linear(image) * np.exp2(gain) for image, gain in zip(still, stops, strict=True)]
    photos = [optics.to_srgb(np.clip(image, 0, 1)).astype(np.float32) for image in light]
    without, within = fit(make_trainer(photos)), fit(make_trainer(photos, (Exposure(),)))
    lost, left = (plain.measure()["photos"] - other.measure()["photos"] for other in (without, within))
    assert lost > 3
    assert left < 0.2 * lost
    shown = [i for i in range(len(photos)) if i not in HELD]
    found = np.log2(within.effects.report()["exposure"]["gain"])
    np.testing.assert_allclose(found.mean(axis=0), 0, atol=1e-9)
    np.testing.assert_allclose(found, (stops - stops[shown].mean(axis=0))[shown], atol=0.15)


EFFECTS = [(Defocus(),), (Exposure(),), (RollingShutter(tolerance_px=0.4, least_bands=4),)]
BLUR = [(MotionBlur(),), (MotionBlur(), Exposure())]


class TestCheckpoints:
    @pytest.mark.parametrize("effects", [sum(EFFECTS, ()), BLUR[1]], ids=["three", "blur and exposure"])
    def test_a_training_that_is_broken_off_ends_with_the_same_bits(self, make_trainer, defocused, tmp_path, effects):
        photos = defocused[0]
        whole, first, second = (make_trainer(photos, effects) for _ in range(3))
        for iteration in range(60):
            whole.step(iteration)
        for iteration in range(31):
            first.step(iteration)
        torch.save(first.state(), tmp_path / "checkpoint")
        second.restore(torch.load(tmp_path / "checkpoint", weights_only=True))
        for iteration in range(31, 60):
            second.step(iteration)
        for name, value in vars(whole.parameters.to_set()).items():
            np.testing.assert_array_equal(value, getattr(second.parameters.to_set(), name), err_msg=name)
        assert whole.effects.report() == second.effects.report()
        assert whole.measure()["photos"] == second.measure()["photos"]

    def test_one_of_a_training_without_the_effect_is_not_taken_up(self, make_trainer, defocused):
        with pytest.raises(KeyError):
            make_trainer(defocused[0], (Defocus(),)).restore(make_trainer(defocused[0]).state())


class TestCost:
    def test_without_effects_nothing_of_them_is_loaded_or_kept(self, make_trainer, defocused):
        """In a process of its own, where no other test has loaded them."""
        code = """
            import sys, insideout.core.stages.surface
            sys.exit(any(name.startswith("insideout.core.effects") for name in sys.modules))
        """
        assert subprocess.run([sys.executable, "-c", textwrap.dedent(code)], check=False).returncode == 0
        assert make_trainer(defocused[0]).effects is None
        assert "effects" not in make_trainer(defocused[0]).state()

    def test_effects_that_are_not_there_change_nothing_that_is_seen(self, make_trainer, still, plain):
        """Photos in focus of a still camera: circles shrink and cameras stay where they are."""
        for effects in [*EFFECTS, BLUR[0]]:
            assert fit(make_trainer(still, effects)).measure()["photos"] > plain.measure()["photos"] - 1.0


def test_a_step_that_is_not_finite_moves_nothing(make_trainer, defocused):
    trainer = make_trainer(defocused[0], (Defocus(warm_up=0.0), RollingShutter(least_bands=4, warm_up=0.0)))
    trainer.step(0)
    before = trainer.effects.report()
    trainer._photos.images = [image * float("nan") for image in trainer._photos.images]
    assert np.isnan(trainer.step(1))
    after = trainer.effects.report()
    assert before["rolling_shutter"] == after["rolling_shutter"]
    shown = [place for place, focus in enumerate(before["defocus"]["focus_disparity"]) if focus is not None]
    assert [after["defocus"]["focus_disparity"][i] for i in shown] == [
        before["defocus"]["focus_disparity"][i] for i in shown
    ]


def test_a_training_of_no_splats_goes_on(make_trainer, defocused):
    trainer = make_trainer(defocused[0], (Defocus(), RollingShutter()), GaussianSet.empty())
    trainer.step(0)
    assert "photos" in trainer.measure()
    assert len(trainer) == 0


def test_effects_are_applied_in_the_order_of_a_camera_whatever_order_they_are_given_in(walls):
    """What is out of focus is so before a row of it is read out: bands of a blurred image have no edges."""
    given = sum(EFFECTS, ())
    effects = [PhotoEffects(order, walls.cameras, 70.0) for order in (given, given[::-1])]
    assert [list(part.report()) for part in effects] == [["rolling_shutter", "defocus", "exposure"]] * 2


def test_an_effect_chosen_twice_is_refused(walls):
    with pytest.raises(SettingError, match="at most once"):
        PhotoEffects((Defocus(), Defocus(warm_up=0.0)), walls.cameras, 70.0)


@pytest.mark.parametrize("other", [Defocus(), RollingShutter()])
def test_a_motion_beside_a_lens_or_a_rolling_shutter_is_refused(walls, other):
    with pytest.raises(SettingError, match=f"motion_blur and {other.name} cannot be learned at once"):
        PhotoEffects((other, MotionBlur()), walls.cameras, 70.0)


def test_effects_have_names():
    assert effects_named(["rolling_shutter", "defocus"]) == (RollingShutter(), Defocus())
    assert effects_named([]) == ()
    with pytest.raises(SettingError, match="'bokeh'; choose defocus, exposure, motion_blur, rolling_shutter"):
        effects_named(["bokeh"])


def test_a_photo_can_be_fitted_without_a_training(walls, optics):
    """As a finished model is measured: the true splats, a photo and nothing else."""
    camera = walls.cameras[5]
    photo = optics.through_lens(lambda view: optics.pinhole(walls.set, view), camera, RADIUS, DISTANCE - DEPTH)
    effects = PhotoEffects((Defocus(),), [camera], 70.0)

    def draw(gaussians, camera):
        return splat(gaussians, camera, torch.from_numpy(optics.background))

    shown = effects.fitted(draw, walls.set, camera, torch.from_numpy(photo)).color.numpy()
    assert psnr(shown, photo, 1.0) > psnr(optics.pinhole(walls.set, camera), photo, 1.0) + 8
