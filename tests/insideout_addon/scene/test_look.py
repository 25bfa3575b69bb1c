"""What of a model is shown: by depth, by density, by what splats are from."""

from __future__ import annotations

from types import SimpleNamespace

import bpy
import numpy as np
import pytest

from insideout.core.gaussians import Modality
from insideout.insideout_addon.scene import display, look
from insideout.insideout_addon.scene.display import display_modifier, show_splats
from insideout.insideout_addon.scene.inside import look_inside
from insideout.insideout_addon.scene.node_tree import input_names, modifier_input, set_modifier_input
from insideout.insideout_addon.scene.splats import (
    DENSITY_HERE,
    DEPTH,
    create_splats,
    read_splats,
    read_values,
    write_values,
)


def test_unpeeled_all_is_shown(shells):
    assert len(shells.shown()) == len(shells)


def test_what_is_less_deep_is_hidden(shells):
    shells.settings.peel_mm = 1.5
    shown = shells.shown()
    assert shells.OUTER - 2.2 < shown.max() < shells.OUTER - 0.9
    shells.settings.peel_mm = 5.0
    assert shells.shown().max() < shells.INNER
    shells.settings.peel_mm = 0.0
    assert len(shells.shown()) == len(shells)


def test_a_layer_is_as_thick_as_it_says(shells):
    shells.settings.peel_mm, shells.settings.peel_layer_mm = 1.0, 1.0
    shown = shells.shown()
    assert shown.min() > shells.OUTER - 2.7
    assert shown.max() < shells.OUTER - 0.4


def test_a_layer_alone_is_the_skin(shells):
    shells.settings.peel_layer_mm = 1.0
    assert shells.OUTER - 1.7 < shells.shown().min() < shells.OUTER - 0.4


def test_a_window_of_densities(shells):
    shells.settings.peel_density_from = 0.8 * shells.DENSITY
    dense = shells.shown()
    assert 0 < len(dense) < shells.are(Modality.XRAY).sum()
    shells.settings.peel_density_from, shells.settings.peel_density_to = 0.0, 0.8 * shells.DENSITY
    thin = shells.shown()
    assert len(dense) + len(thin) == len(shells)
    assert dense.min() < 0.1
    assert thin.min() > shells.INNER - 1.5


def test_a_window_of_densities_can_be_given_in_hounsfield_units(shells):
    """300 mm⁻¹ would hide everything."""
    shells.settings.water, shells.settings.unit = shells.DENSITY, "HU"
    shells.settings.peel_density_from_hu = -200
    assert shells.settings.peel_density_from == pytest.approx(0.8 * shells.DENSITY)
    dense = shells.shown()
    assert 0 < len(dense) < shells.are(Modality.XRAY).sum()
    shells.settings.peel_density_from_hu, shells.settings.peel_density_to_hu = -1000, -200
    assert shells.settings.peel_density_from == 0
    assert len(dense) + len(shells.shown()) == len(shells)
    shells.settings.peel_density_to_hu = -1000
    assert len(shells.shown()) == len(shells)


@pytest.mark.parametrize("unit", ["PER_MM", "HU"])
def test_a_window_of_relative_densities_claims_no_unit(shells, draw_panels, unit):
    shells.model["insideout_warnings"] = "volume.tif: has grey values, so densities are relative"
    shells.settings.unit = unit
    bpy.ops.insideout.look_prepare()
    found = {text for text in draw_panels() if "Dense" in text}
    assert found >= {"Denser Than (relative)", "Less Dense Than (relative)"}
    assert not any(text.endswith(("(HU)", "(mm⁻¹)")) for text in found)


def test_a_window_leaves_the_threshold_of_floaters_alone(shells):
    set_modifier_input(display_modifier(shells.model), "Minimum Density", 0.001)
    shells.settings.peel_density_from = 0.01
    assert modifier_input(display_modifier(shells.model), "Minimum Density") == pytest.approx(0.001)


@pytest.mark.parametrize(("name", "modality"), [("PHOTOS", 0), ("XRAY", 1), ("CLONES", 2)])
def test_by_modality(shells, name, modality):
    shells.settings.modalities = {name}
    assert len(shells.shown()) == shells.are(modality).sum()


def test_ellipsoids_are_peeled_too(shells):
    show_splats(shells.model, ellipsoids=True)
    shells.settings.peel_mm = 5.0
    depsgraph = bpy.context.evaluated_depsgraph_get()
    depsgraph.update()
    places = [i.matrix_world.translation.length for i in depsgraph.object_instances if i.is_instance]
    assert 50 < len(places) < 400
    assert max(places) < shells.INNER


