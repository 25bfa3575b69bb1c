"""Where the pictures of a section box lie: on its six faces, side by side in one image."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import bpy
import numpy as np
from mathutils import Matrix

from ...core.views import Plane
from .color_bar import BOX_BAR_KEY, attach_part
from .leftovers import remove_unused_pictures
from .section import SIZE_KEY, check_sizes
from .section_clip import place_in_model
from .section_face import NAME as PICTURE
from .section_face import hide_from_light, paint
from .section_faces import Face, divided, pulls_in, square
from .splats import shown_model
from .standing import place_in_world

NAME = "InsideOut Box Faces"
# A box goes from -1 to 1 in its own frame.
_SIDE = 2.0
# The pictures float this part of the box's sides above the cut, as those of planes.
_LIFT = 1.5e-3
_FEWEST = 8
# Of a box from before it had a colour bar: the bar's size in that of the box.
_BAR_SIZE = 1.12
# Where x, y and z of the colour bar's frame point in the box: it is read from the front, as that of the first plane.
_BAR_FACING = Matrix(((1, 0, 0), (0, 0, -1), (0, 1, 0)))
# On what shows the pictures, which may get another name; in older files it is known by its name.
_FACES_KEY = "insideout_box_faces"
# On the mesh of the pictures: width and height of those across x, y and z, in pixels.
_TILES_KEY = "insideout_tiles"


@dataclass(frozen=True, eq=False)
class _Tile:
    """A face and the place of its picture.

    Attributes:
        frame: (4, 4) from the face, whose middle is its origin and whose z points out of the box, to the box.
        left, top: of the picture in the image, pixels.
        width, height: of the picture.
        rows: of the image.
    """

    frame: np.ndarray
    left: int
    top: int
    width: int
    height: int
    rows: int


def box_views(box: bpy.types.Object, model: bpy.types.Object, pixels: int) -> list[Plane]:
    """The six faces of a box in a model's frame (mm), `pixels` along the longest edge; two for x, two for y, two for z.

    Args:
        box, model: of a depsgraph whose places count, or as the viewport shows them.

    Raises:
        NoSectionError: the box or the model is scaled to nothing.
    """
    check_sizes(model, box)
    return face_views(place_in_world(model).inverted() @ place_in_world(box), pixels)


def face_views(place: Matrix, pixels: int) -> list[Plane]:
    """As `box_views`, of a box from whose frame `place` leads to the model's."""
    matrix = np.array(place, np.float64)
    edges = _SIDE * np.linalg.norm(matrix[:3, :3], axis=0)
    counts = np.maximum(np.rint(pixels * edges / edges.max()), _FEWEST).astype(int)
    views = []
    for axis, frame in _frames():
        width, height = (int(counts[(axis + step) % 3]) for step in (1, 2))
        place = matrix @ frame
        corner = place @ np.array([-1.0, 1.0, 0.0, 1.0])
        views.append(Plane(corner[:3], _SIDE * place[:3, 0] / width, -_SIDE * place[:3, 1] / height, width, height))
    return views


def paint_box(box: bpy.types.Object, pictures: Sequence[np.ndarray], keep: bool) -> None:
    """Puts pictures (height, width, 4) on the faces of a box, in the order of `box_views`; `shape_box` places them.

    Args:
        keep: saves them in the .blend with it.
    """
    if not box.users_collection:
        return
    faces = box_pictures(box) or _new_pictures(box)
    sizes = [side for rgba in pictures[::2] for side in rgba.shape[1::-1]]
    if list(faces.data.get(_TILES_KEY, ())) != sizes:
        faces.data[_TILES_KEY] = sizes
    tiles = _tiles(sizes)
    image = np.zeros((*_image_size(tiles)[::-1], 4), np.float32)
    for tile, rgba in zip(tiles, pictures, strict=True):
        # The rim once more: between pixels Blender blends with what is beside them.
        around = np.pad(rgba, ((1, 1), (1, 1), (0, 0)), mode="edge")
        image[tile.top : tile.top + tile.height + 2, tile.left : tile.left + tile.width + 2] = around
    paint(faces, image, keep)


def shape_box(
    scene: bpy.types.Scene, section: bpy.types.PropertyGroup, depsgraph: bpy.types.Depsgraph | None = None
) -> None:
    """Puts the pictures of a box onto the cut faces, on their visible side; each part where planes have pulled it.

    Args:
        depsgraph: as in `place_in_model`.
    """
    faces = box_pictures(section.object)
    if faces is None or _TILES_KEY not in faces.data:
        return
    tiles = _tiles(list(faces.data[_TILES_KEY]))
    size = np.array(_image_size(tiles), np.float64)
    lift = np.array([0.0, 0.0, _SIDE * _LIFT * (-1 if section.flip else 1)])
    model = shown_model(scene)
    matrix = np.eye(4) if model is None else np.array(place_in_model(section, model, depsgraph), np.float64)
    places: list[np.ndarray] = []
    corners_in_image: list[np.ndarray] = []
    for tile in tiles:
        for part in divided(square(_SIDE), pulls_in(scene, matrix @ tile.frame, depsgraph)):
            places.append(_in_box(part, tile.frame, lift))
            corners_in_image.append(_in_image(part.corners, tile) / size)
    _fill(faces.data, places, corners_in_image)


