"""Volume: values at world points, cuts, files."""

import numpy as np
import pytest

from insideout.core import volume as volume_module
from insideout.core.densities import Densities
from insideout.core.errors import CaptureError
from insideout.core.steps import run_through
from insideout.core.views import Plane
from insideout.core.volume import Volume, densities_of


@pytest.fixture
def ramp():
    """x + 10 y + 100 z at the voxel centres of an uneven grid."""
    spacing = np.array([0.5, 1.0, 2.0])
    volume = Volume.centered(np.zeros((4, 6, 8)), spacing)
    z, y, x = np.meshgrid(*[np.arange(n) for n in (4, 6, 8)], indexing="ij")
    points = np.stack([x, y, z], -1) * spacing + volume.origin_mm
    return Volume((points @ [1, 10, 100]).astype(np.float32), spacing, volume.origin_mm)


def test_trilinear_sampling_is_exact_on_a_ramp(ramp):
    points = np.random.default_rng(0).uniform(-1.4, 1.4, (50, 3))
    np.testing.assert_allclose(ramp.sample(points), points @ [1, 10, 100], rtol=1e-4, atol=1e-3)


def test_outside_the_box_there_is_nothing(ramp):
    low, high = ramp.box_mm
    assert ramp.sample(np.stack([low - 0.01, high + 0.01])).tolist() == [0, 0]


def test_the_box_is_centred_and_holds_whole_voxels(ramp):
    np.testing.assert_allclose(ramp.box_mm, [[-2, -3, -4], [2, 3, 4]])


def test_one_voxel_can_be_sampled():
    volume = Volume.centered(np.full((1, 1, 1), 7.0), np.ones(3))
    assert volume.sample(np.zeros(3)) == 7.0


def test_a_section_has_the_plane_s_rows_and_columns(ramp):
    cut = ramp.section(Plane([-2, 0, 4], [0.5, 0, 0], [0, 0, -2], 8, 4))
    assert cut.shape == (4, 8)
    assert cut[0, 0] > cut[3, 0], "the first row is the top"


def test_a_section_is_what_its_points_sample(ramp):
    """Also where the plane is slanted, leaves the volume, and the volume has but one layer."""
    rng = np.random.default_rng(0)
    for shape in [(9, 8, 7), (1, 8, 7), (9, 1, 1)]:
        volume = Volume.centered(rng.random(shape), np.array([0.5, 1.0, 2.0]))
        plane = Plane(rng.uniform(-4, 0, 3), rng.uniform(-1, 1, 3), rng.uniform(-1, 1, 3), 11, 13)
        np.testing.assert_allclose(volume.section(plane), volume.sample(plane.points()), atol=1e-6)


def test_a_saved_volume_comes_back(ramp, tmp_path):
    ramp.save(tmp_path / "v.npz")
    back = Volume.load(tmp_path / "v.npz")
    np.testing.assert_array_equal(back.values, ramp.values)
    np.testing.assert_allclose(back.spacing_mm, ramp.spacing_mm)
    np.testing.assert_allclose(back.origin_mm, ramp.origin_mm)


def test_a_volume_without_voxel_size_is_refused_by_name(tmp_path):
    np.savez(tmp_path / "v.npz", volume=np.zeros((2, 2, 2)))
    with pytest.raises(CaptureError, match=r"v\.npz.*spacing_mm_zyx"):
        Volume.load(tmp_path / "v.npz")


