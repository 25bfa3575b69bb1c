"""Pictures to the right of a section plane, in its own plane: the CT on it, and how the model differs from the CT."""

from __future__ import annotations

from collections.abc import Mapping

import bpy

from .color_bar import attach_part, face, text_part
from .leftovers import remove_unused_pictures
from .section import SIZE_KEY
from .section_face import NAME as PICTURE
from .section_face import hide_from_light, paint
from .section_faces import plane_mesh, shape_beside
from .section_image import Picture, Unit, ticks

NAME = "InsideOut Beside"
# How far right each picture is, in sizes of the plane; the colour bar of densities is between them.
_PLACES = {"CT": 1.0, "DIFFERENCE": 2.25}
# Where the bars are then, in sizes of the plane.
BAR_SHIFT = _PLACES["CT"]
_LABEL_BOTTOM = -0.52
# On each part: the kind of its picture, or that of the picture under which it stands.
_PICTURE_KEY, _LABEL_KEY = "insideout_beside", "insideout_beside_label"


def beside_kinds(section: bpy.types.PropertyGroup) -> tuple[str, ...]:
    """Which pictures are wanted beside a plane: none where it does not show the model's own."""
    if section.picture != "MODEL" or section.beside == "NONE":
        return ()
    return ("CT", "DIFFERENCE") if section.beside == "BOTH" else ("CT",)


def show_beside(plane: bpy.types.Object, pictures: Mapping[str, Picture], unit: Unit, flip: bool, keep: bool) -> None:
    """Shows pictures beside a plane, by their kinds, and no others.

    Args:
        unit: of the colour bar.
        flip: the visible side is the one below the plane.
        keep: saves them in the .blend with it.
    """
    if not plane.users_collection:
        return
    names = {"MODEL": "Model", **{kind: _name(kind, picture, unit) for kind, picture in pictures.items()}}
    faces, labels = _parts(plane, _PICTURE_KEY), _parts(plane, _LABEL_KEY)
    if set(faces) != set(pictures) or set(labels) != set(names):
        remove_beside(plane)
        faces = {kind: _new_face(plane, kind) for kind in pictures}
        labels = {kind: _new_label(plane, kind) for kind in names}
    for kind, picture in pictures.items():
        shape_beside(faces[kind], flip, _PLACES[kind] * float(plane[SIZE_KEY]))
        paint(faces[kind], picture.rgba, keep)
    for kind, name in names.items():
        if labels[kind].data.body != name:
            labels[kind].data.body = name
        face(labels[kind], flip)


def beside_parts(plane: bpy.types.Object) -> list[bpy.types.Object]:
    """The objects of the pictures beside a plane."""
    return [*_parts(plane, _PICTURE_KEY).values(), *_parts(plane, _LABEL_KEY).values()]


def is_beside_part(thing: bpy.types.Object) -> bool:
    """Whether an object is a picture beside a plane, or stands under one."""
    return _PICTURE_KEY in thing or _LABEL_KEY in thing


def remove_beside(plane: bpy.types.Object) -> None:
    """Deletes what there is beside a plane."""
    parts = beside_parts(plane)
    if parts:
        # With their data an object goes too.
        bpy.data.batch_remove([part.data for part in parts])
        remove_unused_pictures(PICTURE)


def _parts(plane: bpy.types.Object, key: str) -> dict[str, bpy.types.Object]:
    """By kind; what the user has taken out of the scene does not count."""
    return {child[key]: child for child in plane.children if key in child and child.users_collection}


def _new_face(plane: bpy.types.Object, kind: str) -> bpy.types.Object:
    face = bpy.data.objects.new(NAME, plane_mesh(NAME, float(plane[SIZE_KEY])))
    face[SIZE_KEY], face[_PICTURE_KEY] = plane[SIZE_KEY], kind
    attach_part(face, plane, plane.users_collection[0])
    hide_from_light(face)
    return face


def _new_label(plane: bpy.types.Object, kind: str) -> bpy.types.Object:
    size = float(plane[SIZE_KEY])
    label = text_part(size, _PLACES.get(kind, 0.0) * size, _LABEL_BOTTOM * size)
    label.name, label.data.align_x, label[_LABEL_KEY] = NAME, "CENTER", kind
    attach_part(label, plane, plane.users_collection[0])
    return label


def _name(kind: str, picture: Picture, unit: Unit) -> str:
    if kind == "CT":
        # The bar beside it has the model's unit.
        return "CT" if picture.unit.label == unit.label else f"CT, {picture.unit.label}"
    (_, low), (_, high) = ticks(picture.window, 2, picture.unit)
    return f"Model - CT, {low} (blue) to {high} (red) {picture.unit.label}"
