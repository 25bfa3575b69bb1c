"""What the user has deleted, and something of ours still points at: for that alone Blender keeps it, in no scene.

A box would go on choosing splats, a floor be fallen onto, and a model's millions of splats be saved each time. To let
go of it is no step of the user's history, and Blender puts back only what a step has changed: what an undo brings back
is pointed at again here.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import bpy
from bpy.app.handlers import persistent

from .physics.soft import deleted_colliders
from .scene.showing import deleted_boxes, use_box
from .scene.splats import in_scene

# (who pointed, at what) of this file, by `session_uid`.
_Pairs = set[tuple[int, int]]
_boxes: _Pairs = set()
_colliders: _Pairs = set()
# While a file is saved: models that were deleted, and their splats, which stay out of it.
_set_aside: list[tuple[bpy.types.Object, bpy.types.PointCloud]] = []


def attach() -> None:
    """Lets go of what is deleted from now on."""
    for handlers, handler in _handlers():
        handlers.append(handler)


def detach() -> None:
    """Ends it."""
    for handlers, handler in _handlers():
        if handler in handlers:
            handlers.remove(handler)
    _forget()


def _handlers() -> tuple[tuple[list, Callable[..., None]], ...]:
    follow = bpy.app.handlers
    return (
        (follow.depsgraph_update_post, _on_update),
        (follow.undo_post, _on_undone),
        (follow.redo_post, _on_undone),
        (follow.save_pre, _before_save),
        (follow.save_post, _after_save),
        (follow.save_post_fail, _after_save),
        (follow.load_post, _forget),
    )


@persistent
def _on_update(_: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    # With each deletion a collection changes. In a rendering all is new, and nothing may be changed.
    if depsgraph.mode == "VIEWPORT" and depsgraph.id_type_updated("COLLECTION"):
        _let_go()


@persistent
def _on_undone(*_: Any) -> None:
    things = {thing.session_uid: thing for thing in bpy.data.objects}
    for model, box in _back(_boxes, things, things):
        use_box(model, box)
    for collection, thing in _back(_colliders, {each.session_uid: each for each in bpy.data.collections}, things):
        if collection not in thing.users_collection:
            collection.objects.link(thing)
    # A step that was done again.
    _let_go()


def _let_go() -> None:
    for model, box in deleted_boxes():
        _boxes.add((model.session_uid, box.session_uid))
        use_box(model, None)
    for collection, thing in deleted_colliders():
        _colliders.add((collection.session_uid, thing.session_uid))
        collection.objects.unlink(thing)


def _back(pairs: _Pairs, owners: dict[int, Any], things: dict[int, bpy.types.Object]) -> list[tuple[Any, Any]]:
    """Of pairs those that are there again, which are none any more."""
    there = [pair for pair in pairs if pair[0] in owners and _is_in_a_scene(things.get(pair[1]))]
    pairs.difference_update(there)
    return [(owners[owner], things[thing]) for owner, thing in there]


def _is_in_a_scene(thing: bpy.types.Object | None) -> bool:
    return any(in_scene(thing, scene) for scene in bpy.data.scenes)


@persistent
def _before_save(*_: Any) -> None:
    """Leaves models out of the file that are deleted, but not out of memory, where an undo finds them."""
    for scene in bpy.data.scenes:
        model = scene.insideout.model
        # Without their parent those that hang on it would come back elsewhere.
        if model is None or model.users_collection or model.children or not scene.is_editable:
            continue
        # As no model: no picture need be drawn.
        scene.insideout.property_unset("model")
        # What has a fake user, or what a piece belongs to, is wanted.
        if model.users == 0 and model.type == "POINTCLOUD" and model.is_editable:
            _set_aside.append((model, model.data))
            model.data = bpy.data.pointclouds.new(model.data.name)


@persistent
def _after_save(*_: Any) -> None:
    for model, splats in _set_aside:
        with suppress(ReferenceError):
            empty, model.data = model.data, splats
            bpy.data.pointclouds.remove(empty)
    _set_aside.clear()


@persistent
def _forget(*_: Any) -> None:
    for kept in (_boxes, _colliders, _set_aside):
        kept.clear()