def test_what_is_peeled_may_be_cut_as_well(shells):
    bpy.ops.insideout.section_add()
    shells.settings.peel_mm = 5.0
    shown = shells.shown()
    assert shown.max() < shells.INNER
    assert len(shown) < 0.7 * (shells.radius < shells.INNER).sum()


def test_photos_alone_stay_whole_and_it_is_said_why(shells):
    photos = shells.painted()
    shells.settings.peel_mm = 1.0
    assert len(shells.shown(photos)) == len(photos.data.points)
    assert "photos alone" in shells.settings.look_problem
    shells.settings.peel_mm = 0.0
    assert shells.settings.look_problem == ""
    shells.settings.modalities = {"XRAY"}
    assert len(shells.shown(photos)) == 0


def test_another_model_is_peeled_and_the_one_before_is_whole_again(shells):
    other = create_splats(shells.gaussians, "other", bpy.context)
    show_splats(other, ellipsoids=False)
    before = shells.colors()
    shells.settings.peel_mm, shells.settings.color_by = 5.0, "MODALITY"
    shells.settings.model = other
    assert shells.shown(other).max() < shells.INNER
    assert len(shells.shown()) == len(shells)
    np.testing.assert_array_equal(shells.colors(), before)


def test_what_was_peeled_by_hand_stays_so(shells):
    """As by keyframes in the modifier."""
    shells.settings.peel_mm = 1.0
    shells.settings.peel_mm = 0.0
    set_modifier_input(display_modifier(shells.model), "Peel", 5.0)
    shells.settings.high = 0.04
    shells.settings.color_by = "MODALITY"
    assert shells.shown().max() < shells.INNER


def test_what_was_peeled_by_hand_stays_so_when_a_transform_is_applied(shells):
    shells.settings.peel_mm = 1.0
    shells.settings.peel_mm = 0.0
    set_modifier_input(display_modifier(shells.model), "Peel", 5.0)
    shells.model.scale = (1.5, 1.5, 1.5)
    bpy.context.view_layer.objects.active = shells.model
    assert bpy.ops.insideout.apply_transform() == {"FINISHED"}
    assert 0 < shells.shown().max() < 1.5 * shells.OUTER - 4


def test_linked_splats_stay_as_they_are_and_it_is_said_why(shells, tmp_path):
    bpy.data.libraries.write(str(tmp_path / "library.blend"), {shells.model})
    bpy.ops.wm.read_homefile(use_empty=True)
    with bpy.data.libraries.load(str(tmp_path / "library.blend"), link=True) as (_, wanted):
        wanted.objects = ["model"]
    linked, settings = bpy.data.objects["model"], bpy.context.scene.insideout
    bpy.context.collection.objects.link(linked)
    settings.model = linked
    assert settings.look_problem == ""
    settings.peel_mm = 5.0
    assert "linked from another file" in settings.look_problem
    assert len(shells.shown(linked)) == len(linked.data.points)


def test_a_display_of_an_older_version_is_kept_until_it_is_asked_to_peel(shells):
    older = bpy.data.node_groups.new(display.GROUP, "GeometryNodeTree")
    older.is_modifier = True
    for name, kind in {"Geometry": "Geometry", "Size": "Float", "Ellipsoids": "Bool"}.items():
        older.interface.new_socket(name, in_out="INPUT", socket_type=f"NodeSocket{kind}")
    modifier = display_modifier(shells.model)
    modifier.node_group = older
    set_modifier_input(modifier, "Size", 1.25)
    # Blender 5.2 keeps what the input in this place had before.
    set_modifier_input(modifier, "Ellipsoids", False)
    shells.settings.peel_mm = 0.0
    assert modifier.node_group == older
    shells.settings.peel_mm = 5.0
    assert "Peel" in input_names(modifier.node_group)
    assert modifier_input(modifier, "Size") == pytest.approx(1.25)
    assert modifier_input(modifier, "Soft") is True
    assert shells.shown().max() < shells.INNER


def test_undo_takes_back_peel_and_colours(shells):
    name, before = shells.model.name, shells.colors()
    bpy.ops.ed.undo_push(message="before")
    shells.settings.peel_mm, shells.settings.color_by = 5.0, "MODALITY"
    bpy.ops.ed.undo_push(message="after")
    bpy.ops.ed.undo()
    found, scene = bpy.data.objects[name], bpy.context.scene
    assert (scene.insideout.peel_mm, scene.insideout.color_by) == (0.0, "PHOTOS")
    assert len(shells.shown(found)) == len(shells)
    np.testing.assert_array_equal(shells.colors(found), before)
    bpy.ops.ed.redo()
    found = bpy.data.objects[name]
    assert shells.shown(found).max() < shells.INNER
    assert not np.array_equal(shells.colors(found), before)


