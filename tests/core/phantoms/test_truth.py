"""What is kept as true: surfaces where the material changes, and all of it read back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from insideout.core.errors import CaptureError
from insideout.core.phantoms.materials import Material
from insideout.core.phantoms.model import Part
from insideout.core.phantoms.part_tables import PartTables
from insideout.core.phantoms.truth import Truth, read_truth, truth_surfaces, truth_volume, write_truth
from insideout.core.similarity import Similarity

LEAD = Material("lead", "Pb", 11.3)


def surfaces(phantom, spacing=1.0):
    return truth_surfaces(phantom, PartTables.bake(phantom, 0.4), spacing)


def test_outer_is_closed_and_faces_outwards(ball):
    outer, _ = surfaces(ball)

    mesh = trimesh.Trimesh(outer.vertices, outer.faces, process=False)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * 15**3, rel=0.01)


def test_inner_is_every_other_interface_and_no_more(ball):
    _, inner = surfaces(ball)

    radius = np.linalg.norm(inner.vertices, axis=1)
    on = [np.abs(radius - exact) < 0.05 for exact in (12.0, 4.0)]
    assert np.all(on[0] | on[1])
    area = trimesh.Trimesh(inner.vertices, inner.faces, process=False).area
    assert area == pytest.approx(4 * np.pi * (12**2 + 4**2), rel=0.02)


def test_what_a_later_part_covers_is_no_surface(ball):
    lid = Part("lid", lambda points: points[:, 2] - np.float32(20.0), LEAD)

    _, inner = surfaces(replace(ball, parts=(*ball.parts, lid)))

    assert len(inner.faces) == 0


def test_two_parts_of_one_material_have_no_surface_between_them(ball):
    wood = ball.parts[0].material
    plug = Part("plug", lambda points: np.linalg.norm(points - [0, 0, 13.5], axis=1) - np.float32(1.0), wood)

    _, plain = surfaces(ball)
    _, inner = surfaces(replace(ball, parts=(*ball.parts, plug)))

    assert len(inner.faces) == len(plain.faces)


def test_a_crack_is_found_whatever_the_spacing(ball):
    def crack(points):
        return np.maximum(np.abs(points[:, 0] - 0.1) - np.float32(0.2), np.linalg.norm(points, axis=1) - 3.5)

    _, inner = surfaces(replace(ball, parts=(*ball.parts, Part("crack", crack, None))), spacing=2.0)

    flat = inner.vertices[(np.abs(inner.vertices[:, 0] - 0.1) < 0.25) & (np.linalg.norm(inner.vertices, axis=1) < 3)]
    assert len(flat) > 100
    np.testing.assert_allclose(np.abs(flat[:, 0] - 0.1), 0.2, atol=0.02)


def test_it_reads_back(ball, tmp_path):
    tables = PartTables.bake(ball, 0.5)
    outer, inner = truth_surfaces(ball, tables, 2.0)
    volume = truth_volume(ball, tables, 2.0)
    turned = Similarity(60.0, np.diag([1.0, -1.0, -1.0]), np.array([1.0, 2.0, 3.0]))
    poses = np.tile(np.eye(4), (3, 2, 1, 1))
    write_truth(
        tmp_path / "truth.npz", Truth(volume, turned, outer, inner, ("noise",), np.ones(3), np.full(3, 9.0), poses)
    )

    read = read_truth(tmp_path)

    np.testing.assert_allclose(read.volume.values, volume.values, rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(read.photo_to_world.apply(np.ones(3)), turned.apply(np.ones(3)))
    for name, surface in (("outer", outer), ("inner", inner)):
        np.testing.assert_allclose(getattr(read, name).vertices, surface.vertices, atol=1e-3)
        np.testing.assert_array_equal(getattr(read, name).faces, surface.faces)
    assert read.effects == ("noise",)
    np.testing.assert_array_equal(read.focus_mm, np.full(3, 9.0))
    np.testing.assert_array_equal(read.shutter_poses, poses)


def test_an_older_truth_has_no_surfaces(ball, tmp_path):
    volume = truth_volume(ball, PartTables.bake(ball, 0.5), 4.0)
    write_truth(tmp_path / "truth.npz", Truth(volume, Similarity()))

    read = read_truth(tmp_path)

    assert read.outer is read.inner is read.effects is read.aperture_mm is None
    assert read.volume.values.shape == volume.values.shape


def test_values_at_voxel_centres_stay_what_they_are(ball, tmp_path):
    volume = truth_volume(ball, PartTables.bake(ball, 0.5), 4.0)
    write_truth(tmp_path / "truth.npz", Truth(volume, None, at_centers=True))
    read = read_truth(tmp_path)
    assert read.at_centers
    np.testing.assert_array_equal(read.volume.values, volume.values)
    write_truth(tmp_path / "truth.npz", Truth(volume, None))
    assert not read_truth(tmp_path).at_centers


def test_a_capture_without_truth_says_so(tmp_path):
    with pytest.raises(CaptureError, match="is missing"):
        read_truth(tmp_path)
    (tmp_path / "truth.npz").write_bytes(b"no")
    with pytest.raises(CaptureError, match="cannot be read"):
        read_truth(tmp_path)


@pytest.mark.parametrize("kept", [0.0, 0.5, 0.99])
def test_a_truth_that_was_cut_short_says_so(ball, tmp_path, kept):
    path = tmp_path / "truth.npz"
    write_truth(path, Truth(truth_volume(ball, PartTables.bake(ball, 0.5), 4.0), None))
    path.write_bytes(path.read_bytes()[: int(kept * path.stat().st_size)])
    with pytest.raises(CaptureError, match="cannot be read"):
        read_truth(tmp_path)
