"""The stage `internal`: sections sharpen the inside, contours settle the outside, nothing else gets worse."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from insideout.core.densities import Densities
from insideout.core.errors import Cancelled
from insideout.core.files import write_json
from insideout.core.render import section
from insideout.core.run_folder import RunFolder
from insideout.core.stages.context import StageContext
from insideout.core.stages.density_fit import fit_to_projections
from insideout.core.stages.internal import PRESETS, InternalSettings, reason_to_skip, run
from insideout.core.stages.internal.rgb import ContourLoss
from insideout.core.stages.internal.targets import SectionSeries, soft_material
from insideout.core.stages.internal.xray import DensityLoss, DisplayLoss, start_display
from insideout.core.stages.photo_series import PhotoSeries
from insideout.core.train.schedule import shuffled

QUICK = InternalSettings(
    xray_iterations=50,
    display_iterations=40,
    rgb_iterations=20,
    planes=("axial",),
    shape_rate=0.02,
    projection_weight=1.0,
    photo_size=48,
)


@pytest.fixture(scope="module")
def finished(shells_capture, tmp_path_factory):
    capture, path = shells_capture
    folder = tmp_path_factory.mktemp("internal") / "run"
    shutil.copytree(path, folder)
    context = StageContext(capture, RunFolder(folder), seed=0)
    return context, run(context, QUICK)


class TestXray:
    def test_held_out_sections_rise_and_projections_stay(self, finished):
        _, report = finished
        before, after = report["xray"]["before"], report["xray"]["after"]
        assert after["sections_psnr"] > before["sections_psnr"] + 1.0
        assert after["projections_psnr"] > before["projections_psnr"] - 0.5
        assert report["xray"]["taken_back"] is None

    def test_the_number_of_splats_stays(self, finished):
        context, report = finished
        assert report["splats"]["xray"] == len(context.run.read_set("surface", "xray"))

    def test_display_opacity_shows_material_and_leaves_air_clear(self, finished):
        context, _ = finished
        series = SectionSeries(context.run.volume(), ("axial",))
        xray = context.run.read_set("internal", "xray").to_torch()
        for view in series.held_out[1:-1]:
            shown = section(xray, view.plane, "occupancy").numpy()
            material = series.density(view).numpy()
            assert shown[material > 1.5 * series.threshold].mean() > 0.7
            assert shown[material < 0.05 * series.threshold].mean() < 0.3

    def test_opacities_decide(self, finished):
        context, _ = finished
        start = start_display(context.run.read_set("internal", "xray"), SectionSeries(context.run.volume(), ("axial",)))

        def undecided(opacities):
            return np.minimum(opacities, 1 - opacities).mean()

        assert undecided(context.run.read_set("internal", "xray").opacities) < undecided(start.opacities)

    def test_the_zero_one_term_never_touches_density(self, shells_context):
        series = SectionSeries(shells_context.run.volume(), ("axial",))
        gaussians = start_display(shells_context.run.read_set("surface", "xray"), series).to_torch()
        for field in ("means", "quats", "scales", "opacities", "density"):
            getattr(gaussians, field).requires_grad_(True)
        DisplayLoss(series, 0.2, 0.005, "cpu")(gaussians, 0).backward()
        assert gaussians.opacities.grad.abs().sum() > 0
        for field in ("means", "quats", "scales", "density"):
            assert getattr(gaussians, field).grad is None

    def test_the_density_loss_never_touches_opacity(self, shells_context):
        series = SectionSeries(shells_context.run.volume(), ("axial",))
        gaussians = shells_context.run.read_set("surface", "xray").to_torch()
        for field in ("opacities", "density"):
            getattr(gaussians, field).requires_grad_(True)
        DensityLoss(series, shells_context.capture.projections, 1.0, 0.2, "cpu", 0)(gaussians, 0).backward()
        assert gaussians.density.grad.abs().sum() > 0
        assert gaussians.opacities.grad is None or not gaussians.opacities.grad.any()

    def test_both_terms_weigh_the_same_at_the_start(self, shells_context):
        series = SectionSeries(shells_context.run.volume(), ("axial",))
        start = shells_context.run.read_set("surface", "xray")
        projections = shells_context.capture.projections
        for scale in (1.0, 40.0):
            scaled = replace(projections, images=projections.images * scale)
            loss = DensityLoss(series, scaled, 1.0, 0.2, "cpu", 0)
            without = DensityLoss(series, None, 1.0, 0.2, "cpu", 0)
            loss.balance(start)
            tensors = start.to_torch()
            total = sum(float(loss(tensors, i)) for i in range(6))
            sections = sum(float(without(tensors, i)) for i in range(6))
            assert total == pytest.approx(2 * sections, rel=1e-4)

    def test_a_projection_with_holes_does_not_put_out_the_others(self, shells_context):
        series = SectionSeries(shells_context.run.volume(), ("axial",))
        start, projections = shells_context.run.read_set("surface", "xray"), shells_context.capture.projections
        images = projections.images.copy()
        # The first that the balance looks at.
        images[shuffled(np.flatnonzero(~projections.held_out).tolist(), 0, 0), 3, 3] = np.nan
        whole, holed = (
            DensityLoss(series, replace(projections, images=shown), 1.0, 0.2, "cpu", 0)
            for shown in (projections.images, images)
        )
        assert holed.balance(start) == pytest.approx(whole.balance(start), rel=0.5)
        assert float(holed(start.to_torch(), 1)) > 1.5 * float(
            DensityLoss(series, None, 1.0, 0.2, "cpu", 0)(start.to_torch(), 1)
        )

    def test_sections_that_ruin_projections_are_taken_back(self, shells_context):
        volume = shells_context.run.volume()
        wrong = replace(volume, values=5 * volume.values)
        wrong.save(shells_context.run.path / "initialize" / "volume.npz")
        settings = replace(QUICK, projection_weight=0.0, density_rate=0.2, xray_iterations=25, display_iterations=1)
        settings = replace(settings, rgb_iterations=0)
        start = shells_context.run.read_set("surface", "xray")
        report = run(shells_context, settings)
        assert report["xray"]["taken_back"]
        assert np.array_equal(shells_context.run.read_set("internal", "xray").density, start.density)
        report = run(shells_context, replace(settings, projection_loss_db=None))
        assert report["xray"]["taken_back"] is None
        assert not np.array_equal(shells_context.run.read_set("internal", "xray").density, start.density)

    @pytest.fixture
    def follow(self, finished, shells_context):
        """`follow(volume, own, model)`: by how much radiograph and model differ, before and after sections of a volume
        were followed whatever it costs; and the stage's report."""
        fitted, capture = finished[0].run.read_set("internal", "xray"), shells_context.capture
        shells_context.run.write_set("surface", "xray", fitted)
        steps = {"xray_iterations": 60, "display_iterations": 1, "rgb_iterations": 0}
        settings = replace(PRESETS["standard"], density_rate=0.005, projection_loss_db=None, **steps)

        def follow(volume, own, model):
            volume.save(shells_context.run.path / "initialize" / "volume.npz", own)
            given = replace(capture, volume=volume, volume_densities=own, densities=model)
            report = run(replace(shells_context, capture=given), replace(settings, density_rate=0.01))["xray"]
            ends = fitted, shells_context.run.read_set("internal", "xray")
            return [fit_to_projections(end, capture.projections)[1] for end in ends], report

        return follow

    def test_water_of_another_attenuation_in_the_volume_pulls_at_nothing(self, shells_context, follow):
        own, model, volume = Densities(water_per_mm=0.02), Densities(water_per_mm=0.0256), shells_context.run.volume()
        (before, after), _ = follow(replace(volume, values=volume.values / np.float32(1.28)), own, model)
        assert after == pytest.approx(before, rel=0.03)

    def test_grey_values_that_fit_no_projections_leave_the_model_its_unit(self, shells_context, follow):
        volume = shells_context.run.volume()
        turned = replace(volume, values=np.float32(0.3) * np.rot90(volume.values, 1, (0, 2)))
        (before, after), report = follow(turned, Densities(relative=True), Densities())
        assert report["iterations"] == 0
        assert after == pytest.approx(before, rel=1e-6)
        assert report["projection_factor"] is None, "nothing was weighed against sections"
        for figures in (report["before"], report["after"]):
            assert figures["sections_psnr"] is figures["sections_ssim"] is None, "they would be those of two scales"
            assert figures["projections_psnr"] > 20

    def test_grey_values_that_fit_have_figures_of_sections(self, shells_context, follow):
        _, report = follow(shells_context.run.volume(), Densities(relative=True), Densities(relative=True))
        assert report["projection_factor"] > 0
        assert report["before"]["sections_psnr"] > 10

    def test_held_out_projections_decide_nothing(self, shells_context):
        settings = replace(QUICK, xray_iterations=10, display_iterations=2, rgb_iterations=0)
        honest = run(shells_context, settings)
        kept = shells_context.run.read_set("internal", "xray")
        projections = shells_context.capture.projections
        images = projections.images.copy()
        images[projections.held_out] = np.random.default_rng(0).uniform(0, 9, images[projections.held_out].shape)
        spoiled = replace(shells_context.capture, projections=replace(projections, images=images))
        report = run(replace(shells_context, capture=spoiled), settings)
        assert report["xray"]["after"]["projections_psnr"] < honest["xray"]["after"]["projections_psnr"] - 10
        assert report["xray"]["taken_back"] is None
        assert np.array_equal(shells_context.run.read_set("internal", "xray").density, kept.density)

    def test_a_volume_without_projections_will_do(self, shells_context):
        context = replace(shells_context, capture=replace(shells_context.capture, projections=None))
        report = run(context, replace(QUICK, xray_iterations=40, display_iterations=2, rgb_iterations=0))
        assert report["xray"]["after"]["projections_psnr"] is None
        assert report["xray"]["after"]["sections_ssim"] > report["xray"]["before"]["sections_ssim"]


