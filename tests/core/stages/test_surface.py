"""Fitting: better than the start, the same bits after a break, nothing that is not finite."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from insideout.core.capture.model import Capture, Photo
from insideout.core.effects import Defocus, RollingShutter
from insideout.core.errors import Cancelled
from insideout.core.gaussians import GaussianSet, Modality
from insideout.core.progress import Reporter
from insideout.core.render import radiograph
from insideout.core.run_folder import RunFolder
from insideout.core.stages.context import StageContext
from insideout.core.stages.initialize import InitializeSettings
from insideout.core.stages.initialize import run as initialize
from insideout.core.stages.surface import PRESETS, SurfaceSettings, reason_to_skip, run
from insideout.core.stages.surface import xray as xray_module
from insideout.core.stages.surface.photos import TrainingPhotos, scene_extent
from insideout.core.stages.surface.rgb import RgbSettings, RgbTrainer
from insideout.core.stages.surface.xray import XraySettings, XrayTrainer, screen_gradient
from insideout.core.train.schedule import Decay, Growth, Stop
from insideout.core.train.strategy import DefaultStrategy
from insideout.core.views import Camera, Detector

WHITE = np.ones(3, np.float32)
RGB = RgbSettings(
    iterations=60,
    long_side=48,
    growth=Growth(((0.3, 0.5),)),
    means_rate=Decay(1e-3, 1e-4),
    sh_rate=0.02,
    scale_rate=0.02,
    strategy=DefaultStrategy(start=0.1, stop=0.8, every=15, most=1500),
    degree=1,
)
XRAY = XraySettings(
    iterations=40,
    smooth_voxels=8,
    smooth_every=4,
    means_rate=Decay(3e-3, 1e-3),
    density_rate=Decay(0.05, 0.02),
    scale_rate=Decay(0.03, 0.01),
    strategy=replace(XraySettings().strategy, start=0.1, every=10, most=900),
)
SETTINGS = SurfaceSettings(RGB, XRAY)
# Looks at every tenth of the iterations from a half on. No gain is large enough: it ends with the second look.
HASTY = Stop(views=2, every=0.1, gain_db=1000.0, patience=1, least=0.5)


@pytest.fixture(scope="module")
def initialized(shells_capture, tmp_path_factory):
    """A run folder in which `initialize` is done for the two shells."""
    context = StageContext(shells_capture[0], RunFolder(tmp_path_factory.mktemp("initialized") / "run"))
    initialize(context, InitializeSettings(hull_cells=20, most_rgb=700, xray_splats=600))
    return context.run


@pytest.fixture
def make_context(shells_capture, initialized, tmp_path):
    """Contexts on copies of that folder."""

    def make(name="run", capture=None, **options):
        run_folder = RunFolder(tmp_path / name)
        for part in ("rgb", "xray"):
            run_folder.write_set("initialize", part, initialized.read_set("initialize", part))
        for file in ("volume.npz", "photos.json"):
            (run_folder.stage("initialize") / file).write_bytes((initialized.path / "initialize" / file).read_bytes())
        return StageContext(capture or shells_capture[0], run_folder, **options)

    return make


@pytest.fixture(scope="module")
def splits(shells_capture):
    """Training and held-out photos in memory."""
    photos = shells_capture[0].photos.photos
    return tuple(TrainingPhotos([p for p in photos if p.held_out is held], 48, WHITE) for held in (False, True))


def bits(context):
    return {part: context.run.read_set("surface", part) for part in ("rgb", "xray")}


def assert_same(one, two):
    for part in ("rgb", "xray"):
        assert len(one[part]) == len(two[part])
        for name, value in vars(one[part]).items():
            np.testing.assert_array_equal(value, getattr(two[part], name), err_msg=f"{part} {name}")


class TestPhotos:
    def trainer(self, initialized, splits, settings=RGB):
        start = initialized.read_set("initialize", "rgb")
        return RgbTrainer(start, *splits, WHITE, settings, seed=0, kernel="cpu")

    def test_held_out_photos_are_shown_much_better_than_at_the_start(self, initialized, splits):
        trainer = self.trainer(initialized, splits)
        before = trainer.measure()["photos"]
        losses = [trainer.step(iteration) for iteration in range(RGB.iterations)]
        assert trainer.measure()["photos"] > before + 4
        assert len(trainer) > 700
        assert np.mean(losses[-5:]) < 0.7 * np.mean(losses[:5])

    def test_a_plain_background_stays_free_of_splats(self, initialized, splits):
        alphas = []
        for weight in (0.0, 0.5):
            settings = replace(RGB, mask_weight=weight)
            trainer = self.trainer(initialized, splits, settings)
            for iteration in range(30):
                trainer.step(iteration)
            camera, _, mask = splits[1].read(0)
            from insideout.core.render import splat

            alpha = splat(trainer.parameters.to_set().to_torch(), camera, torch.ones(3)).alpha
            alphas.append(float((alpha - mask).abs().mean()))
        assert alphas[1] < alphas[0]

    def test_a_photo_that_is_not_finite_costs_its_step_only(self, initialized, splits):
        trainer = self.trainer(initialized, splits)

        class Poisoned:
            cameras = splits[0].cameras

            def __len__(self):
                return len(splits[0])

            def read(self, index, share=1.0):
                camera, pixels, mask = splits[0].read(index, share)
                return camera, pixels * float("nan") if index == 0 else pixels, mask

        trainer._photos = Poisoned()
        losses = [trainer.step(iteration) for iteration in range(2 * len(splits[0]))]
        assert np.isnan(losses).sum() == 2
        result = trainer.parameters.to_set()
        assert all(np.isfinite(value).all() for value in vars(result).values())

    def test_every_photo_is_shown_once_a_lap(self, initialized, splits):
        trainer, count = self.trainer(initialized, splits), len(splits[0])
        laps = [[trainer._choose(lap * count + i) for i in range(count)] for lap in range(2)]
        assert sorted(laps[0]) == sorted(laps[1]) == list(range(count))
        assert laps[0] != laps[1]

    def test_an_empty_set_does_not_crash(self, splits):
        trainer = RgbTrainer(GaussianSet.empty(), *splits, WHITE, RGB, seed=0, kernel="cpu")
        trainer.step(0)
        assert len(trainer.parameters.to_set()) == 0

    def test_photos_shrink_with_their_cameras(self, splits):
        camera, pixels, mask = splits[0].read(0, 0.5)
        whole, full, _ = splits[0].read(0)
        assert (camera.width, camera.height) == (24, 24) == tuple(pixels.shape[:2]) == tuple(mask.shape)
        assert camera.fx == pytest.approx(whole.fx / 2)
        np.testing.assert_allclose(pixels.mean(), full.mean(), atol=0.01)

    def test_photos_and_masks_are_those_of_the_files(self, shells_capture, splits):
        from insideout.core.capture.background import foreground_mask
        from insideout.core.capture.photos import read_photo

        photo = next(photo for photo in shells_capture[0].photos.photos if not photo.held_out)
        image, camera = read_photo(photo, 48, (1.0, 1.0, 1.0))
        found, pixels, mask = splits[0].read(0)
        assert (found.width, found.height) == (camera.width, camera.height)
        np.testing.assert_allclose(pixels, image, atol=0.5 / 255 + 1e-6)
        np.testing.assert_array_equal(mask, foreground_mask(image, WHITE))
        behind_nothing = TrainingPhotos([photo], 48, None).read(0)
        assert behind_nothing[2] is None
        assert behind_nothing[1].shape == pixels.shape

    @pytest.mark.parametrize("size", [(4, 3), (101, 53), (700, 500)])
    @pytest.mark.parametrize("background", [None, WHITE])
    def test_oblong_photos_of_few_pixels_and_of_many_keep_colours_and_masks_in_place(self, tmp_path, size, background):
        """Bytes are read by the calling thread alone when they are few, and shared out when they are many."""
        width, height = size
        levels = np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)
        levels[:, : width // 2] = 255
        Image.fromarray(levels).save(tmp_path / "photo.png")
        camera = Camera(width, height, 50.0, 50.0, width / 2, height / 2, np.eye(4))
        found, pixels, mask = TrainingPhotos([Photo(tmp_path / "photo.png", camera)], 1000, background).read(0)
        assert (found.width, found.height) == size
        np.testing.assert_array_equal(pixels, levels.astype(np.float32) / np.float32(255))
        if background is None:
            assert mask is None
        else:
            assert mask.shape == (height, width)
            assert not mask[:, 0].any()

    def test_photos_that_do_not_fit_into_memory_are_read_again(self, shells_capture, splits):
        photos = [photo for photo in shells_capture[0].photos.photos if not photo.held_out]
        tight = TrainingPhotos(photos, 48, WHITE, cache_bytes=2 * 48 * 48 * 4)
        for index in (0, 5, 1, 0):
            for share in (1.0, 0.5):
                for one, two in zip(tight.read(index, share)[1:], splits[0].read(index, share)[1:], strict=True):
                    assert torch.equal(one, two)
        assert len(tight._kept) <= 3
        assert len(tight.cameras) == len(photos)

    def test_the_extent_is_that_of_3dgs(self, splits):
        centers = np.array([camera.center for camera in splits[0].cameras])
        expected = 1.1 * np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()
        assert scene_extent(splits[0].cameras) == pytest.approx(expected)
        assert scene_extent(splits[0].cameras[:1]) == 1.0


class TestProjections:
    def trainer(self, initialized, projections, settings=XRAY):
        start = initialized.read_set("initialize", "xray")
        return XrayTrainer(start, projections, 4 / 3, 0.08, settings, seed=0, kernel="cpu")

    def test_held_out_projections_are_shown_better_than_at_the_start(self, initialized, shells_capture):
        trainer = self.trainer(initialized, shells_capture[0].projections)
        before = trainer.measure()["projections"]
        for iteration in range(XRAY.iterations):
            trainer.step(iteration)
        assert trainer.measure()["projections"] > before + 2.5

    def test_splats_stay_in_the_box_within_the_cap(self, initialized, shells_capture):
        projections = shells_capture[0].projections
        trainer = self.trainer(initialized, projections)
        for iteration in range(20):
            trainer.step(iteration)
        result = trainer.parameters.to_set()
        assert 600 < len(result) <= XRAY.strategy.most
        assert np.all((result.means >= projections.box_mm[0]) & (result.means <= projections.box_mm[1]))
        assert (result.modality == int(Modality.XRAY)).all()

    def test_a_projection_that_is_not_finite_costs_its_step_only(self, initialized, shells_capture):
        projections = shells_capture[0].projections
        images = projections.images.copy()
        bad = int(np.flatnonzero(~projections.held_out)[3])
        images[bad, 5, 7] = np.nan
        trainer = self.trainer(initialized, replace(projections, images=images))
        training = int((~projections.held_out).sum())
        losses = [trainer.step(iteration) for iteration in range(training)]
        assert np.isnan(losses).sum() == 1
        assert np.isfinite(trainer.parameters.to_set().density).all()

    def test_held_out_projections_change_nothing(self, initialized, shells_capture):
        projections = shells_capture[0].projections
        images = projections.images.copy()
        images[projections.held_out] = 7.0
        results = []
        for given in (projections, replace(projections, images=images)):
            trainer = self.trainer(initialized, given)
            for iteration in range(8):
                trainer.step(iteration)
            results.append(trainer.parameters.to_set())
        np.testing.assert_array_equal(results[0].means, results[1].means)

    def test_projections_set_aside_change_nothing(self, initialized, shells_capture):
        projections = shells_capture[0].projections
        settings = replace(XRAY, stop=Stop(views=3))
        aside = self.trainer(initialized, projections, settings).validation
        assert len(aside) == 3
        assert not projections.held_out[aside].any()
        images = projections.images.copy()
        images[aside] = 7.0
        results, found = [], []
        for given in (projections, replace(projections, images=images)):
            trainer = self.trainer(initialized, given, settings)
            for iteration in range(16):
                trainer.step(iteration)
            results.append(trainer.parameters.to_set())
            found.append(trainer.validate())
        np.testing.assert_array_equal(results[0].means, results[1].means)
        assert found[0] > found[1]

    def test_every_projection_is_trained_on_set_aside_or_held_out(self, initialized, shells_capture):
        projections = shells_capture[0].projections
        trainer = self.trainer(initialized, projections, replace(XRAY, stop=Stop(views=3)))
        held_out = np.flatnonzero(projections.held_out)
        parts = np.concatenate([trainer.training, trainer.validation, held_out])
        np.testing.assert_array_equal(np.sort(parts), np.arange(len(projections.images)))
        lap = [trainer._choose(place) for place in range(len(trainer.training))]
        assert sorted(lap) == trainer.training.tolist()

    def test_no_splat_gets_much_thinner_than_a_pixel(self, initialized, shells_capture):
        """Sheets that projections cannot tell from thicker ones: in a coffin a thick base became a bright line."""
        projections = shells_capture[0].projections

        def thinnest_mm(pixels: float) -> float:
            trainer = self.trainer(initialized, projections, replace(XRAY, least_pixels=pixels))
            for iteration in range(20):
                trainer.step(iteration)
            return float(trainer.parameters.to_set().scales.min())

        limit = 1.5 * thinnest_mm(0.0)
        assert thinnest_mm(limit / projections.pixel_mm) >= limit * (1 - 1e-5)

    def test_squares_bring_held_out_projections_nearer_too(self, initialized, shells_capture):
        trainer = self.trainer(initialized, shells_capture[0].projections, replace(XRAY, squares_weight=30.0))
        before = trainer.measure()["projections"]
        for iteration in range(XRAY.iterations):
            trainer.step(iteration)
        assert trainer.measure()["projections"] > before + 2.5

    def test_projections_grow_to_their_full_size(self, initialized, shells_capture, monkeypatch):
        """Half the side in the first half of the fit, and the same rays' mean; never under 32 pixels a side."""
        projections = shells_capture[0].projections
        images = np.random.default_rng(0).random((len(projections.images), 64, 96), dtype=np.float32)
        wider = replace(
            projections,
            images=images,
            detectors=[replace(d, width=96, height=64, u=0.5 * d.u, v=0.5 * d.v) for d in projections.detectors],
        )
        settings = replace(XRAY, iterations=6, growth=Growth(((0.3, 0.25), (0.6, 0.5))), smooth_weight=0.0)
        trainer, seen = self.trainer(initialized, wider, settings), []
        drawn = xray_module.radiograph

        def radiograph(gaussians, detector, *rest):
            seen.append((detector.height, detector.width))
            return drawn(gaussians, detector, *rest)

        monkeypatch.setattr(xray_module, "radiograph", radiograph)
        for iteration in range(6):
            assert np.isfinite(trainer.step(iteration))
        assert seen == [(32, 48)] * 4 + [(64, 96)] * 2
        halved = wider.in_blocks(2).images
        np.testing.assert_allclose(halved, images.reshape(-1, 32, 2, 48, 2).mean(axis=(2, 4)), rtol=1e-5)

    def test_without_the_option_none_is_set_aside(self, initialized, shells_capture):
        trainer = self.trainer(initialized, shells_capture[0].projections)
        assert (len(trainer.validation), trainer.validate()) == (0, None)

    def test_validation_sees_the_fit_get_better(self, initialized, shells_capture):
        trainer = self.trainer(initialized, shells_capture[0].projections, replace(XRAY, stop=Stop(views=3)))
        before = trainer.validate()
        for iteration in range(XRAY.iterations):
            trainer.step(iteration)
        assert trainer.validate() > before + 2.5

    def test_a_projection_that_is_not_finite_is_not_measured_on(self, initialized, shells_capture):
        projections = shells_capture[0].projections
        settings = replace(XRAY, stop=Stop(views=3))
        first, *others = self.trainer(initialized, projections, settings).validation
        images = projections.images.copy()
        images[first, 5, 7] = np.nan
        trainer = self.trainer(initialized, replace(projections, images=images), settings)
        assert trainer.validation.tolist() == others
        assert first not in trainer.training
        assert np.isfinite(trainer.validate())

    def test_a_budget_makes_the_number_of_splats_grow_evenly(self, initialized, shells_capture):
        """Densified at 10, 20 and 30 of 40, on the way from 600 to 900; a few are pruned each time."""
        counts = []
        for budget in (False, True):
            strategy = replace(XRAY.strategy, start=0.0, stop=1.0, every=10, gradient=1e-9, most=900, budget=budget)
            trainer = self.trainer(initialized, shells_capture[0].projections, replace(XRAY, strategy=strategy))
            start, grown = len(trainer), []
            for iteration in range(30):
                trainer.step(iteration)
                if iteration % 10 == 9:
                    grown.append(len(trainer) - start)
            counts.append(grown)
        for grown, shares in zip(counts, ([1, 1, 1], [0.25, 0.5, 0.75]), strict=True):
            allowed = np.array(shares) * (900 - start)
            assert np.all(grown <= allowed)
            np.testing.assert_allclose(grown, allowed, atol=20)

    def test_screen_gradients_are_computed_until_the_last_densification(self, initialized, shells_capture, monkeypatch):
        asked, real = [], xray_module.screen_gradient
        monkeypatch.setattr(xray_module, "screen_gradient", lambda *given: asked.append(1) or real(*given))
        settings = replace(XRAY, iterations=20, strategy=replace(XRAY.strategy, start=0.0, stop=0.5, every=5))
        trainer = self.trainer(initialized, shells_capture[0].projections, settings)
        for iteration in range(settings.iterations):
            trainer.step(iteration)
        assert len(asked) == 10

    @pytest.mark.parametrize("parallel", [False, True])
    def test_screen_gradients_are_those_by_the_projected_centres(self, parallel):
        """One splat: moving it by what moves its shadow by a pixel changes the loss by the pixel gradient."""
        beam = np.array([1.0, 0, 0]) if parallel else np.array([-100.0, 0, 0])
        detector = Detector(
            40, 30, beam, np.array([60.0, 0, 0]), np.array([0, 2.0, 0]), np.array([0, 0, -2.0]), parallel
        )
        means = torch.tensor([[0.0, 3.0, -4.0]], requires_grad=True)
        start = GaussianSet.create(np.zeros((1, 3)), 4.0, density=0.1, modality=Modality.XRAY).to_torch()
        weights = torch.linspace(0, 1, 40)[None, :] * torch.linspace(1, 2, 30)[:, None]

        def loss(at):
            return (radiograph(replace(start, means=at), detector, kernel="reference") * weights).sum()

        loss(means).backward()
        found = float(screen_gradient(means.grad.numpy(), means.detach().numpy(), detector)[0])
        nearer = 1.0 if parallel else 100.0 / 160.0
        by_pixel = []
        for step in (detector.u, detector.v):
            shift = torch.tensor(0.05 * nearer * step[None], dtype=torch.float32)
            by_pixel.append(float(loss(means.detach() + shift) - loss(means.detach() - shift)) / 0.1)
        assert found == pytest.approx(np.hypot(20 * by_pixel[0], 15 * by_pixel[1]), rel=0.02)


