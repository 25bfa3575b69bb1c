"""The section plane in a scene: place, picture, colour bar, what follows when it moves."""

from __future__ import annotations

from dataclasses import replace

import bpy
import numpy as np
import pytest
from mathutils import Vector

from insideout.core.gaussians import GaussianSet
from insideout.insideout_addon.scene import section, section_face, section_live, section_picture, sections
from insideout.insideout_addon.scene.color_bar import bar_parts
from insideout.insideout_addon.scene.contours import contour_lines
from insideout.insideout_addon.scene.display import display_modifier, show_splats
from insideout.insideout_addon.scene.importing import import_splats
from insideout.insideout_addon.scene.node_tree import modifier_input
from insideout.insideout_addon.scene.section_cut import cut_modifiers
from insideout.insideout_addon.scene.splats import create_splats


@pytest.fixture
def cut(blender, one_ball):
    """A model of one ball between two markers that span a box around it, with its section plane."""
    markers = GaussianSet.create([[-17, -22, -19], [23, 18, 21]], 0.01)
    splats = create_splats(GaussianSet.concatenate([one_ball, markers]), "model", bpy.context)
    show_splats(splats, True)
    sections.add_section_plane(splats, bpy.context)
    return bpy.context.scene.insideout


def _image():
    image = bpy.data.images[section_face.NAME]
    pixels = np.empty(image.size[0] * image.size[1] * 4, np.float32)
    image.pixels.foreach_get(pixels)
    return pixels.reshape(image.size[1], image.size[0], 4)[::-1]


def test_the_plane_is_half_way_in_and_faces_the_front(cut):
    np.testing.assert_allclose(cut.sections[0].object.location, [3, -2, 1], atol=0.5)
    np.testing.assert_allclose(np.array(cut.sections[0].object.matrix_world)[:3, 2], [0, -1, 0], atol=1e-6)


def test_the_display_is_cut(cut):
    plane_section = cut.sections[0]
    (modifier,) = cut_modifiers(cut.model)
    assert cut.model.modifiers.find(modifier.name) < cut.model.modifiers.find(display_modifier(cut.model).name)
    assert modifier_input(modifier, "Section") == plane_section.object
    assert modifier_input(display_modifier(cut.model), "Cut")
    plane_section.flip, plane_section.slab_mm = True, 4.0
    assert modifier_input(modifier, "Flip")
    assert modifier_input(modifier, "Slab") == pytest.approx(4.0)
    plane_section.cut = False
    assert cut_modifiers(cut.model) == []
    assert not modifier_input(display_modifier(cut.model), "Cut")


def test_sections_have_the_right_values(cut):
    values, view = section.sample_section(bpy.context.scene, 101)
    assert values.max() == pytest.approx(0.04, rel=2e-3)
    row, column = np.unravel_index(values.argmax(), values.shape)
    np.testing.assert_allclose(view.points()[row, column], [3, -2, 1], atol=0.5)


def test_sections_follow_the_plane(cut):
    cut.sections[0].object.location.y -= 5.0
    bpy.context.view_layer.update()
    offset = float(cut.sections[0].object.location.y) + 2.0
    values, _ = section.sample_section(bpy.context.scene, 101)
    assert values.max() == pytest.approx(0.04 * np.exp(-(offset**2) / 50), rel=5e-3)


def test_sections_are_the_same_when_model_and_plane_are_moved_together(cut):
    before, _ = section.sample_section(bpy.context.scene, 64)
    cut.model.location = cut.sections[0].object.location = (0, 0, 0)
    cut.model.location.x += 7
    cut.sections[0].object.location = (3 + 7, -2, 1)
    bpy.context.view_layer.update()
    after, _ = section.sample_section(bpy.context.scene, 64)
    assert after.max() == pytest.approx(before.max(), rel=5e-3)


def test_the_picture_shows_the_ball_the_right_way_up(cut):
    cut.sections[0].object.location.z += 6.0
    bpy.context.view_layer.update()
    cut.pixels = 64
    section_picture.refresh_sections(bpy.context.scene)
    picture = _image()
    assert picture.shape == (64, 64, 4)
    rows, columns = np.nonzero(picture[..., 3] > 0.99)
    assert rows.mean() > 36, "the plane went up, so the ball is in the picture's lower half"
    assert columns.mean() == pytest.approx(31.5, abs=1.5)


