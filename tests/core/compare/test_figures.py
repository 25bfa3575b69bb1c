"""What the figures say of models whose faults are known."""

import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from insideout.core.capture.model import Capture, Projections
from insideout.core.capture.read import read_capture
from insideout.core.compare.code import CODE
from insideout.core.compare.meshes import (
    Surfaces,
    distances,
    facing_air,
    mesh_figures,
    patch_occupancy,
    surfaces_of,
    true_surfaces,
)
from insideout.core.compare.score import _photo_mesh, truth_figures, volume_figures, volume_mesh
from insideout.core.compare.score import _voxels as voxels_of
from insideout.core.compare.sections import SectionJudge, slab_image
from insideout.core.compare.starts import errors_of, is_found, moved_photos, random_similarity
from insideout.core.compare.thinning import with_projections
from insideout.core.compare.truth import Truth, find_truth, without_truth
from insideout.core.densities import PER_MM, Densities
from insideout.core.errors import SettingError
from insideout.core.evaluate.lines import line_integrals, volume_projection_figures
from insideout.core.gaussians import GaussianSet
from insideout.core.phantoms.shepp_logan import SheppLoganScan, make_shepp_logan
from insideout.core.phantoms.truth import Surface
from insideout.core.progress import Reporter
from insideout.core.render.voxels import voxel_averages, voxelize
from insideout.core.similarity import Similarity
from insideout.core.spherical_harmonics import rgb_to_sh
from insideout.core.views import Detector, Plane
from insideout.core.volume import Volume


def nothing():
    pass


@pytest.fixture(scope="module")
def blobs():
    """Forty splats of attenuation and their voxels, 1 mm wide."""
    rng = np.random.default_rng(0)
    splats = GaussianSet.create(
        rng.uniform(-12, 12, (40, 3)), rng.uniform(2, 4, (40, 3)), density=rng.uniform(0.02, 0.05, 40), modality=1
    )
    return splats, voxelize(splats, np.full(3, -23.5), 1.0, (48, 48, 48))


@pytest.fixture(scope="module")
def shell():
    """A ball of radius 15 mm with a cavity of radius 8 mm, 0.75 mm voxels averaged over their insides."""
    axis = (np.arange(48) - 23.5) * 0.75
    radius = np.sqrt(axis[:, None, None] ** 2 + axis[None, :, None] ** 2 + axis[None, None, :] ** 2)
    values = np.clip((15 - radius) / 0.75 + 0.5, 0, 1) * np.clip((radius - 8) / 0.75 + 0.5, 0, 1)
    return Volume.centered(0.05 * values, np.full(3, 0.75))


def test_the_truth_itself_scores_perfectly_and_a_shifted_one_does_not(blobs):
    _, truth = blobs
    judge = SectionJudge.of(truth, "cpu", nothing)
    perfect = judge.density(truth)
    assert perfect["psnr"] >= 60
    assert perfect["ssim"] > 0.999
    by_shift = []
    for shift in (0.2, 1.0, 3.0):
        moved = Volume(truth.values, truth.spacing_mm, truth.origin_mm + np.array([shift, 0, 0]))
        by_shift.append(judge.density(moved)["psnr"])
        assert volume_figures(moved, truth)["psnr"] < volume_figures(truth, truth)["psnr"]
    assert 60 > by_shift[0] > by_shift[1] > by_shift[2]


def test_air_everywhere_has_the_figures_of_the_truth_s_own_strength(blobs):
    _, truth = blobs
    judge = SectionJudge.of(truth, "cpu", nothing)
    found, air = judge.nothing(), replace(truth, values=np.zeros_like(truth.values))
    assert found == judge.density(air)
    shown = [r for r in judge.references if (r > judge.air).mean() >= 0.01]
    expected = np.mean([10 * np.log10(judge.peak**2 / np.mean(r.astype(np.float64) ** 2)) for r in shown])
    assert found["psnr"] == pytest.approx(expected, abs=1e-3)
    assert found["psnr"] < judge.density(truth)["psnr"] - 20
    assert found["piqe"] == 100


