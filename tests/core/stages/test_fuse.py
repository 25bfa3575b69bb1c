"""The stage `fuse`: colours where photos know them, details on top, X-rays as they were."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from insideout.core.colormap import density_colors
from insideout.core.errors import Cancelled
from insideout.core.files import write_json
from insideout.core.gaussians import GaussianSet, Modality
from insideout.core.render import radiograph, section
from insideout.core.spherical_harmonics import rgb_to_sh, sh_to_rgb
from insideout.core.stages.fuse import (
    FuseSettings,
    clone_details,
    color_by_density,
    density_at_centers,
    detail_threshold,
    fuse_sets,
    limit_display,
    pixels_seen,
    reason_to_skip,
    run,
)
from insideout.core.stages.photo_series import PhotoSeries

QUICK = FuseSettings(iterations=30, photo_size=48, opacity_rate=0.3)


def wall(count=20, spacing=1.0):
    """Photo splats on the plane z = 0 in three colours and growing sizes."""
    x, y = np.meshgrid(np.arange(count) * spacing, np.arange(count) * spacing)
    points = np.stack([x.ravel(), y.ravel(), np.zeros(count * count)], -1)
    colors = np.stack([x.ravel() / count, y.ravel() / count, np.full(count * count, 0.3)], -1)
    sh = np.zeros((len(points), 4, 3), np.float32)
    sh[:, 0] = rgb_to_sh(colors)
    sh[:, 1:] = np.random.default_rng(0).normal(size=(len(points), 3, 3))
    scales = np.tile(np.linspace(0.1, 1.0, len(points))[:, None], (1, 3))
    return GaussianSet.create(points, scales, opacities=0.9, sh=sh)


def column(depths):
    points = np.stack([np.full(len(depths), 5.2), np.full(len(depths), 7.1), depths], -1)
    density = np.linspace(0.01, 0.06, len(depths))
    return GaussianSet.create(points, 0.5, density=density, opacities=0.8, modality=Modality.XRAY)


class TestTransfer:
    def test_near_splats_take_all_bands_of_the_nearest_photo_splat(self):
        rgb, xray = wall(), column(np.array([0.1, 0.6, 30.0]))
        fusion = fuse_sets(rgb, xray)
        nearest = int(np.argmin(np.linalg.norm(rgb.means - xray.means[0], axis=1)))
        assert np.array_equal(fusion.fused.sh[0], rgb.sh[nearest])
        assert np.array_equal(fusion.fused.sh[1], rgb.sh[nearest])

    def test_depth_is_two_median_spacings_and_deeper_ones_show_their_density(self):
        # The column's splats are 0.5 apart, the wall's 1.0: the coarser counts.
        xray = column(np.arange(0.1, 8.0, 0.5))
        fusion = fuse_sets(wall(), xray)
        distance = np.linalg.norm(xray.means - [5.0, 7.0, 0.0], axis=1)
        assert fusion.depth_mm == pytest.approx(2.0)
        assert np.array_equal(fusion.near_surface, distance <= 2.0)
        deep = ~fusion.near_surface
        shown = fusion.fused.select(np.arange(len(xray))).sh
        assert np.array_equal(shown[deep, 0], color_by_density(xray).sh[deep, 0])
        assert not shown[deep, 1:].any()

    def test_depth_in_spacings_is_a_setting(self):
        xray = column(np.arange(0.1, 8.0, 0.5))
        assert (
            fuse_sets(wall(), xray, depth_spacings=5.0).near_surface.sum() > fuse_sets(wall(), xray).near_surface.sum()
        )

    def test_paint_all_leaves_no_density_colour(self):
        assert fuse_sets(wall(), column(np.arange(0.1, 30.0, 3.0)), paint_all=True).near_surface.all()

    def test_splats_that_photos_hardly_show_give_no_colour(self):
        rgb = wall()
        rgb.opacities[:] = 0.9
        xray = column(np.array([0.0, 0.5]))
        nearest = int(np.argmin(np.linalg.norm(rgb.means - xray.means[0], axis=1)))
        rgb.opacities[nearest] = 0.01
        assert not np.array_equal(fuse_sets(rgb, xray).fused.sh[0], rgb.sh[nearest])


class TestColorByDensity:
    def test_the_same_material_has_one_colour_however_many_splats_share_it(self):
        # Left: one splat of full density at each point. Right: three that lie upon each other, a sixth, a third, half.
        grid = np.stack(np.meshgrid(*[np.arange(6.0)] * 3, indexing="ij"), -1).reshape(-1, 3)
        left, right = (grid + np.array([shift, 0, 0]) for shift in (0.0, 20.0))
        points = np.concatenate([left, right, right, right])
        shares = np.repeat([1.0, 1 / 6, 1 / 3, 1 / 2], len(grid))
        solid = GaussianSet.create(points, 0.6, density=0.02 * shares, modality=Modality.XRAY)
        inner = np.all((grid > 1) & (grid < 4), axis=1)
        colors = sh_to_rgb(color_by_density(solid).sh[:, 0])[np.tile(inner, 4)]
        assert np.ptp(colors, axis=0).max() < 0.05

    def test_density_at_a_centre_is_that_of_the_section_through_it(self):
        random = np.random.default_rng(3)
        xray = GaussianSet.create(
            random.uniform(-10, 10, (300, 3)),
            random.uniform(1.5, 2.0, (300, 3)),
            density=random.uniform(0.001, 0.02, 300),
            modality=Modality.XRAY,
        )
        offsets = (xray.means[:, None] - xray.means[None]) / xray.scales[None]
        exact = (xray.density * np.exp(-0.5 * np.square(offsets).sum(-1))).sum(1)
        # Between the corners of a voxel half a scale wide, a Gaussian loses at most 1 - exp(-3/32).
        assert density_at_centers(xray) == pytest.approx(exact, rel=0.09)

    def test_floaters_far_away_do_not_coarsen_the_grid_and_keep_their_own_density(self):
        xray = column(np.arange(0.0, 8.0, 0.5))
        many = GaussianSet.concatenate([xray] * 20)
        far = GaussianSet.create([[1e6, 0, 0]], 0.5, density=0.03, modality=Modality.XRAY)
        together = density_at_centers(GaussianSet.concatenate([many, far]))
        assert together[:-1] == pytest.approx(density_at_centers(many), rel=0.05)
        assert together[-1] == pytest.approx(0.03)

    def test_an_empty_set_has_no_colours(self):
        assert len(color_by_density(GaussianSet.empty())) == 0


class TestClones:
    @pytest.mark.parametrize("percentile", [50.0, 95.0, 100.0])
    def test_the_share_below_the_percentile_is_cloned(self, percentile):
        rgb = wall()
        clones = clone_details(rgb, detail_threshold(rgb, percentile))
        assert len(clones) == pytest.approx(percentile / 100 * len(rgb), abs=1)

    def test_the_threshold_is_on_the_largest_eigenvalue_of_the_covariance(self):
        random = np.random.default_rng(0)
        rgb = GaussianSet.create(
            random.normal(size=(200, 3)), random.uniform(0.1, 2, (200, 3)), quats=random.normal(size=(200, 4))
        )
        largest = np.linalg.eigvalsh(rgb.covariances().astype(np.float64)).max(axis=1)
        threshold = detail_threshold(rgb, 95.0)
        assert threshold == pytest.approx(np.quantile(largest, 0.95), rel=1e-5)
        assert np.sqrt(np.square(clone_details(rgb, threshold).scales).max()) <= np.sqrt(threshold)

    def test_clones_have_no_density_and_are_tagged(self):
        rgb = replace(wall(), density=np.full(400, 0.02, np.float32))
        fused = fuse_sets(rgb, column(np.array([0.1, 4.0]))).fused
        clones = fused.modality == Modality.CLONE
        assert clones.sum() == 380
        assert not fused.density[clones].any()
        assert (fused.modality[~clones] == Modality.XRAY).all()
        assert np.array_equal(np.flatnonzero(~clones), [0, 1])


class TestLimit:
    def test_no_splat_shows_more_than_the_limit_at_the_surface(self):
        rgb, xray = wall(), column(np.arange(0.1, 4.0, 0.3))
        limited = limit_display(xray, rgb.means, 0.03)
        offsets = (rgb.means[None] - xray.means[:, None]) / xray.scales[:, None]
        shown = limited.opacities[:, None] * np.exp(-0.5 * np.square(offsets).sum(-1))
        assert shown.max() <= 0.03 + 1e-6
        assert limited.opacities[-1] == xray.opacities[-1]
        assert limited.opacities[0] < 0.1

    def test_turned_splats_are_measured_along_their_own_axes(self):
        # Long along x, turned to lie along z: it reaches the wall; the same without the turn does not.
        half = np.sqrt(0.5)
        for quat, reaches in (([half, 0, half, 0], True), ([1, 0, 0, 0], False)):
            splat = GaussianSet.create([[5, 5, 3.0]], [[3.0, 0.3, 0.3]], quats=np.array([quat]), opacities=0.9)
            assert (limit_display(splat, wall().means, 0.03).opacities[0] < 0.1) == reaches

    def test_without_a_surface_nothing_is_limited(self):
        xray = column(np.array([1.0]))
        assert limit_display(xray, np.zeros((0, 3)), 0.03) is xray


@pytest.fixture(scope="module")
def finished(shells_capture, tmp_path_factory):
    import shutil

    from insideout.core.run_folder import RunFolder
    from insideout.core.stages.context import StageContext
    from insideout.core.stages.internal.targets import SectionSeries
    from insideout.core.stages.internal.xray import start_display

    capture, path = shells_capture
    folder = tmp_path_factory.mktemp("fuse") / "run"
    shutil.copytree(path, folder)
    context = StageContext(capture, RunFolder(folder), seed=0)
    series = SectionSeries(context.run.volume(), ("axial",))
    context.run.write_set("internal", "xray", start_display(context.run.read_set("surface", "xray"), series))
    context.run.write_set("internal", "rgb", context.run.read_set("align", "rgb"))
    write_json(context.run.path / "internal" / "report.json", {})
    return context, run(context, QUICK)


class TestStage:
    def test_radiographs_and_density_sections_are_those_of_the_radiative_splats(self, finished):
        context, _ = finished
        fused = context.run.read_set("fuse", "fused").to_torch()
        xray = context.run.read_set("internal", "xray").to_torch()
        for detector in context.capture.projections.detectors[:3]:
            assert torch.allclose(radiograph(fused, detector), radiograph(xray, detector), atol=1e-5)
        from insideout.core.sections import choose_planes

        plane = choose_planes(context.run.volume().box_mm, pixel_mm=1.0)[12].plane
        assert torch.allclose(section(fused, plane), section(xray, plane), atol=1e-6)

    def test_the_finish_brings_the_photos_back(self, finished):
        _, report = finished
        figures = report["photos_psnr"]
        assert figures["finished"] > figures["transferred"] + 5
        assert figures["finished"] > figures["rgb"] - 4.0

    def test_the_finish_changes_no_shape_no_density_and_no_colour_inside(self, finished):
        context, report = finished
        start = fuse_sets(context.run.read_set("internal", "rgb"), context.run.read_set("internal", "xray"))
        fused = context.run.read_set("fuse", "fused")
        for field in ("means", "quats", "modality", "density"):
            assert np.allclose(getattr(fused, field), getattr(start.fused, field), atol=1e-6)
        assert np.allclose(fused.scales, start.fused.scales, rtol=1e-6)
        inside = np.linalg.norm(fused.means, axis=1) < 9.0
        assert inside.sum() > 50
        assert np.array_equal(fused.sh[inside], start.fused.sh[inside])
        recolored = (fused.sh != start.fused.sh).any(axis=(1, 2)) & (fused.modality == Modality.XRAY)
        assert recolored.sum() <= report["finish"]["colored"]

    def test_what_no_photo_sees_keeps_its_display_opacity(self, finished):
        context, _ = finished
        before, after = context.run.read_set("internal", "xray"), context.run.read_set("fuse", "fused")
        inside = np.linalg.norm(before.means, axis=1) < 9.0
        assert np.abs(before.opacities - after.opacities[: len(before)])[inside].mean() < 0.05

    def test_clones_keep_their_opacity(self, finished):
        context, _ = finished
        rgb, fused = context.run.read_set("internal", "rgb"), context.run.read_set("fuse", "fused")
        clones = fused.opacities[fused.modality == Modality.CLONE]
        assert clones == pytest.approx(rgb.opacities[: len(clones)], abs=1e-5)

    def test_photos_see_the_outside_and_not_the_inside(self, finished):
        context, _ = finished
        fused = context.run.read_set("fuse", "fused")
        pixels = pixels_seen(fused, PhotoSeries(context, 48), "cpu", lambda: None)
        radius = np.linalg.norm(fused.means, axis=1)
        outside = pixels[fused.modality == Modality.CLONE].sum()
        assert outside > 20 * pixels[radius < 9.0].sum()
        # All splats together account for the object's pixels: between its disc and the whole image, 8 photos.
        assert 8 * 500 < pixels.sum() < 8 * 48 * 48

    def test_counts_add_up(self, finished):
        context, report = finished
        splats = report["splats"]
        assert splats["fused"] == splats["xray"] + splats["clone"] == len(context.run.read_set("fuse", "fused"))
        assert report["clones"]["count"] + report["clones"]["left_out"] == len(context.run.read_set("internal", "rgb"))

    def test_same_seed_same_result(self, finished, shells_context, stopping_in):
        context, _ = finished
        for name in ("rgb", "xray"):
            shells_context.run.write_set("internal", name, context.run.read_set("internal", name))
        write_json(shells_context.run.path / "internal" / "report.json", {})
        stopping = replace(shells_context, reporter=stopping_in("finish"))
        with pytest.raises(Cancelled):
            run(stopping, QUICK)
        assert shells_context.checkpoint("fuse", "finish").exists()
        run(shells_context, QUICK)
        once, again = context.run.read_set("fuse", "fused"), shells_context.run.read_set("fuse", "fused")
        assert np.allclose(once.sh, again.sh, atol=1e-5)
        assert np.allclose(once.opacities, again.opacities, atol=1e-5)


class TestOneModality:
    def test_photos_alone_are_the_model(self, shells_context):
        folder = shells_context.run.path
        (folder / "surface" / "xray.ply").unlink()
        write_json(folder / "align" / "report.json", {"skipped": "no X-ray"})
        write_json(folder / "internal" / "report.json", {"skipped": "no X-ray"})
        assert reason_to_skip(shells_context) is None
        report = run(shells_context, QUICK)
        assert report["mode"].startswith("rgb only")
        fused, rgb = (shells_context.run.read_set(*which) for which in (("fuse", "fused"), ("surface", "rgb")))
        assert np.array_equal(fused.sh, rgb.sh)

    def test_xrays_alone_are_coloured_by_density(self, shells_context):
        folder = shells_context.run.path
        (folder / "surface" / "rgb.ply").unlink()
        write_json(folder / "align" / "report.json", {"skipped": "no photos"})
        report = run(shells_context, QUICK)
        assert report["mode"].startswith("xray only")
        fused = shells_context.run.read_set("fuse", "fused")
        assert (fused.modality == Modality.XRAY).all()
        assert sh_to_rgb(fused.sh[:, 0]) == pytest.approx(density_colors(density_at_centers(fused)), abs=1e-3)

    def test_nothing_is_nothing(self, shells_context):
        for name in ("rgb", "xray"):
            (shells_context.run.path / "surface" / f"{name}.ply").unlink()
        write_json(shells_context.run.path / "align" / "report.json", {"skipped": "no photos"})
        assert "neither" in reason_to_skip(shells_context)
