"""Any number of sections: planes and boxes, what each shows, what their bars say."""

from __future__ import annotations

import bpy
import numpy as np
import pytest

from insideout.core.errors import CaptureError
from insideout.core.render.section_numpy import SectionSplats, section_density
from insideout.core.views import Plane
from insideout.core.volume import Volume
from insideout.insideout_addon.scene import section, section_live, section_picture, sections
from insideout.insideout_addon.scene.color_bar import bar_parts
from insideout.insideout_addon.scene.ct_volume import volume_path
from insideout.insideout_addon.scene.display import display_modifier, show_splats
from insideout.insideout_addon.scene.node_tree import modifier_input
from insideout.insideout_addon.scene.section_cut import cut_modifiers
from insideout.insideout_addon.scene.splats import create_splats


@pytest.fixture
def model(blender, random_set):
    """200 splats, shown, not cut."""
    splats = create_splats(random_set, "model", bpy.context)
    show_splats(splats, True)
    bpy.context.scene.insideout.pixels = 48
    return splats


@pytest.fixture
def scanned(model, random_set, tmp_path):
    """The model of a run whose CT volume is the splats' own density, 0.01 mm⁻¹ too high."""
    splats = SectionSplats(random_set)
    slices = [
        section_density(
            splats, Plane(np.array([-30.5, -30.5, z]), np.array([1.0, 0, 0]), np.array([0, 1.0, 0]), 61, 61)
        )
        for z in range(-30, 31)
    ]
    volume = Volume.centered(np.stack(slices) + np.float32(0.01), np.ones(3))
    volume.save(tmp_path / "initialize" / "volume.npz")
    model["insideout_source"] = str(tmp_path / "fused.ply")
    return model


def _settings():
    return bpy.context.scene.insideout


def _drawn(plane):
    image = section_picture._image(plane)
    pixels = np.empty(image.size[0] * image.size[1] * 4, np.float32)
    image.pixels.foreach_get(pixels)
    return pixels.reshape(image.size[1], image.size[0], 4)[::-1]


def _texts(plane):
    return [part.data.body for part in bar_parts(plane) if part.type == "FONT"]


def _slots(model):
    return [modifier_input(modifier, "Slot") for modifier in cut_modifiers(model)]


