"""Importing a run's splats."""

from __future__ import annotations

import json
import weakref
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector

from insideout.core.errors import GaussianFileError
from insideout.core.gaussians import GaussianSet
from insideout.insideout_addon.scene import importing
from insideout.insideout_addon.scene.display import display_modifier
from insideout.insideout_addon.scene.importing import (
    BODY_KEY,
    WARNINGS_KEY,
    available_sets,
    find_set,
    frame_box,
    import_in_steps,
    import_splats,
    lengths_are_arbitrary,
    load_splats,
    place_in_steps,
    place_splats,
)
from insideout.insideout_addon.scene.node_tree import modifier_input, set_modifier_input
from insideout.insideout_addon.scene.section import sample_section
from insideout.insideout_addon.scene.splats import shows_density


def test_view_dependent_colors_are_read_where_they_are_asked_for(tmp_path, random_set):
    """They are most of a file; what is kept of it says that it has them."""
    random_set.save(tmp_path / "a.ply")
    full, plain = (load_splats(tmp_path / "a.ply", view_dependent=asked) for asked in (True, False))
    assert (full.gaussians.sh_degree, plain.gaussians.sh_degree) == (1, 0)
    assert full.provenance["file"]["sh_degree"] == plain.provenance["file"]["sh_degree"] == 1


def test_the_furthest_stage_is_taken(tmp_path, random_set):
    random_set.save(tmp_path / "surface" / "xray.ply")
    assert find_set(tmp_path, "xray") == tmp_path / "surface" / "xray.ply"
    random_set.save(tmp_path / "internal" / "xray.ply")
    assert find_set(tmp_path, "xray") == tmp_path / "internal" / "xray.ply"
    random_set.save(tmp_path / "xray.ply")
    assert find_set(tmp_path, "xray") == tmp_path / "xray.ply"
    assert available_sets(tmp_path) == ["xray"]


def test_a_run_without_the_set_is_told(tmp_path):
    with pytest.raises(GaussianFileError, match="holds no fused splats"):
        find_set(tmp_path, "fused")


def test_a_run_that_is_not_there_or_is_a_file_is_told(tmp_path):
    with pytest.raises(GaussianFileError, match="there is no such folder"):
        find_set(tmp_path / "run", "fused")
    (tmp_path / "run").write_text("notes")
    with pytest.raises(GaussianFileError, match="is a file, not a folder"):
        find_set(tmp_path / "run", "fused")


def test_the_model_is_shown_active_and_in_millimetres(blender, tmp_path, random_set):
    random_set.save(tmp_path / "fused.ply")
    splats = import_splats(tmp_path / "fused.ply", "model", bpy.context)
    assert bpy.context.scene.insideout.model == splats
    assert bpy.context.view_layer.objects.active == splats
    assert not any(thing.select_get() for thing in bpy.context.view_layer.objects), "outlines would cover the model"
    assert modifier_input(display_modifier(splats), "Ellipsoids")
    assert bpy.context.scene.unit_settings.scale_length == pytest.approx(0.001)
    assert bpy.context.scene.unit_settings.length_unit == "MILLIMETERS"


class TestPhotosAlone:
    """No X-ray tells how large the object is and what belongs to it."""

    @pytest.fixture
    def splats(self, blender, photo_run):
        return import_splats(photo_run / "fused.ply", "model", bpy.context)

    def test_nothing_claims_millimetres(self, splats):
        units = bpy.context.scene.unit_settings
        assert (units.scale_length, units.length_unit) == (1.0, "METERS")
        assert lengths_are_arbitrary(splats)
        assert tuple(splats.scale) == (1, 1, 1)

    def test_the_background_is_hidden_not_deleted(self, splats):
        assert _shown(splats) == 1000
        assert len(splats.data.points) == 1300
        bpy.context.scene.insideout.hide_background = False
        assert _shown(splats) == 1300

    def test_the_object_fills_the_frame(self, splats, photo_run):
        box = load_splats(photo_run / "fused.ply").box
        np.testing.assert_allclose(box, [[2, 0, -3], [4, 2, -1]], atol=0.1)

    def test_what_the_run_warned_of_is_kept(self, splats):
        assert splats[WARNINGS_KEY].splitlines() == ["photos: few photos", "initialize: 3 of 40 photos were left out"]
        assert not shows_density(splats)


