"""Where the picture of a plane lies: on the cut faces, which this plane and others may have pulled apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import bpy
import numpy as np

from .section import SIZE_KEY, shown_planes
from .section_clip import face_normal, place_in_model
from .splats import shown_model

# The picture floats this part of its size above the cut, so that it does not fight with the caps for depth.
_LIFT = 1.5e-3


@dataclass(frozen=True, eq=False)
class Pull:
    """A plane that pulls a model apart, in the frame of a plane with a picture.

    Attributes:
        normal, offset: a place p is on its upper side where normal · p > offset.
        step: (3,) how far the upper side is moved; the other one as far the other way.
    """

    normal: np.ndarray
    offset: float
    step: np.ndarray


@dataclass(frozen=True, eq=False)
class Face:
    """A part of a picture: corners (n, 2) in its plane, n > 2, and how far it is moved from there (3,)."""

    corners: np.ndarray
    shift: np.ndarray


def plane_mesh(name: str, size: float) -> bpy.types.Mesh:
    """A square whose picture lies on its own plane; see `shape_plane`."""
    mesh = bpy.data.meshes.new(name)
    _fill(mesh, size, [Face(square(size), np.array([0.0, 0.0, _LIFT * size]))])
    return mesh


def shape_plane(
    scene: bpy.types.Scene, section: bpy.types.PropertyGroup, depsgraph: bpy.types.Depsgraph | None = None
) -> None:
    """Puts a plane's picture onto the cut faces: on the visible side of one, or on both; each part where its half is.

    Args:
        depsgraph: as in `place_in_model`.
    """
    plane = section.object
    size = float(plane[SIZE_KEY])
    lift = np.array([0.0, 0.0, _LIFT * size * (-1 if section.flip else 1)])
    own, others = _pulls(scene, section, depsgraph)
    faces = divided(square(size), others)
    if own is None:
        faces = [Face(face.corners, face.shift + lift) for face in faces]
    else:
        away = own.step - lift
        faces = [Face(face.corners, face.shift + way) for face in faces for way in (-away, away)]
    if not _is_filled(plane.data, faces):
        _fill(plane.data, size, faces)


def shape_beside(face: bpy.types.Object, flip: bool, beside: float) -> None:
    """Puts a picture to the right of a plane's own, as if nothing were pulled apart.

    Args:
        beside: from middle to middle, in units of the plane's own frame.
    """
    size = float(face[SIZE_KEY])
    # Seen from below, right is the other way.
    side = -1 if flip else 1
    faces = [Face(square(size), side * np.array([beside, 0.0, _LIFT * size]))]
    if not _is_filled(face.data, faces):
        _fill(face.data, size, faces)


def divided(corners: np.ndarray, pulls: Sequence[Pull]) -> list[Face]:
    """A convex polygon (n, 2) in the plane z = 0 in the parts that planes pull it into."""
    faces = [Face(corners, np.zeros(3))]
    for pull in pulls:
        sides = [
            Face(_clipped(face.corners, way * pull.normal[:2], way * pull.offset), face.shift + way * pull.step)
            for face in faces
            for way in (1, -1)
        ]
        faces = [face for face in sides if len(face.corners) > 2]
    return faces


def square(size: float) -> np.ndarray:
    """(4, 2) the corners of a square around the origin."""
    return 0.5 * size * np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])


def pulls_in(scene: bpy.types.Scene, frame: np.ndarray, depsgraph: bpy.types.Depsgraph | None) -> list[Pull]:
    """What the scene's planes do to a picture that is no plane's own.

    Args:
        frame: (4, 4) from the picture's to that of the model.
        depsgraph: as in `place_in_model`.
    """
    model = shown_model(scene)
    return [] if model is None else [_pull(other, frame, model, depsgraph) for other in _pulling(scene)]


def _clipped(corners: np.ndarray, normal: np.ndarray, offset: float) -> np.ndarray:
    """The part of a convex polygon (n, 2) where normal · p >= offset (Sutherland and Hodgman, CACM 17(1), 1974)."""
    heights = corners @ normal - offset
    if (heights >= 0).all():
        return corners
    kept = []
    following = zip(np.roll(corners, -1, axis=0), np.roll(heights, -1), strict=True)
    for here, low, (there, high) in zip(corners, heights, following, strict=True):
        if low >= 0:
            kept.append(here)
        if low * high < 0:
            kept.append(here + low / (low - high) * (there - here))
    return np.array(kept).reshape(-1, 2)


def _pulls(
    scene: bpy.types.Scene, section: bpy.types.PropertyGroup, depsgraph: bpy.types.Depsgraph | None
) -> tuple[Pull | None, list[Pull]]:
    """That of a plane itself, if it pulls, and those of the scene's other planes."""
    pulling = _pulling(scene)
    model = shown_model(scene)
    if model is None:
        up = np.array([0.0, 0.0, 0.5 * section.apart_mm * (-1 if section.flip else 1)])
        return (Pull(up, 0.0, up) if section in pulling else None), []
    frame = np.array(place_in_model(section, model, depsgraph), np.float64)
    pulls = {other.object: _pull(other, frame, model, depsgraph) for other in pulling}
    return pulls.pop(section.object, None), list(pulls.values())


def _pulling(scene: bpy.types.Scene) -> list[bpy.types.PropertyGroup]:
    return [other for other in shown_planes(scene) if other.cut and other.apart_mm > 0]


def _pull(
    section: bpy.types.PropertyGroup,
    frame: np.ndarray,
    model: bpy.types.Object,
    depsgraph: bpy.types.Depsgraph | None,
) -> Pull:
    """What a plane does to what has a frame (4, 4) in the model."""
    matrix = np.array(place_in_model(section, model, depsgraph), np.float64)
    normal = face_normal(matrix, 2) * (-1 if section.flip else 1)
    step = np.linalg.pinv(frame[:3, :3]) @ (0.5 * section.apart_mm * normal)
    return Pull(normal @ frame[:3, :3], float(normal @ (matrix[:3, 3] - frame[:3, 3])), step)


def _places(faces: Sequence[Face]) -> np.ndarray:
    """(n, 3) all corners."""
    flat = np.concatenate([face.corners for face in faces])
    shifts = np.concatenate([np.broadcast_to(face.shift, (len(face.corners), 3)) for face in faces])
    return np.column_stack([flat, np.zeros(len(flat))]) + shifts


def _is_filled(mesh: bpy.types.Mesh, faces: Sequence[Face]) -> bool:
    if [polygon.loop_total for polygon in mesh.polygons] != [len(face.corners) for face in faces]:
        return False
    found = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", found)
    return np.allclose(found, _places(faces).ravel(), rtol=1e-5, atol=1e-7)


def _fill(mesh: bpy.types.Mesh, size: float, faces: Sequence[Face]) -> None:
    materials = list(mesh.materials)
    mesh.clear_geometry()
    ends = np.cumsum([len(face.corners) for face in faces])
    loops = [range(end - len(face.corners), end) for end, face in zip(ends, faces, strict=True)]
    mesh.from_pydata(_places(faces).tolist(), [], [tuple(map(int, loop)) for loop in loops])
    layer = mesh.uv_layers.get("UVMap") or mesh.uv_layers.new(name="UVMap")
    layer.data.foreach_set("uv", np.concatenate([face.corners for face in faces]).ravel() / size + 0.5)
    if not len(mesh.materials):
        for material in materials:
            mesh.materials.append(material)
    mesh.update()