class TestStage:
    def test_both_halves_are_fitted_and_reported(self, make_context):
        context = make_context()
        report = run(context, SETTINGS)
        result = bits(context)
        for part, kind, iterations in (("rgb", "photos", 60), ("xray", "projections", 40)):
            assert report[part]["iterations"] == iterations
            first, last = report[part]["heldout"][0], report[part]["heldout"][-1]
            assert last["iteration"] == iterations
            assert last[kind] > first[kind] - 1
            assert report["splats"][part] == len(result[part])
            assert all(np.isfinite(value).all() for value in vars(result[part]).values())
        assert report["rgb"]["background"] == pytest.approx([1, 1, 1], abs=0.02)

    def test_few_photos_have_fewer_splats_and_steps(self, make_context):
        report = run(make_context(), replace(SETTINGS, rgb=replace(RGB, passes=2, splats_per_pair=0.01)))["rgb"]
        training = report["photos"]["training"]
        assert report["trained_with"]["strategy"]["most"] == round(0.01 * training**2)
        assert report["iterations"] == report["planned"] == 2 * training

    @pytest.mark.parametrize("stop", [23, 85])
    def test_killed_and_resumed_ends_with_the_same_bits(self, make_context, stop):
        settings = replace(SETTINGS, rgb=replace(RGB, strategy=replace(RGB.strategy, reset_every=20)))
        whole = make_context("whole")
        run(whole, settings)
        asked = iter(range(10**6))
        broken = make_context("broken", reporter=Reporter(is_cancelled=lambda: next(asked) >= stop))
        with pytest.raises(Cancelled):
            run(broken, settings)
        assert not broken.run.has_set("surface", "xray")
        run(replace(broken, reporter=Reporter()), settings)
        assert_same(bits(whole), bits(broken))

    def test_effects_are_learnt_at_every_size_kept_over_a_break_and_reported(self, make_context):
        effects = Defocus(warm_up=0.0), RollingShutter(least_bands=2, tolerance_px=0.5, warm_up=0.0)
        settings = SurfaceSettings(replace(RGB, effects=effects), replace(XRAY, iterations=2))
        whole = make_context("whole")
        report = run(whole, settings)["rgb"]
        assert report["skipped_steps"] == 0
        found = json.loads(json.dumps(report["effects"]))
        assert all(0 < aperture < 10 for aperture in found["defocus"]["aperture_tenths_px"])
        assert np.shape(found["rolling_shutter"]["start_world_to_camera"]) == (8, 4, 4)
        asked = iter(range(10**6))
        broken = make_context("broken", reporter=Reporter(is_cancelled=lambda: next(asked) >= 35))
        with pytest.raises(Cancelled):
            run(broken, settings)
        assert run(replace(broken, reporter=Reporter()), settings)["rgb"]["effects"] == report["effects"]
        assert_same(bits(whole), bits(broken))

    def test_a_flat_curve_ends_either_half(self, make_context):
        """Looks at 30 and 36 of 60 photos, at 20 and 24 of 40 projections."""
        report = run(make_context(), SurfaceSettings(replace(RGB, stop=HASTY), replace(XRAY, stop=HASTY)))
        for part, looks, views in (("rgb", [30, 36], "photos"), ("xray", [20, 24], "projections")):
            assert report[part]["iterations"] == looks[-1]
            assert [done for done, _ in report[part]["validation"]] == looks
            assert all(np.isfinite(psnr) for _, psnr in report[part]["validation"])
            assert report[part][views]["validation"] == 2

    @pytest.mark.parametrize("stop", [31, 58])
    def test_killed_between_two_looks_it_ends_where_it_would_have(self, make_context, stop):
        """After 31 photos, one look done; after all 36 photos and 22 projections, one look done."""
        settings = SurfaceSettings(replace(RGB, stop=HASTY), replace(XRAY, stop=HASTY))
        whole = make_context("whole")
        expected = run(whole, settings)
        asked = iter(range(10**6))
        broken = make_context("broken", reporter=Reporter(is_cancelled=lambda: next(asked) >= stop))
        with pytest.raises(Cancelled):
            run(broken, settings)
        report = run(replace(broken, reporter=Reporter()), settings)
        assert_same(bits(whole), bits(broken))
        for part in ("rgb", "xray"):
            for history in (report[part], expected[part]):
                assert history.pop("seconds") > 0
                assert all(point.pop("seconds") > 0 for point in history["heldout"])
        assert report == expected

    def test_no_preset_stops_early(self):
        assert all(half.stop is None for preset in PRESETS.values() for half in (preset.rgb, preset.xray))

    def test_progress_runs_from_photos_to_projections(self, make_context):
        heard = []
        run(make_context(reporter=Reporter(heard.append)), SETTINGS)
        parts = [p.part for p in heard]
        assert parts == sorted(parts), "rgb, then xray"
        fractions = [p.fraction for p in heard]
        assert fractions == sorted(fractions)
        assert fractions[-1] < 1, "the pipeline says when a stage is done"
        assert {p.part for p in heard if p.heldout_psnr is not None} == {"rgb", "xray"}

    def test_a_volume_without_projections_is_passed_on(self, make_context, shells_capture, tmp_path):
        volume = RunFolder(shells_capture[1]).volume()
        context = make_context(capture=Capture(path=tmp_path, volume=volume))
        (context.run.path / "initialize" / "rgb.ply").unlink()
        report = run(context, SETTINGS)
        assert "projections" in report["xray"]["skipped"]
        assert len(bits_of_xray(context)) == report["splats"]["xray"]

    def test_it_is_skipped_only_without_any_start(self, make_context, shells_capture, tmp_path):
        assert reason_to_skip(make_context()) is None
        assert reason_to_skip(StageContext(shells_capture[0], RunFolder(tmp_path / "nothing")))


def bits_of_xray(context):
    return context.run.read_set("surface", "xray")
