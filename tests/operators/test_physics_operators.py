"""Break, make rigid, bake, whole again: as a script or a button calls them."""

from __future__ import annotations

from types import SimpleNamespace

import bpy
import numpy as np
import pytest

from insideout.core.errors import SettingError
from insideout.core.gaussians import GaussianSet, Modality
from insideout.core.mesh.weight import mass_text
from insideout.insideout_addon.physics.whole import make_rigid
from insideout.insideout_addon.physics.world import is_floor
from insideout.insideout_addon.scene.showing import shown_as
from insideout.insideout_addon.scene.weighing import MASS_KEY
from insideout.operators import break_model as break_operator


@pytest.fixture
def model(blender, tmp_path):
    """Splats in a cube of 20 mm, without a mesh."""
    axis = np.arange(-9.0, 10.0, 3.0)
    points = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    GaussianSet.create(points, 1.5, density=0.02, modality=Modality.XRAY).save(tmp_path / "fused.ply")
    bpy.ops.insideout.import_run(filepath=str(tmp_path / "fused.ply"))
    return bpy.context.scene.insideout.model


def test_without_a_model_nothing_can_be_pressed(blender):
    for name in ("break_model", "make_rigid", "bake_physics", "unbreak"):
        assert not getattr(bpy.ops.insideout, name).poll()


def test_a_model_without_a_mesh_cannot_break_and_says_why(model):
    with pytest.raises(RuntimeError, match=r"mesh\.glb: is not there"):
        bpy.ops.insideout.break_model()
    assert not model.hide_viewport


@pytest.mark.parametrize(("low", "high"), [(0.06, 0.01), (0.02, 0.02)])
def test_a_window_upside_down_is_refused(model, low, high):
    with pytest.raises(RuntimeError, match=rf"Low \({low} mm⁻¹\) is not below High \({high} mm⁻¹\); lower it"):
        bpy.ops.insideout.break_model(low=low, high=high)
    with pytest.raises(RuntimeError, match=r"mesh\.glb: is not there"):
        bpy.ops.insideout.break_model(low=low, high=0.0)


def test_it_can_fall_as_a_whole_by_the_hull_of_its_splats(model):
    assert bpy.ops.insideout.make_rigid() == {"FINISHED"}
    body = model.parent
    # Up to 1.6 standard deviations beyond the outer centres.
    np.testing.assert_allclose(body.dimensions, 2 * (9 + 1.6 * 1.5), rtol=1e-3)
    assert not bpy.ops.insideout.break_model.poll() or bpy.ops.insideout.unbreak.poll()
    with pytest.raises(RuntimeError, match="has a body already"):
        bpy.ops.insideout.make_rigid()
    assert bpy.ops.insideout.bake_physics(start=1, end=4) == {"FINISHED"}
    assert not bpy.ops.insideout.bake_physics.poll()
    assert bpy.ops.insideout.unbreak() == {"FINISHED"}
    assert model.parent is None
    assert len(bpy.data.objects) == 1


def test_it_has_somewhere_to_fall(model):
    """There is no dialog to ask for it, and what stands on the floor already does not fall."""
    bpy.ops.insideout.make_rigid()
    floor = next(thing for thing in bpy.data.objects if is_floor(thing))
    lowest = min((model.parent.matrix_world @ vertex.co).z for vertex in model.parent.data.vertices)
    assert lowest - floor.location.z == pytest.approx(50.0, rel=1e-4)


@pytest.fixture
def linked(model, tmp_path):
    """`linked(override)`: the model of another file, in this one's scene."""
    name = model.name
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "library.blend"))

    def link(override):
        bpy.ops.wm.read_factory_settings(use_empty=True)
        with bpy.data.libraries.load(str(tmp_path / "library.blend"), link=True) as (_, wanted):
            wanted.objects = [name]
        (there,) = wanted.objects
        bpy.context.scene.collection.objects.link(there)
        return there.override_create(remap_local_usages=True) if override else there

    return link