def _shown(splats):
    """How many splats the display leaves."""
    display_modifier(splats).show_viewport = True
    set_modifier_input(display_modifier(splats), "Ellipsoids", False)
    bpy.context.view_layer.update()
    evaluated = splats.evaluated_get(bpy.context.evaluated_depsgraph_get())
    return len(evaluated.data.points)


def test_an_xray_model_has_no_background(blender, tmp_path, random_set):
    random_set.save(tmp_path / "fused.ply")
    splats = import_splats(tmp_path / "fused.ply", "model", bpy.context)
    assert splats[BODY_KEY] == 0
    assert not lengths_are_arbitrary(splats)
    assert shows_density(splats)


def test_a_display_of_an_older_version_in_the_file_is_left_to_its_models(blender, tmp_path, photo_run):
    old = bpy.data.node_groups.new("InsideOut Splats", "GeometryNodeTree")
    splats = import_splats(photo_run / "fused.ply", "model", bpy.context)
    assert display_modifier(splats).node_group != old
    again = import_splats(photo_run / "fused.ply", "again", bpy.context)
    assert display_modifier(again).node_group == display_modifier(splats).node_group


def test_a_new_files_camera_and_light_see_the_model_and_its_cube_is_hidden(blender, photo_run):
    bpy.ops.wm.read_homefile(use_factory_startup=True)
    import_splats(photo_run / "fused.ply", "model", bpy.context)
    scene = bpy.context.scene
    assert not bpy.data.objects["Cube"].visible_get()
    assert bpy.data.objects["Cube"].hide_render
    bpy.context.view_layer.update()
    corners = [Vector((x, y, z)) for x in (2, 4) for y in (0, 2) for z in (-3, -1)]
    seen = np.array([world_to_camera_view(scene, scene.camera, corner) for corner in corners])
    assert seen[:, :2].min() > 0
    assert seen[:, :2].max() < 1
    assert seen[:, 2].min() > scene.camera.data.clip_start
    assert np.ptp(seen[:, 1]) > 0.3, "and large"
    assert 2.0 < (bpy.data.objects["Light"].location - Vector((3, 1, -2))).length < 20


def test_a_camera_that_was_moved_stays(blender, photo_run):
    bpy.ops.wm.read_homefile(use_factory_startup=True)
    camera = bpy.context.scene.camera
    camera.location.x += 1
    before = camera.location.copy()
    import_splats(photo_run / "fused.ply", "model", bpy.context)
    assert camera.location == before


@pytest.mark.builds_groups
def test_placing_in_steps_shows_nothing_before_the_end(blender, tmp_path, random_set):
    random_set.save(tmp_path / "fused.ply")
    steps = place_in_steps(load_splats(tmp_path / "fused.ply"), "a", bpy.context)
    objects = [len(bpy.context.scene.objects) for _ in steps]
    assert len(objects) > 8
    assert not any(objects)
    assert bpy.context.scene.objects["a"] == bpy.context.scene.insideout.model


def test_splats_are_not_kept_in_memory_where_blender_has_them(blender, tmp_path, random_set, monkeypatch):
    random_set.save(tmp_path / "fused.ply")
    loaded = load_splats(tmp_path / "fused.ply")
    splats, kept = weakref.ref(loaded.gaussians), []
    monkeypatch.setattr(importing, "remember_placement", lambda _: kept.append(splats()))
    place_splats(loaded, "a", bpy.context)
    assert kept == [None], "before Blender is made to show them"


def _facts():
    kinds = ("objects", "pointclouds", "meshes", "node_groups", "materials", "images")
    blocks = {kind: sorted(block.name for block in getattr(bpy.data, kind)) for kind in kinds}
    chosen = [thing.name for thing in bpy.context.selected_objects], bpy.context.view_layer.objects.active
    return blocks, chosen, bpy.context.scene.insideout.model


