"""Adding a section works in steps: ended between any two nothing stays, and an undo in a break does no harm."""

from __future__ import annotations

import subprocess
import sys

import bpy
import numpy as np
import pytest

from insideout.core.render import section_numpy
from insideout.core.steps import run_through
from insideout.insideout_addon.scene import section, section_live, section_picture, sections
from insideout.insideout_addon.scene.kept_splats import kept_splats
from insideout.insideout_addon.scene.section_box import box_pictures
from insideout.insideout_addon.scene.section_cut import cut_modifiers
from insideout.insideout_addon.scene.section_face import face_image

pytestmark = pytest.mark.builds_groups

_ADDING = {"section_add": sections.add_plane_in_steps, "section_add_box": sections.add_box_in_steps}
_KINDS = ("objects", "meshes", "curves", "materials", "images", "node_groups")


@pytest.fixture
def settings(blender, tmp_path, random_set):
    random_set.save(tmp_path / "fused.ply")
    settings = bpy.context.scene.insideout
    settings.pixels = 32
    bpy.ops.insideout.import_run(filepath=str(tmp_path / "fused.ply"))
    return settings


def _state(settings):
    """What the file has, and the scene says."""
    blocks = [(kind, block.name, block.users) for kind in _KINDS for block in getattr(bpy.data, kind)]
    scene = bpy.context.scene
    told = (settings.is_property_set("high"), len(settings.sections), settings.section_index)
    selected = [thing.name for thing in scene.objects if thing.select_get()]
    modifiers = [modifier.name for modifier in settings.model.modifiers]
    return blocks, told, scene.render.use_lock_interface, selected, modifiers, bpy.context.view_layer.objects.active


def _pictures(thing):
    face = thing if thing.type == "MESH" else box_pictures(thing)
    image = face_image(face)
    pixels = np.empty(len(image.pixels), np.float32)
    image.pixels.foreach_get(pixels)
    return pixels


class _Pressed:
    """The operator as Blender calls it; only Blender makes one of its own class."""

    def __init__(self, tool, told):
        self.add, self.told = _ADDING[tool], told

    def report(self, kinds, text):
        self.told.append(text)


def _steps(tool, told=None):
    return getattr(bpy.types, f"INSIDEOUT_OT_{tool}").steps(_Pressed(tool, [] if told is None else told), bpy.context)


@pytest.mark.parametrize("tool", _ADDING)
@pytest.mark.parametrize("earlier", [0, 1])
def test_ended_between_any_two_steps_nothing_stays(settings, monkeypatch, tool, earlier):
    """Of the first section, whose node group is new, and of a further one; every fifth break is asked."""
    for _ in range(earlier):
        bpy.ops.insideout.section_add()
    monkeypatch.setattr(section_numpy, "_ROWS", 64)
    before = _state(settings)
    for count in range(1, 1000, 5):
        steps, shares = _steps(tool), []
        for _, share in zip(range(count), steps, strict=False):
            shares.append(share)
        if len(shares) < count:
            break
        steps.close()
        assert _state(settings) == before, f"after {count} steps"
    assert count > 15
    assert shares == sorted(shares)
    assert 0 <= shares[0] <= shares[-1] <= 1
    assert len(settings.sections) == earlier + 1


@pytest.mark.parametrize("tool", _ADDING)
def test_the_picture_is_what_drawing_it_again_gives_and_was_worked_out_before(settings, monkeypatch, tool):
    """A model that is moved, turned and scaled; the last step is to be short, and the scene to change in it alone."""
    settings.model.location, settings.model.rotation_euler = (3, -4, 1), (0.3, -0.2, 1.0)
    settings.model.scale = (0.5, 0.7, 0.5)
    bpy.context.view_layer.update()
    steps = _ADDING[tool](settings.model, bpy.context)
    drawing = section_picture.draw_picture

    def draw(*given, **named):
        # Whatever is worked out here Blender would wait for.
        with monkeypatch.context() as patch:
            for module, name in ((section, "section_in_steps"), (section_picture, "section_density")):
                patch.setattr(module, name, None)
            return drawing(*given, **named)

    monkeypatch.setattr(sections, "draw_picture", draw)
    added = run_through(steps)
    found = _pictures(added)
    assert len(np.unique(found)) > 20
    drawing(bpy.context.scene, settings.sections[0])
    np.testing.assert_array_equal(_pictures(added), found)


def test_what_is_edited_in_a_break_is_what_the_picture_shows(settings):
    steps = _ADDING["section_add"](settings.model, bpy.context)
    for _ in range(20):
        next(steps)
    settings.model.data.attributes["density"].data.foreach_set("value", np.zeros(200, np.float32))
    settings.model.data.update_tag()
    bpy.context.view_layer.update()
    plane = run_through(steps)
    assert _pictures(plane).reshape(-1, 4)[:, 3].max() == 0


