"""Sections that are removed: nothing of them stays, in the scene or in the file, and undo brings them back."""

from __future__ import annotations

import bpy
import numpy as np
import pytest

from insideout.insideout_addon.scene import (
    section,
    section_box,
    section_cut,
    section_face,
    section_live,
    section_picture,
    sections,
)
from insideout.insideout_addon.scene.color_bar import bar_parts
from insideout.insideout_addon.scene.display import display_modifier
from insideout.insideout_addon.scene.node_tree import modifier_input
from insideout.insideout_addon.scene.section_cut import cut_modifiers


def _settings():
    return bpy.context.scene.insideout


def _drawn(plane):
    return np.array(section_face.face_image(plane).pixels[:])


_SECTIONS_DATA = ("meshes", "curves", "images", "materials", "objects")


def _of_sections():
    """What bpy.data holds of sections, by kind, but for what the model is shown by."""
    model = _settings().model
    shown_by = {"InsideOut Soft Splats", "InsideOut Solid Splats", "InsideOut Splats"} | {model.name, model.data.name}
    return {kind: {block.name for block in getattr(bpy.data, kind)} - shown_by for kind in _SECTIONS_DATA}


_NOTHING = {kind: set() for kind in _SECTIONS_DATA}
# In the colour that somebody may have given it; Blender saves nothing that has no user.
_INK_ALONE = {**_NOTHING, "materials": {"InsideOut Colour Bar Text"}}


def _removed(scene, section):
    sections.remove_section(scene, section)


def _deleted_in_the_viewport(scene, section):
    for collection in section.object.users_collection:
        collection.objects.unlink(section.object)
    section_live.remove_lost(scene)


def _deleted_by_a_script(scene, section):
    bpy.data.objects.remove(section.object)
    section_live.remove_lost(scene)


@pytest.mark.parametrize("how", [_removed, _deleted_in_the_viewport, _deleted_by_a_script])
def test_no_data_of_removed_sections_stays(scanned, tmp_path, how):
    scene = bpy.context.scene
    for number in range(3):
        sections.add_section_plane(scanned, bpy.context)
        _settings().sections[-1].beside = ("NONE", "CT", "BOTH")[number]
        section_picture.refresh_sections(scene)
        _settings().colors = ("INFERNO", "GREY", "VIRIDIS")[number]
        sections.add_section_box(scanned, bpy.context)
        section_picture.refresh_sections(scene)
    assert len(_of_sections()["images"]) >= 9
    while len(_settings().sections):
        how(scene, _settings().sections[0])
    assert _of_sections() == _INK_ALONE
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "without.blend"), copy=True)
    with bpy.data.libraries.load(str(tmp_path / "without.blend")) as (saved, _):
        assert saved.images == saved.meshes == saved.curves == []
        assert not [name for name in saved.materials if name.startswith(("InsideOut Colour Bar", "InsideOut Section"))]


def test_pictures_that_are_no_longer_beside_a_plane_leave_nothing(scanned):
    sections.add_section_plane(scanned, bpy.context)
    section_picture.refresh_sections(bpy.context.scene)
    before = _of_sections()
    for _ in range(2):
        _settings().sections[0].beside = "BOTH"
        section_picture.refresh_sections(bpy.context.scene)
        assert len(_of_sections()["images"]) == len(before["images"]) + 2
        _settings().sections[0].beside = "NONE"
    assert {kind: len(names) for kind, names in _of_sections().items() if kind != "objects"} == {
        kind: len(names) for kind, names in before.items() if kind != "objects"
    }


def _renamed(plane_or_box):
    """What the Outliner shows under a plane or a box, under other names."""
    for number, part in enumerate(list(plane_or_box.children)):
        part.name = f"mine {number}"


def test_parts_go_with_their_section_whatever_they_are_called(scanned):
    scene = bpy.context.scene
    for add in (sections.add_section_plane, sections.add_section_box):
        add(scanned, bpy.context)
        _settings().sections[-1].beside = "BOTH"
        section_picture.refresh_sections(scene)
        _renamed(_settings().sections[0].object)
        mark = bpy.data.objects.new("Mark", None)
        scene.collection.objects.link(mark)
        mark.parent = _settings().sections[0].object
        sections.remove_section(scene, _settings().sections[0])
        assert {thing.name for thing in scene.objects if thing.type != "POINTCLOUD"} == {"Mark"}
        bpy.data.objects.remove(mark)
        assert _of_sections() == _INK_ALONE