def bar_size(box: bpy.types.Object, model: bpy.types.Object) -> tuple[float, float, float]:
    """Size, reach and middle of a box's colour bar, see `color_bar.Legend`, mm: right of model and box.

    Args:
        box, model: as in `box_views`.
    """
    edges = _edges(box, model)
    size, reach, middle = box.get(BOX_BAR_KEY, (_BAR_SIZE * edges.max(), 0.0, 0.0))
    return float(size), max(float(reach), float(edges[0] / 2)), float(middle)


def bar_frame(box: bpy.types.Object, model: bpy.types.Object) -> Matrix:
    """From the frame of a box's colour bar, mm around the middle of the box, to that of the box.

    Args:
        box, model: as in `box_views`.
    """
    return Matrix.Diagonal((*(_SIDE / _edges(box, model)), 1.0)) @ _BAR_FACING.to_4x4()


def _edges(box: bpy.types.Object, model: bpy.types.Object) -> np.ndarray:
    """(3,) how long a box is along its x, y and z, mm in the model's frame."""
    matrix = np.array(place_in_world(model).inverted() @ place_in_world(box), np.float64)
    return _SIDE * np.linalg.norm(matrix[:3, :3], axis=0)


def box_pictures(box: bpy.types.Object) -> bpy.types.Object | None:
    """What shows the pictures of a box; None where it has none, or the user has taken it out of the scene."""
    return next((part for part in box.children if is_box_pictures(part) and part.users_collection), None)


def is_box_pictures(part: bpy.types.Object) -> bool:
    """Whether an object below a box shows its pictures."""
    return _FACES_KEY in part or part.name.startswith(NAME)


def remove_box_pictures(box: bpy.types.Object) -> None:
    """Deletes what shows the pictures of a box."""
    parts = [part for part in box.children if is_box_pictures(part)]
    if parts:
        # With their data an object goes too.
        bpy.data.batch_remove([part.data for part in parts])
        remove_unused_pictures(PICTURE)


def _frames() -> Iterator[tuple[int, np.ndarray]]:
    """The axis across each face, and its frame in the box: `_Tile.frame`."""
    for axis in range(3):
        for sign in (-1.0, 1.0):
            frame = np.zeros((4, 4))
            # Seen from outside, x goes to the right on all of them.
            frame[(axis + 1) % 3, 0], frame[(axis + 2) % 3, 1], frame[axis, 2] = sign, 1.0, sign
            frame[axis, 3], frame[3, 3] = sign, 1.0
            yield axis, frame


def _tiles(sizes: Sequence[int]) -> list[_Tile]:
    """Two rows of pictures, those of an axis above each other, a pixel of rim around each."""
    tall = max(sizes[1::2]) + 2
    lefts = np.cumsum([0, *(width + 2 for width in sizes[::2])])
    return [
        _Tile(frame, int(lefts[axis]), tall * (number % 2), int(sizes[2 * axis]), int(sizes[2 * axis + 1]), 2 * tall)
        for number, (axis, frame) in enumerate(_frames())
    ]


def _image_size(tiles: Sequence[_Tile]) -> tuple[int, int]:
    """Width and height of all of them together, pixels."""
    return max(tile.left + tile.width + 2 for tile in tiles), tiles[0].rows


def _in_box(part: Face, frame: np.ndarray, lift: np.ndarray) -> np.ndarray:
    """(n, 3) the corners of a part of a face in the box's frame."""
    flat = np.column_stack([part.corners, np.zeros(len(part.corners))]) + part.shift + lift
    return flat @ frame[:3, :3].T + frame[:3, 3]


def _in_image(corners: np.ndarray, tile: _Tile) -> np.ndarray:
    """(n, 2) pixels from the image's lower left for corners (n, 2) of a face from -1 to 1."""
    across = tile.left + 1 + 0.5 * (corners[:, 0] + 1) * tile.width
    down = tile.top + 1 + 0.5 * (1 - corners[:, 1]) * tile.height
    return np.column_stack([across, tile.rows - down])


def _fill(mesh: bpy.types.Mesh, places: Sequence[np.ndarray], uvs: Sequence[np.ndarray]) -> None:
    """Gives a mesh these polygons, unless it has them."""
    flat = np.concatenate([*(part.ravel() for part in places), *(part.ravel() for part in uvs)])
    layer = mesh.uv_layers.get("UVMap") or mesh.uv_layers.new(name="UVMap")
    if [polygon.loop_total for polygon in mesh.polygons] == [len(part) for part in places]:
        found, known = np.empty(3 * len(mesh.vertices), np.float32), np.empty(2 * len(mesh.loops), np.float32)
        mesh.vertices.foreach_get("co", found)
        layer.data.foreach_get("uv", known)
        if np.allclose(np.concatenate([found, known]), flat, rtol=1e-5, atol=1e-6):
            return
    materials = list(mesh.materials)
    mesh.clear_geometry()
    ends = np.cumsum([len(part) for part in places])
    loops = [tuple(range(end - len(part), end)) for end, part in zip(ends.tolist(), places, strict=True)]
    mesh.from_pydata(np.concatenate(places).tolist(), [], loops)
    layer = mesh.uv_layers.get("UVMap") or mesh.uv_layers.new(name="UVMap")
    layer.data.foreach_set("uv", np.concatenate(uvs).astype(np.float32).ravel())
    if not len(mesh.materials):
        for material in materials:
            mesh.materials.append(material)
    mesh.update()


def _new_pictures(box: bpy.types.Object) -> bpy.types.Object:
    faces = bpy.data.objects.new(NAME, bpy.data.meshes.new(NAME))
    faces[SIZE_KEY], faces[_FACES_KEY] = _SIDE, True
    attach_part(faces, box, box.users_collection[0])
    hide_from_light(faces)
    return faces
