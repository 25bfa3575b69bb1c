"""What makes a section readable: a colour bar with its numbers and a scale bar, parented to the plane or the box."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import bpy
import numpy as np
from mathutils import Matrix

from .node_tree import TreeBuilder, shader_builder, shared_material
from .section_image import PER_MM, Unit, Window, bar_rgba, round_length, ticks

NAME = "InsideOut Colour Bar"
# In parts of the plane's size: the colour bar, and the scale bar's height, thickness and greatest length.
_GAP, _BOTTOM, _WIDTH, _HEIGHT, _TEXT = 0.07, -0.33, 0.035, 0.66, 0.036
_SCALE_TOP, _SCALE_THICK, _SCALE_LONGEST = -0.385, 0.008, 0.25
# Of numbers and scale bar before the viewport's dark grey.
_INK = 0.7
# On a plane: how far the model reaches to the right on it, when the plane was made; mm.
REACH_KEY = "insideout_reach_mm"
# On a box: what `Legend` calls size, reach and middle, when the box was made; mm in the model's frame.
BOX_BAR_KEY = "insideout_box_bar_mm"
# On each part: "strip", "unit", "scale", "length" or the number of the label.
_PART_KEY = "insideout_bar"
_PLACE_KEY = "insideout_place"


@dataclass(frozen=True)
class Legend:
    """What the bars of a plane or a box say, and where they stand, in the plane's own frame or one beside the box.

    Attributes:
        size: of the plane; of a box that of a plane through the same model.
        window: densities of the colour bar's ends.
        reach: how far the model reaches to the right.
        colors: one of `core.colormap.COLOR_MAPS`.
        unit: what densities are written in.
        mm_per_unit: millimetres in a unit of the frame, along the plane's rows.
        shift: how far right of the model they stand, beyond where they are beside the plane alone.
        middle: how far their middle is above the origin.
        flip: the visible side is the one below the plane.
    """

    size: float
    window: Window
    reach: float
    colors: str = "inferno"
    unit: Unit = PER_MM
    mm_per_unit: float = 1.0
    shift: float = 0.0
    middle: float = 0.0
    flip: bool = False

    @property
    def place(self) -> tuple[float, float]:
        """Left end and middle of the bars."""
        return self.reach + _GAP * self.size + self.shift, self.middle


def update_color_bar(plane: bpy.types.Object, legend: Legend, frame: Matrix | None = None) -> None:
    """Writes numbers and lengths on the bars of a plane or a box; makes them anew where they are not complete.

    Args:
        frame: in which the bars stand, in that of the box.
    """
    if not plane.users_collection:
        return
    length_mm = round_length(_SCALE_LONGEST * legend.size * legend.mm_per_unit)
    texts: dict[str | int, str] = {k: text for k, (_, text) in enumerate(ticks(legend.window, unit=legend.unit))}
    texts |= {"unit": legend.unit.label, "length": f"{length_mm:g} mm"}
    parts = {part[_PART_KEY]: part for part in bar_parts(plane) if part.users_collection}
    if set(parts) != {"strip", "scale", *texts} or tuple(parts["strip"].get(_PLACE_KEY, ())) != legend.place:
        remove_color_bar(plane)
        parts = _create(plane, legend)
    for name, text in texts.items():
        if parts[name].data.body != text:
            parts[name].data.body = text
    _color(parts["strip"].data, legend.colors)
    _stretch(parts["scale"].data, legend, length_mm / legend.mm_per_unit)
    for part in parts.values():
        face(part, legend.flip)
    if frame is not None:
        place_color_bar(plane, frame)


def place_color_bar(box: bpy.types.Object, frame: Matrix) -> None:
    """Stands the bars of a box, as large as they are wherever it is scaled to, in a frame given in the box's own."""
    for part in bar_parts(box):
        if part.matrix_parent_inverse != frame:
            part.matrix_parent_inverse = frame


def face(part: bpy.types.Object, flip: bool) -> None:
    """Turns a text or a bar about the plane's y to the side from which the plane is seen."""
    turn = math.pi if flip else 0.0
    if abs(part.rotation_euler.y - turn) > 1e-6:
        part.rotation_euler.y = turn


def bar_parts(plane: bpy.types.Object) -> list[bpy.types.Object]:
    """The objects of a plane's bars."""
    return [child for child in plane.children if _PART_KEY in child]


def remove_color_bar(plane: bpy.types.Object) -> None:
    """Deletes what is there of a plane's bars."""
    data = [part.data for part in bar_parts(plane)]
    # With their data an object goes too.
    bpy.data.batch_remove(data)