def test_splats_are_cut_where_voxels_were_sampled(blobs):
    splats, truth = blobs
    assert SectionJudge.of(truth, "cpu", nothing).density(voxel_averages(splats, truth))["psnr"] > 45


def test_a_perfect_model_of_walls_thinner_than_a_voxel_has_no_error():
    """The truth's voxels are averages: by its values at points a perfect model was rated below a blurred one."""
    rng = np.random.default_rng(1)
    walls = GaussianSet.create(
        rng.uniform(-9, 9, (60, 3)),
        np.column_stack([np.full(60, 0.15), rng.uniform(2, 4, (60, 2))]),
        quats=rng.normal(size=(60, 4)),
        density=0.04,
        modality=1,
    )
    fine = voxelize(walls, np.full(3, -11.9375), 0.125, (192, 192, 192)).values
    truth = Volume.centered(fine.reshape(24, 8, 24, 8, 24, 8).mean(axis=(1, 3, 5)), np.ones(3))
    judge = SectionJudge.of(truth, "cpu", nothing)
    blurred = replace(
        walls, scales=walls.scales + np.float32([0.4, 0, 0]), density=walls.density * np.float32(0.15 / 0.55)
    )
    rated = judge.density(voxel_averages(blurred, truth))["psnr"]
    assert judge.density(voxel_averages(walls, truth))["psnr"] > 45
    assert rated < 40
    at_centers = voxelize(walls, truth.origin_mm, 1.0, (24, 24, 24))
    assert judge.density(at_centers)["psnr"] < rated


@pytest.mark.parametrize("at_centers", [False, True])
def test_a_model_has_voxels_as_the_truth_has_them(blobs, tmp_path, at_centers):
    """The Shepp-Logan head is given by its values at voxel centres, the other phantoms by averages over voxels."""
    splats, grid = blobs
    splats.save(tmp_path / "fused.ply")
    coarse = Volume(np.zeros((8, 8, 8), np.float32), np.full(3, 6.0), np.full(3, -21.0))
    study = SimpleNamespace(truth=Truth(coarse, True, "", at_centers=at_centers), reporter=Reporter())
    found = voxels_of(study, SimpleNamespace(folder=tmp_path)).values
    averages = grid.values.reshape(8, 6, 8, 6, 8, 6).mean(axis=(1, 3, 5))
    wanted = voxelize(splats, coarse.origin_mm, 6.0, (8, 8, 8)).values if at_centers else averages
    np.testing.assert_allclose(found, wanted, atol=0.01 * averages.max())


def test_photo_splats_are_compared_as_grey_slabs_and_as_occupancy(blobs):
    splats, truth = blobs
    white = replace(
        splats, opacities=np.full(40, 0.5, np.float32), sh=rgb_to_sh(np.ones((40, 1, 3))).astype(np.float32)
    )
    judge = SectionJudge.of(truth, "cpu", nothing)
    figures = judge.colored(white)
    assert figures["occupancy"]["fitted_attenuation_per_mm"] > 0
    assert figures["occupancy"]["psnr"] > figures["paper"]["psnr"]
    # Black splats show as the black that the background is: only the reference is left.
    black = judge.colored(replace(white, sh=rgb_to_sh(np.zeros((40, 1, 3))).astype(np.float32)))
    shown = [r for r in judge.references if (r > 0.1 * judge.peak).mean() >= 0.01]
    expected = np.mean([10 * np.log10(judge.peak**2 / np.mean(r.astype(np.float64) ** 2)) for r in shown])
    assert black["paper"]["psnr"] == pytest.approx(expected, abs=1e-3)
    assert black["occupancy"]["psnr"] == pytest.approx(figures["occupancy"]["psnr"], abs=1e-6)