@pytest.mark.parametrize("override", [False, True])
def test_how_a_model_of_another_file_is_shown_is_kept_or_it_is_told(linked, override):
    """When the file is opened again a linked one would be shown as in its own."""
    bpy.context.scene.insideout.model = model = linked(override)
    before = shown_as(model)
    for tool, options in (("show_as", {"display": "POINTS"}), ("ellipsoids_box", {})):
        if override:
            assert getattr(bpy.ops.insideout, tool)(**options) == {"FINISHED"}
        else:
            with pytest.raises(RuntimeError, match="is linked from another file; make it local first"):
                getattr(bpy.ops.insideout, tool)(**options)
    assert shown_as(model) == ("MIXED" if override else before)
    assert not any(thing.type == "EMPTY" for thing in bpy.context.scene.objects) or override


@pytest.mark.parametrize("override", [False, True])
def test_a_model_of_another_file_is_told_to_be_made_local(linked, override):
    bpy.context.scene.insideout.model = model = linked(override)
    for tool in ("break_model", "make_rigid", "make_soft", "weigh"):
        with pytest.raises(RuntimeError, match="is linked from another file; make it local first"):
            getattr(bpy.ops.insideout, tool)()
    with bpy.context.temp_override(active_object=model, selected_objects=[model], selected_editable_objects=[model]):
        model.select_set(True)
        bpy.context.view_layer.objects.active = model
        bpy.ops.object.make_local(type="SELECT_OBDATA")
    assert bpy.ops.insideout.weigh(cavities=False) == {"FINISHED"}
    assert bpy.ops.insideout.make_soft(resolution=4) == {"FINISHED"}


@pytest.mark.parametrize(("tool", "does"), [("make_rigid", "fall"), ("make_soft", "bend")])
@pytest.mark.parametrize(
    ("weighed", "relative", "options", "told"),
    [
        (False, False, {}, "with densities taken as water's"),
        (False, False, {"density_factor": 50.0}, "by 50 g/cm³ per mm⁻¹"),
        (False, True, {"density_factor": 50.0}, "by 50 g/cm³ for a density of 1"),
        (True, False, {"density_factor": 50.0}, "by water"),
    ],
)
def test_a_mass_is_told_with_its_calibration(model, capfd, tool, does, weighed, relative, options, told):
    if relative:
        model["insideout_warnings"] = "volume.tif: has grey values, so densities are relative"
    if weighed:
        bpy.ops.insideout.weigh(cavities=False)
    assert getattr(bpy.ops.insideout, tool)(**options) == {"FINISHED"}
    (body,) = (thing for thing in bpy.data.objects if MASS_KEY in thing and thing != model)
    assert f"{body.name}: {mass_text(body[MASS_KEY])} {told}; play to see it {does}" in capfd.readouterr().out


@pytest.mark.parametrize("tool", ["make_rigid", "make_soft"])
@pytest.mark.parametrize("floor", [False, True])
def test_what_was_set_up_for_deleted_bodies_can_be_taken_away(draw_panels, model, tool, floor):
    """Gravity a thousand times as strong is felt by whatever else there is in a scene."""
    scene = bpy.context.scene
    gravity = tuple(scene.gravity)
    getattr(bpy.ops.insideout, tool)(use_floor=floor)
    assert scene.gravity.z < 100 * gravity[2]
    bpy.ops.object.select_all(action="DESELECT")
    for thing in scene.objects:
        thing.hide_set(False)
        thing.hide_select = False
        thing.select_set(True)
    bpy.ops.object.delete()
    assert not scene.objects
    assert {"Import a model first, under Model", "Back to Whole"} <= set(draw_panels())
    assert bpy.ops.insideout.unbreak() == {"FINISHED"}
    assert tuple(scene.gravity) == gravity
    assert scene.rigidbody_world is None
    assert not bpy.ops.insideout.unbreak.poll()
    assert "Back to Whole" not in draw_panels()


def test_beside_another_model_too(draw_panels, model, tmp_path):
    scene = bpy.context.scene
    gravity = tuple(scene.gravity)
    bpy.ops.insideout.make_rigid(use_floor=False)
    bpy.data.objects.remove(model.parent)
    bpy.data.objects.remove(model)
    bpy.ops.insideout.import_run(filepath=str(tmp_path / "fused.ply"))
    assert {"Make Rigid...", "Back to Whole"} <= set(draw_panels())
    assert bpy.ops.insideout.unbreak() == {"FINISHED"}
    assert tuple(scene.gravity) == gravity
    assert scene.rigidbody_world is None
    assert "Back to Whole" not in draw_panels()