@pytest.mark.builds_groups
def test_ended_between_any_two_steps_nothing_is_left(blender, tmp_path, random_set):
    random_set.save(tmp_path / "fused.ply")
    bpy.ops.mesh.primitive_cube_add()
    before, ended = _facts(), False
    for count in range(1, 100):
        steps = import_in_steps(tmp_path / "fused.ply", "a", bpy.context)
        shares = [share for _, share in zip(range(count), steps, strict=False)]
        if ended := len(shares) < count:
            break
        steps.close()
        assert _facts() == before, f"after {count} steps"
        assert shares == sorted(shares)
        assert 0 <= shares[0] <= shares[-1] <= 1
    assert ended
    assert count > 20
    assert bpy.context.scene.insideout.model is not None


@pytest.mark.builds_groups
def test_ended_early_what_another_model_uses_stays(blender, tmp_path, random_set):
    random_set.save(tmp_path / "fused.ply")
    import_splats(tmp_path / "fused.ply", "first", bpy.context)
    before = _facts()
    steps = import_in_steps(tmp_path / "fused.ply", "a", bpy.context)
    for _ in range(20):
        next(steps)
    steps.close()
    assert _facts() == before


@pytest.mark.builds_groups
def test_ended_early_what_the_user_made_meanwhile_stays(blender, tmp_path, random_set):
    random_set.save(tmp_path / "fused.ply")
    before = _facts()[0]
    steps = import_in_steps(tmp_path / "fused.ply", "a", bpy.context)
    for _ in range(20):
        next(steps)
    bpy.data.materials.new("Mine")
    bpy.data.node_groups.new("Mine too", "GeometryNodeTree")
    steps.close()
    assert _facts()[0] == {**before, "materials": ["Mine"], "node_groups": ["Mine too"]}


def test_colours_are_shown_as_they_are(blender, tmp_path, random_set):
    random_set.save(tmp_path / "fused.ply")
    bpy.context.scene.view_settings.view_transform = "AgX"
    import_splats(tmp_path / "fused.ply", "model", bpy.context)
    assert bpy.context.scene.view_settings.view_transform == "Standard"


def test_water_is_that_of_the_scans_hounsfield_units_unless_the_user_has_set_another(blender, tmp_path, random_set):
    settings = bpy.context.scene.insideout

    def water(told):
        run = tmp_path / str(told)
        random_set.save(run / "fused.ply")
        (run / "report.json").write_text(json.dumps({"stages": {}, "water_per_mm": told}), "utf-8")
        import_splats(run / "fused.ply", "model", bpy.context)
        return settings.water

    assert [water(told) for told in (0.0206, 0.022, None)] == pytest.approx([0.0206, 0.022, 0.0195])
    settings.water = 0.02
    assert water(0.0206) == pytest.approx(0.02)


def test_units_the_user_chose_stay(blender, tmp_path, random_set):
    bpy.context.scene.unit_settings.scale_length = 0.01
    random_set.save(tmp_path / "fused.ply")
    import_splats(tmp_path / "fused.ply", "model", bpy.context)
    assert bpy.context.scene.unit_settings.scale_length == pytest.approx(0.01)


@pytest.mark.parametrize("content", ["", "not a ply"])
def test_a_bad_file_changes_nothing(blender, tmp_path, content):
    (tmp_path / "bad.ply").write_text(content, "utf-8")
    with pytest.raises(GaussianFileError, match=r"bad\.ply"):
        import_splats(tmp_path / "bad.ply", "model", bpy.context)
    assert len(bpy.data.objects) == 0


def test_an_empty_set_changes_nothing(blender, tmp_path):
    GaussianSet.empty().save(tmp_path / "none.ply")
    with pytest.raises(GaussianFileError, match="holds no splats"):
        import_splats(tmp_path / "none.ply", "model", bpy.context)
    assert len(bpy.data.objects) == 0


