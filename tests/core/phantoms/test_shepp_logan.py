"""The Shepp-Logan head: the table's values, exact projections, a capture that reads back."""

import numpy as np
import pytest
import trimesh

from insideout.core.capture.detectors import CircularScan
from insideout.core.capture.projections import read_projections
from insideout.core.errors import SettingError
from insideout.core.fdk_process import fdk
from insideout.core.phantoms import scanner
from insideout.core.phantoms.shepp_logan import (
    PEAK_PER_MM,
    UNIT_PER_MM,
    SheppLoganScan,
    head_projection,
    make_shepp_logan,
    shepp_logan_projections,
    shepp_logan_surfaces,
    shepp_logan_volume,
    volume_psnr,
)
from insideout.core.phantoms.truth import read_truth
from insideout.core.volume import Volume

TINY = SheppLoganScan(angles=9, heldout=2, detector=24, voxels=16)


def test_values_are_those_of_the_table():
    volume = shepp_logan_volume(64)
    levels = np.unique(np.round(volume.values.astype(np.float64) / UNIT_PER_MM, 4))
    assert levels.tolist() == [0, 1, 1.02, 1.03, 1.04, 1.06, 2]
    assert volume.values.max() == np.float32(PEAK_PER_MM)
    # Centres of the table's third to fifth ellipsoids, and brain where the fifth would be if y were turned over.
    middles = np.array([[-0.22, 0, -0.25], [0.22, 0, -0.25], [0.0, 0.45, -0.25], [0.0, -0.45, -0.25]]) * 110
    assert volume.sample(middles) / UNIT_PER_MM == pytest.approx([1.0, 1.0, 1.04, 1.02], abs=1e-4)


def test_surfaces_are_the_ellipsoids_themselves():
    """Marching cubes of values at voxel centres are a quarter of a millimetre off."""
    outer, inner = shepp_logan_surfaces()
    semi = 110 * np.array([0.69, 0.92, 0.9])
    assert np.linalg.norm(outer.vertices / semi, axis=1) == pytest.approx(1.0, abs=1e-5)
    mesh = trimesh.Trimesh(outer.vertices, outer.faces, process=False)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * semi.prod(), rel=5e-4)
    assert np.linalg.norm(mesh.triangles_center / semi, axis=1).min() > 1 - 0.01 / semi.max()
    others = trimesh.Trimesh(inner.vertices, inner.faces, process=False).split()
    assert len(others) == 9
    # The second ventricle, turned by 72 degrees.
    turn = np.radians(72)
    ahead = 110 * (np.array([0.22, 0, -0.25]) + 0.31 * np.array([np.cos(turn), np.sin(turn), 0]))
    assert np.linalg.norm(inner.vertices - ahead, axis=1).min() < 1


def test_projections_are_the_line_integrals_of_the_volume():
    scan = CircularScan(5, 5, (30.0, 30.0), 1000.0, 1536.0, offset_mm=(3.0, -2.0))
    detector = scan.detector(0.7)
    fine = shepp_logan_volume(128)
    origins, directions = detector.rays()
    along = np.arange(860.0, 1140.0, 1.0)
    points = origins[..., None, :] + along[:, None] * directions[..., None, :]
    summed = fine.sample(points).sum(axis=-1)
    # The volume is a step function of 2 mm voxels, off by at most a voxel of the skull at each crossing.
    assert head_projection(detector) == pytest.approx(summed, abs=2 * 2.0 * PEAK_PER_MM)
    assert np.abs(head_projection(detector) - summed).mean() < 0.01 * summed.max()


def test_a_parallel_ray_through_the_middle_crosses_the_skull_twice():
    detector = CircularScan(1, 1, (1.0, 1.0), 1000.0, 1536.0, parallel=True).detector(0.0)
    skull = 2 * (0.69 - 0.6624) * 110 * 2.0
    brain = 2 * 0.6624 * 110 * 1.02
    assert head_projection(detector)[0, 0] / UNIT_PER_MM == pytest.approx(skull + brain, rel=1e-6)


def test_the_capture_reads_back(tmp_path):
    folder = make_shepp_logan(tmp_path / "head", scan=TINY)
    read = read_projections(folder / "xray" / "meta_data.json").projections
    made = shepp_logan_projections(TINY)
    assert np.array_equal(read.images, made.images)
    assert read.held_out.tolist() == [False] * 9 + [True] * 2
    assert read.voxels == (16, 16, 16)
    assert np.allclose(read.box_mm, made.box_mm)
    assert np.allclose(read.detectors[3].source, made.detectors[3].source)
    truth = read_truth(folder)
    assert np.array_equal(truth.volume.values, shepp_logan_volume(16).values)
    assert truth.photo_to_world is None
    assert truth.at_centers
    assert len(truth.inner.faces) > len(truth.outer.faces) > 10_000
    with pytest.raises(SettingError, match="not empty"):
        make_shepp_logan(folder)
    with pytest.raises(SettingError, match="angles is 0"):
        make_shepp_logan(tmp_path / "none", angles=0)


def test_the_usual_reconstruction_lies_beside_it_where_it_is_asked_for(tmp_path, monkeypatch):
    seen = []
    reconstructed = shepp_logan_volume(4)
    monkeypatch.setattr(scanner, "fdk", lambda projections, **_: seen.append(projections) or reconstructed)
    folder = make_shepp_logan(tmp_path / "head", scan=TINY, with_fdk=True)
    assert np.array_equal(Volume.load(folder / "fdk.npz").values, reconstructed.values)
    assert seen[0].held_out.tolist() == [False] * 9 + [True] * 2
    assert not (make_shepp_logan(tmp_path / "without", scan=TINY) / "fdk.npz").exists()


def test_psnr_is_over_all_voxels_with_the_skull_as_full_scale():
    truth = shepp_logan_volume(16)
    off = Volume(truth.values + np.float32(0.1 * PEAK_PER_MM), truth.spacing_mm, truth.origin_mm)
    assert volume_psnr(off) == pytest.approx(20.0, abs=1e-4)
    with pytest.raises(ValueError, match="256 mm"):
        volume_psnr(Volume.centered(truth.values, np.ones(3)))


@pytest.mark.slow
@pytest.mark.parametrize(("window", "expected"), [("ramp", 24.0), ("hann", 25.2)])
def test_fdk_scores_what_is_quoted_for_it(window, expected):
    projections = shepp_logan_projections(SheppLoganScan(heldout=0))
    assert volume_psnr(fdk(projections, window=window)) == pytest.approx(expected, abs=0.05)
