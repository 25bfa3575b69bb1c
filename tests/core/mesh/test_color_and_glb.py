"""Vertex colours come from near splats only; the file is glTF as the standard has it."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest
import trimesh

from insideout.core.gaussians import GaussianSet
from insideout.core.mesh import color_mesh, extract_mesh, write_glb
from insideout.core.spherical_harmonics import C0
from insideout.core.volume import Volume


@pytest.fixture
def red_shell():
    """Splats on the ball's outer surface: the upper half red, the lower half blue."""
    index = np.arange(4000)
    z = 1 - 2 * (index + 0.5) / len(index)
    turn = index * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - z * z)
    means = 10 * np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1) + [1, 2, -1]
    colors = np.where((z > 0)[:, None], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    return GaussianSet.create(means, 0.2, sh=((colors - 0.5) / C0)[:, None])


def test_outside_is_painted_and_inside_is_not(ball_volume, red_shell):
    volume = ball_volume(cavity=6.0)
    mesh = color_mesh(extract_mesh(volume, 0.025), red_shell, volume)

    from_center = mesh.vertices - [1, 2, -1]
    outer = np.linalg.norm(from_center, axis=1) > 8
    colors = mesh.visual.vertex_colors[:, :3]
    assert np.all(colors[outer & (from_center[:, 2] > 1)] == [255, 0, 0])
    assert np.all(colors[outer & (from_center[:, 2] < -1)] == [0, 0, 255])
    # The wall is as dense as anything here, so the cavity has the bright end of the map: yellow.
    assert np.all(colors[~outer][:, :2] > 200)


def test_a_large_splat_paints_as_far_as_it_reaches(ball_volume):
    """An even patch of paint is a few wide, flat splats, whose centres are far from most of the vertices."""
    red = ((np.array([1.0, 0.0, 0.0]) - 0.5) / C0)[None, None]
    wide = GaussianSet.create([[1.0, 2.0, 9.0]], [[3.0, 3.0, 0.3]], sh=red)
    mesh = color_mesh(extract_mesh(ball_volume(), 0.025), wide)
    colors, apart = mesh.visual.vertex_colors[:, :3], mesh.vertices - [1, 2, -1]
    beside = np.linalg.norm(apart[:, :2], axis=1)
    assert np.all(colors[(beside < 3) & (apart[:, 2] > 0)] == [255, 0, 0])
    assert np.all(colors[apart[:, 2] < 8] == 153), "grey where the splat does not reach"


def test_behind_a_wall_is_a_voxel_deep_along_it_where_voxels_are_oblong():
    """A wall of 1.5 mm in slices of 6 mm; a mean voxel behind its face is the air on its other side."""
    values = np.zeros((8, 60, 60), np.float32)
    values[1:7, 10:50, 10:50] = 0.05
    values[2:6, 13:47, 13:47] = 0.0
    volume = Volume.centered(values, np.array([0.5, 0.5, 6.0]))
    mesh = color_mesh(extract_mesh(volume, 0.025), None, volume)
    face = (mesh.vertices[:, 0] < -9.7) & (np.abs(mesh.vertices[:, 1]) < 7) & (np.abs(mesh.vertices[:, 2]) < 8)
    assert face.any()
    assert (mesh.visual.vertex_colors[face, :2] > 200).all()


def test_materials_of_a_thin_rod_in_a_large_box_have_colours_of_their_own():
    values = np.zeros((100, 100, 100), np.float32)
    values[40:60, 50:53, 50:53], values[60:80, 50:53, 50:53] = 0.02, 0.2
    volume = Volume.centered(values, np.ones(3))
    mesh = color_mesh(extract_mesh(volume, 0.01), None, volume)
    z, brightness = mesh.vertices[:, 2], mesh.visual.vertex_colors[:, :3].sum(axis=1)
    light, dense = brightness[(z > -8) & (z < 8)], brightness[(z > 13) & (z < 28)]
    assert light.max() < dense.min() - 100


def test_invisible_splats_do_not_paint(ball_volume, red_shell):
    ghost = GaussianSet.create(red_shell.means, 0.2, sh=red_shell.sh, opacities=0.01)

    mesh = color_mesh(extract_mesh(ball_volume(), 0.025), ghost)

    assert np.all(mesh.visual.vertex_colors[:, :3] == 153)


def test_no_splats_at_all(ball_volume):
    volume = ball_volume()
    for nothing in (None, GaussianSet.empty()):
        assert np.ptp(color_mesh(extract_mesh(volume, 0.025), nothing).visual.vertex_colors, axis=0).max() == 0


def read_glb(path):
    """The JSON part and the binary part of a .glb."""
    content = path.read_bytes()
    (length,) = struct.unpack("<I", content[12:16])
    return json.loads(content[20 : 20 + length]), content[28 + length :]


def vertex_attribute(path, name):
    tree, binary = read_glb(path)
    accessor = tree["accessors"][tree["meshes"][0]["primitives"][0]["attributes"][name]]
    dtype, columns = {5123: np.uint16, 5126: np.float32}[accessor["componentType"]], int(accessor["type"][-1])
    start = tree["bufferViews"][accessor["bufferView"]]["byteOffset"]
    return np.frombuffer(binary, dtype, accessor["count"] * columns, start).reshape(-1, columns)


def test_glb_is_in_metres_and_y_up(ball_volume, red_shell, tmp_path):
    volume = ball_volume()
    write_glb(color_mesh(extract_mesh(volume, 0.025), red_shell), tmp_path / "mesh.glb")

    read = trimesh.load(tmp_path / "mesh.glb", force="mesh", process=False)
    np.testing.assert_allclose(read.bounds, [[-0.009, -0.011, -0.012], [0.011, 0.009, 0.008]], atol=5e-5)
    assert read.volume == pytest.approx(4 / 3 * np.pi * 0.01**3, rel=0.01)
    top = vertex_attribute(tmp_path / "mesh.glb", "POSITION")[:, 1] > 0.001
    assert np.all(vertex_attribute(tmp_path / "mesh.glb", "COLOR_0")[top] == [65535, 0, 0, 65535])


def test_glb_is_not_metal_and_says_what_was_done(ball_volume, tmp_path):
    write_glb(extract_mesh(ball_volume(), 0.025), tmp_path / "mesh.glb")

    tree, _ = read_glb(tmp_path / "mesh.glb")
    assert tree["materials"][0]["pbrMetallicRoughness"]["metallicFactor"] == 0
    assert tree["materials"][0]["doubleSided"]
    assert tree["meshes"][0]["primitives"][0]["material"] == 0
    assert tree["asset"]["extras"]["unit"] == "metre"


def test_glb_colours_are_linear(ball_volume, tmp_path):
    write_glb(color_mesh(extract_mesh(ball_volume(), 0.025), None), tmp_path / "mesh.glb")

    # sRGB 0.6 is 0.319 of full light.
    light = round(0.318547 * 65535)
    assert np.all(vertex_attribute(tmp_path / "mesh.glb", "COLOR_0") == [light, light, light, 65535])
    tree, _ = read_glb(tmp_path / "mesh.glb")
    (primitive,) = tree["meshes"][0]["primitives"]
    assert set(primitive["attributes"]) == {"POSITION", "NORMAL", "COLOR_0"}
    assert tree["accessors"][primitive["attributes"]["COLOR_0"]]["normalized"] is True
    assert len(tree["bufferViews"]) == 4, "no second colours, of 8 bits"