def test_attenuation_without_a_unit_has_the_factor_that_suits_it_best(blobs):
    """X-Gaussian's opacities know no mm⁻¹: what is wrong by a factor alone is not wrong."""
    _, truth = blobs
    judge = SectionJudge.of(truth, "cpu", nothing)
    noise = np.random.default_rng(0).normal(0.0, 0.02 * judge.peak, truth.values.shape).astype(np.float32)
    near = replace(truth, values=truth.values + noise)
    figures = judge.density(replace(near, values=3.0 * near.values), unit_known=False)
    assert figures["fitted_factor"] == pytest.approx(1 / 3, rel=0.02)
    assert figures["psnr"] == pytest.approx(judge.density(near)["psnr"], abs=0.1)
    assert judge.density(replace(near, values=3.0 * near.values))["psnr"] < figures["psnr"] - 10


def test_a_slab_shows_the_splats_near_the_plane_where_they_are():
    red = rgb_to_sh(np.array([[[1.0, 0.0, 0.0]]])).astype(np.float32)
    splats = GaussianSet.create([[3.0, 0.0, 5.0], [-3.0, 0.0, 8.0]], 0.6, opacities=0.9, sh=np.repeat(red, 2, axis=0))
    plane = Plane([-8.0, 8.0, 5.5], [0.5, 0, 0], [0, -0.5, 0], 32, 32)
    image = slab_image(splats, plane, 2.0, "cpu")
    row, column = np.unravel_index(image.argmax(), image.shape)
    assert (row, column) in [(r, c) for r in (15, 16) for c in (21, 22)]
    assert image.max() == pytest.approx(0.299 * 0.9, rel=0.15)
    assert image[:, :12].max() < 0.01


def test_surfaces_are_told_apart_and_measured(shell):
    true = surfaces_of(shell)
    assert np.linalg.norm(true.outer.vertices, axis=1) == pytest.approx(15, abs=0.3)
    assert np.linalg.norm(true.inner.vertices, axis=1) == pytest.approx(8, abs=0.3)
    exact = mesh_figures(true.whole, true, 0.75)
    assert exact["watertight"]
    for side in ("outer", "inner"):
        assert exact[side]["from_truth"]["mean_mm"] < 1e-6
        assert exact[side]["to_truth"]["mean_mm"] < 1e-6
    assert exact["normals"]["42"]["occupancy"] == 1.0
    assert exact["normals"]["42"]["total_variation"] == pytest.approx(0, abs=1e-9)


def surface_of(mesh):
    return Surface(np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32))


@pytest.fixture(scope="module")
def filled():
    """A ball of 15 mm whose hollow of 8 mm has air in its upper half and another material in its lower, 0.75 mm
    voxels, with its true surfaces."""
    axis = (np.arange(48) - 23.5) * 0.75
    radius = np.sqrt(axis[:, None, None] ** 2 + axis[None, :, None] ** 2 + axis[None, None, :] ** 2)
    values = np.where(radius > 15, 0.0, np.where(radius > 8, 0.05, np.where(axis[:, None, None] > 0, 0.0, 0.03)))
    volume = Volume.centered(values.astype(np.float32), np.full(3, 0.75))
    outer, inner = (surface_of(trimesh.creation.icosphere(4, radius)) for radius in (15, 8))
    return Truth(volume, True, "the true attenuation", outer=outer, inner=inner)


def test_true_inner_surfaces_count_where_there_is_air_on_one_side_and_the_rest_is_told(filled):
    sphere = trimesh.creation.icosphere(4, 8)
    kept, left_out = facing_air(sphere, filled.volume)
    assert left_out == pytest.approx(0.5, abs=0.08)
    assert kept.area == pytest.approx((1 - left_out) * sphere.area)
    assert (kept.triangles_center[:, 2] > -1).all()
    assert facing_air(trimesh.creation.icosphere(2, 12), filled.volume) == (None, 1.0)


def test_true_surfaces_know_what_was_left_out_of_them(filled):
    found = true_surfaces(filled)
    assert found.inner_left_out == pytest.approx(0.5, abs=0.08)
    assert np.linalg.norm(found.inner.vertices, axis=1) == pytest.approx(8, abs=0.1)
    assert np.linalg.norm(found.outer.vertices, axis=1) == pytest.approx(15, abs=0.1)
    alone = true_surfaces(replace(filled, inner=None))
    assert (alone.inner, alone.inner_left_out) == (None, None)


