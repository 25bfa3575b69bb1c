"""Files from before there were several sections: what one plane was is taken over as a section."""

from __future__ import annotations

import bpy

from .color_bar import NAME as COLOR_BAR
from .display import display_modifier, renew_display
from .node_tree import input_names, modifier_input, set_modifier_input
from .section import SIZE_KEY
from .section_cut import apply_cuts
from .splats import in_scene, is_splats, shown_model


def take_over() -> None:
    """Brings the file's displays of splats up to date, and lists the planes by which they were cut as sections."""
    for splats in [thing for thing in bpy.data.objects if is_splats(thing) and thing.is_editable]:
        display = display_modifier(splats)
        if display is None or "Section" not in input_names(display.node_group):
            continue
        old = {name: modifier_input(display, name) for name in input_names(display.node_group) - {"Geometry"}}
        renew_display(display)
        set_modifier_input(display, "Cut", False)
        for scene in bpy.data.scenes:
            if shown_model(scene) == splats and in_scene(old["Section"], scene) and SIZE_KEY in old["Section"]:
                _list(scene, old)


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