def test_further_planes_face_the_front_the_left_and_the_top(model):
    planes = [sections.add_section_plane(model, bpy.context) for _ in range(3)]
    facing = [np.array(plane.matrix_world)[:3, 2] for plane in planes]
    np.testing.assert_allclose(facing, [[0, -1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-6)
    assert [np.array(plane.matrix_world)[2, 1] for plane in planes[:2]] == pytest.approx([1, 1]), "up is up"
    assert len(cut_modifiers(model)) == 3
    assert section.shown_plane(bpy.context.scene) == planes[2]


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


def test_pieces_bring_slots_of_their_own(model):
    model.data.attributes.new("cut_normal_0", "FLOAT_VECTOR", "POINT")
    model.data.attributes.new("cut_height_0", "FLOAT", "POINT")
    sections.add_section_plane(model, bpy.context)
    assert _slots(model) == [1]
    sections.remove_sections(bpy.context.scene)
    assert modifier_input(display_modifier(model), "Cut"), "they stay cut where they were broken"


def test_a_moved_model_is_drawn_on_all_planes(model):
    planes = [sections.add_section_plane(model, bpy.context) for _ in range(2)]
    section_live.live.refresh(bpy.context.scene)
    before = [_drawn(plane) for plane in planes]
    model.location = (1.5, 1.5, 1.5)
    bpy.context.view_layer.update()
    section_live.live.refresh(bpy.context.scene)
    for plane, old in zip(planes, before, strict=True):
        assert np.abs(_drawn(plane) - old).max() > 0.05


def test_a_picture_ends_where_another_section_hides_the_model(model):
    """The plane that is seen from the left hides x < 0: the left half of the front plane's picture."""
    front, left = (sections.add_section_plane(model, bpy.context) for _ in range(2))
    left.location.x = front.location.x
    bpy.context.view_layer.update()
    section_live.live.refresh(bpy.context.scene)
    alpha = _drawn(front)[..., 3]
    assert alpha[:, :24].max() == 0
    assert alpha[:, 24:].max() == 1
    left.location.x -= 100
    bpy.context.view_layer.update()
    section_live.live.refresh(bpy.context.scene)
    assert _drawn(front)[..., 3][:, :24].max() == 1, "the left plane moved away and hides nothing"


@pytest.mark.parametrize("inside", [True, False])
def test_a_picture_ends_at_a_box(model, inside):
    plane, box = sections.add_section_plane(model, bpy.context), sections.add_section_box(model, bpy.context)
    box.matrix_world = plane.matrix_world.copy()
    box.scale = [0.25 * plane["insideout_size_mm"]] * 3
    _settings().sections[1].flip = inside
    bpy.context.view_layer.update()
    section_live.live.refresh(bpy.context.scene)
    shown = _drawn(plane)[..., 3] > 0
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


def test_both_faces_show_the_picture_when_the_halves_are_apart(model):
    plane = sections.add_section_plane(model, bpy.context)
    section_picture.refresh_sections(bpy.context.scene)
    before = _drawn(plane)
    _settings().sections[0].apart_mm = 20.0
    heights = sorted({round(vertex.co.z, 2) for vertex in plane.data.vertices})
    lift = 1.5e-3 * plane["insideout_size_mm"]
    assert heights == pytest.approx([-10 + lift, 10 - lift], abs=0.01)
    assert len(plane.data.polygons) == 2
    section_picture.refresh_sections(bpy.context.scene)
    np.testing.assert_array_equal(_drawn(plane), before)
    _settings().sections[0].apart_mm = 0.0
    assert len(plane.data.polygons) == 1


def test_the_ct_on_the_plane_and_the_difference(scanned):
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
    np.testing.assert_allclose(_drawn(plane), ct.rgba, atol=0.5 / 255 + 1e-6)


def test_a_model_without_its_run_has_no_ct(model):
    sections.add_section_plane(model, bpy.context)
    with pytest.raises(CaptureError, match="no CT volume"):
        volume_path(model)
    _settings().sections[0].picture = "CT"
    assert not section_picture.draw_picture(bpy.context.scene, _settings().sections[0])


def test_densities_in_hounsfield_units(model):
    plane = sections.add_section_plane(model, bpy.context)
    settings = _settings()
    settings.low, settings.high, settings.water, settings.unit = 0.0, 0.04, 0.02, "HU"
    section_picture.refresh_sections(bpy.context.scene)
    assert {"HU", "-1000", "0", "1000"} <= set(_texts(plane))
    settings.unit = "PER_MM"
    section_picture.refresh_sections(bpy.context.scene)
    assert "mm⁻¹" in _texts(plane)


def test_colours_can_be_chosen(model):
    plane = sections.add_section_plane(model, bpy.context)
    section_picture.refresh_sections(bpy.context.scene)
    before = _drawn(plane)
    _settings().colors = "GREY"
    section_picture.refresh_sections(bpy.context.scene)
    grey = _drawn(plane)
    np.testing.assert_allclose(grey[..., 0], grey[..., 2], atol=1e-6)
    assert np.abs(grey - before).max() > 0.1
    (strip,) = [part for part in bar_parts(plane) if part.type == "MESH" and part.data.uv_layers]
    assert [material.name for material in strip.data.materials] == ["InsideOut Colour Bar grey"]


@pytest.mark.parametrize("stretch", [1.0, 2.5])
def test_the_scale_bar_is_as_long_as_it_says(model, stretch):
    plane = sections.add_section_plane(model, bpy.context)
    plane.scale = (stretch, stretch, stretch)
    bpy.context.view_layer.update()
    section_picture.refresh_sections(bpy.context.scene)
    (said,) = [float(text[:-3]) for text in _texts(plane) if text.endswith(" mm")]
    (bar,) = [part for part in bar_parts(plane) if part.type == "MESH" and not part.data.uv_layers]
    bpy.context.view_layer.update()
    corners = np.array([bar.matrix_world @ vertex.co for vertex in bar.data.vertices])
    assert np.ptp(corners[:, 0]) == pytest.approx(said, rel=1e-5)
    assert said <= 0.25 * plane.dimensions.x * (1 + 1e-6) < 5 * said