def test_true_surfaces_face_away_from_the_material(filled):
    """A phantom's cavity is a part of air, turned to the material around it: its walls had the opposite normals of all
    reconstructed ones."""
    bead = trimesh.creation.icosphere(3, 3).apply_translation([0, 0, 4])
    values = filled.volume.values.copy()
    axis = (np.arange(48) - 23.5) * 0.75
    distance = np.sqrt((axis[:, None, None] - 4) ** 2 + axis[None, :, None] ** 2 + axis[None, None, :] ** 2)
    values[distance < 3] = 0.05
    inner = surface_of(trimesh.util.concatenate([trimesh.creation.icosphere(4, 8), bead]))
    found = true_surfaces(replace(filled, volume=replace(filled.volume, values=values), inner=inner)).inner
    on_bead = np.linalg.norm(found.triangles_center - [0, 0, 4], axis=1) < 3.01
    assert 0.3 < found.area_faces[on_bead].sum() / bead.area <= 1.001
    away = np.where(on_bead[:, None], found.triangles_center - [0, 0, 4], -found.triangles_center)
    assert (np.einsum("ij,ij->i", away, found.face_normals) > 0).all()


def test_so_do_those_of_a_phantom(tiny_capture, tmp_path):
    truth = find_truth(read_capture(tiny_capture), tmp_path, Reporter())
    true = true_surfaces(truth)
    reach = 0.75 * float(truth.volume.spacing_mm.min()) * true.inner.face_normals
    ahead, behind = (truth.volume.sample(true.inner.triangles_center + side * reach) for side in (1, -1))
    assert (ahead < behind).all()


@pytest.fixture(scope="module")
def head(tmp_path_factory):
    """The Shepp-Logan head with few, small projections."""
    scan = SheppLoganScan(angles=9, heldout=2, detector=24)
    return read_capture(make_shepp_logan(tmp_path_factory.mktemp("captures") / "head", scan=scan))


def test_the_shepp_logan_head_is_measured_by_its_ellipsoid_not_by_its_voxels(head, tmp_path):
    truth = find_truth(head, tmp_path, Reporter())
    true = true_surfaces(truth)
    assert (true.inner, true.inner_left_out) == (None, 1.0)
    semi = 110 * np.array([0.69, 0.92, 0.9])
    exact, larger = (trimesh.creation.icosphere(5).apply_scale(size * semi) for size in (1.0, 1.02))
    assert mesh_figures(exact, true, 2.0)["outer"]["to_truth"]["mean_mm"] < 0.05
    assert mesh_figures(larger, true, 2.0)["outer"]["to_truth"]["mean_mm"] == pytest.approx(1.8, abs=0.2)
    judge = SectionJudge.of(truth.volume, "cpu", nothing)
    study = SimpleNamespace(capture=SimpleNamespace(volume=None, projections=head.projections))
    figures = truth_figures(study, truth, judge, true)
    assert figures["normals"]["42"]["occupancy"] == 1.0
    assert figures["mesh"] is None, "a mesh of values at points is no measure of what voxels can tell"


def test_a_head_from_before_its_surfaces_were_kept_has_no_mesh_figures(head, tmp_path):
    truth = replace(find_truth(head, tmp_path, Reporter()), outer=None, inner=None)
    assert true_surfaces(truth) is None
    judge = SectionJudge.of(truth.volume, "cpu", nothing)
    study = SimpleNamespace(capture=SimpleNamespace(volume=None, projections=head.projections))
    figures = truth_figures(study, truth, judge, None)
    assert (figures["surface_unknown"], figures["no_surface"]) == (True, False)


def test_how_much_of_the_true_inner_surfaces_a_mesh_finds(shell):
    true = surfaces_of(shell)
    upper = true.inner.submesh([true.inner.triangles_center[:, 2] > 0], append=True)
    half = trimesh.util.concatenate([true.outer, upper])
    assert mesh_figures(true.whole, true, 0.75)["inner_found"] == 1
    assert mesh_figures(half, true, 0.75)["inner_found"] == pytest.approx(0.53, abs=0.05)
    assert mesh_figures(true.outer, true, 0.75)["inner_found"] == 0
    assert mesh_figures(true.outer, Surfaces(true.outer, None), 0.75)["inner_found"] is None


