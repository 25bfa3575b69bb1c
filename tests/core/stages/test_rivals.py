"""The published rivals: their numbers, their units, and that they reconstruct."""

from dataclasses import replace

import numba
import numpy as np
import pytest
import torch

from insideout.core.capture.detectors import CircularScan
from insideout.core.capture.model import Capture
from insideout.core.capture.pinhole import camera_of
from insideout.core.errors import SettingError
from insideout.core.gaussians import GaussianSet, Modality
from insideout.core.phantoms.shepp_logan import SheppLoganScan, shepp_logan_projections, shepp_logan_volume
from insideout.core.render import radiograph, section, splat
from insideout.core.run_folder import RunFolder
from insideout.core.sections import choose_planes, reference_section
from insideout.core.spherical_harmonics import C0
from insideout.core.stages.context import StageContext
from insideout.core.stages.initialize.xray import first_splats
from insideout.core.stages.surface import SurfaceSettings
from insideout.core.stages.surface import run as surface
from insideout.core.stages.surface.rivals import r2_gaussian, x_gaussian
from insideout.core.stages.surface.x_gaussian import XGaussianTrainer, intensity, projected, with_density
from insideout.core.stages.surface.xray import XraySettings, XrayTrainer
from insideout.core.train.losses import d_ssim, l1
from insideout.core.train.parameters import Parameters
from insideout.core.train.schedule import Decay, Stop
from insideout.core.train.smoothness import block_variation
from insideout.core.train.strategy import Densifier

UNIT = 0.02


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    """Steps this small are made many times faster by one thread than by several that wait for each other."""
    threads = numba.get_num_threads(), torch.get_num_threads()
    numba.set_num_threads(1)
    torch.set_num_threads(1)
    yield
    numba.set_num_threads(threads[0])
    torch.set_num_threads(threads[1])


@pytest.fixture(scope="module")
def head():
    return shepp_logan_projections(SheppLoganScan(angles=12, heldout=2, detector=32, voxels=32))


@pytest.fixture(scope="module")
def volume():
    return shepp_logan_volume(32)


def start_of(volume, settings, count=800):
    return first_splats(
        volume, settings.start, count, settings.acui_stride, 0, settings.acui_scale, settings.density_factor
    )


def trainer_of(head, volume, iterations=60, **changes):
    first, fit = r2_gaussian(iterations)
    fit = replace(fit, smooth_voxels=8, **changes)
    return XrayTrainer(start_of(volume, first), head, 8.0, UNIT, fit, 0, "cpu")


def test_published_schedules_are_the_defaults():
    (_, r2), (_, x) = r2_gaussian(), x_gaussian()
    assert (r2.iterations * r2.strategy.start, r2.iterations * r2.strategy.stop) == pytest.approx((500, 15_000))
    assert (x.iterations * x.strategy.start, x.iterations * x.strategy.stop) == pytest.approx((500, 8_000))
    assert (x.strategy.every, x.strategy.reset_every) == (200, 4000)
    (_, r2), (_, x) = r2_gaussian(1000), x_gaussian(1000)
    assert (r2.strategy.start, r2.strategy.stop, r2.strategy.every) == (0.1, 0.5, 100)
    assert (x.strategy.start, x.strategy.stop, x.strategy.every, x.strategy.reset_every) == (0.1, 0.4, 100, 200)


def test_published_numbers_are_r2_gaussian_s_and_x_gaussian_s():
    (start, r2), (first, x) = r2_gaussian(), x_gaussian()
    assert (start.start, start.xray_splats, start.fdk_window, start.density_factor) == ("fdk", 50_000, "ramp", 0.15)
    assert (first.start, first.acui_stride, first.acui_scale) == ("acui", 8, 1.0)
    assert (r2.iterations, x.iterations) == (30_000, 20_000)
    assert (r2.structure_weight, r2.squares_weight, x.structure_weight) == (0.25, None, 0.2)
    assert (r2.smooth_weight, r2.smooth_voxels, r2.smooth_every) == (0.05, 32, 1)
    assert (r2.least_scale, r2.most_scale, r2.least_pixels, r2.memory) == (0.0005, 0.5, 0.0, 0.999)
    rates = [(rate.start, rate.end) for rate in (r2.means_rate, r2.density_rate, r2.scale_rate, r2.rotation_rate)]
    assert rates == [(2e-4, 2e-5), (0.01, 0.001), (0.005, 0.0005), (0.001, 0.0001)]
    assert (x.means_rate.start, x.means_rate.end) == (1.9e-4, 1.9e-6)
    assert (x.scale_rate.start, x.rotation_rate.start, x.opacity_rate, x.intensity_rate) == (0.005, 0.001, 0.008, 0.002)
    split = {"split": "drawn", "split_factor": 1.6}
    known = {"gradient": 5e-5, "clone_size": 0.2, "prune_density": 1e-5, "prune_opacity": 0.0, "most": 500_000}
    assert {name: getattr(r2.strategy, name) for name in (*known, *split)} == {**known, **split}
    known = {"gradient": 2.6e-5, "clone_size": 0.01, "prune_opacity": 0.005, "prune_size": 0.1, "reset_opacity": 0.01}
    assert {name: getattr(x.strategy, name) for name in (*known, *split)} == {**known, **split}