def test_a_truncated_volume_is_named(ramp, tmp_path):
    ramp.save(tmp_path / "v.npz")
    whole = (tmp_path / "v.npz").read_bytes()
    for part in (0, 20, len(whole) // 2, len(whole) - 30):
        (tmp_path / "v.npz").write_bytes(whole[:part])
        with pytest.raises(CaptureError, match=r"v\.npz: cannot be read as \.npz"):
            Volume.load(tmp_path / "v.npz")


def test_an_averaged_volume_has_the_same_values_in_the_same_place():
    spacing = np.array([0.5, 1.0, 2.0])
    z, y, x = np.meshgrid(*[np.arange(n) for n in (4, 9, 13)], indexing="ij")
    fine = Volume(np.asarray(x + 10 * y + 100 * z, np.float32), spacing, np.zeros(3))
    coarse = fine.averaged(5)
    assert coarse.values.shape == (4, 4, 4)
    np.testing.assert_allclose(coarse.spacing_mm, [1.5, 2.0, 2.0])
    points = np.random.default_rng(0).uniform([0.5, 0.5, 0], [5.0, 6.5, 6.0], (50, 3))
    np.testing.assert_allclose(coarse.sample(points), fine.sample(points), rtol=1e-5)
    assert fine.averaged(13).values.shape == fine.values.shape


@pytest.mark.parametrize(
    ("densities", "unit", "water"),
    [(Densities(), "1/mm", None), (Densities(relative=True), "grey", None), (Densities(False, 0.0206), "1/mm", 0.0206)],
)
def test_a_saved_volume_says_what_its_values_are_in(ramp, tmp_path, densities, unit, water):
    ramp.save(tmp_path / "v.npz", densities)
    with np.load(tmp_path / "v.npz") as archive:
        assert str(archive["unit"]) == unit
        assert archive.get("water_per_mm") == water
    assert densities_of(tmp_path / "v.npz") == densities
    np.testing.assert_array_equal(Volume.load(tmp_path / "v.npz").values, ramp.values)


def test_a_volume_that_does_not_say_what_it_is_in_is_in_mm(tmp_path):
    np.savez(tmp_path / "v.npz", volume=np.ones((2, 2, 2)))
    assert densities_of(tmp_path / "v.npz") == Densities()
    (tmp_path / "v.npz").write_bytes(b"PK")
    with pytest.raises(CaptureError, match="cannot be read"):
        densities_of(tmp_path / "v.npz")


def test_in_steps_a_section_is_the_same(ramp, monkeypatch):
    plane = Plane([-2, 0, 4], [0.5, 0, 0.1], [0, 0.2, -0.5], 8, 10)
    expected, shares = ramp.section(plane), []
    monkeypatch.setattr(volume_module, "_PIXELS", 24)
    np.testing.assert_array_equal(run_through(ramp.section_in_steps(plane), shares.append), expected)
    assert shares == [0.3, 0.6, 0.9, 1.0]


@pytest.mark.parametrize("packed", [np.savez, np.savez_compressed])
@pytest.mark.parametrize("order", ["C", "F"])
def test_a_file_is_read_in_steps(tmp_path, monkeypatch, packed, order):
    values = np.asarray(np.random.default_rng(0).random((4, 6, 8)), order=order)
    packed(tmp_path / "v.npz", volume=values, spacing_mm_zyx=[2.0, 1.0, 0.5])
    monkeypatch.setattr(volume_module, "_PIECE", 500)
    shares = []
    found = run_through(Volume.load_in_steps(tmp_path / "v.npz"), shares.append)
    np.testing.assert_array_equal(found.values, values.astype(np.float32))
    assert len(shares) >= 4
    assert shares == sorted(shares)
    assert shares[-1] == 1.0


def test_an_npy_of_that_name_is_refused(tmp_path):
    with open(tmp_path / "v.npz", "wb") as stream:
        np.save(stream, np.ones((4, 6, 8)))
    for read in (Volume.load, densities_of):
        with pytest.raises(CaptureError, match=r"v\.npz: cannot be read as \.npz"):
            read(tmp_path / "v.npz")


def test_a_file_with_a_changed_byte_is_refused(tmp_path):
    np.savez(tmp_path / "v.npz", volume=np.ones((4, 6, 8), np.float32), spacing_mm_zyx=np.ones(3))
    content = bytearray((tmp_path / "v.npz").read_bytes())
    content[400] ^= 1
    (tmp_path / "v.npz").write_bytes(content)
    with pytest.raises(CaptureError, match="cannot be read"):
        Volume.load(tmp_path / "v.npz")
