"""Any number of sections: planes and boxes, what each shows, what their bars say."""

from __future__ import annotations

from dataclasses import replace

import bpy
import numpy as np
import pytest
from mathutils import Matrix, Vector

from insideout.core.affine import Kept
from insideout.core.errors import CaptureError
from insideout.insideout_addon.scene import section, section_clip, section_live, section_picture, sections
from insideout.insideout_addon.scene.color_bar import bar_parts
from insideout.insideout_addon.scene.ct_volume import volume_path
from insideout.insideout_addon.scene.display import display_modifier
from insideout.insideout_addon.scene.node_tree import modifier_input
from insideout.insideout_addon.scene.placement import apply_transform
from insideout.insideout_addon.scene.section_cut import cut_modifiers
from insideout.insideout_addon.scene.splats import WATER_KEY, create_splats, in_scene, read_splats


def _settings():
    return bpy.context.scene.insideout


def _slots(model):
    return [modifier_input(modifier, "Slot") for modifier in cut_modifiers(model)]


def test_further_planes_face_the_front_the_left_and_the_top(model):
    planes = [sections.add_section_plane(model, bpy.context) for _ in range(3)]
    facing = [np.array(plane.matrix_world)[:3, 2] for plane in planes]
    np.testing.assert_allclose(facing, [[0, -1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-6)
    assert [np.array(plane.matrix_world)[2, 1] for plane in planes[:2]] == pytest.approx([1, 1]), "up is up"
    assert len(cut_modifiers(model)) == 3
    assert section.shown_plane(bpy.context.scene) == planes[2]


@pytest.mark.parametrize("mirror", [(-1, 1, 1), (1, -2, 2), (-1, -1, -1)])
def test_sections_of_a_mirrored_model_face_as_those_of_any_other(model, mirror):
    box = sections.add_section_box(model, bpy.context)
    bpy.context.view_layer.update()
    eighth = np.sign(box.matrix_world.translation - model.matrix_world.translation)
    sections.remove_sections(bpy.context.scene)
    model.scale = mirror
    bpy.context.view_layer.update()
    planes = [sections.add_section_plane(model, bpy.context) for _ in range(3)]
    bpy.context.view_layer.update()
    facing = [np.array(plane.matrix_world.to_3x3().normalized())[:, 2] for plane in planes]
    np.testing.assert_allclose(facing, [[0, -1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-5)
    box = sections.add_section_box(model, bpy.context)
    bpy.context.view_layer.update()
    assert not any(thing.matrix_world.is_negative for thing in (*planes, box))
    middle = np.array(model.matrix_world @ Vector(section.model_box(read_splats(model)).mean(axis=0)))
    np.testing.assert_array_equal(np.sign(np.array(box.matrix_world.translation) - middle), eighth)


def test_a_model_of_photos_alone_leaves_the_window_as_it_is(blender, random_set):
    photos = create_splats(replace(random_set, density=np.zeros_like(random_set.density)), "photos", bpy.context)
    _settings().low, _settings().high = 0.5, 1.5
    sections.add_section_plane(photos, bpy.context)
    assert (_settings().low, _settings().high) == (0.5, 1.5)


def test_each_section_has_its_own_settings(model):
    first, second = (sections.add_section_plane(model, bpy.context) for _ in range(2))
    _settings().sections[0].flip = True
    _settings().sections[1].cut = False
    (modifier,) = cut_modifiers(model)
    assert modifier_input(modifier, "Section") == first
    assert modifier_input(modifier, "Flip")
    _settings().sections[0].cut = False
    assert cut_modifiers(model) == []
    assert not modifier_input(display_modifier(model), "Cut")
    assert second.name in bpy.context.scene.objects


def test_what_else_is_parented_to_a_plane_is_left_alone(model):
    plane = sections.add_section_plane(model, bpy.context)
    shown, hidden = (bpy.data.objects.new(name, None) for name in ("shown", "hidden"))
    for thing in (shown, hidden):
        bpy.context.scene.collection.objects.link(thing)
        thing.parent = plane
    hidden.hide_viewport = hidden.hide_render = True
    for show_density in (False, True):
        _settings().sections[0].show_density = show_density
        assert [part.hide_render for part in bar_parts(plane)] == [not show_density] * 9
        assert (shown.hide_viewport, shown.hide_render) == (False, False)
        assert (hidden.hide_viewport, hidden.hide_render) == (True, True)


def test_whether_a_plane_is_rendered_changes_only_when_its_picture_comes_or_goes(model):
    plane = sections.add_section_plane(model, bpy.context)
    plane.hide_render = True
    _settings().sections[0].slab_mm, _settings().sections[0].flip = 2.0, True
    assert plane.hide_render
    _settings().sections[0].show_density = False
    plane.hide_render = False
    _settings().sections[0].slab_mm = 0.0
    assert not plane.hide_render
    _settings().sections[0].show_density = True
    assert not plane.hide_render
    _settings().sections[0].show_density = False
    assert plane.hide_render


def test_only_the_chosen_section_is_removed(model):
    first, second = (sections.add_section_plane(model, bpy.context) for _ in range(2))
    _settings().section_index = 0
    name = first.name
    bpy.ops.insideout.section_remove()
    assert name not in bpy.data.objects
    assert [entry.object for entry in _settings().sections] == [second]
    assert [modifier_input(modifier, "Section") for modifier in cut_modifiers(model)] == [second]


def test_a_box_takes_a_corner_out_of_the_model_and_can_crop_it_instead(model):
    box = sections.add_section_box(model, bpy.context)
    (modifier,) = cut_modifiers(model)
    assert modifier_input(modifier, "Box")
    assert modifier_input(modifier, "Flip")
    assert box.type == "EMPTY"
    _settings().sections[0].flip = False
    assert not modifier_input(modifier, "Flip")
    assert section.shown_plane(bpy.context.scene) is None
    assert bpy.ops.insideout.section_remove() == {"FINISHED"}
    assert modifier_input(display_modifier(model), "Cut") is False


def test_sections_share_the_slots_of_a_splat(model):
    sections.add_section_plane(model, bpy.context)
    sections.add_section_box(model, bpy.context)
    sections.add_section_plane(model, bpy.context)
    assert _slots(model) == [0, 1, 2]
    _settings().sections[0].slab_mm = 2.0
    _settings().sections[1].flip = False
    assert _slots(model) == [0, 2, 5]
    sections.add_section_plane(model, bpy.context)
    assert _slots(model) == [0, 2, 5, -1], "what finds no slot hides splats whole"


def test_a_section_that_finds_no_place_on_splats_is_told(model, draw_panels):
    for _ in range(7):
        sections.add_section_plane(model, bpy.context)
    assert _slots(model)[-1] == -1
    assert any("whole splats" in text for text in draw_panels(width=2000))
    _settings().section_index = 0
    assert not any("whole splats" in text for text in draw_panels(width=2000))


def test_pieces_bring_slots_of_their_own(model):
    model.data.attributes.new("cut_normal_0", "FLOAT_VECTOR", "POINT")
    model.data.attributes.new("cut_height_0", "FLOAT", "POINT")
    sections.add_section_plane(model, bpy.context)
    assert _slots(model) == [1]
    sections.remove_sections(bpy.context.scene)
    assert modifier_input(display_modifier(model), "Cut"), "they stay cut where they were broken"


def test_a_moved_model_is_drawn_on_all_planes(model, drawn):
    planes = [sections.add_section_plane(model, bpy.context) for _ in range(2)]
    section_live.live.refresh(bpy.context.scene)
    before = [drawn(plane) for plane in planes]
    model.location = (1.5, 1.5, 1.5)
    bpy.context.view_layer.update()
    section_live.live.refresh(bpy.context.scene)
    for plane, old in zip(planes, before, strict=True):
        assert np.abs(drawn(plane) - old).max() > 0.05


def test_a_picture_ends_where_another_section_hides_the_model(model, drawn):
    """The plane that is seen from the left hides x < 0: the left half of the front plane's picture."""
    front, left = (sections.add_section_plane(model, bpy.context) for _ in range(2))
    left.location.x = front.location.x
    bpy.context.view_layer.update()
    section_live.live.refresh(bpy.context.scene)
    alpha = drawn(front)[..., 3]
    assert alpha[:, :24].max() == 0
    assert alpha[:, 24:].max() == 1
    left.location.x -= 100
    bpy.context.view_layer.update()
    section_live.live.refresh(bpy.context.scene)
    assert drawn(front)[..., 3][:, :24].max() == 1, "the left plane moved away and hides nothing"


@pytest.mark.parametrize("inside", [True, False])
def test_a_picture_ends_at_a_box(model, inside, drawn):
    plane, box = sections.add_section_plane(model, bpy.context), sections.add_section_box(model, bpy.context)
    box.matrix_world = plane.matrix_world.copy()
    box.scale = [0.25 * plane["insideout_size_mm"]] * 3
    _settings().sections[1].flip = inside
    bpy.context.view_layer.update()
    section_live.live.refresh(bpy.context.scene)
    shown = drawn(plane)[..., 3] > 0
    in_box = np.zeros_like(shown)
    in_box[12:36, 12:36] = True
    assert not shown[in_box == inside].any()
    assert shown[in_box != inside].any()


def test_only_the_chosen_plane_has_a_colour_bar(model):
    first, second = (sections.add_section_plane(model, bpy.context) for _ in range(2))
    section_picture.refresh_sections(bpy.context.scene)
    assert (len(bar_parts(first)), len(bar_parts(second))) == (0, 9)
    _settings().section_index = 0
    section_picture.refresh_sections(bpy.context.scene)
    assert (len(bar_parts(first)), len(bar_parts(second))) == (9, 0)


def test_the_picture_lies_on_the_visible_side_of_the_cut(model):
    plane = sections.add_section_plane(model, bpy.context)
    assert plane.data.vertices[0].co.z > 0
    _settings().sections[0].flip = True
    assert plane.data.vertices[0].co.z < 0


def test_both_faces_show_the_picture_when_the_halves_are_apart(model, drawn):
    plane = sections.add_section_plane(model, bpy.context)
    section_picture.refresh_sections(bpy.context.scene)
    before = drawn(plane)
    _settings().sections[0].apart_mm = 20.0
    heights = sorted({round(vertex.co.z, 2) for vertex in plane.data.vertices})
    lift = 1.5e-3 * plane["insideout_size_mm"]
    assert heights == pytest.approx([-10 + lift, 10 - lift], abs=0.01)
    assert len(plane.data.polygons) == 2
    section_picture.refresh_sections(bpy.context.scene)
    np.testing.assert_array_equal(drawn(plane), before)
    _settings().sections[0].apart_mm = 0.0
    assert len(plane.data.polygons) == 1


def test_the_ct_on_the_plane_and_the_difference(scanned, drawn):
    plane = sections.add_section_plane(scanned, bpy.context)
    scene, chosen = bpy.context.scene, _settings().sections[0]
    values, view = section.sample_section(scene)
    ct = section_picture.picture_of(values, view, scene, "CT")
    near = np.abs(ct.rgba - section_picture.picture_of(values + 0.01, view, scene, "MODEL").rgba).max(axis=2) < 0.1
    assert near.mean() > 0.95, "but for what a grid of 1 mm smoothes"
    inside = np.abs(view.points() @ np.array([0, 0, 1])) < 25
    difference = section_picture.picture_of(values, view, scene, "DIFFERENCE")
    assert difference.window.low == -difference.window.high
    blue = difference.rgba[..., 2] > difference.rgba[..., 0]
    assert blue[inside & (difference.rgba[..., 3] > 0.5)].mean() > 0.95, "the scan is denser everywhere"
    chosen.picture = "CT"
    section_picture.refresh_sections(scene)
    np.testing.assert_allclose(drawn(plane), ct.rgba, atol=0.5 / 255 + 1e-6)


def test_the_ct_follows_a_transform_that_was_applied_to_the_splats(scanned):
    """Model and plane turned and moved together show what they showed before."""
    plane = sections.add_section_plane(scanned, bpy.context)
    scene = bpy.context.scene
    before, view = section.sample_section(scene)
    ct = section_picture.picture_of(before, view, scene, "CT")
    turn = Matrix.Translation((5, -7, 3)) @ Matrix.Rotation(0.7, 4, "Z")
    scanned.matrix_world, plane.matrix_world = turn @ scanned.matrix_world, turn @ plane.matrix_world
    bpy.context.view_layer.update()
    apply_transform(scanned)
    bpy.context.view_layer.update()
    after, moved = section.sample_section(scene)
    np.testing.assert_allclose(after, before, atol=1e-3 * before.max())
    again = section_picture.picture_of(after, moved, scene, "CT")
    np.testing.assert_allclose(again.rgba, ct.rgba, atol=0.02)


def test_the_ct_follows_a_size_that_was_corrected(scanned):
    """Of twice as large a voxel the same line integrals make half the density, in the model and in its CT."""
    plane = sections.add_section_plane(scanned, bpy.context)
    before, view = section.sample_section(bpy.context.scene)
    ct = section_picture.scan_on(view, scanned)
    scanned[WATER_KEY] = _settings().water = 0.03
    for thing in (scanned, plane):
        thing.matrix_world = Matrix.Scale(2.0, 4) @ thing.matrix_world
    bpy.context.view_layer.update()
    apply_transform(scanned, Kept.LINE_INTEGRALS)
    bpy.context.view_layer.update()
    after, view = section.sample_section(bpy.context.scene)
    np.testing.assert_allclose(after, before / 2, atol=1e-3 * before.max())
    np.testing.assert_allclose(section_picture.scan_on(view, scanned), ct / 2, atol=1e-3 * ct.max())
    assert (scanned[WATER_KEY], _settings().water) == pytest.approx((0.015, 0.015)), "so that HU stay what they are"


def test_a_model_without_its_run_has_no_ct(model, draw_panels, drawn):
    plane = sections.add_section_plane(model, bpy.context)
    with pytest.raises(CaptureError, match="no CT volume"):
        volume_path(model)
    section_picture.refresh_sections(bpy.context.scene)
    assert drawn(plane).max() > 0
    _settings().sections[0].picture = "CT"
    assert not section_picture.draw_picture(bpy.context.scene, _settings().sections[0])
    assert drawn(plane).max() == 0, "no picture that passes for the CT"
    assert any("no CT volume" in text for text in draw_panels())


@pytest.mark.parametrize(("name", "value"), [("peel_mm", 2.0), ("peel_density_to", 0.1), ("modalities", {"XRAY"})])
def test_the_panel_says_that_pictures_are_of_the_whole_model(model, draw_panels, name, value, drawn):
    sections.add_section_plane(model, bpy.context)
    told = "Pictures show the whole model, peeled or not"
    whole = drawn(section.shown_plane(bpy.context.scene))
    assert told not in draw_panels()
    setattr(_settings(), name, value)
    assert told in draw_panels()
    section_picture.refresh_sections(bpy.context.scene)
    np.testing.assert_array_equal(drawn(section.shown_plane(bpy.context.scene)), whole)


def test_colours_can_be_chosen(model, drawn):
    plane = sections.add_section_plane(model, bpy.context)
    section_picture.refresh_sections(bpy.context.scene)
    before = drawn(plane)
    _settings().colors = "GREY"
    section_picture.refresh_sections(bpy.context.scene)
    grey = drawn(plane)
    np.testing.assert_allclose(grey[..., 0], grey[..., 2], atol=1e-6)
    assert np.abs(grey - before).max() > 0.1
    (strip,) = [part for part in bar_parts(plane) if part.type == "MESH" and part.data.uv_layers]
    assert [material.name for material in strip.data.materials] == ["InsideOut Colour Bar grey"]


@pytest.mark.parametrize("stretch", [1.0, 2.5])
def test_the_scale_bar_is_as_long_as_it_says(model, stretch, bar_texts):
    plane = sections.add_section_plane(model, bpy.context)
    plane.scale = (stretch, stretch, stretch)
    bpy.context.view_layer.update()
    section_picture.refresh_sections(bpy.context.scene)
    (said,) = [float(text[:-3]) for text in bar_texts(plane) if text.endswith(" mm")]
    (bar,) = [part for part in bar_parts(plane) if part.type == "MESH" and not part.data.uv_layers]
    bpy.context.view_layer.update()
    corners = np.array([bar.matrix_world @ vertex.co for vertex in bar.data.vertices])
    assert np.ptp(corners[:, 0]) == pytest.approx(said, rel=1e-5)
    assert said <= 0.25 * plane.dimensions.x * (1 + 1e-6) < 5 * said


@pytest.mark.parametrize("shape", ["plane", "box"])
@pytest.mark.parametrize("scale", [(0.001, 0.001, 0.001), (2, 1, 1), (-1, 0.5, 2)])
def test_a_picture_ends_at_turned_sections_of_a_scaled_model(model, shape, scale):
    """As each pixel's place in the frame of the plane or box says: it hides z > 0, or what is beyond -1 to 1."""
    plane = sections.add_section_plane(model, bpy.context)
    other = (sections.add_section_plane if shape == "plane" else sections.add_section_box)(model, bpy.context)
    _settings().sections[1].flip = False
    other.rotation_euler = (0.4, 0.7, 0.2)
    model.scale = scale
    bpy.context.view_layer.update()
    _, view = section.sample_section(bpy.context.scene, plane=plane)
    to_other = np.array(other.matrix_world.inverted() @ model.matrix_world)
    there = view.points() @ to_other[:3, :3].T + to_other[:3, 3]
    wanted = there[..., 2] > 0 if shape == "plane" else (np.abs(there) > 1).any(axis=-1)
    hidden = section_clip.hidden_pixels(bpy.context.scene, _settings().sections[0], view)
    assert (hidden == wanted).mean() > 0.999
    assert 0.05 < wanted.mean() < 0.98


def test_faces_of_a_stretched_plane_are_apart_by_mm(model):
    plane = sections.add_section_plane(model, bpy.context)
    _settings().sections[0].apart_mm = 20.0
    plane.scale = (2.5, 2.5, 2.5)
    bpy.context.view_layer.update()
    section_live.live.refresh(bpy.context.scene)
    heights = 2.5 * np.array([vertex.co.z for vertex in plane.data.vertices])
    assert np.ptp(heights) == pytest.approx(20, abs=0.01 * plane["insideout_size_mm"])


def test_what_is_chosen_stays_chosen_when_an_earlier_section_goes(model):
    for _ in range(3):
        sections.add_section_plane(model, bpy.context)
    _settings().section_index = 1
    chosen = section.shown_plane(bpy.context.scene)
    sections.remove_section(bpy.context.scene, _settings().sections[0])
    assert section.shown_plane(bpy.context.scene) == chosen


def test_a_plane_after_a_box_keeps_the_window(model):
    sections.add_section_box(model, bpy.context)
    _settings().high = 0.5
    sections.add_section_plane(model, bpy.context)
    assert _settings().high == 0.5


def test_the_first_plane_finds_the_window_of_a_file_whose_boxes_had_no_pictures(model):
    sections.add_section_box(model, bpy.context)
    _settings().property_unset("low")
    _settings().property_unset("high")
    before = _settings().high
    sections.add_section_plane(model, bpy.context)
    assert _settings().high != before


def test_scenes_that_share_their_objects_share_the_cuts(model):
    """Scene > Linked Copy: each plane is in the lists of both, and cuts once."""
    scene = bpy.context.scene
    sections.add_section_plane(model, bpy.context)
    sections.add_section_plane(model, bpy.context)
    bpy.ops.scene.new(type="LINK_COPY")
    for cut in (False, True):
        for other in bpy.data.scenes:
            for entry in other.insideout.sections:
                entry.cut = cut
    assert _slots(model) == [0, 1]
    for other in bpy.data.scenes:
        sections.remove_sections(other)
    assert scene.insideout.model == model
    assert cut_modifiers(model) == []


@pytest.fixture
def linked(model, tmp_path):
    """The model linked from another file, beside an object of this file with its name; returns both."""
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "library.blend"))
    bpy.ops.wm.read_factory_settings(use_empty=True)
    own = bpy.data.objects.new("model", None)
    bpy.context.scene.collection.objects.link(own)
    with bpy.data.libraries.load(str(tmp_path / "library.blend"), link=True) as (_, wanted):
        wanted.objects = ["model"]
    (there,) = wanted.objects
    bpy.context.scene.collection.objects.link(there)
    return there, own


def test_a_linked_model_is_known_beside_an_object_of_its_name(linked):
    there, own = linked
    assert all(in_scene(thing, bpy.context.scene) for thing in linked)
    bpy.context.scene.collection.objects.unlink(there)
    assert not in_scene(there, bpy.context.scene)
    assert in_scene(own, bpy.context.scene)


def test_the_residuals_of_a_linked_model_are_not_looked_for_in_an_object_of_its_name(linked, draw_panels):
    _settings().model, _ = linked
    _settings().color_by = "RESIDUAL"
    assert any("linked from another file" in text for text in draw_panels(width=2000))


@pytest.mark.parametrize("tool", ["section_add", "section_add_box"])
def test_a_linked_model_is_told_to_be_overridden_and_then_cut(linked, tool):
    there, _ = linked
    _settings().model = there
    with pytest.raises(RuntimeError, match=r"^Error: model: is linked from another file"):
        getattr(bpy.ops.insideout, tool)()
    assert len(_settings().sections) == 0
    override = there.override_create(remap_local_usages=True)
    _settings().model = override
    assert getattr(bpy.ops.insideout, tool)() == {"FINISHED"}
    assert len(cut_modifiers(override)) == 1


def test_a_full_copy_of_the_scene_has_pictures_of_its_own(model, drawn):
    scene, plane = bpy.context.scene, sections.add_section_plane(model, bpy.context)
    section_live.live.refresh(scene)
    before = drawn(plane)
    bpy.ops.scene.new(type="FULL_COPY")
    copied = bpy.context.scene
    copied.insideout.high *= 3
    section_picture.refresh_sections(copied)
    assert np.abs(drawn(copied.insideout.sections[0].object) - before).max() > 0.05
    np.testing.assert_array_equal(drawn(plane), before)
    count = len(bpy.data.images)
    section_picture.refresh_sections(copied)
    assert len(bpy.data.images) == count