def test_r2_s_smoothness_pulls_with_its_weight_in_its_own_units(head, volume):
    """Of a block of R²-Gaussian's attenuations, which are those in mm⁻¹ over `UNIT`."""

    def pull(weight):
        trainer = trainer_of(head, volume, smooth_weight=weight)
        trainer._smooth(trainer._fit, 0)
        return trainer, trainer.parameters.gradient("density").copy()

    trainer, doubled = pull(0.1)
    _, once = pull(0.05)
    np.testing.assert_allclose(doubled, 2 * once, rtol=1e-4, atol=1e-12)
    before = trainer.parameters.raw["density"].detach().clone()

    def rough(raw):
        trainer.parameters.raw["density"].data.copy_(raw)
        rng = np.random.default_rng([0, 3, 0])
        with torch.no_grad():
            found = block_variation(trainer.parameters.activate(), head.box_mm, 8.0, 8, 3.0, rng)
        return 0.05 * float(found) / UNIT

    index = int(np.abs(once).argmax())
    step = torch.zeros_like(before)
    step.view(-1)[index] = 0.01
    slope = (rough(before + step) - rough(before - step)) / 0.02
    assert once.ravel()[index] == pytest.approx(slope, rel=0.02)


def test_r2_starts_with_a_share_of_the_volume_s_density_and_fits_nothing(volume):
    first, _ = r2_gaussian()
    found = start_of(volume, first)
    assert found.density == pytest.approx(0.15 * volume.sample(found.means), rel=1e-5)
    assert len(found) == 800


def test_r2_s_loss_is_in_its_own_units(head, volume):
    """In a scene of side 2 with attenuations over `UNIT` the same lines of its paper give the same loss."""
    trainer = trainer_of(head, volume, smooth_weight=0.0)
    current = trainer.parameters.to_set().to_torch()
    index = trainer._choose(0)
    half_side = 128.0
    unit_detector = head.detectors[index]
    unit_detector = replace(
        unit_detector,
        **{name: np.asarray(getattr(unit_detector, name)) / half_side for name in ("source", "center", "u", "v")},
    )
    scene = replace(
        current, means=current.means / half_side, scales=current.scales / half_side, density=current.density / UNIT
    )
    image = radiograph(scene, unit_detector, mode="affine", cutoff_sigmas=3.0)
    target = torch.from_numpy(head.images[index] / np.float32(UNIT * half_side))
    expected = float(l1(image, target) + 0.25 * d_ssim(image, target))
    assert trainer.step(0) == pytest.approx(expected, rel=1e-3)
    # The default divides by the largest line integral and so has another loss.
    assert trainer_of(head, volume, smooth_weight=0.0, full_scale="peak").step(0) != pytest.approx(expected, rel=0.05)


def test_r2_halves_the_density_of_clones_and_of_both_children_of_a_split():
    _, fit = r2_gaussian()
    rule = replace(fit.strategy, start=0.0, every=1)
    start = GaussianSet.create(np.eye(3), np.array([[0.1] * 3, [0.5] * 3, [0.1] * 3]), density=[0.4, 0.8, 0.2])
    parameters = Parameters(start, ("means", "quats", "scales", "density"), density_unit=1.0)
    densifier = Densifier(rule, parameters, 1.0, 100, 0)
    densifier.observe(np.array([1.0, 1.0, 0.0], np.float32), np.ones(3, bool))
    assert densifier.after_step(10)
    after = parameters.to_set()
    # Scales up to a tenth of the box's side, 0.2 half sides, are cloned: the first, not the second.
    assert np.sort(after.density) == pytest.approx([0.2, 0.2, 0.2, 0.4, 0.4], rel=1e-5)
    assert np.sort(after.scales[:, 0]) == pytest.approx([0.1, 0.1, 0.1, 0.5 / 1.6, 0.5 / 1.6], rel=1e-5)