def test_faces_of_a_box_that_were_renamed_are_drawn_on_and_hidden(scanned):
    box = sections.add_section_box(scanned, bpy.context)
    section_picture.refresh_sections(bpy.context.scene)
    faces = section_box.box_pictures(box)
    faces.name = "Cut faces"
    _settings().colors = "GREY"
    section_picture.refresh_sections(bpy.context.scene)
    assert section_box.box_pictures(box) == faces
    assert len([child for child in box.children if child.type == "MESH" and "insideout_bar" not in child]) == 1
    _settings().sections[0].show_density = False
    assert faces.hide_viewport


def test_faces_of_a_box_in_an_older_file_are_known_by_their_name(scanned):
    box = sections.add_section_box(scanned, bpy.context)
    section_picture.refresh_sections(bpy.context.scene)
    faces = section_box.box_pictures(box)
    for key in set(faces.keys()) - {section.SIZE_KEY}:
        del faces[key]
    assert section_box.box_pictures(box) == faces


def test_what_else_is_used_stays_when_a_section_is_removed(scanned):
    first, second = (sections.add_section_plane(scanned, bpy.context) for _ in range(2))
    section_picture.refresh_sections(bpy.context.scene)
    picture = section_face.face_image(first)
    poster = bpy.data.objects.new("Poster", first.data)
    bpy.context.scene.collection.objects.link(poster)
    kept = section_face.face_image(second)
    sections.remove_section(bpy.context.scene, _settings().sections[0])
    assert section_face.face_image(poster) == picture
    assert section_face.face_image(second) == kept
    assert len(bar_parts(second)) == 9
    assert bar_parts(second)[0].data.materials[0].name == "InsideOut Colour Bar inferno"


def test_a_removed_section_comes_back_with_undo(scanned):
    plane = sections.add_section_plane(scanned, bpy.context)
    section_live.live.refresh(bpy.context.scene)
    before, data, name = _drawn(plane), _of_sections(), plane.name
    bpy.ops.ed.undo_push(message="before")
    assert bpy.ops.insideout.section_remove() == {"FINISHED"}
    bpy.ops.ed.undo_push(message="after")
    assert _of_sections() == _INK_ALONE
    bpy.ops.ed.undo()
    assert _of_sections() == data
    plane = _settings().sections[0].object
    assert plane.name == name
    np.testing.assert_allclose(_drawn(plane), before, atol=0.5 / 255 + 1e-6)
    section_picture.refresh_sections(bpy.context.scene)
    bpy.ops.ed.redo()
    assert {kind: names for kind, names in _of_sections().items() if kind != "materials"} == {
        kind: set() for kind in _SECTIONS_DATA if kind != "materials"
    }


def _cut_by(model):
    return [modifier_input(modifier, "Section") for modifier in cut_modifiers(model)]


def test_a_plane_that_was_deleted_by_hand_cuts_again_when_that_is_undone(scanned, monkeypatch):
    """What went with it did so in no step of the history, and Blender puts back only what a step has changed."""
    scene = bpy.context.scene
    plane = sections.add_section_plane(scanned, bpy.context)
    name = plane.name
    # In a window a timer does what this does here at once.
    bpy.app.handlers.depsgraph_update_post.remove(section_live.on_depsgraph_update)
    # What the last step has changed is put back whole.
    for message in ("here", "before"):
        bpy.ops.ed.undo_push(message=message)
    for thing in scene.objects:
        thing.select_set(thing == plane)
    bpy.ops.object.delete()
    bpy.ops.ed.undo_push(message="after")
    assert _cut_by(scanned)
    section_live.remove_lost(scene)
    assert not _cut_by(scanned)
    assert not modifier_input(display_modifier(scanned), "Cut")
    bpy.ops.ed.undo()
    scene, model = bpy.context.scene, _settings().model
    plane = _settings().sections[0].object
    assert plane.name == name
    assert _cut_by(model) == [plane]
    assert modifier_input(display_modifier(model), "Cut")
    # Nothing is worked out again where nothing was lost.
    monkeypatch.delattr(section_cut, "set_modifier_input")
    section_live.on_undone(scene)
    assert _cut_by(model) == [plane]
