"""The first splats: on the object, of the right mass, from the training views alone."""

import re
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from insideout.core import fdk_process
from insideout.core.capture.model import Capture, Photos
from insideout.core.capture.registered import load_photos
from insideout.core.densities import Densities
from insideout.core.errors import Cancelled, SettingError
from insideout.core.evaluate import reference
from insideout.core.evaluate.reference import reference_volume
from insideout.core.fdk import fdk
from insideout.core.files import plain
from insideout.core.gaussians import Modality
from insideout.core.ply import read_comments
from insideout.core.progress import Reporter
from insideout.core.render import radiograph
from insideout.core.run_folder import RunFolder
from insideout.core.similarity import Similarity
from insideout.core.spherical_harmonics import sh_to_rgb
from insideout.core.stages.context import StageContext
from insideout.core.stages.initialize import PRESETS, InitializeSettings, run
from insideout.core.stages.initialize import xray as from_xray
from insideout.core.stages.initialize.hull import carve, viewed_sphere
from insideout.core.stages.initialize.photos import neighbour_distance
from insideout.core.stages.initialize.xray import first_splats
from insideout.core.views import Camera
from insideout.core.volume import Volume, densities_of

SETTINGS = InitializeSettings(hull_cells=32, most_rgb=2000, xray_splats=3000)
OUTER_MM = 18.0


@pytest.fixture(scope="module")
def started(shells_capture, tmp_path_factory):
    """(report, run folder) of the two shells' photos and projections."""
    context = fresh(shells_capture[0], tmp_path_factory.mktemp("started"))
    return run(context, SETTINGS), context.run


@pytest.fixture(scope="module")
def similarity(shells_capture):
    return RunFolder(shells_capture[1]).similarity()


def fresh(capture, folder, **options):
    return StageContext(capture, RunFolder(folder / "run"), **options)


def xray_only(capture):
    return replace(capture, photos=None)


def test_coloured_splats_lie_on_the_object(started, similarity):
    report, folder = started
    rgb = folder.read_set("initialize", "rgb").transformed(similarity)
    radii = np.linalg.norm(rgb.means, axis=1)
    assert report["photos"]["points"]["plain_background"]
    assert len(rgb) == report["splats"]["rgb"] > 500
    # The hull of eight photos bulges where none of them looks along the surface.
    assert np.percentile(radii, 1) > 0.9 * OUTER_MM
    assert np.median(radii) < 1.25 * OUTER_MM
    assert radii.max() < 2.0 * OUTER_MM


def test_coloured_splats_have_the_colours_of_the_photos(started, similarity):
    rgb = started[1].read_set("initialize", "rgb").transformed(similarity)
    normals = rgb.means / np.linalg.norm(rgb.means, axis=1, keepdims=True)
    expected = 0.5 + 0.4 * np.sin(normals * [5.0, 4.0, 6.0])
    difference = np.abs(sh_to_rgb(rgb.sh[:, 0]) - expected).max(axis=1)
    assert np.median(difference) < 0.15


def test_coloured_splats_start_as_3dgs_does(started):
    rgb = started[1].read_set("initialize", "rgb")
    np.testing.assert_allclose(rgb.opacities, 0.1, rtol=1e-4)
    np.testing.assert_allclose(rgb.scales, neighbour_distance(rgb.means)[:, None].repeat(3, 1), rtol=1e-3)


def test_cameras_and_held_out_flags_are_kept_for_later_stages(started, shells_capture):
    stored = load_photos(started[1].path / "initialize" / "photos.json")
    given = shells_capture[0].photos.photos
    assert [photo.held_out for photo in stored.photos] == [photo.held_out for photo in given]
    assert all(photo.camera is not None for photo in stored.photos)