def test_r2_fits_held_out_projections(head, volume):
    # Six times its rates make up for two hundred times fewer iterations.
    rates = {"means_rate": Decay(1.2e-3), "density_rate": Decay(0.06, 0.006), "scale_rate": Decay(0.03, 0.003)}
    trainer = trainer_of(head, volume, 120, **rates)
    before = trainer.measure()["projections"]
    for iteration in range(120):
        assert np.isfinite(trainer.step(iteration))
    assert before < 23
    assert trainer.measure()["projections"] > 26


def x_trainer(head, volume, iterations, **changes):
    first, fit = x_gaussian(iterations)
    start = start_of(volume, replace(first, acui_stride=4))
    return XGaussianTrainer(start, head, replace(fit, **changes), 0, "cpu")


@pytest.fixture(scope="module")
def fitted(head, volume):
    """Four times its rates make up for a hundred times fewer iterations."""
    trainer = x_trainer(head, volume, 150, opacity_rate=0.032, intensity_rate=0.008, scale_rate=Decay(0.02))
    for iteration in range(150):
        assert np.isfinite(trainer.step(iteration))
    return trainer


def test_x_gaussian_fits_held_out_projections(head, volume, fitted):
    assert x_trainer(head, volume, 150).measure()["projections"] < 10
    assert fitted.measure()["projections"] > 24
    assert fitted.image(13).shape == (32, 32)


@pytest.mark.parametrize("away_mm", [1536.0, 9000.0])
def test_x_gaussian_s_extent_of_a_parallel_beam_is_that_of_the_scanned_box(head, volume, away_mm):
    """Where its detector stands means nothing, and its cameras have a place for drawing alone."""
    scan = CircularScan(32, 32, (10.0, 10.0), 1000.0, away_mm, parallel=True)
    beam = replace(head, detectors=scan.detectors(head.angles_rad))
    assert x_trainer(beam, volume, 10).extent == pytest.approx(np.linalg.norm(head.box_mm[1] - head.box_mm[0]))


def test_x_gaussian_s_intensity_is_one_number_from_all_sides(head, fitted):
    found = fitted.result()
    assert found.sh.shape[1:] == (1, 3)
    assert (found.sh == found.sh[:, :, :1]).all()
    assert np.ptp(intensity(found)) > 0.01
    one = GaussianSet.create(np.zeros((1, 3)), 30.0, opacities=1.0, sh=found.sh[7:8])
    shown = [splat(one.to_torch(), camera_of(detector)).color.max() for detector in head.detectors]
    assert np.array(shown) == pytest.approx(0.99 * intensity(one)[0], rel=0.02)


def test_splats_of_x_gaussian_hide_one_another_where_attenuation_would_add_up(head):
    """Two of the same on a ray: blended they are 1 − (1 − o)² of their intensity, not twice o."""
    detector = head.detectors[0]
    ray = np.asarray(detector.center) - np.asarray(detector.source)
    behind = 0.2 * ray / np.linalg.norm(ray) * 10.0
    sh = np.full((1, 1, 3), (0.8 - 0.5) / C0, np.float32)
    one = GaussianSet.create(np.zeros((1, 3)), 30.0, opacities=0.6, sh=sh)
    two = GaussianSet.create(np.stack([np.zeros(3), behind]), 30.0, opacities=0.6, sh=np.repeat(sh, 2, axis=0))
    single, both = (projected(found, camera_of(detector), peak=1.0).max() for found in (one, two))
    assert single == pytest.approx(0.6 * 0.8, rel=0.02)
    assert both == pytest.approx((1 - 0.4**2) * 0.8, rel=0.02)