@pytest.mark.parametrize(("size", "off"), [(1.0, 0.0), (1.1, 1.5)])
def test_a_mesh_of_photos_is_brought_to_mm_before_it_is_measured(shell, size, off):
    frame = Similarity(20.0, np.diag([1.0, -1.0, -1.0]), np.array([3.0, -5.0, 40.0]))
    mesh = trimesh.creation.icosphere(4, 15.0 * size)
    mesh.vertices = frame.inverse().apply(mesh.vertices)
    study = SimpleNamespace(photo_frame=lambda: (frame, "the true similarity"), truth=SimpleNamespace(volume=shell))
    figures = _photo_mesh(study, SimpleNamespace(mesh=lambda: mesh), surfaces_of(shell))
    assert figures["frame"] == "the true similarity"
    assert figures["outer"]["to_truth"]["mean_mm"] == pytest.approx(off, abs=0.1)
    assert figures["inner_found"] == 0


def test_a_volume_without_a_surface_says_so_without_advice(shell):
    empty = replace(shell, values=np.zeros_like(shell.values))
    assert volume_mesh(empty, surfaces_of(shell)) == {"failed": "no surface found"}


def test_what_rows_are_measured_against_has_figures_of_its_own(filled):
    judge = SectionJudge.of(filled.volume, "cpu", nothing)
    study = SimpleNamespace(capture=SimpleNamespace(volume=filled.volume, projections=None))
    figures = truth_figures(study, filled, judge, true_surfaces(filled))
    assert figures["given"]
    assert figures["measured_sections"] == figures["nothing"]["count"] < figures["held_out_sections"]
    assert figures["nothing"] == judge.nothing()
    assert figures["inner_left_out"] == pytest.approx(0.5, abs=0.08)
    assert figures["mesh"]["inner_found"] > 0.9
    assert set(figures["normals"]) == {"42", "242"}
    without = truth_figures(study, filled, judge, None)
    assert without["no_surface"]
    assert (without["normals"], without["mesh"]) == (None, None)


def test_a_mesh_that_is_off_is_off_by_as_much(shell):
    true = surfaces_of(shell)
    grown = trimesh.creation.icosphere(4, 15.6)
    figures = mesh_figures(grown, true, 0.75)
    assert figures["outer"]["from_truth"]["mean_mm"] == pytest.approx(0.6, abs=0.06)
    assert figures["outer"]["to_truth"]["mean_voxels"] == pytest.approx(0.8, abs=0.08)
    # The cavity is missing: its true points are 7.6 mm away, and nothing of the mesh is near it.
    assert figures["inner"]["from_truth"]["mean_mm"] == pytest.approx(7.6, abs=0.1)
    assert figures["inner"]["to_truth"] is None


def test_distances_to_triangles_are_exact():
    square = trimesh.Trimesh([[0, 0, 0], [4, 0, 0], [4, 4, 0], [0, 4, 0]], [[0, 1, 2], [0, 2, 3]])
    points = np.array([[1, 2, 3.0], [-3, 2, 4], [7, 8, 0], [2, 2, -0.5]])
    np.testing.assert_allclose(distances(square, points), [3, 5, 5, 0.5], atol=1e-12)


def test_patches_of_a_flat_box_take_fewer_directions_than_those_of_a_ball():
    ball, box = trimesh.creation.icosphere(5, 10), trimesh.creation.box((20, 20, 20)).subdivide_loop(0)
    for _ in range(5):
        box = box.subdivide()
    assert np.mean(patch_occupancy(ball, 242)) > np.mean(patch_occupancy(box, 242)) > 0


