"""What shows a model's inside and what was measured of it: hidden while the model is in pieces, and as before again."""

from __future__ import annotations

import bpy
import pytest

from insideout.insideout_addon.measure.rulers import rulers
from insideout.insideout_addon.measure.thickness_map import thickness_maps
from insideout.insideout_addon.physics import breaking as breaking_module
from insideout.insideout_addon.scene.color_bar import bar_parts
from insideout.insideout_addon.scene.section_picture import refresh_sections
from insideout.insideout_addon.scene.sections import add_section_plane

QUICK = {"pieces": 3, "detail_mm": 4.0}


def hidden():
    """By object: whether it is disabled in the viewport, and in renderings."""
    return {thing.name: (thing.hide_viewport, thing.hide_render) for thing in bpy.context.scene.objects}


def unbroken():
    assert bpy.ops.insideout.unbreak() == {"FINISHED"}
    assert not any("insideout_hidden_by_break" in thing for thing in bpy.data.objects)
    return hidden()


@pytest.fixture
def measured(imported, hollow_ball):
    """A model with a section plane and a box, wall thickness, contours, a distance and its centre of mass; and the
    user's cube, which follows it."""
    model = imported(*hollow_ball)
    scene = bpy.context.scene
    scene.insideout.pixels = 64
    bpy.ops.insideout.section_add()
    bpy.ops.insideout.thickness()
    bpy.ops.insideout.contours_curve()
    for x in (-20.0, 20.0):
        bpy.ops.insideout.point_add(location=(x, 0.0, 0.0))
    bpy.ops.insideout.measure()
    bpy.ops.insideout.weigh(cavities=False)
    bpy.ops.insideout.weigh_center()
    bpy.ops.insideout.section_add_box()
    bpy.ops.mesh.primitive_cube_add()
    bpy.context.object.parent = model
    return model


def test_pieces_fall_out_of_nothing_that_belongs_to_the_whole(measured):
    before = hidden()
    assert {name.partition(".")[0] for name in before} >= {
        *("InsideOut Section", "InsideOut Box", "InsideOut Box Faces", "InsideOut Colour Bar", "InsideOut Measure"),
        *("InsideOut Thickness", "InsideOut Thickness Legend", "InsideOut Point", "InsideOut Contours"),
        *("InsideOut Centre of Mass", "Cube"),
    }
    assert bpy.ops.insideout.break_model(**QUICK) == {"FINISHED"}
    broken = hidden()
    assert {name for name in before if broken[name] != (True, True)} == {"Cube"}
    assert all(broken[name] == (False, False) for name in broken if " Piece " in name and not name.endswith("Splats"))
    assert unbroken() == before


def test_what_the_user_had_hidden_stays_hidden(measured):
    scene = bpy.context.scene
    rulers(scene)[0].hide_render = True
    thickness_maps(scene)[0].hide_viewport = True
    plane, box = (section.object for section in scene.insideout.sections)
    plane.hide_viewport = plane.hide_render = True
    box.hide_set(True)
    measured.hide_render = True
    before = hidden()
    bpy.ops.insideout.break_model(**QUICK)
    assert {name for name in before if hidden()[name] != (True, True)} == {"Cube"}
    assert unbroken() == before
    assert box.hide_get()


def test_the_file_may_be_closed_meanwhile(measured, tmp_path, place):
    plane = bpy.context.scene.insideout.sections[0].object
    plane.location.x = 3.0
    thickness_maps(bpy.context.scene)[0].hide_render = True
    before, where = hidden(), place(plane).tolist()
    bpy.ops.insideout.break_model(**QUICK)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "broken.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "broken.blend"))
    assert {name for name in before if hidden()[name] != (True, True)} == {"Cube"}
    assert unbroken() == before
    plane = bpy.context.scene.insideout.sections[0].object
    bpy.context.view_layer.update()
    assert place(plane).tolist() == where
    assert not plane.hide_viewport


def test_undo_shows_it_again_too(measured):
    before = hidden()
    bpy.ops.ed.undo_push(message="measured")
    bpy.ops.insideout.break_model(**QUICK)
    bpy.ops.ed.undo_push(message="broken")
    broken = hidden()
    assert {name for name in before if broken[name] != (True, True)} == {"Cube"}
    bpy.ops.ed.undo()
    assert hidden() == before
    bpy.ops.ed.redo()
    assert hidden() == broken
    assert unbroken() == before