def _create(plane: bpy.types.Object, legend: Legend) -> dict[str | int, bpy.types.Object]:
    """The parts by name, the labels by their number from below."""
    collection, size = plane.users_collection[0], legend.size
    left, middle = legend.place
    bottom = middle + _BOTTOM * size
    right, top = left + _WIDTH * size, bottom + _HEIGHT * size
    strip = _rectangle(left, bottom, right, top)
    strip.uv_layers.new(name="UVMap").data.foreach_set("uv", [0, 0, 1, 0, 1, 1, 0, 1])
    scale = _rectangle(0.0, 0.0, size, size)
    scale.materials.append(_ink_material())
    parts: dict[str | int, bpy.types.Object] = {
        "strip": bpy.data.objects.new(NAME, strip),
        "scale": bpy.data.objects.new(NAME, scale),
    }
    for index, (place, _) in enumerate(ticks(Window(0.0, 1.0))):
        parts[index] = text_part(size, right + 0.35 * _TEXT * size, bottom + place * (top - bottom))
    parts["unit"] = text_part(size, left, top + _TEXT * size)
    parts["length"] = text_part(size, left, middle + (_SCALE_TOP - _SCALE_THICK) * size - 0.7 * _TEXT * size)
    for name, part in parts.items():
        part[_PART_KEY] = name
        attach_part(part, plane, collection)
    parts["strip"][_PLACE_KEY] = legend.place
    return parts


def _rectangle(left: float, bottom: float, right: float, top: float) -> bpy.types.Mesh:
    mesh = bpy.data.meshes.new(NAME)
    mesh.from_pydata([(left, bottom, 0), (right, bottom, 0), (right, top, 0), (left, top, 0)], [], [(0, 1, 2, 3)])
    return mesh


def _stretch(mesh: bpy.types.Mesh, legend: Legend, length: float) -> None:
    """Makes the scale bar, under the colour bar, as long as it says."""
    size, (left, middle) = legend.size, legend.place
    top = middle + _SCALE_TOP * size
    right = left + length
    bottom = top - _SCALE_THICK * size
    corners = np.array([(left, bottom, 0), (right, bottom, 0), (right, top, 0), (left, top, 0)], np.float32)
    found = np.empty(12, np.float32)
    mesh.vertices.foreach_get("co", found)
    if not np.allclose(found, corners.ravel(), atol=1e-6 * size):
        mesh.vertices.foreach_set("co", corners.ravel())
        mesh.update()


def _color(mesh: bpy.types.Mesh, colors: str) -> None:
    material = _bar_material(colors)
    if list(mesh.materials) != [material]:
        mesh.materials.clear()
        mesh.materials.append(material)


def text_part(size: float, x: float, y: float) -> bpy.types.Object:
    """A text to be attached to a plane, at a place in the plane's frame."""
    curve = bpy.data.curves.new(NAME, "FONT")
    curve.size = _TEXT * size
    curve.align_y = "CENTER"
    curve.materials.append(_ink_material())
    # Moved by its offset, not its location: Blender draws a dashed line from each child's origin to the plane's.
    curve.offset_x, curve.offset_y = x, y
    return bpy.data.objects.new(NAME, curve)


def attach_part(part: bpy.types.Object, plane: bpy.types.Object, collection: bpy.types.Collection) -> None:
    """Makes an object a part of a plane: it moves with it and cannot be selected."""
    collection.objects.link(part)
    part.parent = plane
    part.hide_select = True
    part.visible_shadow = part.visible_diffuse = part.visible_glossy = False


def _bar_material(colors: str) -> bpy.types.Material:
    name = f"{NAME} {colors}"

    def build(material: bpy.types.Material) -> None:
        rgba = np.ascontiguousarray(bar_rgba(colors=colors)[::-1])
        image = bpy.data.images.new(name, rgba.shape[1], rgba.shape[0])
        image.pixels.foreach_set(rgba.ravel())
        image.pack()
        tree = shader_builder(material)
        texture = tree.add("ShaderNodeTexImage", image=image, extension="EXTEND")
        _glow(tree, texture.outputs["Color"])

    return shared_material(name, __file__, build)


def set_ink(brightness: float = _INK) -> None:
    """Colours the numbers and the scale bar: light before the viewport's dark grey, dark before a light backdrop."""
    material = _ink_material()
    glow = next(n for n in material.node_tree.nodes if n.bl_idname == "ShaderNodeEmission")
    glow.inputs["Color"].default_value = material.diffuse_color = (*[brightness] * 3, 1.0)


def _ink_material() -> bpy.types.Material:
    def build(material: bpy.types.Material) -> None:
        material.diffuse_color = (*[_INK] * 3, 1.0)
        _glow(shader_builder(material), material.diffuse_color)

    return shared_material(f"{NAME} Text", __file__, build)


def _glow(tree: TreeBuilder, color: bpy.types.NodeSocket | Sequence[float]) -> None:
    glow = tree.add("ShaderNodeEmission", {"Color": color})
    tree.add("ShaderNodeOutputMaterial", {"Surface": glow.outputs[0]})