@pytest.mark.parametrize(
    ("system", "scale_length", "unit"), [("METRIC", 0.01, 0.1), ("IMPERIAL", 1.0, 0.001), ("NONE", 1.0, 1.0)]
)
def test_a_millimetre_is_one_in_every_system_of_units(blender, tmp_path, random_set, system, scale_length, unit):
    units = bpy.context.scene.unit_settings
    units.system, units.scale_length = system, scale_length
    random_set.save(tmp_path / "fused.ply")
    splats = import_splats(tmp_path / "fused.ply", "model", bpy.context)
    extent = float((random_set.means.max(axis=0) - random_set.means.min(axis=0)).max())
    assert splats.matrix_world.to_scale().x == pytest.approx(unit)
    bpy.ops.insideout.section_add()
    plane = bpy.context.scene.insideout.sections[0].object
    assert extent < plane.dimensions.x / unit < 1.5 * extent
    values, view = sample_section(bpy.context.scene, 64)
    assert extent < 64 * float((view.u**2).sum()) ** 0.5 < 1.5 * extent
    assert values.max() > 0


def test_a_new_model_is_cut_by_the_plane_that_is_there(blender, tmp_path, random_set):
    random_set.save(tmp_path / "fused.ply")
    import_splats(tmp_path / "fused.ply", "first", bpy.context)
    bpy.ops.insideout.section_add()
    second = import_splats(tmp_path / "fused.ply", "second", bpy.context)
    assert modifier_input(display_modifier(second), "Cut")


class TestAModelMadeAgain:
    """In the same place as the one before, which is not cut any more."""

    @pytest.fixture
    def place(self, blender, tmp_path, random_set):
        """`place(run, digest, name)`: the model of such a run, of a capture of that digest."""

        def make(run="run", digest="a", name="fused"):
            random_set.save(tmp_path / run / f"{name}.ply")
            (tmp_path / run / "capture.json").write_text(json.dumps({"digest": digest}), "utf-8")
            return import_splats(tmp_path / run / f"{name}.ply", name, bpy.context)

        return make

    @pytest.mark.parametrize("run", ["run", "run in another folder"])
    def test_does_not_hide_within_it(self, place, run):
        before, again = place(), place(run)
        assert (before.hide_viewport, before.hide_render) == (True, True)
        assert not again.hide_viewport
        assert not again.hide_render

    @pytest.mark.parametrize("other", [{"run": "b", "digest": "b"}, {"name": "xray"}])
    def test_another_one_stays(self, place, other):
        before, _ = place(), place(**other)
        assert not before.hide_viewport

    def test_one_that_was_moved_aside_stays(self, place):
        before = place()
        before.location.x = 200
        place()
        assert not before.hide_viewport


def test_results_of_a_stage_that_is_made_again_are_not_taken_for_new_ones(tmp_path, random_set):
    for name in ("fused.ply", "fuse/fused.ply", "internal/xray.ply", "surface/xray.ply"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        random_set.save(tmp_path / name)
    (tmp_path / "capture.json").write_text("{}")
    (tmp_path / "surface" / "report.json").write_text("{}")
    assert available_sets(tmp_path) == ["xray"]
    assert find_set(tmp_path, "xray") == tmp_path / "surface" / "xray.ply"
    (tmp_path / "report.json").write_text("{}")
    assert find_set(tmp_path, "fused") == tmp_path / "fused.ply"


@pytest.mark.parametrize(
    ("location", "distance", "moved"),
    [((0, 0, 0), 18.0, True), ((12, 0, 0), 200.0, False), ((500, 0, 0), 200.0, True), ((0, 0, 0), 5000.0, True)],
)
def test_a_first_model_is_in_view(location, distance, moved):
    view = SimpleNamespace(view_location=location, view_distance=distance)
    frame_box(view, np.array([[-30.0, -40, -50], [50, 40, 50]]))
    if moved:
        np.testing.assert_allclose(view.view_location, [10, 0, 0])
        assert 150 < view.view_distance < 400
    else:
        assert (view.view_location, view.view_distance) == (location, distance)
