"""Triangle meshes out of binary glTF. Numpy alone."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import MeshFileError
from ..rotations import quats_to_matrices

_MM_PER_METRE = 1e3
# glTF is y up: x -> x, y -> z, z -> -y.
_Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
_JSON, _BIN = 0x4E4F534A, 0x004E4942
_TRIANGLES = 4
_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """V vertices and F triangles.

    Attributes:
        vertices: (V, 3) float64, mm, z up.
        faces: (F, 3) int64, counter-clockwise from outside.
        colors: (V, 3) float64 sRGB in 0..1, or None where the file has none.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray | None = None


def read_glb(path: Path) -> TriangleMesh:
    """All triangles of a .glb's scene as one mesh: what `write_glb` writes, and plain meshes of other programs.

    Metres with y up become millimetres with z up. Materials, textures, skins and animations are left out; vertices
    are neither welded nor split.

    Raises:
        MeshFileError: the file is missing, damaged, compressed, or holds no triangles.
    """
    path = Path(path)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise MeshFileError(
            "{path}: cannot be read ({reason}); choose the mesh.glb of a run.", path=path, reason=error.strerror
        ) from error
    try:
        document, binary = _chunks(content)
        parts = list(_primitives(document, binary, path))
    except (KeyError, IndexError, TypeError, ValueError, struct.error) as error:
        raise MeshFileError("{path}: is damaged or no .glb; make it again.", path=path) from error
    if not parts:
        raise MeshFileError("{path}: holds no triangles; choose another file.", path=path)
    return _joined(parts)


def _chunks(content: bytes) -> tuple[dict[str, Any], bytes]:
    """The JSON and the binary chunk of a glTF 2.0 container."""
    magic, version, length = struct.unpack_from("<4sII", content)
    if magic != b"glTF" or version != 2 or length > len(content):
        raise ValueError("no whole glTF 2.0 container")
    offset = 12
    chunks: dict[int, bytes] = {}
    while offset + 8 <= length:
        size, kind = struct.unpack_from("<II", content, offset)
        chunks.setdefault(kind, content[offset + 8 : offset + 8 + size])
        offset += 8 + size
    return json.loads(chunks[_JSON]), chunks.get(_BIN, b"")


def _primitives(document: dict[str, Any], binary: bytes, path: Path) -> Iterator[TriangleMesh]:
    """Each set of triangles in the scene, moved by its nodes."""
    for mesh_index, matrix in _placed_meshes(document):
        for primitive in document["meshes"][mesh_index]["primitives"]:
            if primitive.get("mode", _TRIANGLES) != _TRIANGLES:
                continue
            if "KHR_draco_mesh_compression" in primitive.get("extensions", {}):
                raise MeshFileError("{path}: is compressed with Draco; export it without compression.", path=path)
            places = _accessor(document, binary, primitive["attributes"]["POSITION"], path).astype(np.float64)
            places = places @ matrix[:3, :3].T + matrix[:3, 3]
            if not np.isfinite(places).all():
                raise ValueError("positions that are not finite")
            if "indices" in primitive:
                faces = _accessor(document, binary, primitive["indices"], path).astype(np.int64).reshape(-1, 3)
            else:
                faces = np.arange(len(places)).reshape(-1, 3)
            if faces.size and faces.max() >= len(places):
                raise ValueError("indices beyond the vertices")
            if np.linalg.det(matrix[:3, :3]) < 0:
                faces = faces[:, ::-1]
            colors = None
            if "COLOR_0" in primitive["attributes"]:
                colors = _srgb(_accessor(document, binary, primitive["attributes"]["COLOR_0"], path)[:, :3])
            if len(faces):
                yield TriangleMesh(_MM_PER_METRE * places @ _Z_UP.T, faces, colors)


def _placed_meshes(document: dict[str, Any]) -> Iterator[tuple[int, np.ndarray]]:
    """Index and 4x4 matrix of each mesh in the scene; without a scene all meshes where they are."""
    nodes = document.get("nodes", [])
    if not nodes:
        for index in range(len(document.get("meshes", []))):
            yield index, np.eye(4)
        return
    children = {child for node in nodes for child in node.get("children", [])}
    if "scenes" in document:
        roots = document["scenes"][document.get("scene", 0)].get("nodes", [])
    else:
        roots = [index for index in range(len(nodes)) if index not in children]
    waiting = [(root, np.eye(4)) for root in roots]
    seen: set[int] = set()
    while waiting:
        index, above = waiting.pop(0)
        if index in seen:
            raise ValueError("a node with two parents")
        seen.add(index)
        node = nodes[index]
        matrix = above @ _node_matrix(node)
        if "mesh" in node:
            yield node["mesh"], matrix
        waiting += [(child, matrix) for child in node.get("children", [])]


def _node_matrix(node: dict[str, Any]) -> np.ndarray:
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    matrix = np.eye(4)
    x, y, z, w = node.get("rotation", (0.0, 0.0, 0.0, 1.0))
    turn = quats_to_matrices(np.array([[w, x, y, z]], np.float64))[0]
    matrix[:3, :3] = turn * np.array(node.get("scale", (1.0, 1.0, 1.0)), np.float64)
    matrix[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return matrix


def _accessor(document: dict[str, Any], binary: bytes, index: int, path: Path) -> np.ndarray:
    """(count,) or (count, width) numbers; normalised integers as shares of their range."""
    accessor = document["accessors"][index]
    if "sparse" in accessor or "bufferView" not in accessor:
        raise MeshFileError("{path}: has sparse accessors; export it as a plain mesh.", path=path)
    view = document["bufferViews"][accessor["bufferView"]]
    if "uri" in document["buffers"][view["buffer"]]:
        raise MeshFileError("{path}: keeps its data in another file; export it as one .glb.", path=path)
    dtype, width, count = np.dtype(_COMPONENTS[accessor["componentType"]]), _WIDTHS[accessor["type"]], accessor["count"]
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    stride = view.get("byteStride", dtype.itemsize * width)
    if count and start + stride * (count - 1) + dtype.itemsize * width > len(binary):
        raise ValueError("data beyond the end")
    values: np.ndarray = np.ndarray((count, width), dtype, binary, start, (stride, dtype.itemsize)).copy()
    if accessor.get("normalized") and dtype.kind in "iu":
        values = values / np.iinfo(dtype).max
    return values[:, 0] if width == 1 else values


def _joined(parts: list[TriangleMesh]) -> TriangleMesh:
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    colors = None
    if any(part.colors is not None for part in parts):
        # glTF multiplies with white where a primitive has no colours.
        colors = np.concatenate([np.ones_like(p.vertices) if p.colors is None else p.colors for p in parts])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=False)])
    return TriangleMesh(np.concatenate([part.vertices for part in parts]), faces, colors)


def _srgb(linear: np.ndarray) -> np.ndarray:
    """sRGB in 0..1 of linear colours (IEC 61966-2-1)."""
    linear = np.clip(linear.astype(np.float64), 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
