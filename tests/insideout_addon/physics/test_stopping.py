"""Breaking, softening, weighing and making rigid, ended between any two steps: the file is as it was."""

from __future__ import annotations

import bpy
import numpy as np
import pytest

from insideout.core.mesh.density_map import curve_of_materials
from insideout.insideout_addon.physics import hulls
from insideout.insideout_addon.physics.breaking import BreakOptions, break_in_steps, pieces_of
from insideout.insideout_addon.physics.soft import SoftOptions, make_soft_in_steps
from insideout.insideout_addon.physics.whole import rigid_in_steps
from insideout.insideout_addon.scene.splats import read_splats
from insideout.insideout_addon.scene.weighing import kept_weight, weigh_model_in_steps

FACTOR = 50.0
# Lists of a file that something may be left in.
KINDS = (
    *("objects", "meshes", "pointclouds", "scenes", "collections", "materials", "node_groups", "actions"),
    *("shape_keys", "images", "texts"),
)


@pytest.fixture
def model(imported, hollow_ball):
    """Selected and active beside a cube of the user's, which is selected."""
    found = imported(*hollow_ball)
    bpy.ops.mesh.primitive_cube_add()
    cube = bpy.context.object
    for thing in (found, cube):
        thing.select_set(True)
    bpy.context.view_layer.objects.active = found
    return found


def facts(model):
    scene, layer = bpy.context.scene, bpy.context.view_layer
    return {
        **{kind: sorted(block.name for block in getattr(bpy.data, kind)) for kind in KINDS},
        "keys": sorted(map(str, [*scene.keys(), *model.keys()])),
        "attributes": sorted(model.data.attributes.keys()),
        "modifiers": [modifier.name for modifier in model.modifiers],
        "hidden": (model.hide_viewport, model.hide_render, model.parent),
        "selected": sorted(thing.name for thing in layer.objects if thing.select_get()),
        "active": layer.objects.active.name,
        "collection": layer.active_layer_collection.name,
        "gravity": tuple(scene.gravity),
        "world": scene.rigidbody_world is not None,
    }


def breaking(model):
    return break_in_steps(
        model, bpy.context, BreakOptions(pieces=4, spacing_mm=3.0, g_cm3_per_mm_inv=FACTOR, show="SPLATS")
    )


def softening(model):
    return make_soft_in_steps(model, bpy.context, SoftOptions(resolution=4, g_cm3_per_mm_inv=FACTOR))


def weighing(model):
    return weigh_model_in_steps(model, curve_of_materials(["PMMA"], 60), edge_mm_inv=0.02, voxels=24)


def making_rigid(model):
    return rigid_in_steps(model, bpy.context.scene, FACTOR)


@pytest.mark.parametrize("work", [breaking, softening, weighing, making_rigid])
def test_ended_between_any_two_steps_nothing_is_changed(model, work, monkeypatch):
    # That of so few points is made at once.
    monkeypatch.setattr(hulls, "_AT_A_TIME", 1000)
    before, splats = facts(model), read_splats(model)
    for count in range(1, 1000):
        steps, shares = work(model), []
        try:
            for _ in range(count):
                shares.append(next(steps))
        except StopIteration:
            break
        steps.close()
        assert facts(model) == before, f"after {count} steps"
        assert shares == sorted(shares)
        assert 0 <= min(shares) <= max(shares) <= 1
    assert count > 4
    assert len(shares) == count - 1
    np.testing.assert_array_equal(read_splats(model).means, splats.means)


def test_between_steps_there_is_no_scene_but_the_user_s(model):
    """Blender draws its menu of scenes then, and may save the file."""
    for _ in breaking(model):
        assert list(bpy.data.scenes) == [bpy.context.scene]
        # What nobody uses is not saved.
        assert not any(thing.users for thing in bpy.data.objects if thing.name.startswith("InsideOut Break"))


def test_breaking_has_a_step_for_each_cell_wall_and_piece(model):
    """So that Esc does not wait for all of them."""
    steps, count = breaking(model), 0
    for _ in steps:
        count += 1
    pieces = len(pieces_of(bpy.context.scene, model))
    assert count >= 3 * 4 + pieces


def test_weighing_by_materials_has_many(model):
    count = sum(1 for _ in weighing(model))
    assert count > 12
    assert kept_weight(model) is not None


@pytest.mark.parametrize("active", [False, True])
def test_what_was_selected_may_be_deleted_meanwhile(model, active):
    """In another window."""
    cube = bpy.data.objects["Cube"]
    if active:
        bpy.context.view_layer.objects.active = cube
    steps = breaking(model)
    while not pieces_of(bpy.context.scene, model):
        next(steps)
    bpy.data.objects.remove(cube)
    steps.close()
    assert pieces_of(bpy.context.scene, model) == []
    assert [thing.name for thing in bpy.context.view_layer.objects if thing.select_get()] == [model.name]
    assert bpy.context.view_layer.objects.active == (None if active else model)


def test_an_error_among_the_last_steps_leaves_nothing_either(model, monkeypatch):
    from insideout.insideout_addon.physics import breaking as module

    def fail(*_):
        raise MemoryError

    before = facts(model)
    monkeypatch.setattr(module, "add_floor", fail)
    with pytest.raises(MemoryError):
        for _ in breaking(model):
            pass
    assert facts(model) == before