def test_the_volume_is_the_fdk_of_the_projections(started, shells_capture):
    # The Hann window and the detector's pixels blur by about 0.7 voxels: there the correlation is best.
    truth = gaussian_filter(RunFolder(shells_capture[1]).volume().values, 0.7)
    found = started[1].volume().values
    assert found.shape == truth.shape
    assert found.min() >= 0
    assert np.corrcoef(found.ravel(), truth.ravel())[0, 1] > 0.94
    assert (found * truth).sum() / (truth**2).sum() == pytest.approx(1.0, abs=0.05)
    for axis in range(3):
        before, here, after = (np.corrcoef(np.roll(found, k, axis).ravel(), truth.ravel())[0, 1] for k in (-1, 0, 1))
        # The vertex of the parabola through the three: where the volume lies, in voxels.
        assert abs(0.5 * (before - after) / (before - 2 * here + after)) < 0.1


def test_the_report_s_reference_is_of_all_projections(started, shells_capture):
    projections = shells_capture[0].projections
    reference = Volume.load(started[1].path / "initialize" / "reference.npz")
    expected = fdk(projections, np.ones(len(projections.images), bool))
    np.testing.assert_array_equal(reference.values, expected.values)


def test_a_stale_or_damaged_reference_is_made_anew(started, shells_capture, tmp_path):
    expected = Volume.load(started[1].path / "initialize" / "reference.npz").values
    context = fresh(xray_only(shells_capture[0]), tmp_path)
    path = context.run.stage("initialize") / "reference.npz"
    Volume.centered(np.ones((2, 3, 4), np.float32), np.ones(3)).save(path)
    run(context, SETTINGS)
    np.testing.assert_array_equal(Volume.load(path).values, expected)
    path.write_bytes(b"PK cut short")
    np.testing.assert_array_equal(reference_volume(context)[0].values, expected)


def test_the_process_of_the_fdk_and_its_memory_are_not_kept(shells_capture, tmp_path, monkeypatch):
    monkeypatch.undo()
    run(fresh(xray_only(shells_capture[0]), tmp_path), SETTINGS)
    assert fdk_process._process is None


def test_radiative_splats_lie_in_material_and_explain_the_projections(started, shells_capture):
    report, folder = started
    xray = folder.read_set("initialize", "xray")
    assert report["xray"]["start"] == "fdk"
    assert len(xray) == 3000
    assert (xray.modality == int(Modality.XRAY)).all()
    assert (folder.volume().sample(xray.means) > 0).mean() > 0.98
    factor, correlation = against_projections(xray, shells_capture[0].projections)
    assert factor == pytest.approx(1.0, abs=0.02)
    assert correlation > 0.9


def against_projections(xray, projections):
    """(least-squares factor, correlation) of the splats' line integrals and those of all projections."""
    shown = np.stack([radiograph(xray.to_torch(), detector).numpy() for detector in projections.detectors])
    measured = projections.images
    return (shown * measured).sum() / (shown**2).sum(), np.corrcoef(shown.ravel(), measured.ravel())[0, 1]


@pytest.mark.parametrize("start", ["fdk", "acui", "coarse"])
def test_a_volume_of_the_wrong_scale_gives_splats_of_the_right_one(shells_capture, tmp_path, start):
    volume = RunFolder(shells_capture[1]).volume()
    capture = replace(xray_only(shells_capture[0]), volume=replace(volume, values=3 * volume.values))
    context = fresh(capture, tmp_path)
    report = run(context, replace(SETTINGS, start=start, acui_stride=3, coarse_splats=1728))
    factor, _ = against_projections(context.run.read_set("initialize", "xray"), capture.projections)
    assert factor == pytest.approx(1.0, abs=0.02)
    assert report["xray"]["density_factor"] == pytest.approx(1 / 3, rel=0.15)


def test_held_out_projections_are_not_looked_at(shells_capture, started, tmp_path):
    projections = shells_capture[0].projections
    images = projections.images.copy()
    images[projections.held_out] = 99.0
    changed = Capture(path=tmp_path, projections=replace(projections, images=images))
    context = fresh(changed, tmp_path)
    run(context, SETTINGS)
    np.testing.assert_array_equal(context.run.volume().values, started[1].volume().values)


