"""What the user deletes with X is gone, whatever of the add-on's still points at it; and undo brings it back."""

from __future__ import annotations

import bpy
import numpy as np
import pytest

from insideout.core.gaussians import GaussianSet, Modality
from insideout.insideout_addon import deleted
from insideout.insideout_addon.physics.soft import SoftOptions, make_soft
from insideout.insideout_addon.physics.world import bodies_of, is_floor
from insideout.insideout_addon.scene.display import display_modifier
from insideout.insideout_addon.scene.importing import import_splats
from insideout.insideout_addon.scene.node_tree import KIND_KEY, modifier_input
from insideout.insideout_addon.scene.showing import add_box
from insideout.insideout_addon.scene.splats import read_splats, shown_model

SPLATS = 20_000


@pytest.fixture
def model(blender, tmp_path):
    rng = np.random.default_rng(0)
    places = rng.normal(0, 8.0, (SPLATS, 3))
    gaussians = GaussianSet.create(places, 1.0, density=0.04, modality=Modality.XRAY, opacities=0.9)
    gaussians.save(tmp_path / "fused.ply")
    return import_splats(tmp_path / "fused.ply", "model", bpy.context)


def delete(thing):
    """As X does, and as steps of the history are made."""
    bpy.context.view_layer.update()
    for other in bpy.context.view_layer.objects:
        other.select_set(other == thing)
    bpy.context.view_layer.objects.active = thing
    # What a step has changed is put back whole; here nothing but the deletion is in the last one.
    for message in ("here", "before"):
        bpy.ops.ed.undo_push(message=message)
    # Blender tells what has changed after it has noted the step.
    handlers = bpy.app.handlers.depsgraph_update_post
    before = handlers[:]
    handlers.clear()
    bpy.ops.object.delete()
    bpy.ops.ed.undo_push(message="deleted")
    handlers.extend(before)
    bpy.context.view_layer.layer_collection.collection.update_tag()
    bpy.context.view_layer.update()


def box_of(model):
    return modifier_input(display_modifier(model), "Box")


def save(path):
    bpy.ops.wm.save_as_mainfile(filepath=str(path), compress=False)
    return path.stat().st_size


class TestBox:
    def test_it_chooses_no_splats_any_more(self, model):
        add_box(model, bpy.context)
        delete(box_of(model))
        assert box_of(model) is None

    def test_undo_and_redo(self, model):
        name = add_box(model, bpy.context).name
        delete(box_of(model))
        for _ in range(2):
            bpy.ops.ed.undo()
            model = bpy.context.scene.insideout.model
            assert box_of(model) == bpy.context.scene.objects[name]
            bpy.ops.ed.redo()
            model = bpy.context.scene.insideout.model
            assert box_of(model) is None
            assert name not in bpy.context.scene.objects

    def test_one_that_was_made_since_stays_until_it_is_undone(self, model):
        first = add_box(model, bpy.context)
        first.name = "First"
        delete(first)
        add_box(model, bpy.context).name = "Second"
        bpy.ops.ed.undo_push(message="second box")
        delete(box_of(model))
        bpy.ops.ed.undo()
        model = bpy.context.scene.insideout.model
        assert box_of(model).name == "Second"
        for _ in range(4):
            bpy.ops.ed.undo()
        model = bpy.context.scene.insideout.model
        assert box_of(model).name == "First"
        assert "Second" not in bpy.context.scene.objects

    def test_one_that_the_user_takes_out_himself_stays_out(self, model):
        box = add_box(model, bpy.context)
        deleted.use_box(model, None)
        cube = bpy.data.objects.new("Cube", None)
        bpy.context.collection.objects.link(cube)
        delete(cube)
        bpy.ops.ed.undo()
        assert box.name in bpy.context.scene.objects
        assert box_of(bpy.context.scene.insideout.model) is None

    def test_in_another_scene_it_is_still_there(self, model):
        box = add_box(model, bpy.context)
        bpy.data.scenes.new("Other").collection.objects.link(box)
        delete(box)
        assert box_of(model) == box