def test_the_picture_travels_with_the_blend(cut):
    section_picture.refresh_sections(bpy.context.scene)
    assert bpy.data.images[section_face.NAME].packed_file is not None


def test_the_window_reaches_from_air_to_the_dense_parts(cut):
    assert cut.low == 0.0
    assert cut.high == pytest.approx(0.04, rel=0.1)


def test_the_colour_bar_says_the_window_in_mm(cut):
    texts = sorted(o.data.body for o in cut.sections[0].object.children if o.type == "FONT")
    assert "mm⁻¹" in texts
    assert texts[0].startswith("0.000")
    cut.high = 0.08
    section_picture.refresh_sections(bpy.context.scene)
    assert "0.0800" in [o.data.body for o in cut.sections[0].object.children if o.type == "FONT"]


def test_a_moved_plane_is_noticed_and_another_object_is_not(cut, monkeypatch):
    noticed = []
    monkeypatch.setattr(section_live.live, "moved", noticed.append)
    empty = bpy.data.objects.new("other", None)
    bpy.context.collection.objects.link(empty)
    bpy.context.view_layer.update()
    noticed.clear()
    empty.location.x = 3
    bpy.context.view_layer.update()
    assert noticed == []
    cut.sections[0].object.location.x += 1
    bpy.context.view_layer.update()
    assert noticed == [bpy.context.scene]


def test_a_quick_look_is_coarser(cut):
    section_picture.draw_picture(bpy.context.scene, cut.sections[0], divisor=3, quick=True)
    assert _image().shape[0] == 512 // 3


@pytest.mark.parametrize("what", ["means", "scales"])
def test_a_splat_that_is_no_number_leaves_a_box(what):
    places = np.random.default_rng(0).uniform(-10, 10, (500, 3))
    whole = GaussianSet.create(places, 0.1, density=0.02, modality=1)
    spoiled = getattr(whole, what).copy()
    spoiled[3, 0] = np.nan
    box = section.model_box(replace(whole, **{what: spoiled}))
    np.testing.assert_array_equal(box, section.model_box(whole.select(np.arange(500) != 3)))


def test_stray_splats_do_not_stretch_the_box():
    rng = np.random.default_rng(0)
    means = np.concatenate([rng.uniform(-10, 10, (2000, 3)), [[500.0, 0, 0]]])
    box = section.model_box(GaussianSet.create(means, 0.1))
    assert np.abs(box).max() < 11


def test_without_a_section_the_user_is_told(blender):
    with pytest.raises(ValueError, match="Add Section Plane"):
        section.sample_section(bpy.context.scene)


def test_contour_of_the_section_is_the_ball(cut):
    values, view = section.sample_section(bpy.context.scene, 128)
    line = contour_lines(values, 0.02)[0]
    side = np.linalg.norm(view.u)
    exact = np.sqrt(50 * np.log(2) - (float(cut.sections[0].object.location.y) + 2) ** 2)
    assert side * np.ptp(line[:, 0]) / 2 == pytest.approx(exact, rel=5e-3)


def _delete_as_the_user(thing):
    for other in bpy.context.view_layer.objects:
        other.select_set(other == thing)
    bpy.context.view_layer.objects.active = thing
    bpy.ops.object.delete()
    bpy.context.view_layer.update()


def _colour_bars():
    return [o for o in bpy.data.objects if o.name.startswith("InsideOut Colour Bar")]


def test_a_plane_that_is_deleted_by_hand_takes_the_cut_and_the_colour_bar_along(cut, monkeypatch):
    noticed = []
    monkeypatch.setattr(section_live.live, "mark", noticed.append)
    assert _colour_bars()
    _delete_as_the_user(cut.sections[0].object)
    assert noticed
    assert section.shown_plane(bpy.context.scene) is None
    sections.remove_sections(bpy.context.scene)
    assert len(cut.sections) == 0
    assert not _colour_bars()
    assert not modifier_input(display_modifier(cut.model), "Cut")
    sections.add_section_plane(cut.model, bpy.context)
    assert modifier_input(display_modifier(cut.model), "Cut")