def test_acui_is_a_grid_of_stride_voxels_over_the_whole_cuboid(shells_capture, tmp_path):
    context = fresh(xray_only(shells_capture[0]), tmp_path)
    report = run(context, replace(SETTINGS, start="acui", acui_stride=6))
    xray, volume = context.run.read_set("initialize", "xray"), context.run.volume()
    assert "photos" not in report
    assert len(xray) == 6**3
    step = 6 * volume.spacing_mm[0]
    np.testing.assert_allclose(np.unique(np.round(np.diff(np.unique(xray.means[:, 0])), 3)), step, rtol=1e-3)
    np.testing.assert_allclose(xray.means.min(axis=0), volume.box_mm[0] + step / 2, rtol=1e-4)
    assert (xray.density > 0).all(), "a density of zero could not be trained"


def test_coarse_fills_the_whole_cuboid_with_cells_of_its_mean_attenuation():
    values = np.zeros((24, 16, 8), np.float32)
    values[:, :, :2] = 0.04
    volume = Volume(values, np.array([0.5, 0.5, 1.0]), np.array([3.0, -2.0, 1.0]))
    splats = first_splats(volume, "coarse", 96, 8, 0, density_factor=1.0)
    assert len(splats) == 2 * 4 * 12
    np.testing.assert_allclose(splats.scales, 1.0)
    edges = splats.means.min(axis=0) - 1.0, splats.means.max(axis=0) + 1.0
    np.testing.assert_allclose(edges, volume.box_mm, atol=1e-5)
    # Of a cell's four voxels along x two have material; between the voxel centres it fades out.
    np.testing.assert_allclose(splats.density.reshape(2, -1), np.full((2, 48), [[0.02], [1e-6]]), atol=2e-3)


def test_a_sheet_thinner_than_a_cell_counts_with_its_mass_in_coarse():
    values = np.zeros((40, 40, 40), np.float32)
    values[:, :, 17] = 0.3
    volume = Volume.centered(values, np.ones(3))
    splats = first_splats(volume, "coarse", 64, 8, 0, density_factor=1.0)
    assert len(splats) == 4**3
    assert splats.density.max() == pytest.approx(0.03)
    assert splats.density.sum() * 1000 == pytest.approx(values.sum(), rel=1e-3)


@pytest.mark.parametrize("thick", [1, 2, 4, 5, 8, 9])
@pytest.mark.parametrize("start", ["acui", "coarse"])
def test_a_slab_of_a_few_voxels_has_splats(thick, start):
    """A cell of 8 voxels is wider than the whole box."""
    volume = Volume.centered(np.full((thick, 40, 40), 0.02, np.float32), np.ones(3))
    splats = first_splats(volume, start, 100, 8, 0)
    assert len(splats) >= 25
    low, high = volume.box_mm
    assert ((splats.means >= low) & (splats.means <= high)).all()


@pytest.mark.parametrize(("asked", "made"), [(1, 1), (50, 4**3), (2500, 14**3)])
def test_coarse_has_about_as_many_cells_as_asked(shells_capture, asked, made):
    splats = first_splats(RunFolder(shells_capture[1]).volume(), "coarse", asked, 8, 0)
    assert len(splats) == made
    assert (splats.density > 0).all(), "a density of zero could not be trained"


@pytest.mark.parametrize("start", ["acui", "coarse"])
def test_a_volume_alone_starts_fine_because_nothing_splits_later(shells_capture, tmp_path, start):
    volume = RunFolder(shells_capture[1]).volume()
    context = fresh(Capture(path=tmp_path, volume=volume), tmp_path)
    report = run(context, replace(SETTINGS, start=start))
    assert report["xray"]["start"] == "fdk"
    assert len(context.run.read_set("initialize", "xray")) > 2000


def test_a_volume_of_the_user_goes_before_fdk(shells_capture, tmp_path):
    volume = RunFolder(shells_capture[1]).volume()
    context = fresh(Capture(path=tmp_path, volume=volume), tmp_path)
    report = run(context, SETTINGS)
    assert report["xray"]["volume"] == "the capture's own"
    np.testing.assert_array_equal(context.run.volume().values, volume.values)


