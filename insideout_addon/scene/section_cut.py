"""Sections cut the model: a modifier for each, before the one that displays the splats."""

from __future__ import annotations

import bpy

from .cut_slots import HEIGHTS, SLOTS
from .cutting import GROUP, cut_group
from .display import display_modifier
from .node_tree import is_of_kind, modifier_input, set_modifier_input
from .section import shown_sections
from .splats import is_splats, shown_model


def apply_cuts(scene: bpy.types.Scene) -> None:
    """Brings the modifiers of all splats of a scene in line with the sections.

    A model is cut by the sections of all scenes whose model it is; other splats are whole again. Those that are linked
    from another file stay as they are there.
    """
    for splats in [thing for thing in scene.objects if is_splats(thing) and thing.is_editable]:
        wanted = [section for other in bpy.data.scenes for section in _cutting(other, splats)]
        if wanted or cut_modifiers(splats):
            _apply(splats, _once(wanted))


def cut_modifiers(splats: bpy.types.Object) -> list[bpy.types.NodesModifier]:
    """The modifiers by which sections cut splats."""
    return [modifier for modifier in splats.modifiers if is_of_kind(modifier, GROUP)]


def hides_whole_splats(splats: bpy.types.Object, section: bpy.types.PropertyGroup) -> bool:
    """Whether a section found no place among the cuts that splats can be closed at, so that it hides whole ones."""
    return any(
        modifier_input(modifier, "Section") == section.object and modifier_input(modifier, "Slot") < 0
        for modifier in cut_modifiers(splats)
    )


def _cutting(scene: bpy.types.Scene, splats: bpy.types.Object) -> list[bpy.types.PropertyGroup]:
    if shown_model(scene) != splats:
        return []
    return [section for section in shown_sections(scene) if section.cut]


def _once(wanted: list[bpy.types.PropertyGroup]) -> list[bpy.types.PropertyGroup]:
    """The first section of each plane or box: scenes made by Linked Copy share theirs."""
    first: dict[bpy.types.Object, bpy.types.PropertyGroup] = {}
    for section in wanted:
        first.setdefault(section.object, section)
    return list(first.values())


def _apply(splats: bpy.types.Object, wanted: list[bpy.types.PropertyGroup]) -> None:
    display = display_modifier(splats)
    if display is None:
        return
    kept = {section.object for section in wanted}
    by_object = {}
    for modifier in cut_modifiers(splats):
        thing = modifier_input(modifier, "Section")
        if thing in kept and thing not in by_object:
            by_object[thing] = modifier
        else:
            splats.modifiers.remove(modifier)
    own = _own_slots(splats)
    slot = own
    for section in wanted:
        modifier = by_object.get(section.object) or _new_modifier(splats, section)
        needed = _slots_needed(section)
        place = slot if slot + needed <= SLOTS else -1
        slot += needed if place >= 0 else 0
        inputs = {
            "Box": section.shape == "BOX",
            "Flip": section.flip,
            "Slab": section.slab_mm,
            "Apart": section.apart_mm if section.shape == "PLANE" else 0.0,
            "Slot": place,
        }
        for name, value in inputs.items():
            if modifier_input(modifier, name) != value:
                set_modifier_input(modifier, name, value)
    cut = bool(wanted) or own > 0
    if modifier_input(display, "Cut") != cut:
        set_modifier_input(display, "Cut", cut)


def _own_slots(splats: bpy.types.Object) -> int:
    """How many slots the splats bring along, as the pieces of a broken model do."""
    return sum(name in splats.data.attributes for name in HEIGHTS)


def _slots_needed(section: bpy.types.PropertyGroup) -> int:
    if section.shape == "BOX":
        return 1 if section.flip else 3
    return 2 if section.slab_mm > 0 else 1


def _new_modifier(splats: bpy.types.Object, section: bpy.types.PropertyGroup) -> bpy.types.NodesModifier:
    modifier = splats.modifiers.new(section.object.name, "NODES")
    modifier.node_group = cut_group()
    modifier.show_expanded = False
    set_modifier_input(modifier, "Section", section.object)
    display = display_modifier(splats)
    splats.modifiers.move(len(splats.modifiers) - 1, splats.modifiers.find(display.name))
    return modifier
