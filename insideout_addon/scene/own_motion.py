"""Whether an object is placed by something other than the user's hand."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import bpy

# What of an object's own makes up its place; "delta_" may stand before each.
_PLACE = ("location", "rotation_euler", "rotation_quaternion", "rotation_axis_angle", "scale")


def moves_by_itself(thing: bpy.types.Object) -> bool:
    """Whether constraints, keyframes or drivers of its own say where an object is; not whether its parent's do."""
    if any(not constraint.mute and constraint.influence > 0 for constraint in thing.constraints):
        return True
    animation = thing.animation_data
    if animation is None:
        return False
    strips = [strip for track in animation.nla_tracks if not track.mute for strip in _played(track.strips)]
    curves = [*animation.drivers, *(curve for owner in (animation, *strips) for curve in _curves(owner))]
    return any(curve.data_path.removeprefix("delta_") in _PLACE and not curve.mute for curve in curves)


def _played(strips: Iterable[bpy.types.NlaStrip]) -> Iterator[bpy.types.NlaStrip]:
    """Those that are not muted, and what lies in strips of strips."""
    for strip in strips:
        if not strip.mute:
            yield strip
            yield from _played(strip.strips)


def _curves(owner: bpy.types.AnimData | bpy.types.NlaStrip) -> list[bpy.types.FCurve]:
    """Those of its action that are of this object: others may have theirs in the same one."""
    if owner.action is None or owner.action_slot is None:
        return []
    bags = [strip.channelbag(owner.action_slot) for layer in owner.action.layers for strip in layer.strips]
    return [curve for bag in bags if bag is not None for curve in bag.fcurves]