class TestCollider:
    @pytest.fixture
    def falling(self, model):
        """(cage, floor, collection of what is fallen onto)."""
        cage = make_soft(model, bpy.context, SoftOptions(resolution=3, drop_mm=20.0))
        floor = next(thing for thing in bodies_of(bpy.context.scene) if is_floor(thing))
        (colliders,) = (each for each in bpy.data.collections if each.name.endswith(" Colliders"))
        assert list(colliders.objects) == [floor]
        return cage, floor, colliders

    def test_a_deleted_floor_holds_nothing(self, falling):
        cage, floor, colliders = falling
        delete(floor)
        assert len(colliders.objects) == 0

        def height(frame):
            bpy.context.scene.frame_set(frame)
            shown = cage.evaluated_get(bpy.context.evaluated_depsgraph_get())
            return min(vertex.co.z for vertex in shown.data.vertices)

        fallen = height(1)
        for frame in range(2, 16):
            last = height(frame)
        # g·t²/2; the floor was 20 mm below.
        assert fallen - last == pytest.approx(9810 / 2 * (14 / 24) ** 2, rel=0.1)

    def test_undo_and_redo(self, falling):
        _, floor, colliders = falling
        name, within = floor.name, colliders.name
        delete(floor)
        for _ in range(2):
            bpy.ops.ed.undo()
            floor = bpy.context.scene.objects[name]
            assert list(bpy.data.collections[within].objects) == [floor]
            bpy.ops.ed.redo()
            assert len(bpy.data.collections[within].objects) == 0

    def test_one_that_is_only_hidden_stays(self, falling):
        _, floor, colliders = falling
        floor.hide_viewport = True
        bpy.context.view_layer.update()
        assert list(colliders.objects) == [floor]


class TestModel:
    def test_it_is_not_saved(self, model, tmp_path):
        before = save(tmp_path / "a.blend")
        delete(model)
        after = save(tmp_path / "a.blend")
        assert after < before - 50 * SPLATS
        bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
        assert bpy.context.scene.insideout.model is None
        assert sum(len(cloud.points) for cloud in bpy.data.pointclouds) == 0

    @pytest.mark.parametrize("saved", [0, 1, 2])
    def test_undo_brings_it_back_after_saving_too(self, model, tmp_path, saved):
        expected = read_splats(model).means
        ruler = bpy.data.objects.new("ruler", None)
        bpy.context.collection.objects.link(ruler)
        ruler.parent = model
        delete(model)
        bpy.context.scene.objects["ruler"].location.x = 3
        bpy.ops.ed.undo_push(message="moved")
        for _ in range(saved):
            save(tmp_path / "a.blend")
        assert len(bpy.data.pointclouds) == 1
        bpy.ops.ed.undo()
        bpy.ops.ed.undo()
        scene = bpy.context.scene
        model = shown_model(scene)
        assert model.name == "model"
        np.testing.assert_array_equal(read_splats(model).means, expected)
        assert display_modifier(model).node_group[KIND_KEY] == "InsideOut Splats"
        assert scene.objects["ruler"].parent == model
        save(tmp_path / "b.blend")
        bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "b.blend"))
        assert len(read_splats(shown_model(bpy.context.scene))) == SPLATS

    def test_saving_moves_nothing_that_hangs_on_it(self, model, tmp_path):
        ruler = bpy.data.objects.new("ruler", None)
        bpy.context.collection.objects.link(ruler)
        ruler.parent, model.location.x = model, 50
        delete(model)
        before = ruler.matrix_world.copy()
        save(tmp_path / "a.blend")
        bpy.context.view_layer.update()
        assert ruler.matrix_world == before
        bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
        np.testing.assert_allclose(bpy.data.objects["ruler"].matrix_world.translation, (50, 0, 0), atol=1e-4)

    def test_one_that_is_in_another_scene_or_has_a_fake_user_is_saved(self, model, tmp_path):
        model.use_fake_user = True
        delete(model)
        save(tmp_path / "a.blend")
        assert bpy.context.scene.insideout.model is None
        assert len(model.data.points) == SPLATS
        bpy.data.scenes.new("Other").collection.objects.link(model)
        bpy.context.scene.insideout.model = model
        save(tmp_path / "a.blend")
        assert bpy.context.scene.insideout.model == model
        bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
        assert len(bpy.data.objects["model"].data.points) == SPLATS

    def test_a_file_that_cannot_be_written_changes_nothing(self, model, tmp_path):
        delete(model)
        with pytest.raises(RuntimeError):
            save(tmp_path / "nowhere" / "a.blend")
        assert len(model.data.points) == SPLATS
        assert len(bpy.data.pointclouds) == 1
