"""A .blend from before there were several sections: one plane, which the display itself cut at; or a bare box."""

from __future__ import annotations

import bpy
import pytest

from insideout.insideout_addon.scene import section_live, sections
from insideout.insideout_addon.scene.color_bar import bar_parts
from insideout.insideout_addon.scene.display import display_group, display_modifier
from insideout.insideout_addon.scene.node_tree import modifier_input, set_modifier_input
from insideout.insideout_addon.scene.section_box import box_pictures, remove_box_pictures
from insideout.insideout_addon.scene.section_cut import cut_modifiers
from insideout.insideout_addon.scene.splats import create_splats

pytestmark = pytest.mark.builds_groups


def _old_group():
    group = bpy.data.node_groups.new("InsideOut Splats", "GeometryNodeTree")
    group.is_modifier = True
    sockets = {"Geometry": "Geometry", "Size": "Float", "Section": "Object", "Cut": "Bool", "Flip": "Bool"}
    for name, kind in {**sockets, "Slab": "Float"}.items():
        group.interface.new_socket(name, in_out="INPUT", socket_type=f"NodeSocket{kind}")
    return group


@pytest.fixture
def old(blender, random_set):
    """A model that the old display cuts at a plane, which no section knows; returns both."""
    splats = create_splats(random_set, "model", bpy.context)
    modifier = splats.modifiers.new("InsideOut Splats", "NODES")
    modifier.node_group = _old_group()
    plane = sections.add_section_plane(splats, bpy.context)
    bpy.context.scene.insideout.sections.clear()
    for own in cut_modifiers(splats):
        splats.modifiers.remove(own)
    bar = bpy.data.objects.new("InsideOut Colour Bar", bpy.data.curves.new("text", "FONT"))
    bpy.context.collection.objects.link(bar)
    bar.parent = plane
    for name, value in {"Size": 1.25, "Section": plane, "Cut": True, "Flip": True, "Slab": 2.5}.items():
        set_modifier_input(modifier, name, value)
    return splats, plane


@pytest.fixture
def opened(old, tmp_path):
    names = [thing.name for thing in old]
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "old.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "old.blend"))
    return [bpy.data.objects[name] for name in names]


def test_the_plane_is_a_section_with_its_settings(opened):
    model, plane = opened
    (entry,) = bpy.context.scene.insideout.sections
    assert (entry.object, entry.shape, entry.cut, entry.flip, entry.slab_mm) == (plane, "PLANE", True, True, 2.5)
    (modifier,) = cut_modifiers(model)
    assert modifier_input(modifier, "Section") == plane


def test_the_display_is_the_present_one_with_its_settings(opened):
    display = display_modifier(opened[0])
    assert display.node_group == display_group()
    assert modifier_input(display, "Size") == pytest.approx(1.25)
    assert modifier_input(display, "Cut")


def test_the_colour_bar_is_made_anew(opened):
    section_live.live.refresh(bpy.context.scene)
    plane = opened[1]
    assert len(plane.children) == len(bar_parts(plane)) == 9
    bpy.ops.insideout.section_remove()
    assert [thing.name for thing in bpy.context.scene.objects] == ["model"]
    assert cut_modifiers(opened[0]) == []


def test_it_happens_once(opened):
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    assert len(bpy.context.scene.insideout.sections) == 1


def test_a_plane_that_is_gone_leaves_the_model_whole(old):
    model, plane = old
    bpy.data.objects.remove(plane)
    section_live.on_file_loaded(None)
    assert len(bpy.context.scene.insideout.sections) == 0
    assert display_modifier(model).node_group == display_group()
    assert not modifier_input(display_modifier(model), "Cut")


@pytest.fixture
def reopened_box(blender, random_set, tmp_path):
    """`reopened_box(change)`: a box, changed and opened again, with the frame set as for a rendering."""

    def reopen(change):
        box = sections.add_section_box(create_splats(random_set, "model", bpy.context), bpy.context)
        change(bpy.context.scene.insideout, box)
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "box.blend"))
        bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "box.blend"))
        bpy.context.scene.frame_set(1)
        return bpy.data.objects[sections.BOX_NAME]

    return reopen


def test_a_box_of_before_pictures_gets_none_in_a_made_up_window(reopened_box):
    def before_pictures(settings, box):
        remove_box_pictures(box)
        settings.property_unset("low")
        settings.property_unset("high")

    box = reopened_box(before_pictures)
    (entry,) = bpy.context.scene.insideout.sections
    assert (entry.object, entry.show_density, box_pictures(box)) == (box, False, None)
    entry.show_density = True
    bpy.ops.insideout.section_window()
    section_live.live.refresh(bpy.context.scene)
    assert box_pictures(box) is not None


@pytest.mark.parametrize(
    "change",
    [lambda settings, box: remove_box_pictures(box), lambda settings, box: settings.property_unset("high")],
    ids=["a window", "pictures"],
)
def test_a_box_with_a_window_or_pictures_keeps_them(reopened_box, change):
    box = reopened_box(change)
    assert bpy.context.scene.insideout.sections[0].show_density
    assert box_pictures(box) is not None
