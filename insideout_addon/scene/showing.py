"""How a model is shown: as points, as ellipsoids, or both, and which of its splats are ellipsoids then."""

from __future__ import annotations

import bpy
import numpy as np
from mathutils import Matrix, Vector

from .display import display_modifier, show_splats
from .linking import open_collection
from .memory import chosen_display
from .mixing import CHOSEN
from .native import draws_splats, make_native
from .node_tree import input_names, modifier_input, set_modifier_input
from .section import turned_box
from .splats import read_density, renew_base, require_editable
from .standing import place_in_world

BOX_NAME = "InsideOut Ellipsoids"
# Where Blender keeps which points are selected in Edit Mode; where it is not there all are.
_SELECTION = ".selection"
_VERY_LARGE = 1e9


def show_as(splats: bpy.types.Object, display: str) -> bpy.types.NodesModifier:
    """Shows splats in one of the ways of `chosen_display`; what the user has set for mixed ones stays.

    Args:
        display: "AUTOMATIC", "POINTS", "ELLIPSOIDS" or "MIXED".

    Raises:
        SettingError: the model is linked from another file, and would be shown as before when this one is opened again.
    """
    require_editable(splats)
    chosen = chosen_display(display, len(splats.data.points))
    modifier = show_splats(splats, chosen != "POINTS", chosen == "MIXED")
    renew_base(splats.data)
    make_native(splats.data)
    if chosen == "MIXED" and modifier_input(modifier, "Large From") == 0:
        most = modifier_input(modifier, "Ellipsoids at Most")
        # Blender's own splats are ellipsoids already.
        size = _VERY_LARGE if draws_splats() else _large_from(splats, most)
        set_modifier_input(modifier, "Large From", size)
    return modifier


def shown_as(splats: bpy.types.Object) -> str:
    """ "POINTS", "ELLIPSOIDS" or "MIXED"; "" of splats without a display of this version."""
    modifier = display_modifier(splats)
    try:
        if modifier is None or not modifier_input(modifier, "Ellipsoids"):
            return "" if modifier is None else "POINTS"
        return "MIXED" if modifier_input(modifier, "Mixed") else "ELLIPSOIDS"
    except KeyError:
        return ""


def has_selection(splats: bpy.types.Object) -> bool:
    """Whether the user has selected points in Edit Mode, now or before."""
    return splats.mode == "EDIT" or _SELECTION in splats.data.attributes


def choose_selected(splats: bpy.types.Object, extend: bool = False) -> int:
    """Makes the points selected in Edit Mode ellipsoids, whatever else is; none selected: none chosen any more.

    Args:
        extend: keeps those that were chosen before.

    Returns:
        How many are chosen.

    Raises:
        SettingError: as `choose`.
    """
    found = splats.data.attributes.get(_SELECTION)
    selected = np.ones(len(splats.data.points), bool)
    if found is not None:
        found.data.foreach_get("value", selected)
    return choose(splats, selected | chosen(splats) if extend else selected)


def choose(splats: bpy.types.Object, which: np.ndarray) -> int:
    """Makes splats ellipsoids, the first ones where there is no room for all; shows the model as mixed.

    Args:
        which: (N,) bool.

    Returns:
        How many.

    Raises:
        SettingError: the model, or its splats, are linked from another file.
    """
    for block in (splats, splats.data):
        require_editable(block)
    attributes = splats.data.attributes
    layer = attributes.get(CHOSEN) or attributes.new(CHOSEN, "BOOLEAN", "POINT")
    layer.data.foreach_set("value", np.ascontiguousarray(which, bool))
    splats.data.update_tag()
    show_as(splats, "MIXED")
    return int(np.count_nonzero(which))


def chosen(splats: bpy.types.Object) -> np.ndarray:
    """(N,) bool: the splats that `choose` has chosen."""
    which = np.zeros(len(splats.data.points), bool)
    if CHOSEN in splats.data.attributes:
        splats.data.attributes[CHOSEN].data.foreach_get("value", which)
    return which


def add_box(splats: bpy.types.Object, context: bpy.types.Context) -> bpy.types.Object:
    """The box in which splats are ellipsoids, half as long as the model if it is new; shows the model as mixed.

    Raises:
        DamagedSplatsError: an attribute is missing, or of another type.
        SettingError: as `show_as`.
    """
    modifier = show_as(splats, "MIXED")
    box = modifier_input(modifier, "Box")
    if box is not None and box.name in context.scene.objects:
        return box
    place, turn, scale = place_in_world(splats).decompose()
    low, high = turned_box(read_density(splats), turn)
    box = bpy.data.objects.new(BOX_NAME, None)
    box.empty_display_type, box.empty_display_size = "CUBE", 1.0
    inside = Matrix.LocRotScale(Vector(0.5 * (low + high)), None, Vector(0.25 * (high - low)))
    box.matrix_world = Matrix.LocRotScale(place, None, scale) @ inside
    open_collection(context).objects.link(box)
    set_modifier_input(modifier, "Box", box)
    return box


def deleted_boxes() -> list[tuple[bpy.types.Object, bpy.types.Object]]:
    """(model, its box) where the box is in no collection any more, and chooses splats there still; one of another file
    may never have been in any here."""
    models = [thing for thing in bpy.data.objects if thing.type == "POINTCLOUD" and thing.is_editable]
    pairs = [(model, box) for model in models if (box := _box(model)) is not None]
    return [(model, box) for model, box in pairs if box.library is None and not box.users_collection]


def use_box(splats: bpy.types.Object, box: bpy.types.Object | None) -> None:
    """Lets a box choose splats where none does, or none any more."""
    modifier = display_modifier(splats)
    if modifier is not None and (box is None or _box(splats) is None):
        set_modifier_input(modifier, "Box", box)


def _box(splats: bpy.types.Object) -> bpy.types.Object | None:
    modifier = display_modifier(splats)
    if modifier is None or "Box" not in input_names(modifier.node_group):
        return None
    return modifier_input(modifier, "Box")


def _large_from(splats: bpy.types.Object, most: int) -> float:
    """The size, mm, of the last of the `most` largest splats; 0 where there are no more than that."""
    radius = np.empty(len(splats.data.points), np.float32)
    splats.data.attributes["radius"].data.foreach_get("value", radius)
    return float(np.partition(radius, -most)[-most]) if 0 < most < len(radius) else 0.0