def test_weighed_or_not_water_is_as_heavy(model):
    """Weigh and Break have the same default, and say masses in the same words."""
    bpy.ops.insideout.make_rigid()
    unweighed = model.parent["insideout_mass_g"]
    bpy.ops.insideout.unbreak()
    bpy.ops.insideout.weigh(cavities=False)
    bpy.ops.insideout.make_rigid()
    assert model.parent["insideout_mass_g"] == pytest.approx(unweighed, rel=1e-5)


@pytest.mark.parametrize("tool", ["make_rigid", "make_soft"])
def test_the_scan_s_own_water_is_as_heavy_as_water(model, capfd, tool):
    """As sections show it at 0 HU; a factor that is given goes before, if it is that of a usual scan's water, too."""
    told = []
    for water, options in ((0.0195, {}), (0.039, {}), (0.039, {"density_factor": 1 / 0.0195})):
        bpy.context.scene.insideout.water = water
        capfd.readouterr()
        assert getattr(bpy.ops.insideout, tool)(**options) == {"FINISHED"}
        (body,) = (thing for thing in bpy.data.objects if MASS_KEY in thing and thing != model)
        told.append((body[MASS_KEY], "taken as water's" in capfd.readouterr().out))
        bpy.ops.insideout.unbreak()
    (usual, _), *others = told
    assert told[0][1]
    assert others == [(pytest.approx(usual / 2, rel=1e-5), True), (pytest.approx(usual, rel=1e-5), False)]


@pytest.mark.parametrize("tool", ["break_model", "make_rigid", "make_soft"])
def test_the_dialog_starts_with_the_water_of_the_scan(model, tool):
    bpy.context.scene.insideout.water = 0.04
    dialog = SimpleNamespace(invoke_props_dialog=lambda *_, **__: {"RUNNING_MODAL"})
    window = SimpleNamespace(window_manager=dialog, scene=bpy.context.scene)
    for given, factor in ((set(), 25.0), ({"density_factor"}, 50.0)):
        properties = SimpleNamespace(is_property_set=given.__contains__)
        operator = SimpleNamespace(density_factor=50.0, properties=properties)
        getattr(bpy.types, f"INSIDEOUT_OT_{tool}").ask(operator, window)
        assert operator.density_factor == pytest.approx(factor)
    assert getattr(bpy.ops.insideout, tool).get_rna_type().properties["density_factor"].is_skip_save


def test_relative_densities_know_nothing_of_another_scan_s_water(model):
    model["insideout_warnings"] = "volume.tif: has grey values, so densities are relative"
    masses = []
    for water in (0.0195, 0.039):
        bpy.context.scene.insideout.water = water
        bpy.ops.insideout.make_rigid()
        masses.append(model.parent[MASS_KEY])
        bpy.ops.insideout.unbreak()
    assert masses[0] == pytest.approx(masses[1], rel=1e-6)


def test_photos_alone_have_no_mass_to_break(draw_panels, model, photo_run):
    """Beside a model that has: what is shown counts."""
    bpy.ops.insideout.import_run(filepath=str(photo_run / "fused.ply"))
    photos = bpy.context.scene.insideout.model
    assert photos != model
    for press in (bpy.ops.insideout.break_model, bpy.ops.insideout.make_rigid):
        assert not press.poll()
    with pytest.raises(SettingError, match="is of photos alone, which have no mass"):
        make_rigid(photos, bpy.context.scene, 50.0)
    assert "Photos alone have no density, so they have no mass to break" in draw_panels(600)
    assert bpy.context.scene.rigidbody_world is None


@pytest.mark.parametrize("tool", ["break_model", "make_rigid", "make_soft"])
@pytest.mark.parametrize("scale", [(0, 0, 0), (1, 1, 0)])
def test_what_is_scaled_to_nothing_cannot_fall_and_says_why(model, tool, scale):
    """Of a point there would be pieces, with the masses of the whole."""
    model.scale = scale
    with pytest.raises(RuntimeError, match="is scaled to nothing; give it a size again"):
        getattr(bpy.ops.insideout, tool)()
    assert list(bpy.context.scene.objects) == [model]