def test_show_all_takes_everything_back(shells):
    before = shells.colors()
    shells.settings.peel_mm, shells.settings.peel_density_from, shells.settings.modalities = 3.0, 0.01, {"XRAY"}
    shells.settings.color_by = "DENSITY"
    assert bpy.ops.insideout.look_reset() == {"FINISHED"}
    assert len(shells.shown()) == len(shells)
    np.testing.assert_array_equal(shells.colors(), before)
    assert shells.settings.modalities == {"PHOTOS", "XRAY", "CLONES"}


def test_show_all_takes_back_what_was_peeled_by_hand(shells):
    shells.settings.peel_mm = 1.0
    shells.settings.peel_mm = 0.0
    by_hand = {"Peel": 5.0, "Layer": 2.0, "Density From": 0.001, "Clones": False}
    for name, value in by_hand.items():
        set_modifier_input(display_modifier(shells.model), name, value)
    assert len(shells.shown()) < len(shells)
    shells.settings.color_by = "MODALITY"
    assert len(shells.shown()) < len(shells), "other settings leave it"
    assert bpy.ops.insideout.look_reset() == {"FINISHED"}
    assert len(shells.shown()) == len(shells)


def test_the_splats_stay_what_they_are(shells):
    before = read_splats(shells.model)
    shells.settings.peel_mm, shells.settings.color_by = 3.0, "DENSITY"
    after = read_splats(shells.model)
    for name in ("means", "scales", "opacities", "sh", "density", "modality"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))


def test_where_blender_draws_splats_it_is_said_that_they_keep_their_colours(shells, monkeypatch):
    monkeypatch.setattr(look, "draws_splats", lambda: True)
    shells.settings.color_by = "MODALITY"
    assert "Ellipsoids under Shown as" in shells.settings.look_problem
    bpy.ops.insideout.show_as(display="ELLIPSOIDS")
    assert shells.settings.look_problem == ""


@pytest.fixture
def joined(shells):
    """The shells after a tenth of their splats were deleted and joined to them again, as Blender's Join leaves them."""
    look_inside(shells.model)
    for name in (DEPTH, DENSITY_HERE):
        values = read_values(shells.model, name)
        values[: len(shells) // 10] = 0
        write_values(shells.model, name, values)
    return shells


def test_what_was_joined_has_to_be_prepared_again(joined, draw_panels):
    assert look.needs_a_look_inside(joined.model)
    assert "Prepare Peeling" in draw_panels()
    assert "Peel (mm)" not in draw_panels()
    assert bpy.ops.insideout.look_prepare() == {"FINISHED"}
    assert not look.needs_a_look_inside(joined.model)
    assert "Peel (mm)" in draw_panels()


def test_in_a_window_what_was_joined_waits_to_be_prepared(joined, monkeypatch):
    before = read_values(joined.model, DEPTH)
    app = SimpleNamespace(background=False)
    monkeypatch.setattr(look, "bpy", SimpleNamespace(app=app, data=bpy.data, context=bpy.context, types=bpy.types))
    joined.settings.peel_mm = 5.0
    assert "press Prepare Peeling" in joined.settings.look_problem
    joined.settings.high = 0.04
    np.testing.assert_array_equal(read_values(joined.model, DEPTH), before)
    assert bpy.ops.insideout.look_prepare() == {"FINISHED"}
    assert joined.settings.look_problem == ""
    assert joined.shown().max() < joined.INNER


def test_a_script_without_a_window_need_not_prepare_what_was_joined(joined):
    joined.settings.peel_mm = 5.0
    assert joined.settings.look_problem == ""
    assert joined.shown().max() < joined.INNER


def test_preparing_what_was_joined_can_be_ended(joined):
    before = [read_values(joined.model, name) for name in (DEPTH, DENSITY_HERE)]
    steps = look.prepare_in_steps(joined.model)
    for _ in range(3):
        assert 0 <= next(steps) <= 1
    steps.close()
    for name, values in zip((DEPTH, DENSITY_HERE), before, strict=True):
        np.testing.assert_array_equal(read_values(joined.model, name), values)
    assert look.needs_a_look_inside(joined.model)
