"""Meshes out of binary glTF: what the engine writes, and what other programs do."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest

from insideout.core.errors import MeshFileError
from insideout.core.mesh.glb_reader import read_glb

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]], np.uint16)


def glb(document, binary=b""):
    """A container of a glTF document and its data."""
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def tetrahedron(**node):
    """A document with one mesh, 16-bit indices and no colours, and its data."""
    return {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, **node}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": 12, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": 48},
            {"buffer": 0, "byteOffset": 48, "byteLength": 24},
        ],
        "buffers": [{"byteLength": 72}],
    }, CORNERS.tobytes() + FACES.tobytes()


def test_what_the_engine_writes_comes_back(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    from insideout.core.mesh import write_glb

    ball = trimesh.creation.icosphere(subdivisions=2, radius=20.0)
    ball.apply_translation([1.0, 2.0, 30.0])
    ball.visual.vertex_colors = np.tile([200, 100, 50, 255], (len(ball.vertices), 1)).astype(np.uint8)
    write_glb(ball, tmp_path / "mesh.glb")
    mesh = read_glb(tmp_path / "mesh.glb")
    np.testing.assert_allclose(mesh.vertices, ball.vertices, atol=1e-5)
    np.testing.assert_array_equal(mesh.faces, ball.faces)
    np.testing.assert_allclose(255 * mesh.colors[0], [200, 100, 50], atol=0.05)


def test_dark_colours_come_back_apart(tmp_path):
    """In 8 bits of light the 31 darkest of sRGB's 256 were five."""
    trimesh = pytest.importorskip("trimesh")
    from insideout.core.mesh import write_glb

    ball = trimesh.creation.icosphere(subdivisions=3)
    levels = (np.arange(len(ball.vertices)) % 256).astype(np.uint8)
    ball.visual.vertex_colors = np.column_stack([levels, levels[::-1], levels, np.full_like(levels, 255)])
    write_glb(ball, tmp_path / "mesh.glb")
    found = 255 * read_glb(tmp_path / "mesh.glb").colors
    np.testing.assert_allclose(found, np.column_stack([levels, levels[::-1], levels]), atol=0.05)


def test_metres_with_y_up_become_millimetres_with_z_up(tmp_path):
    (tmp_path / "t.glb").write_bytes(glb(*tetrahedron()))
    mesh = read_glb(tmp_path / "t.glb")
    np.testing.assert_allclose(mesh.vertices, [[0, 0, 0], [1000, 0, 0], [0, 0, 1000], [0, -1000, 0]], atol=1e-9)
    assert mesh.colors is None


def test_nodes_move_their_meshes(tmp_path):
    half = float(np.sqrt(0.5))
    placed = tetrahedron(translation=[1, 0, 0], rotation=[0, half, 0, half], scale=[2, 2, 2])
    (tmp_path / "t.glb").write_bytes(glb(*placed))
    # A quarter turn about y up takes x to -z, which is y here.
    np.testing.assert_allclose(read_glb(tmp_path / "t.glb").vertices[1], [1000, 2000, 0], atol=1e-3)


def test_a_mirroring_node_keeps_the_outside_outside(tmp_path):
    from insideout.core.mesh.solids import volume_and_centroid

    for scale in ([1, 1, 1], [-1, 1, 1]):
        (tmp_path / "t.glb").write_bytes(glb(*tetrahedron(scale=scale)))
        mesh = read_glb(tmp_path / "t.glb")
        assert volume_and_centroid(mesh.vertices, mesh.faces)[0] == pytest.approx(1e9 / 6)


def test_primitives_of_several_meshes_become_one(tmp_path):
    document, binary = tetrahedron()
    document["nodes"] = [{"children": [1, 2]}, {"mesh": 0}, {"mesh": 0, "translation": [5, 0, 0]}]
    (tmp_path / "t.glb").write_bytes(glb(document, binary))
    mesh = read_glb(tmp_path / "t.glb")
    assert mesh.vertices.shape == (8, 3)
    assert mesh.faces.min() == 0
    assert mesh.faces.max() == 7


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "damaged"),
        (b"glTF" + struct.pack("<II", 2, 999), "damaged"),
        (glb({"asset": {}, "meshes": [{"primitives": [{"attributes": {"POSITION": 7}}]}]}), "damaged"),
        (glb({"asset": {"version": "2.0"}}), "no triangles"),
        (glb(tetrahedron()[0], b"\0" * 8), "damaged"),
    ],
)
def test_what_is_no_mesh_is_told(tmp_path, content, says):
    (tmp_path / "t.glb").write_bytes(content)
    with pytest.raises(MeshFileError, match=rf"t\.glb: .*{says}"):
        read_glb(tmp_path / "t.glb")


def test_a_missing_file_is_told(tmp_path):
    with pytest.raises(MeshFileError, match=r"none\.glb: cannot be read.*choose the mesh\.glb"):
        read_glb(tmp_path / "none.glb")


def test_compressed_meshes_are_told(tmp_path):
    document, binary = tetrahedron()
    document["meshes"][0]["primitives"][0]["extensions"] = {"KHR_draco_mesh_compression": {}}
    (tmp_path / "t.glb").write_bytes(glb(document, binary))
    with pytest.raises(MeshFileError, match="Draco"):
        read_glb(tmp_path / "t.glb")
