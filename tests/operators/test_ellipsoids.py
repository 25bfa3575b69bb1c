"""How the model is shown, and which splats are ellipsoids, as a script or a button asks for it."""

from __future__ import annotations

import bpy
import numpy as np
import pytest

from insideout.insideout_addon.scene.display import display_modifier
from insideout.insideout_addon.scene.node_tree import modifier_input, set_modifier_input
from insideout.insideout_addon.scene.showing import chosen, shown_as
from insideout.panels.model import INSIDEOUT_PT_model


@pytest.fixture
def model(blender, tmp_path, random_set):
    random_set.save(tmp_path / "fused.ply")
    bpy.ops.insideout.import_run(filepath=str(tmp_path / "fused.ply"))
    return bpy.context.scene.insideout.model


@pytest.fixture
def select(model):
    """`select(which)`: selects points in Edit Mode, as the user's mouse does; the model stays in Edit Mode."""

    def choose(which):
        bpy.context.view_layer.objects.active = model
        bpy.ops.object.mode_set(mode="EDIT")
        bpy.ops.pointcloud.select_all(action="DESELECT")
        model.data.attributes[".selection"].data.foreach_set("value", np.ascontiguousarray(which, bool))

    return choose


def _instances(model):
    depsgraph = bpy.context.evaluated_depsgraph_get()
    depsgraph.update()
    geometry = model.evaluated_get(depsgraph).evaluated_geometry()
    instances = geometry.instances_pointcloud()
    return len(instances.points) if instances else 0


def test_a_large_model_is_imported_mixed(blender, tmp_path, random_set, monkeypatch):
    for name, count in (("AUTOMATIC_ELLIPSOIDS", 100), ("MOST_ELLIPSOIDS", 60)):
        monkeypatch.setattr(f"insideout.insideout_addon.scene.memory.{name}", count)
    random_set.save(tmp_path / "fused.ply")
    bpy.ops.insideout.import_run(filepath=str(tmp_path / "fused.ply"))
    model = bpy.context.scene.insideout.model
    assert shown_as(model) == "MIXED"
    set_modifier_input(display_modifier(model), "Ellipsoids at Most", 60)
    assert 58 <= _instances(model) <= 60


@pytest.mark.parametrize("display", ["POINTS", "ELLIPSOIDS", "MIXED"])
def test_the_model_is_shown_as_asked_for(model, display):
    assert bpy.ops.insideout.show_as(display=display) == {"FINISHED"}
    assert shown_as(model) == display


def test_there_must_be_a_model(blender):
    for name in ("show_as", "ellipsoids_selected", "ellipsoids_box"):
        assert not getattr(bpy.ops.insideout, name).poll()


class TestSelected:
    def test_something_must_have_been_selected_once(self, model):
        assert not bpy.ops.insideout.ellipsoids_selected.poll()

    def test_selected_splats_are_ellipsoids(self, model, select):
        which = np.arange(200) % 10 == 0
        select(which)
        bpy.ops.insideout.ellipsoids_selected()
        assert shown_as(model) == "MIXED"
        np.testing.assert_array_equal(chosen(model), which)
        bpy.ops.object.mode_set(mode="OBJECT")
        set_modifier_input(display_modifier(model), "Large From", 1e9)
        set_modifier_input(display_modifier(model), "Minimum Opacity", 0.0)
        set_modifier_input(display_modifier(model), "Minimum Density", 0.0)
        assert _instances(model) == 20

    def test_others_can_be_added(self, model, select):
        select(np.arange(200) < 5)
        bpy.ops.insideout.ellipsoids_selected()
        select(np.arange(200) >= 190)
        bpy.ops.insideout.ellipsoids_selected(extend=True)
        assert chosen(model).sum() == 15

    def test_all_selected_is_told_by_nothing(self, model, select):
        """Blender takes the attribute away when everything is selected."""
        select(np.arange(200) < 5)
        model.data.attributes.remove(model.data.attributes[".selection"])
        bpy.ops.insideout.ellipsoids_selected()
        assert chosen(model).all()

    def test_none_selected_forgets_them(self, model, select):
        for which in (np.ones(200), np.zeros(200)):
            select(which)
            bpy.ops.insideout.ellipsoids_selected()
        assert not chosen(model).any()

    def test_who_chooses_too_many_is_told(self, model, select, capfd):
        bpy.ops.insideout.show_as(display="MIXED")
        set_modifier_input(display_modifier(model), "Ellipsoids at Most", 10)
        select(np.arange(200) < 30)
        bpy.ops.insideout.ellipsoids_selected()
        assert (
            "30 splats chosen, only the 10 largest are ellipsoids; raise Ellipsoids at Most" in capfd.readouterr().out
        )


def test_a_box_is_added_chosen_and_found_again(model):
    for _ in range(2):
        assert bpy.ops.insideout.ellipsoids_box() == {"FINISHED"}
    box = bpy.context.view_layer.objects.active
    assert [thing.name for thing in bpy.data.objects if thing.type == "EMPTY"] == [box.name]
    assert box.select_get()
    assert not model.select_get()
    assert modifier_input(display_modifier(model), "Box") == box
    assert _instances(model) > 0


def test_the_sidebar_offers_what_mixed_models_need(model, draw_panels):
    wanted = {"Ellipsoids at Most", "Ellipsoids in Box", "Ellipsoids for Selected"}
    texts = draw_panels(classes=[INSIDEOUT_PT_model])
    assert "Shown as Ellipsoids" in texts
    assert not wanted & set(texts)
    bpy.ops.insideout.show_as(display="MIXED")
    texts = draw_panels(classes=[INSIDEOUT_PT_model])
    assert "Shown as Mixed" in texts
    assert wanted <= set(texts)