def test_what_was_edited_just_before_is_what_the_window_spans(settings):
    """What was kept for sections is of before."""
    bpy.ops.insideout.section_add()
    bpy.ops.insideout.section_remove()
    settings.property_unset("high")
    before = kept_splats.of(settings.model).density
    settings.model.data.attributes["density"].data.foreach_set("value", np.full(200, 0.5, np.float32))
    settings.model.data.update_tag()
    sections.add_section_plane(settings.model, bpy.context)
    assert settings.high > 2 * before.max()


def test_after_it_nothing_is_drawn_again(settings, monkeypatch):
    bpy.ops.insideout.section_add()
    drawn = []
    monkeypatch.setattr(section_live, "draw_picture", lambda *given, **named: drawn.append(given))
    section_live.live.refresh(bpy.context.scene)
    assert drawn == []
    settings.sections[0].object.location.x += 1
    bpy.context.view_layer.update()
    section_live.live.refresh(bpy.context.scene)
    assert len(drawn) == 1


def test_a_model_that_is_taken_away_in_a_break_is_told(settings):
    steps = _steps("section_add", told := [])
    next(steps)
    bpy.data.objects.remove(settings.model)
    assert list(steps)
    assert told == ["The scene or its model changed before the section was there; press the button again."]
    assert len(bpy.context.scene.insideout.sections) == 0


def _deleted(settings):
    with bpy.context.temp_override(selected_objects=[settings.model], active_object=settings.model):
        bpy.ops.object.delete()


def _scene_switched(settings):
    bpy.context.window.scene = bpy.data.scenes.new("Other")


@pytest.mark.parametrize("meanwhile", [_deleted, _scene_switched])
def test_where_the_model_left_the_scene_or_another_is_shown_nothing_is_added(settings, meanwhile):
    """A deleted model is still in the file: the scene's settings keep it."""
    before = len(bpy.data.objects)
    steps = _steps("section_add", told := [])
    for _ in range(4):
        next(steps)
    meanwhile(settings)
    assert list(steps)
    assert told == ["The scene or its model changed before the section was there; press the button again."]
    assert len(bpy.data.objects) == before
    assert all(len(scene.insideout.sections) == 0 for scene in bpy.data.scenes)
    assert all(scene.insideout.model is None for scene in bpy.data.scenes if scene.name == "Other")


def test_where_the_active_collection_is_another_file_s_a_section_comes_into_the_scene_s_own(
    settings, linked_collection
):
    bpy.ops.insideout.section_add()
    assert settings.sections[0].object.name in bpy.context.scene.collection.objects
    assert not linked_collection.objects


_SESSION = """
import sys
from types import SimpleNamespace
import bpy
import insideout
from insideout.insideout_addon.scene.sections import add_plane_in_steps
from insideout.insideout_addon.scene.cutting import cut_group

bpy.ops.wm.read_factory_settings(use_empty=True)
insideout.register()
bpy.context.scene.insideout.pixels = 32
bpy.ops.ed.undo_push(message="Nothing")
bpy.ops.insideout.import_run(filepath={ply!r})
for message in ("Imported", "Here"):
    bpy.ops.ed.undo_push(message=message)
pressed = SimpleNamespace(add=add_plane_in_steps, report=lambda kinds, text: print(text))
for count in range(1, 1000, 9):
    steps, made = bpy.types.INSIDEOUT_OT_section_add.steps(pressed, bpy.context), 0
    for made, _ in zip(range(1, count + 1), steps):
        pass
    if made < count:
        break
    {meanwhile}
    {then}
    bpy.ops.insideout.section_remove() if len(bpy.context.scene.insideout.sections) else None
    bpy.data.orphans_purge(do_recursive=True)
    bpy.ops.ed.undo_push(message="Again")
    bpy.ops.ed.undo_push(message="And again")
print("Ends:", count, len(bpy.data.node_groups) > 0, cut_group().name)
insideout.unregister()
"""


@pytest.mark.parametrize(
    ("meanwhile", "then"),
    [("bpy.ops.ed.undo()", "list(steps)"), ("bpy.data.orphans_purge(do_recursive=True)", "steps.close()")],
)
def test_an_undo_in_a_break_does_no_harm(tmp_path, random_set, meanwhile, then):
    """In a process of its own, which would end if a socket that is gone were asked for anything."""
    random_set.save(tmp_path / "fused.ply")
    code = _SESSION.format(ply=str(tmp_path / "fused.ply"), meanwhile=meanwhile, then=then)
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=300)
    assert answer.returncode == 0, answer.stdout[-2000:] + answer.stderr[-2000:]
    assert "Traceback" not in answer.stderr
    ended = next(line for line in answer.stdout.splitlines() if line.startswith("Ends:"))
    assert int(ended.split()[1]) > 20


def test_after_it_one_undo_takes_it_away(settings):
    bpy.ops.ed.undo_push(message="Before")
    bpy.ops.insideout.section_add()
    bpy.ops.ed.undo_push(message="Add Section Plane")
    bpy.ops.ed.undo()
    model = bpy.context.scene.insideout.model
    assert len(bpy.context.scene.insideout.sections) == 0
    assert cut_modifiers(model) == []
    assert sorted(thing.type for thing in bpy.data.objects) == ["POINTCLOUD"]