class TestRgb:
    def test_colours_come_back_bit_for_bit(self, finished):
        context, report = finished
        before, after = context.run.read_set("align", "rgb"), context.run.read_set("internal", "rgb")
        assert report["rgb"]["taken_back"] is None
        assert np.array_equal(before.sh, after.sh)
        assert np.array_equal(before.density, after.density)
        assert not np.array_equal(before.means, after.means)

    def test_photos_stay_and_splats_come_no_further_from_the_surface(self, finished):
        _, report = finished
        before, after = report["rgb"]["before"], report["rgb"]["after"]
        assert after["photos_psnr"] > before["photos_psnr"] - 0.25
        assert after["surface_chamfer_mm"] < before["surface_chamfer_mm"]

    def test_splats_come_closer_to_the_outer_contour(self, finished):
        context, _ = finished
        series = SectionSeries(context.run.volume(), ("axial", "coronal"))

        def error(gaussians):
            cuts = [(section(gaussians.to_torch(), v.plane, "occupancy"), series.edge(v)) for v in series.held_out]
            return float(np.mean([(((cut - t.band) * t.weight) ** 2).mean() for cut, t in cuts]))

        assert error(context.run.read_set("internal", "rgb")) < error(context.run.read_set("align", "rgb"))

    def test_photos_that_got_worse_are_taken_back(self, shells_context):
        settings = replace(
            QUICK,
            section_weight=1e4,
            rgb_rate=0.3,
            rgb_iterations=15,
            xray_iterations=0,
            display_iterations=0,
        )
        report = run(shells_context, settings)
        assert report["rgb"]["taken_back"]
        before = shells_context.run.read_set("align", "rgb")
        assert np.array_equal(shells_context.run.read_set("internal", "rgb").means, before.means)

    def test_contours_pull_at_nothing_where_no_splat_is_to_be_seen(self, shells_context):
        series, photos = SectionSeries(shells_context.run.volume(), ("axial",)), PhotoSeries(shells_context, 48)
        rgb = shells_context.run.read_set("align", "rgb")
        view = series.held_out[len(series.held_out) // 2]
        band = series.edge(view).band

        def weight(gaussians):
            loss = ContourLoss(gaussians, 1.0, series, photos, 1.0, 0.2, 0.0, "cpu")
            return loss._photographed(view, band)[band > 0]

        assert weight(rgb).any()
        assert not weight(replace(rgb, opacities=np.full_like(rgb.opacities, 0.05))).any()


class TestTargets:
    def test_a_bore_that_photos_look_into_is_left_undecided(self):
        from insideout.core.volume import Volume

        values = np.zeros((24, 32, 32), np.float32)
        values[4:20, 4:28, 4:28] = 1.0
        values[8:24, 12:20, 12:20] = 0.0
        series = SectionSeries(Volume.centered(values, np.ones(3)), ("axial",), step_mm=1.0)
        view = min(series.held_out, key=lambda v: abs(v.position_mm - 1.0))
        target = series.edge(view)
        assert target.weight[16, 11] == 0
        assert target.weight[16, 8] == 1
        assert target.band[16, 4] == 1
        assert target.band[16, 11] == 0

    def test_a_closed_cavity_is_to_be_empty(self, shells_context):
        series = SectionSeries(shells_context.run.volume(), ("axial",))
        view = min(series.held_out, key=lambda v: abs(v.position_mm))
        target = series.edge(view)
        rows, columns = target.band.shape
        middle = (slice(rows // 2 - 5, rows // 2 + 5), slice(columns // 2 - 5, columns // 2 + 5))
        assert not target.band[middle].any()
        assert bool((target.weight[middle] == 1).all())

    def test_the_skin_is_the_outermost_material(self, shells_context):
        series = SectionSeries(shells_context.run.volume(), ("axial",))
        view = min(series.held_out, key=lambda v: abs(v.position_mm))
        rows, columns = np.nonzero(series.skin(view).numpy())
        plane = view.plane
        radius = np.linalg.norm(plane.origin + columns[:, None] * plane.u + rows[:, None] * plane.v, axis=1)
        assert len(radius)
        assert radius.min() > 18.0 - 5
        assert radius.max() < 18.0 + 3
        material = series.material(view).numpy() > 0.5
        rows, columns = np.nonzero(material & ~series.skin(view).numpy())
        inside = np.linalg.norm(plane.origin + columns[:, None] * plane.u + rows[:, None] * plane.v, axis=1)
        assert inside.max() < 18.0 - 1.5
        assert (inside < 9).any()

    def test_training_sections_are_new_each_round_and_never_held_out(self, shells_context):
        series = SectionSeries(shells_context.run.volume(), ("axial", "coronal"), seed=4)
        n = series.training_count
        first = [series.view(i).position_mm for i in range(n)]
        assert not set(first) & {series.view(n + i).position_mm for i in range(n)}
        assert not any(series.view(i).held_out for i in range(2 * n))
        assert first == [
            SectionSeries(series.volume, ("axial", "coronal"), seed=4).view(i).position_mm for i in range(n)
        ]

    def test_the_outside_surface_leaves_closed_cavities_out(self, shells_context):
        surface = SectionSeries(shells_context.run.volume(), ("axial",)).outside_surface()
        assert np.abs(np.linalg.norm(surface, axis=1) - 18.0).max() < 1.5

    def test_every_item_comes_once_a_round(self):
        for lap in range(3):
            assert sorted(shuffled(range(7), 7 * lap + i, 1) for i in range(7)) == list(range(7))

    def test_no_threshold_means_no_material(self):
        assert not soft_material(np.ones((3, 3)), np.inf).any()


class TestStage:
    def test_it_says_why_it_has_nothing_to_do(self, shells_context):
        assert reason_to_skip(shells_context) is None
        (shells_context.run.path / "initialize" / "volume.npz").unlink()
        assert "volume" in reason_to_skip(shells_context)
        (shells_context.run.path / "surface" / "xray.ply").unlink()
        assert "X-ray" in reason_to_skip(shells_context)

    def test_a_surface_that_kept_no_splat_leaves_nothing_to_do(self, shells_context):
        empty = shells_context.run.read_set("surface", "xray").select(slice(0, 0))
        shells_context.run.write_set("surface", "xray", empty)
        assert "no radiative splats" in reason_to_skip(shells_context)

    def test_xray_alone_is_refined_without_photos(self, shells_context):
        write_json(shells_context.run.path / "align" / "report.json", {"skipped": "there are no photos"})
        report = run(shells_context, replace(QUICK, xray_iterations=2, display_iterations=2))
        assert "skipped" in report["rgb"]
        assert not shells_context.run.has_set("internal", "rgb")

    def test_a_cancelled_stage_goes_on_where_it_stopped(self, shells_context, shells_capture, tmp_path, stopping_in):
        short = replace(QUICK, xray_iterations=12, display_iterations=4, rgb_iterations=6)
        stopping = replace(shells_context, reporter=stopping_in("xray"))
        with pytest.raises(Cancelled):
            run(stopping, short)
        assert shells_context.checkpoint("internal", "xray").exists()
        run(shells_context, short)
        shutil.copytree(shells_capture[1], tmp_path / "whole")
        whole = replace(shells_context, run=RunFolder(tmp_path / "whole"))
        run(whole, short)
        for name in ("rgb", "xray"):
            once, again = whole.run.read_set("internal", name), shells_context.run.read_set("internal", name)
            for field in ("means", "scales", "opacities", "density"):
                np.testing.assert_array_equal(getattr(once, field), getattr(again, field))

    def test_presets_grow(self):
        steps = [PRESETS[name].xray_iterations for name in ("draft", "standard", "paper")]
        assert steps == sorted(steps)
        joint = [PRESETS[name].joint.iterations for name in ("draft", "standard", "paper")]
        assert joint == sorted(set(joint))

    def test_losses_weigh_as_in_the_paper(self):
        for preset in PRESETS.values():
            assert (preset.structure_weight, preset.zero_one_weight) == (0.2, 0.005)


def test_nothing_trains_when_there_are_no_splats(shells_context):
    from insideout.core.gaussians import GaussianSet

    series = SectionSeries(shells_context.run.volume(), ("axial",))
    empty = GaussianSet.empty()
    assert len(start_display(empty, series)) == 0
    loss = DensityLoss(series, None, 0.0, 0.2, "cpu", 0)(empty.to_torch(), 0)
    assert bool(torch.isfinite(loss))