@pytest.mark.parametrize("own", [Densities(water_per_mm=0.0195), Densities(relative=True)])
def test_a_volume_beside_projections_keeps_its_own_scale_in_its_file(shells_capture, tmp_path, own):
    """Splats have that of the projections; given to another capture, the volume is what it was."""
    volume, model = RunFolder(shells_capture[1]).volume(), Densities(water_per_mm=0.025)
    given = replace(xray_only(shells_capture[0]), volume=volume, densities=model, volume_densities=own)
    context = fresh(given, tmp_path)
    context.run.densities = model
    run(context, SETTINGS)
    folder = context.run.path / "initialize"
    assert densities_of(folder / "volume.npz") == own
    np.testing.assert_array_equal(context.run.volume().values, volume.values)
    reference, source = reference_volume(context)
    if own.relative:
        assert source == "FDK of all projections"
    else:
        np.testing.assert_allclose(reference.values, 0.025 / 0.0195 * volume.values, rtol=1e-5)
    assert "insideout water_per_mm = 0.025" in read_comments(folder / "xray.ply")


def test_an_empty_volume_still_gives_splats_with_finite_numbers(shells_capture, tmp_path):
    volume = RunFolder(shells_capture[1]).volume()
    empty = replace(volume, values=np.zeros_like(volume.values))
    context = fresh(Capture(path=tmp_path, volume=empty), tmp_path)
    run(context, SETTINGS)
    xray = context.run.read_set("initialize", "xray")
    assert all(np.isfinite(getattr(xray, name)).all() for name in ("means", "scales", "density"))


def test_an_unknown_start_names_the_ones_there_are(shells_capture, tmp_path):
    with pytest.raises(SettingError, match=re.escape("choose coarse, fdk or acui")):
        run(fresh(xray_only(shells_capture[0]), tmp_path), replace(SETTINGS, start="random"))


def test_without_hull_and_points_the_viewed_ball_is_filled(shells_capture, similarity, tmp_path):
    context = fresh(replace(shells_capture[0], projections=None), tmp_path)
    report = run(context, replace(SETTINGS, hull_cells=0))
    assert report["photos"]["points"]["random"] > 0
    assert report["photos"]["note"], "says why nothing could be triangulated"
    assert report["photos"]["left_out"] == []
    rgb = context.run.read_set("initialize", "rgb").transformed(similarity)
    assert np.linalg.norm(rgb.means.mean(axis=0)) < 0.2 * OUTER_MM
    assert np.linalg.norm(rgb.means, axis=1).max() > 0.6 * OUTER_MM


def test_photos_in_a_folder_given_by_a_relative_path_are_not_told_to_be_left_out(shells_capture, tmp_path, monkeypatch):
    """Cameras that were found and kept have whole paths."""
    capture = replace(shells_capture[0], projections=None)
    monkeypatch.chdir(capture.photos.photos[0].path.parent)
    given = replace(capture.photos, photos=[replace(p, path=Path(p.path.name)) for p in capture.photos.photos])
    found = replace(capture.photos, photos=capture.photos.photos[1:])
    monkeypatch.setattr("insideout.core.stages.initialize.photos.place_photos", lambda _: (found, ""))
    report = run(fresh(replace(capture, photos=given), tmp_path), replace(SETTINGS, hull_cells=0))
    assert report["photos"]["left_out"] == [capture.photos.photos[0].path.name]


