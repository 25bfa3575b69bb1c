"""Bodies whose volume and mass are known, as runs that can be imported."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import bpy
import numpy as np
import pytest

from insideout.core.gaussians import GaussianSet, Modality


@dataclass
class Body:
    """Vertices (V, 3) mm, faces (F, 3), sRGB colours (V, 3)."""

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray


def ball(radius, center=(0.0, 0.0, 0.0), cavity=False, color=(0.9, 0.2, 0.1), subdivisions=4):
    """A sphere; as the wall of a cavity turned inside out."""
    import bmesh

    mesh = bmesh.new()
    bmesh.ops.create_icosphere(mesh, subdivisions=subdivisions, radius=radius)
    vertices = np.array([vertex.co for vertex in mesh.verts]) + center
    mesh.verts.index_update()
    faces = np.array([[vertex.index for vertex in face.verts] for face in mesh.faces])
    mesh.free()
    return Body(vertices, faces[:, ::-1] if cavity else faces, np.tile(color, (len(vertices), 1)))


def together(*bodies):
    starts = np.cumsum([0, *(len(body.vertices) for body in bodies)])
    return Body(
        np.concatenate([body.vertices for body in bodies]),
        np.concatenate([body.faces + start for body, start in zip(bodies, starts, strict=False)]),
        np.concatenate([body.colors for body in bodies]),
    )


def filling(inside, extent, spacing=2.0, density=0.04):
    """Overlapping splats on a grid wherever `inside(points)` is true: nearly even density."""
    axis = np.arange(-extent, extent + spacing / 2, spacing)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    points = points[inside(points)]
    peak = density * spacing**3 / ((2 * np.pi) ** 1.5 * (0.6 * spacing) ** 3)
    return GaussianSet.create(points, 0.6 * spacing, density=peak, modality=Modality.XRAY, opacities=0.9)


def write_run(folder: Path, body: Body, gaussians: GaussianSet):
    """A run folder with fused.ply and mesh.glb, by no code of the add-on's."""
    gaussians.save(folder / "fused.ply")
    x, y, z = body.vertices.T
    places = (1e-3 * np.stack([x, z, -y], axis=1)).astype(np.float32)
    linear = np.where(body.colors <= 0.04045, body.colors / 12.92, ((body.colors + 0.055) / 1.055) ** 2.4)
    parts = [places.tobytes(), linear.astype(np.float32).tobytes(), body.faces.astype(np.uint32).tobytes()]
    starts = np.cumsum([0, *(len(part) for part in parts)])
    kinds = [("VEC3", 5126, len(places)), ("VEC3", 5126, len(places)), ("SCALAR", 5125, body.faces.size)]
    document = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2}]}],
        "accessors": [
            {"bufferView": k, "type": kind, "componentType": component, "count": count}
            for k, (kind, component, count) in enumerate(kinds)
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": int(start), "byteLength": len(part)}
            for part, start in zip(parts, starts, strict=False)
        ],
        "buffers": [{"byteLength": int(starts[-1])}],
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    data = b"".join(parts)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    (folder / "mesh.glb").write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


@pytest.fixture
def hollow_ball():
    """A ball of radius 20 mm with a cavity of 12 mm around its centre, red outside; and its splats."""
    body = together(ball(20.0), ball(12.0, cavity=True, color=(0.3, 0.3, 0.3)))

    def inside(points):
        distance = np.linalg.norm(points, axis=1)
        return (distance < 19.5) & (distance > 12.5)

    return body, filling(inside, 20.0)


@pytest.fixture
def shells():
    """Three shells in each other around the origin, like dolls in a doll: radii 20-17, 14-11 and a core of 7 mm."""
    radii = (20.0, 17.0, 14.0, 11.0, 7.0)
    body = together(*(ball(radius, cavity=bool(k % 2)) for k, radius in enumerate(radii)))

    def inside(points):
        layer = np.searchsorted(sorted(radii), np.linalg.norm(points, axis=1))
        return layer % 2 == 0

    return body, filling(inside, 20.0)


@pytest.fixture
def imported(blender, tmp_path):
    """`imported(body, gaussians)`: the model of a run that holds them."""

    def bring(body, gaussians, name="run"):
        (tmp_path / name).mkdir(exist_ok=True)
        write_run(tmp_path / name, body, gaussians)
        bpy.context.scene.insideout.run = str(tmp_path / name)
        assert bpy.ops.insideout.import_run() == {"FINISHED"}
        return bpy.context.scene.insideout.model

    return bring


@pytest.fixture
def shapes():
    """How to make bodies of one's own: `ball`, `together`, `filling`, `Body`."""
    return SimpleNamespace(ball=ball, together=together, filling=filling, Body=Body)


@pytest.fixture
def place():
    """`place(thing, frame)`: (4, 4) where an object is, at a frame."""

    def at(thing, frame=None):
        if frame is not None:
            bpy.context.scene.frame_set(frame)
        return np.array(thing.evaluated_get(bpy.context.evaluated_depsgraph_get()).matrix_world)

    return at