def test_x_gaussian_scales_all_projections_by_one_number(head, volume):
    faint = replace(head, images=head.images * np.linspace(0.2, 1.0, len(head.images), dtype=np.float32)[:, None, None])
    trainer = x_trainer(faint, volume, 10)
    assert trainer._peak == faint.images[~faint.held_out].max()
    twice = replace(faint, images=2 * faint.images)
    assert x_trainer(twice, volume, 10).step(0) == pytest.approx(trainer.step(0), rel=1e-6)


def test_x_gaussian_s_density_fits_the_training_sections_and_no_others(volume, fitted):
    views = choose_planes(volume.box_mm, 32.0, pixel_mm=16.0)
    training = [view for view in views if not view.held_out]
    references = [reference_section(volume, view) for view in training]
    found = with_density(fitted.result(), training, references)

    def misfit(factor):
        scaled = replace(found, density=found.density * np.float32(factor)).to_torch()
        cuts = [section(scaled, view.plane).numpy() for view in training]
        return sum(((cut - wanted) ** 2).sum() for cut, wanted in zip(cuts, references, strict=True))

    assert misfit(1.0) < min(misfit(0.95), misfit(1.05))
    added = found.opacities * intensity(found)
    readings = added / np.exp(np.log(found.scales).mean(axis=1)), added
    assert any(
        found.density == pytest.approx(share * found.density.sum() / share.sum(), rel=1e-3) for share in readings
    )
    with pytest.raises(ValueError, match="held-out"):
        with_density(found, views, [reference_section(volume, view) for view in views])


@pytest.mark.parametrize("along", [True, False], ids=["a line integral", "a density"])
def test_what_an_x_gaussian_splat_adds_is_read_in_the_way_that_fits(along):
    """Blobs of many sizes: as line integrals, what each adds is its density times its thickness."""
    random = np.random.default_rng(0)
    means, scales = random.uniform(-25, 25, (40, 3)), np.repeat(random.uniform(1, 6, (40, 1)), 3, axis=1)
    density = random.uniform(0.01, 0.04, 40)
    added = density * (np.sqrt(2 * np.pi) * scales[:, 0] if along else 1.0)
    opacities = 0.9 * added / added.max()
    # Intensity 1.
    shown = GaussianSet.create(means, scales, opacities=opacities, sh=np.full((40, 1, 3), 0.5 / C0))
    true = replace(shown, density=density.astype(np.float32)).to_torch()
    box = np.array([[-32.0] * 3, [32.0] * 3])
    training = [view for view in choose_planes(box, 8.0, pixel_mm=2.0) if not view.held_out]
    found = with_density(shown, training, [section(true, view.plane).numpy() for view in training])
    assert found.density == pytest.approx(density, rel=1e-3)


def test_x_gaussian_goes_on_bit_for_bit(head, volume):
    whole, broken, later = (x_trainer(head, volume, 40) for _ in range(3))
    for iteration in range(40):
        whole.step(iteration)
    for iteration in range(17):
        broken.step(iteration)
    later.restore(broken.state())
    for iteration in range(17, 40):
        later.step(iteration)
    assert np.array_equal(whole.result().means, later.result().means)
    assert np.array_equal(whole.result().opacities, later.result().opacities)


def test_the_stage_runs_the_model_that_is_asked_for(head, volume, tmp_path):
    context = StageContext(Capture(tmp_path / "head", projections=head), RunFolder(tmp_path / "run"))
    first, fit = x_gaussian(20)
    context.run.write_set("initialize", "xray", start_of(volume, first))
    volume.save(context.run.stage("initialize") / "volume.npz")
    report = surface(context, SurfaceSettings(xray=replace(fit, stop=Stop(views=2, every=0.2))))
    assert report["xray"]["projections"] == {"training": 10, "validation": 2, "held_out": 2}
    found = context.run.read_set("surface", "xray")
    assert (found.modality == int(Modality.XRAY)).all()
    # The brain is 0.02; at the start every third cell is air.
    assert 0.0003 < found.density.mean() < 0.02
    assert len(report["xray"]["validation"]) > 0


def test_unknown_models_are_named():
    with pytest.raises(SettingError, match="additive or x_gaussian"):
        XraySettings(model="nerf")
    with pytest.raises(SettingError, match="peak, body or box"):
        XraySettings(full_scale="view")
    for wrong in ({"straight_from": 0.01}, {"straight_from": 0.0, "squares_weight": 30.0}):
        with pytest.raises(SettingError, match="straight_from"):
            XraySettings(**wrong)
