"""The colour bar beside a section plane: a strip and its numbers in mm⁻¹, parented to the plane."""

from __future__ import annotations

import bpy
import numpy as np

from .node_tree import TreeBuilder, shader_builder
from .section_image import UNIT, Window, bar_rgba, ticks

NAME = "InsideOut Colour Bar"
# In parts of the plane's size.
_GAP, _BOTTOM, _WIDTH, _HEIGHT, _TEXT = 0.07, -0.33, 0.035, 0.66, 0.036
# How far the model reaches to the right on the plane, when the plane was made; mm.
REACH_KEY = "insideout_reach_mm"
# On each part: "strip", "unit" or the number of the label.
_PART_KEY = "insideout_bar"


def update_color_bar(plane: bpy.types.Object, size: float, window: Window) -> None:
    """Writes the window's numbers on the bar of a plane of this size; makes the bar anew where it is not complete."""
    if not plane.users_collection:
        return
    texts = [text for _, text in ticks(window)]
    parts = {part[_PART_KEY]: part for part in bar_parts(plane) if part.users_collection}
    if set(parts) != {"strip", "unit", *range(len(texts))}:
        remove_color_bar(plane)
        parts = _create(plane, size)
    for index, text in enumerate(texts):
        if parts[index].data.body != text:
            parts[index].data.body = text


def bar_parts(plane: bpy.types.Object) -> list[bpy.types.Object]:
    """The objects of a plane's bar."""
    return [child for child in plane.children if _PART_KEY in child]


def remove_color_bar(plane: bpy.types.Object) -> None:
    """Deletes what is there of a plane's bar."""
    data = [part.data for part in bar_parts(plane)]
    # With their data an object goes too.
    bpy.data.batch_remove(data)


def _create(plane: bpy.types.Object, size: float) -> dict[str | int, bpy.types.Object]:
    """The parts by name, the labels by their number from below."""
    collection = plane.users_collection[0]
    left, bottom = float(plane[REACH_KEY]) + _GAP * size, _BOTTOM * size
    mesh = bpy.data.meshes.new(NAME)
    right, top = left + _WIDTH * size, bottom + _HEIGHT * size
    mesh.from_pydata([(left, bottom, 0), (right, bottom, 0), (right, top, 0), (left, top, 0)], [], [(0, 1, 2, 3)])
    mesh.uv_layers.new(name="UVMap").data.foreach_set("uv", [0, 0, 1, 0, 1, 1, 0, 1])
    mesh.materials.append(_bar_material())
    parts: dict[str | int, bpy.types.Object] = {"strip": bpy.data.objects.new(NAME, mesh)}
    for index, (place, _) in enumerate(ticks(Window(0.0, 1.0))):
        parts[index] = _text(size, right + 0.35 * _TEXT * size, bottom + place * (top - bottom))
    parts["unit"] = _text(size, left, top + _TEXT * size)
    parts["unit"].data.body = UNIT
    for name, part in parts.items():
        part[_PART_KEY] = name
        _attach(part, plane, collection)
    return parts


def _text(size: float, x: float, y: float) -> bpy.types.Object:
    curve = bpy.data.curves.new(NAME, "FONT")
    curve.size = _TEXT * size
    curve.align_y = "CENTER"
    curve.materials.append(_ink_material())
    # Moved by its offset, not its location: Blender draws a dashed line from each child's origin to the plane's.
    curve.offset_x, curve.offset_y = x, y
    return bpy.data.objects.new(NAME, curve)


def _attach(part: bpy.types.Object, plane: bpy.types.Object, collection: bpy.types.Collection) -> None:
    collection.objects.link(part)
    part.parent = plane
    part.hide_select = True
    part.visible_shadow = part.visible_diffuse = part.visible_glossy = False


def _bar_material() -> bpy.types.Material:
    material = bpy.data.materials.get(NAME)
    if material is None:
        rgba = np.ascontiguousarray(bar_rgba()[::-1])
        image = bpy.data.images.new(NAME, rgba.shape[1], rgba.shape[0])
        image.pixels.foreach_set(rgba.ravel())
        image.pack()
        material = _emitter(NAME)
        build = TreeBuilder(material.node_tree)
        texture = build.add("ShaderNodeTexImage", image=image, extension="EXTEND")
        glow = next(n for n in material.node_tree.nodes if n.bl_idname == "ShaderNodeEmission")
        build.connect(texture.outputs["Color"], glow.inputs["Color"])
    return material


def set_ink(brightness: float) -> None:
    """Colours the bar's numbers: light before the viewport's dark grey, dark before a light backdrop."""
    material = _ink_material()
    glow = next(n for n in material.node_tree.nodes if n.bl_idname == "ShaderNodeEmission")
    glow.inputs["Color"].default_value = material.diffuse_color = (*[brightness] * 3, 1.0)


def _ink_material() -> bpy.types.Material:
    name = f"{NAME} Text"
    material = bpy.data.materials.get(name)
    if material is None:
        material = _emitter(name)
        set_ink(0.7)
    return material


def _emitter(name: str) -> bpy.types.Material:
    material = bpy.data.materials.new(name)
    build = shader_builder(material)
    glow = build.add("ShaderNodeEmission")
    build.add("ShaderNodeOutputMaterial", {"Surface": glow.outputs[0]})
    return material