def test_line_integrals_of_a_volume(blobs):
    _, truth = blobs
    flat = Volume.centered(np.full((40, 40, 40), 0.03, np.float32), np.full(3, 1.0))
    detector = Detector(9, 7, [0, -500, 0], [0, 250, 0], [4, 0, 0], [0, 0, -4])
    middle = line_integrals(flat, detector)[3, 4]
    assert middle == pytest.approx(40 * 0.03, rel=0.01)
    detectors = [replace(detector, source=[500 * np.sin(a), -500 * np.cos(a), 0]) for a in (0.0, 0.01)]
    images = np.stack([line_integrals(truth, one) for one in detectors])
    projections = Projections(images, detectors, np.array([False, True]), np.zeros(2), truth.box_mm, (48, 48, 48))
    assert volume_projection_figures(truth, projections, nothing) == {"psnr": 100.0, "count": 1}
    less = Volume(0.9 * truth.values, truth.spacing_mm, truth.origin_mm)
    assert volume_projection_figures(less, projections, nothing)["psnr"] < 40


def test_errors_of_a_similarity_are_measured_at_the_middle():
    true = random_similarity(1, 0, 2.0)
    middle = np.array([3.0, -5.0, 40.0])
    assert is_found(errors_of(true, true, middle))
    angle = np.radians(1.5)
    about_z = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
    turned = Similarity(1.01, about_z, middle - 1.01 * about_z @ middle + [0, 0, 0.4]).after(true)
    errors = errors_of(turned, true, middle)
    assert errors["scale_percent"] == pytest.approx(1.0)
    assert errors["rotation_deg"] == pytest.approx(1.5)
    assert errors["tilt_deg"] == pytest.approx(0.0, abs=1e-5)
    assert errors["translation_mm"] == pytest.approx(0.4)
    assert not is_found(errors)
    upside_down = Similarity(1.0, np.diag([1.0, -1.0, -1.0]), np.zeros(3)).after(true)
    assert errors_of(upside_down, true, middle)["tilt_deg"] == pytest.approx(180.0)