def test_sparse_points_that_photos_see_as_background_are_left_out(shells_capture, similarity, tmp_path):
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(900, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    on_the_object = (OUTER_MM - 0.5) * directions[:600]
    beside_it = 1.7 * OUTER_MM * directions[600:]
    points = similarity.inverse().apply(np.concatenate([on_the_object, beside_it]))
    capture = shells_capture[0]
    photos = Photos(capture.photos.photos, points, np.full((900, 3), 0.5))
    context = fresh(replace(capture, photos=photos, projections=None), tmp_path)
    report = run(context, replace(SETTINGS, hull_cells=24))
    assert 550 <= report["photos"]["points"]["sparse"] <= 620


def test_the_same_seed_gives_the_same_splats(shells_capture, started, tmp_path):
    context = fresh(shells_capture[0], tmp_path)
    run(context, SETTINGS)
    for name in ("rgb", "xray"):
        again, before = context.run.read_set("initialize", name), started[1].read_set("initialize", name)
        np.testing.assert_array_equal(again.means, before.means)


def test_it_can_be_cancelled(shells_capture, tmp_path):
    asked = iter(range(1000))
    context = fresh(shells_capture[0], tmp_path, reporter=Reporter(is_cancelled=lambda: next(asked) > 3))
    with pytest.raises(Cancelled):
        run(context, SETTINGS)
    assert not context.run.has_set("initialize", "xray")


@pytest.mark.parametrize(("made", "not_again"), [("photos", {"hull"}), ("volume", {"hull", "FDK"})])
def test_broken_off_it_goes_on_after_the_last_finished_part(made, not_again, started, shells_capture, tmp_path):
    stops = Reporter(is_cancelled=(tmp_path / "run" / "initialize" / f"{made}.checkpoint.npz").exists)
    with pytest.raises(Cancelled):
        run(fresh(shells_capture[0], tmp_path, reporter=stops), SETTINGS)

    heard = []
    context = fresh(shells_capture[0], tmp_path, reporter=Reporter(heard.append))
    again, before = plain(run(context, SETTINGS)), plain(started[0])
    for half in ("photos", "xray"):
        assert again[half].pop("seconds") > 0
        assert before[half].pop("seconds") > 0
    assert again == before
    done = {progress.part for progress in heard} | {progress.message[:3] for progress in heard}
    assert not done & not_again
    for name in ("rgb", "xray"):
        again, before = context.run.read_set("initialize", name), started[1].read_set("initialize", name)
        np.testing.assert_array_equal(again.means, before.means)
        np.testing.assert_array_equal(again.density, before.density)


def test_an_fdk_is_not_lost_with_what_comes_after_it(started, shells_capture, tmp_path, monkeypatch):
    """The one of all projections takes as long again, and compressing both longer than some."""
    folder, made = tmp_path / "run" / "initialize", []
    monkeypatch.setattr(from_xray, "fdk", lambda *given, **options: made.append("training") or fdk(*given, **options))
    monkeypatch.setattr(reference, "fdk", lambda *given, **options: made.append("all") or fdk(*given, **options))
    for step, so_far in (("fdk", ["training", "all"]), ("volume", ["training", "all", "all"])):
        stops = Reporter(is_cancelled=(folder / f"{step}.checkpoint.npz").exists)
        with pytest.raises(Cancelled):
            run(fresh(xray_only(shells_capture[0]), tmp_path, reporter=stops), SETTINGS)
        assert made == so_far
    stored = (folder / "volume.npz").stat().st_size
    run(fresh(xray_only(shells_capture[0]), tmp_path), SETTINGS)
    assert made == so_far
    assert (folder / "volume.npz").stat().st_size < stored
    for name in ("volume.npz", "reference.npz"):
        with zipfile.ZipFile(folder / name) as archive:
            assert {entry.compress_type for entry in archive.infolist()} == {zipfile.ZIP_DEFLATED}
        found, expected = (Volume.load(one / name).values for one in (folder, started[1].path / "initialize"))
        np.testing.assert_array_equal(found, expected)


def test_its_progress_never_goes_back(shells_capture, tmp_path):
    heard = []
    run(fresh(shells_capture[0], tmp_path, reporter=Reporter(heard.append)), SETTINGS)
    fractions = [progress.fraction for progress in heard]
    assert fractions == sorted(fractions)
    assert fractions[-1] > 0.9


def test_presets_start_coarse():
    assert {name: preset.start for name, preset in PRESETS.items()} == dict.fromkeys(
        ("draft", "standard", "paper"), "coarse"
    )


def test_neighbour_distance_is_never_zero():
    same = np.zeros((5, 3))
    assert (neighbour_distance(same) > 0).all()
    assert neighbour_distance(np.zeros((1, 3))).tolist() == [1.0]
    line = np.arange(6.0)[:, None] * [1.0, 0, 0]
    assert neighbour_distance(line)[2] == pytest.approx((1 + 1 + 2) / 3)


class TestHull:
    SIZE = 60

    def around(self, count=12):
        """Cameras on a ring about z that look at (1, 2, 3) from 10 units away, half of them from above."""
        views = []
        for index in range(count):
            angle, height = 2 * np.pi * index / count, 0.6 * (index % 2)
            forward = -np.array([np.cos(angle), np.sin(angle), height])
            forward /= np.linalg.norm(forward)
            right = np.cross(forward, [0, 0, 1.0])
            right /= np.linalg.norm(right)
            pose = np.eye(4)
            pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
            pose[:3, 3] = -pose[:3, :3] @ (np.array([1.0, 2.0, 3.0]) - 10 * forward)
            views.append(Camera(self.SIZE, self.SIZE, 120.0, 120.0, 30.0, 30.0, pose))
        return views

    def disc(self, radius=12):
        rows, columns = np.mgrid[: self.SIZE, : self.SIZE] + 0.5
        return np.hypot(rows - 30, columns - 30) < radius

    def test_the_viewed_ball_is_what_the_cameras_point_at(self):
        middle, radius = viewed_sphere(self.around())
        np.testing.assert_allclose(middle, [1, 2, 3], atol=1e-4)
        assert radius == pytest.approx(0.5 * 10 * 60 / 120, rel=1e-6)

    def test_cameras_that_all_look_the_same_way_see_something_before_them(self):
        """A camera on a rail: nothing tells how far away the object is."""
        first = self.around()[0]
        forward, right = first.world_to_camera[2, :3], first.world_to_camera[0, :3]
        rail = [first.transformed(Similarity(1.0, np.eye(3), place * right)) for place in (0.0, 1.0, 2.0, 3.0)]
        middle, radius = viewed_sphere(rail)
        np.testing.assert_allclose(middle, first.center + 1.5 * right + 6 * forward, atol=1e-6)
        assert radius == pytest.approx(0.5 * 6 * 60 / 120)
        assert viewed_sphere([first])[1] == pytest.approx(0.5 * 60 / 120)

    def test_parallel_rays_see_as_much_from_any_distance(self):
        views = [replace(c, orthographic=True, fx=12.0, fy=12.0) for c in self.around()]
        middle, radius = viewed_sphere(views)
        np.testing.assert_allclose(middle, [1, 2, 3], atol=1e-4)
        assert radius == pytest.approx(0.5 * 60 / 12)

    def test_discs_in_all_photos_are_a_ball(self):
        cameras = self.around()
        points, normals, _ = carve(cameras, [self.disc()] * len(cameras), 32, lambda _: None)
        offsets = points - [1, 2, 3]
        radii = np.linalg.norm(offsets, axis=1)
        assert len(points) > 300
        assert np.median(radii) == pytest.approx(10 * 12 / 120, rel=0.15)
        assert np.mean((normals * offsets).sum(axis=1) > 0) > 0.98, "normals look outwards"

    def test_masks_that_share_nothing_give_no_points(self):
        cameras = self.around()
        points, _, _ = carve(cameras, [np.zeros((60, 60), bool)] * len(cameras), 16, lambda _: None)
        assert len(points) == 0

    def test_points_behind_a_camera_are_not_in_its_image(self):
        camera = self.around()[0]
        behind = camera.center + (camera.center - [1, 2, 3])
        _, _, inside = camera.pixels_of(np.stack([behind, [1.0, 2.0, 3.0]]))
        assert inside.tolist() == [False, True]