def test_a_plane_that_a_script_removes_is_noticed_too(cut):
    bpy.data.objects.remove(cut.sections[0].object)
    assert section_live.lost_sections(bpy.context.scene)
    sections.remove_sections(bpy.context.scene)
    assert not _colour_bars()
    assert not section_live.lost_sections(bpy.context.scene)


def test_a_model_that_is_deleted_by_hand_is_no_model(cut):
    _delete_as_the_user(cut.model)
    assert not bpy.ops.insideout.section_window.poll()
    section_picture.refresh_sections(bpy.context.scene)
    with pytest.raises(ValueError, match="import a model"):
        section.sample_section(bpy.context.scene)


def test_another_model_is_cut_by_the_plane_that_is_there(cut, one_ball):
    other = create_splats(one_ball, "other", bpy.context)
    show_splats(other, True)
    cut.model = other
    assert modifier_input(display_modifier(other), "Cut")
    assert modifier_input(cut_modifiers(other)[0], "Section") == cut.sections[0].object


def test_the_plane_may_be_renamed_and_its_material_taken_away(cut):
    cut.sections[0].object.name = cut.sections[0].object.data.name = "Schnitt"
    cut.sections[0].object.data.materials.clear()
    section_picture.refresh_sections(bpy.context.scene)
    assert _image().shape[0] == cut.pixels


def test_it_goes_on_in_a_saved_and_reopened_file(cut, tmp_path):
    before, _ = section.sample_section(bpy.context.scene, 64)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "cut.blend"))
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "cut.blend"))
    settings = bpy.context.scene.insideout
    after, _ = section.sample_section(bpy.context.scene, 64)
    np.testing.assert_allclose(after, before, atol=1e-6)
    settings.sections[0].object.location.y -= 5.0
    bpy.context.view_layer.update()
    moved, _ = section.sample_section(bpy.context.scene, 64)
    assert moved.max() < 0.8 * before.max()
    assert modifier_input(cut_modifiers(settings.model)[0], "Section") == settings.sections[0].object


def test_two_scenes_have_a_section_each(cut, one_ball):
    first = bpy.context.scene
    second = bpy.data.scenes.new("Second")
    with bpy.context.temp_override(scene=second, view_layer=second.view_layers[0], collection=second.collection):
        other = create_splats(one_ball, "other", bpy.context)
        show_splats(other, True)
        sections.add_section_plane(other, bpy.context)
    assert first.insideout.sections[0].object != second.insideout.sections[0].object
    assert second.insideout.sections[0].object.name in second.objects
    second.insideout.sections[0].show_density = False
    sections.remove_sections(second)
    assert section.shown_plane(first) is not None
    assert modifier_input(display_modifier(first.insideout.model), "Cut")
    assert len(_colour_bars()) == len(first.insideout.sections[0].object.children)


def test_a_model_of_photos_alone_is_cut_without_a_picture_or_a_colour_bar(blender, photo_run):
    splats = import_splats(photo_run / "fused.ply", "photos", bpy.context)
    splats.rotation_euler = (0.5, 1.0, 0.2)
    bpy.context.view_layer.update()
    plane = sections.add_section_plane(splats, bpy.context)
    np.testing.assert_allclose(plane.matrix_world.to_3x3().col[2], (0, -1, 0), atol=1e-5)
    middle = splats.matrix_world @ Vector((3, 1, -2))
    np.testing.assert_allclose(plane.matrix_world.translation, middle, atol=0.1)
    settings = bpy.context.scene.insideout
    for show_density in (True, False, True):
        settings.sections[0].show_density = show_density
        section_picture.refresh_sections(bpy.context.scene)
        assert bar_parts(plane) == []
        assert (plane.hide_render, plane.display_type) == (True, "WIRE")
    assert modifier_input(display_modifier(splats), "Cut")