def test_random_starts_are_proper_similarities_and_differ():
    first, second = random_similarity(0, 0, 1.0), random_similarity(0, 1, 1.0)
    for one in (first, second):
        np.testing.assert_allclose(one.rotation @ one.rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(one.rotation) == pytest.approx(1)
        assert 0.2 <= one.scale <= 5
    assert abs(first.scale - second.scale) > 1e-3


def test_moved_photos_see_the_moved_scene(tiny_capture):
    photos = read_capture(tiny_capture).photos
    move = random_similarity(0, 2, 1.0)
    moved = moved_photos(photos, move)
    point = np.array([0.1, 0.2, 0.3])
    for before, after in zip(photos.photos[:3], moved.photos[:3], strict=True):
        seen = []
        for camera, place in ((before.camera, point), (after.camera, move.apply(point))):
            x, y, z = np.asarray(camera.world_to_camera)[:3, :3] @ place + np.asarray(camera.world_to_camera)[:3, 3]
            seen.append((camera.fx * x / z, camera.fy * y / z))
        np.testing.assert_allclose(*seen, rtol=1e-6)


def test_the_truth_of_a_capture(tiny_capture, tmp_path):
    capture = read_capture(tiny_capture)
    truth = find_truth(capture, tmp_path, Reporter())
    assert truth.exact
    assert truth.similarity.scale > 1
    low, high = truth.volume.box_mm
    assert ((truth.middle_mm > low) & (truth.middle_mm < high)).all()
    assert find_truth(replace(capture.photos_only(), path=tmp_path), tmp_path, Reporter()) is None


def test_a_reference_that_was_damaged_is_made_anew(tiny_capture, blobs, monkeypatch, tmp_path):
    capture = replace(read_capture(tiny_capture), path=tmp_path)
    made = []

    def fdk(projections, views, reporter):
        made.append(views.all())
        return blobs[1]

    monkeypatch.setattr("insideout.core.compare.truth.fdk", fdk)
    for _ in range(2):
        truth = find_truth(capture, tmp_path, Reporter())
        assert not truth.exact
        np.testing.assert_array_equal(truth.volume.values, blobs[1].values)
    assert made == [True]
    kept = next(tmp_path.glob("reference *.npz"))
    kept.write_bytes(kept.read_bytes()[:100])
    np.testing.assert_array_equal(find_truth(capture, tmp_path, Reporter()).volume.values, blobs[1].values)
    assert made == [True, True]
    # Where an FDK comes out otherwise in a later version.
    monkeypatch.setitem(CODE, "fdk", 99)
    again = find_truth(capture, tmp_path, Reporter())
    assert made == [True] * 3
    assert again.digest != truth.digest


@pytest.fixture
def beside(shell, tmp_path):
    """The shell as a volume beside two empty projections."""
    images, box = np.zeros((2, 4, 4), np.float32), shell.box_mm
    projections = Projections(images, [], np.zeros(2, bool), np.zeros(2), box, (4, 4, 4))
    return Capture(tmp_path, projections=projections, volume=shell, digest="shell")


def test_a_volume_of_hounsfield_units_is_the_truth_in_the_water_of_models(beside, shell, tmp_path):
    """Models are fitted to the projections: the perfect one would else be as wrong as the volume's water."""
    own, of_model = Densities(water_per_mm=0.0195), Densities(water_per_mm=0.025)
    capture = replace(beside, volume_densities=own)
    alike, denser = (find_truth(replace(capture, densities=one), tmp_path, Reporter()) for one in (own, of_model))
    assert alike.volume is shell
    np.testing.assert_allclose(denser.volume.values, 0.025 / 0.0195 * shell.values, rtol=1e-6)
    assert alike.digest != denser.digest, "rows that were measured against the one are not kept beside the other"


def test_gray_values_that_fit_no_projections_are_no_truth(beside, shell, blobs, monkeypatch, tmp_path):
    monkeypatch.setattr("insideout.core.compare.truth.fdk", lambda projections, views, reporter: blobs[1])
    grey = replace(beside, volume_densities=Densities(relative=True))
    truth = find_truth(grey, tmp_path, Reporter())
    assert (truth.source, truth.exact) == ("the FDK of all projections", False)
    np.testing.assert_array_equal(truth.volume.values, blobs[1].values)
    assert truth.digest != find_truth(replace(grey, volume_densities=PER_MM), tmp_path, Reporter()).digest
    alone = replace(grey, projections=None, densities=grey.volume_densities)
    assert find_truth(alone, tmp_path, Reporter()).volume is shell, "models of it are as relative"


def test_methods_do_not_see_the_volume_that_they_are_measured_against(tiny_capture, shell, tmp_path):
    capture = replace(read_capture(tiny_capture), volume=shell)
    shown = without_truth(capture)
    assert shown.volume is None
    assert shown.digest != capture.digest
    assert without_truth(replace(capture, projections=None)).volume is shell
    assert without_truth(shown) is shown
    # A truth that was written anew is another truth.
    other = replace(capture, path=tmp_path, volume=None)
    shutil.copy2(tiny_capture / "truth.npz", tmp_path)
    before = find_truth(other, tmp_path, Reporter()).digest
    content = dict(np.load(tmp_path / "truth.npz"))
    np.savez(tmp_path / "truth.npz", **content | {"volume": content["volume"] * np.float32(1.01)})
    assert find_truth(other, tmp_path, Reporter()).digest != before


def test_thinned_projections_are_evenly_spread_and_keep_the_held_out_ones(tiny_capture):
    capture = read_capture(tiny_capture)
    thinned = with_projections(capture, 8).projections
    assert (int((~thinned.held_out).sum()), int(thinned.held_out.sum())) == (8, 2)
    angles = np.sort(thinned.angles_rad[~thinned.held_out])
    np.testing.assert_allclose(np.diff(angles), np.pi / 4, atol=1e-6)
    assert len(thinned.images) == len(thinned.detectors) == 10
    with pytest.raises(SettingError, match="choose 3 to 16"):
        with_projections(capture, 17)
    with pytest.raises(SettingError, match="has no projections"):
        with_projections(capture.photos_only(), 8)