def test_an_impossible_factor_cannot_be_set(model):
    bpy.ops.insideout.make_rigid(density_factor=-1.0)
    assert model.parent["insideout_mass_g"] > 0


def test_the_panel_follows(draw_panels, model):
    texts = draw_panels()
    assert {"Break...", "Make Rigid..."} <= set(texts)
    assert any(text.startswith("Not weighed") for text in texts)
    bpy.ops.insideout.weigh(cavities=False)
    assert not any(text.startswith("Not weighed") for text in draw_panels())
    bpy.ops.insideout.make_rigid()
    texts = draw_panels()
    assert {"Bake to Keyframes...", "Back to Whole"} <= set(texts)
    assert any(text.startswith("One rigid body, ") and text.endswith(" g") for text in texts)
    bpy.ops.insideout.bake_physics(start=1, end=3)
    assert "Baked to keyframes" in draw_panels()


@pytest.mark.parametrize("tool", ["break_model", "make_rigid", "make_soft"])
@pytest.mark.parametrize("relative", [True, False])
def test_how_heavy_grey_values_are_is_asked_without_a_unit(draw_panels, model, tool, relative):
    if relative:
        model["insideout_warnings"] = "volume.tif: has grey values, so densities are relative"
    texts = []
    operator = SimpleNamespace(
        layout=draw_panels.__closure__[0].cell_contents.Layout(texts), way="RANDOM", use_floor=True, _has_manifold=True,
        bl_rna=getattr(bpy.ops.insideout, tool).get_rna_type(),
    )  # fmt: skip
    draw = getattr(bpy.types, f"INSIDEOUT_OT_{tool}").draw
    draw(operator, bpy.context)
    assert ("g/cm³ at 1 (relative)" in texts) == relative
    assert ("g/cm³ per mm⁻¹" in texts) == (not relative)
    assert ("Not weighed, and densities are relative: so are masses" in draw_panels(600)) == relative
    bpy.ops.insideout.weigh(cavities=False)
    texts.clear()
    draw(operator, bpy.context)
    assert not any("g/cm³" in text for text in texts)


@pytest.mark.parametrize("there", [True, False])
def test_before_it_breaks_it_is_told_that_this_blender_cannot_do_it_well(draw_panels, model, monkeypatch, there):
    monkeypatch.setattr(break_operator, "has_manifold", lambda: there)
    texts = []
    dialog = SimpleNamespace(invoke_props_dialog=lambda *_, **__: {"RUNNING_MODAL"})
    asked = SimpleNamespace(window_manager=dialog, scene=bpy.context.scene)
    operator = SimpleNamespace(
        layout=draw_panels.__closure__[0].cell_contents.Layout(texts), way="RANDOM", use_floor=True,
        bl_rna=bpy.ops.insideout.break_model.get_rna_type(),
        properties=SimpleNamespace(is_property_set=set().__contains__),
    )  # fmt: skip
    cls = bpy.types.INSIDEOUT_OT_break_model
    assert cls.ask(operator, asked) == {"RUNNING_MODAL"}
    cls.draw(operator, bpy.context)
    assert any("without the library manifold" in text for text in texts) == (not there)
    assert ("use a Blender from blender.org" in texts) == (not there)


def test_before_it_bakes_the_scene_s_own_frames_are_offered(blender):
    scene, asked = SimpleNamespace(frame_start=3, frame_end=40), []
    dialog = SimpleNamespace(invoke_props_dialog=lambda operator, **_: asked.append(operator) or {"RUNNING_MODAL"})
    cls, window = bpy.types.INSIDEOUT_OT_bake_physics, SimpleNamespace(window_manager=dialog, scene=scene)
    for given, frames in ((set(), (3, 40)), ({"end"}, (3, 250))):
        operator = SimpleNamespace(start=1, end=250, properties=SimpleNamespace(is_property_set=given.__contains__))
        assert cls.ask(operator, window) == {"RUNNING_MODAL"}
        assert (operator.start, operator.end) == frames
        assert asked.pop() is operator
