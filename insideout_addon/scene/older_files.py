"""Files from before there were several sections, or pictures on boxes: they look as they did."""

from __future__ import annotations

import bpy

from .color_bar import NAME as COLOR_BAR
from .display import display_modifier, renew_display
from .node_tree import input_names, set_modifier_input
from .section import SIZE_KEY, shown_sections
from .section_box import box_pictures
from .section_cut import apply_cuts
from .splats import in_scene, is_splats, shown_model, shows_density


def take_over() -> None:
    """Brings the file's displays of splats up to date, and lists the planes by which they were cut as sections.

    Boxes of before they had pictures get none.
    """
    for splats in [thing for thing in bpy.data.objects if is_splats(thing) and thing.is_editable]:
        display = display_modifier(splats)
        if display is None or "Section" not in input_names(display.node_group):
            continue
        old = renew_display(display)
        set_modifier_input(display, "Cut", False)
        for scene in bpy.data.scenes:
            if shown_model(scene) == splats and in_scene(old["Section"], scene) and SIZE_KEY in old["Section"]:
                _list(scene, old)
    for scene in bpy.data.scenes:
        if scene.is_editable and not scene.insideout.is_property_set("high"):
            _leave_boxes_bare(scene)


def _list(scene: bpy.types.Scene, old: dict) -> None:
    plane = old["Section"]
    section = scene.insideout.sections.add()
    section.object, section.shape = plane, "PLANE"
    section.cut, section.flip, section.slab_mm = bool(old.get("Cut", True)), bool(old.get("Flip")), old.get("Slab", 0.0)
    for part in plane.children:
        # Its parts were known by their order; new ones are made with the next picture.
        if part.name.startswith(COLOR_BAR):
            bpy.data.objects.remove(part)
    apply_cuts(scene)


def _leave_boxes_bare(scene: bpy.types.Scene) -> None:
    """No window was found for them, so that pictures would be of a made-up one, in renderings too."""
    model = shown_model(scene)
    if model is None or not shows_density(model):
        return
    for section in shown_sections(scene):
        if section.shape == "BOX" and section.show_density and box_pictures(section.object) is None:
            section.show_density = False