def test_what_is_made_anew_meanwhile_is_hidden_as_well(measured):
    """A colour bar whose numbers change is another one; a line measured anew has another figure."""
    before, scene = hidden(), bpy.context.scene
    plane = scene.insideout.sections[0].object
    bpy.ops.insideout.break_model(**QUICK)
    for part in bar_parts(plane):
        bpy.data.objects.remove(part)
    scene.insideout.unit = "HU"
    refresh_sections(scene)
    assert bar_parts(plane)
    measured.location.x = 1.0
    bpy.context.view_layer.objects.active = measured
    assert bpy.ops.insideout.apply_transform() == {"FINISHED"}
    anew = [*bar_parts(plane), *rulers(scene)[0].children_recursive]
    assert all(hidden()[part.name] == (True, True) for part in anew)
    assert set(unbroken().values()) == set(before.values())


def test_what_is_set_meanwhile_holds_afterwards(measured):
    section = bpy.context.scene.insideout.sections[0]
    bpy.ops.insideout.break_model(**QUICK)
    section.show_density = False
    section.cut = False
    assert section.object.hide_viewport
    unbroken()
    assert not section.object.hide_viewport
    assert section.object.hide_render
    section.show_density = True
    bpy.ops.insideout.break_model(**QUICK)
    section.flip = True
    assert all(part.hide_viewport for part in [section.object, *bar_parts(section.object)])


def test_sections_are_those_of_the_model_that_is_shown(measured, imported, shells):
    """Of another, which is whole, they show the inside; its own measures stay where the one in pieces is."""
    scene = bpy.context.scene
    before = hidden()
    bpy.ops.insideout.break_model(**QUICK)
    other = imported(*shells, "other")
    sections = [section.object.name for section in scene.insideout.sections]
    assert all(hidden()[name] == before[name] for name in sections)
    assert all(ruler.hide_viewport for ruler in rulers(scene))
    scene.insideout.model = measured
    assert all(hidden()[name] == (True, True) for name in sections)
    scene.insideout.model = other
    breaking_module.make_whole(measured, scene)
    assert {name: now for name, now in hidden().items() if name in before} == before


def test_a_plane_that_is_added_meanwhile_is_seen(measured):
    """It is asked for just now; the next break hides it as well."""
    bpy.ops.insideout.break_model(**QUICK)
    plane = add_section_plane(measured, bpy.context)
    assert not plane.hide_viewport
    unbroken()
    assert not plane.hide_viewport
    bpy.ops.insideout.break_model(**QUICK)
    assert plane.hide_viewport


def test_nothing_is_hidden_by_a_break_that_fails(measured, monkeypatch):
    def fail(*_):
        raise MemoryError

    before = hidden()
    monkeypatch.setattr(breaking_module, "add_floor", fail)
    with pytest.raises(MemoryError):
        breaking_module.break_model(measured, bpy.context, breaking_module.BreakOptions(pieces=3, spacing_mm=4.0))
    assert hidden() == before


def test_a_rigid_body_takes_it_along(measured, place):
    """Sections cut it wherever it falls, and what was measured goes with it."""
    before = hidden()
    (point, *_) = (thing for thing in measured.children if thing.name.startswith("InsideOut Point"))
    bpy.ops.insideout.make_rigid()
    high = place(point)[2, 3]
    for frame in range(1, 8):
        bpy.context.scene.frame_set(frame)
    assert place(point)[2, 3] < high - 1
    assert {name: now for name, now in hidden().items() if name in before} == before
    assert unbroken() == before


def test_of_a_soft_body_sections_are_left(measured):
    """They cut the splats where they are bent to; what was measured would stay where they were."""
    before = hidden()
    bpy.ops.insideout.make_soft(resolution=4)
    changed = {name.partition(".")[0] for name in before if hidden()[name] != before[name]}
    assert changed == {
        *("InsideOut Point", "InsideOut Measure", "InsideOut Measure Text", "InsideOut Measure Casing"),
        *("InsideOut Thickness", "InsideOut Thickness Legend", "InsideOut Thickness Legend Text"),
        *("InsideOut Thickness Legend Casing", "InsideOut Contours", "InsideOut Centre of Mass"),
    }
    assert unbroken() == before
