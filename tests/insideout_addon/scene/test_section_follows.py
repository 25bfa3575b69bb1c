"""What happens under a section: the model is edited or replaced, the plane animated, scaled, hidden or taken apart."""

from __future__ import annotations

from types import SimpleNamespace

import bpy
import numpy as np
import pytest

from insideout.core.render import section_numpy
from insideout.insideout_addon.scene import section, section_face, section_live, section_picture, sections
from insideout.insideout_addon.scene.color_bar import bar_parts
from insideout.insideout_addon.scene.display import display_modifier, show_splats
from insideout.insideout_addon.scene.kept_splats import kept_splats
from insideout.insideout_addon.scene.node_tree import modifier_input
from insideout.insideout_addon.scene.splats import create_splats


@pytest.fixture
def cut(blender, random_set):
    """A model of 200 splats with its section plane."""
    splats = create_splats(random_set, "model", bpy.context)
    show_splats(splats, True)
    sections.add_section_plane(splats, bpy.context)
    bpy.context.scene.insideout.pixels = 48
    return bpy.context.scene.insideout


@pytest.fixture
def timers(monkeypatch):
    """The timers that section_live.py registers when it believes there is a window."""
    registered = []

    def register(function, **options):
        registered.append(function)
        bpy.app.timers.register(function, **options)

    window = SimpleNamespace(
        background=False,
        timers=SimpleNamespace(
            register=register,
            is_registered=bpy.app.timers.is_registered,
            unregister=bpy.app.timers.unregister,
        ),
        handlers=bpy.app.handlers,
        is_job_running=bpy.app.is_job_running,
    )
    monkeypatch.setattr(section_live, "bpy", SimpleNamespace(app=window, data=bpy.data, types=bpy.types))
    return registered


def _sampled():
    return section.sample_section(bpy.context.scene)[0]


def _drawn():
    image = section_face.face_image(bpy.context.scene.insideout.sections[0].object)
    pixels = np.empty(image.size[0] * image.size[1] * 4, np.float32)
    image.pixels.foreach_get(pixels)
    return pixels.reshape(image.size[1], image.size[0], 4)


def _drawn_anew():
    section_picture.refresh_sections(bpy.context.scene)
    return _drawn()


def _render(folder, animation=False):
    """A picture of a few pixels, or of frames 1 and 2; returns what the plane showed in each."""
    scene = bpy.context.scene
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(camera)
    scene.camera, scene.render.engine, scene.cycles.samples = camera, "CYCLES", 1
    scene.render.resolution_x = scene.render.resolution_y = 8
    scene.frame_start, scene.frame_end, scene.render.filepath = 1, 2, str(folder / "#")
    shown = []
    bpy.app.handlers.render_post.append(lambda *_: shown.append(_drawn()))
    bpy.ops.render.render(animation=animation, write_still=not animation)
    bpy.app.handlers.render_post.clear()
    return shown


def _labels(plane):
    return sorted(part.data.body for part in bar_parts(plane) if part.type == "FONT")


def test_a_hundred_changes_wait_for_one_timer(cut, timers):
    for step in range(100):
        cut.low = step * 1e-5
    assert len(timers) == 1
    section_live.detach()
    assert not bpy.app.timers.is_registered(timers[0])
    section_live.attach()


def test_an_edited_model_is_read_again(cut):
    before = _sampled()
    cut.model.scale = (2, 2, 2)
    for other in bpy.context.view_layer.objects:
        other.select_set(other == cut.model)
    bpy.context.view_layer.objects.active = cut.model
    bpy.ops.object.transform_apply(scale=True)
    after = _sampled()
    kept_splats.clear()
    np.testing.assert_array_equal(after, _sampled())
    assert np.abs(after - before).max() > 0.1 * before.max()


def test_a_model_edited_while_there_is_no_plane_is_read_again(cut):
    _sampled()
    sections.remove_sections(bpy.context.scene)
    density = np.zeros(200, np.float32)
    cut.model.data.attributes["density"].data.foreach_set("value", density)
    cut.model.data.update_tag()
    bpy.context.view_layer.update()
    sections.add_section_plane(cut.model, bpy.context)
    assert _sampled().max() == 0


def test_undoing_an_edit_is_noticed(cut):
    bpy.ops.ed.undo_push(message="before")
    before = _sampled()
    cut.model.data.attributes["density"].data.foreach_set("value", np.zeros(200, np.float32))
    cut.model.data.update_tag()
    bpy.context.view_layer.update()
    assert _sampled().max() == 0
    bpy.ops.ed.undo_push(message="after")
    bpy.ops.ed.undo()
    bpy.context.view_layer.update()
    np.testing.assert_array_equal(_sampled(), before)


def test_the_model_before_is_whole_again(cut, one_ball):
    first = cut.model
    second = create_splats(one_ball, "second", bpy.context)
    show_splats(second, True)
    cut.model = second
    assert not modifier_input(display_modifier(first), "Cut")
    assert modifier_input(display_modifier(second), "Cut")
    cut.model = first
    assert modifier_input(display_modifier(first), "Cut")
    assert not modifier_input(display_modifier(second), "Cut")


def test_a_plane_deleted_in_background_mode_is_gone_at_once(cut):
    for other in bpy.context.view_layer.objects:
        other.select_set(other == cut.sections[0].object)
    bpy.ops.object.delete()
    assert len(cut.sections) == 0
    assert [o.name for o in bpy.context.scene.objects] == ["model"]
    assert not modifier_input(display_modifier(cut.model), "Cut")


def test_an_animated_plane_takes_its_picture_along(cut):
    scene = bpy.context.scene
    cut.sections[0].object.keyframe_insert("location", frame=1)
    cut.sections[0].object.location.y += 8
    cut.sections[0].object.keyframe_insert("location", frame=10)
    for frame in (10, 1):
        scene.frame_set(frame)
        seen = _drawn()
        np.testing.assert_array_equal(seen, _drawn_anew())
    first = seen
    scene.frame_set(10)
    assert np.abs(_drawn() - first).max() > 0.05


def test_each_rendered_frame_shows_its_own_section(cut, tmp_path):
    scene = bpy.context.scene
    cut.sections[0].object.keyframe_insert("location", frame=1)
    cut.sections[0].object.location.y += 8
    cut.sections[0].object.keyframe_insert("location", frame=2)
    scene.frame_set(1)
    rendered = _render(tmp_path, animation=True)
    wanted = []
    for frame in (1, 2):
        scene.frame_set(frame)
        wanted.append(_drawn_anew())
    np.testing.assert_array_equal(rendered, wanted)
    assert np.abs(wanted[0] - wanted[1]).max() > 0.05


def test_a_window_is_locked_before_its_picture_changes_in_the_thread_that_renders(cut, timers, monkeypatch):
    """Unlocked it would draw the picture at the same time, and Blender crashes."""
    scene = bpy.context.scene
    assert scene.render.use_lock_interface
    drawn = []
    monkeypatch.setattr(section_live, "draw_picture", lambda *_, **options: drawn.append(options))
    monkeypatch.setattr(section_live.bpy.app, "is_job_running", lambda kind: kind == "RENDER")
    cut.sections[0].object.location.y += 1
    bpy.context.view_layer.update()
    scene.render.use_lock_interface = False
    section_live.on_frame_changed(scene, None)
    assert drawn == []
    scene.render.use_lock_interface = True
    section_live.on_frame_changed(scene, None)
    assert len(drawn) == 1
    section_live._redraw_live()
    assert len(drawn) == 1, "the timer waits until rendering ends"


def test_a_picture_out_of_date_is_not_rendered(cut, tmp_path):
    section_picture.draw_picture(bpy.context.scene, cut.sections[0], divisor=3)
    coarse = _drawn()
    assert coarse.shape[0] == 16
    assert _render(tmp_path)[0].shape[0] == 48
    cut.high *= 2
    np.testing.assert_array_equal(_render(tmp_path)[0], _drawn_anew())


def test_a_stretched_plane_has_a_section_of_its_shape(cut):
    square, _ = section.sample_section(bpy.context.scene)
    cut.sections[0].object.scale = (2, 1, 1)
    bpy.context.view_layer.update()
    values, view = section.sample_section(bpy.context.scene)
    assert square.shape == (48, 48)
    assert values.shape == (24, 48)
    assert np.linalg.norm(view.u) == pytest.approx(np.linalg.norm(view.v), rel=1e-5)
    assert 48 * np.linalg.norm(view.u) == pytest.approx(cut.sections[0].object.dimensions.x, rel=1e-5)
    section_picture.refresh_sections(bpy.context.scene)
    assert _drawn().shape == (24, 48, 4)


@pytest.mark.parametrize("which", ["plane", "model"])
def test_what_is_scaled_to_nothing_is_told(cut, which):
    (cut.model if which == "model" else cut.sections[0].object).scale = (0, 0, 0)
    bpy.context.view_layer.update()
    section_picture.refresh_sections(bpy.context.scene)
    with pytest.raises(section.NoSectionError, match="scaled to nothing"):
        section.sample_section(bpy.context.scene)


@pytest.mark.parametrize("lost", [slice(0, 1), slice(3, 4), slice(6, 7), slice(None)])
def test_a_colour_bar_that_was_taken_apart_is_made_anew(cut, lost):
    before = _labels(cut.sections[0].object)
    for part in bar_parts(cut.sections[0].object)[lost]:
        bpy.data.objects.remove(part)
    section_picture.refresh_sections(bpy.context.scene)
    assert _labels(cut.sections[0].object) == before
    assert len(bar_parts(cut.sections[0].object)) == 9
    assert len([curve for curve in bpy.data.curves if curve.users]) == 7


def test_an_unlinked_label_is_made_anew(cut):
    label = bar_parts(cut.sections[0].object)[2]
    label.use_fake_user = True
    bpy.context.scene.collection.objects.unlink(label)
    section_picture.refresh_sections(bpy.context.scene)
    assert len([part for part in bar_parts(cut.sections[0].object) if part.name in bpy.context.scene.objects]) == 9


def test_a_plane_in_an_excluded_collection_can_be_hidden(blender, random_set):
    held = bpy.data.collections.new("held")
    bpy.context.scene.collection.children.link(held)
    layer = bpy.context.view_layer.layer_collection.children["held"]
    bpy.context.view_layer.active_layer_collection = layer
    splats = create_splats(random_set, "model", bpy.context)
    show_splats(splats, True)
    sections.add_section_plane(splats, bpy.context)
    layer.exclude = True
    settings = bpy.context.scene.insideout
    settings.sections[0].show_density = False
    assert all(part.hide_viewport for part in bar_parts(settings.sections[0].object))
    settings.sections[0].show_density = True
    assert not any(part.hide_viewport for part in bar_parts(settings.sections[0].object))


def test_the_plane_is_placed_in_the_models_frame(cut):
    cut.model.scale = (0.1, 0.1, 0.1)
    bpy.context.view_layer.update()
    section.place_plane(bpy.context.scene, (5, -2, 1), (0, 0, 2))
    matrix = np.array(cut.model.matrix_world.inverted() @ cut.sections[0].object.matrix_world)
    np.testing.assert_allclose(matrix[:3, 3], [5, -2, 1], atol=1e-5)
    np.testing.assert_allclose(matrix[:3, 2] / np.linalg.norm(matrix[:3, 2]), [0, 0, 1], atol=1e-6)
    section.place_plane(bpy.context.scene, position=(0, 0, 0))
    kept = np.array(cut.model.matrix_world.inverted() @ cut.sections[0].object.matrix_world)
    np.testing.assert_allclose(kept[:3, :3], matrix[:3, :3], atol=1e-5)


@pytest.fixture
def two_scenes(cut, random_set, monkeypatch):
    """A second scene, with a model and a plane of its own; in both all pictures are in full."""
    first = bpy.context.scene
    second = bpy.data.scenes.new("Second")
    with bpy.context.temp_override(scene=second, view_layer=second.view_layers[0], collection=second.collection):
        splats = create_splats(random_set, "other model", bpy.context)
        show_splats(splats, True)
        sections.add_section_plane(splats, bpy.context)
    second.insideout.pixels = 48
    monkeypatch.setattr(section_live, "_SETTLE_S", 0.0)
    drawn = []
    draw = section_live.draw_picture

    def note(scene, section, *args, **options):
        drawn.append(scene)
        return draw(scene, section, *args, **options)

    for scene in (first, second):
        section_live.live.refresh(scene)
    section_live._redraw_live()
    monkeypatch.setattr(section_live, "draw_picture", note)
    return first, second, drawn


def test_each_scene_that_changes_gets_its_pictures(two_scenes):
    """Two windows may show two scenes, and an object may move in both at once."""
    first, second, drawn = two_scenes
    for scene in (first, second):
        scene.insideout.sections[0].object.location.z += 1
        scene.view_layers[0].update()
        section_live.live.moved(scene)
    assert section_live._redraw_live() is None
    assert drawn == [first, second]
    section_live._redraw_live()
    assert drawn == [first, second], "nothing has changed since"


def test_a_setting_of_one_scene_leaves_the_other_ones_pictures(two_scenes):
    first, second, drawn = two_scenes
    first.insideout.low = 0.001
    section_live.live.moved(second)
    section_live._redraw_live()
    assert drawn == [first]


def test_an_edited_model_is_noticed_in_its_scene_whichever_was_cut_last(two_scenes):
    first, second, drawn = two_scenes
    section.sample_section(second)
    first.insideout.model.data.update_tag()
    first.view_layers[0].update()
    section_live._redraw_live()
    assert drawn == [first]


def test_a_scene_that_is_deleted_meanwhile_is_passed_over(two_scenes):
    first, second, drawn = two_scenes
    first.insideout.low = 0.001
    second.insideout.low = 0.001
    bpy.data.scenes.remove(second)
    assert section_live._redraw_live() is None
    assert drawn == [first]


def _forget(scene):
    """The scene's splats, as if they were edited."""
    scene.insideout.model.data.update_tag()
    scene.view_layers[0].update()


def _calls(most=500):
    """How often the timer is called until it has nothing to do."""
    for count in range(1, most + 1):
        if section_live._redraw_live() is None:
            return count
    raise AssertionError(f"still at work after {most} calls")


def test_edited_splats_are_read_a_little_with_each_call(two_scenes, monkeypatch):
    """A million are read in a second, in which the window would stand still."""
    first, _, drawn = two_scenes
    monkeypatch.setattr(section_live, "_QUICK_S", 0.0)
    monkeypatch.setattr(section_numpy, "_ROWS", 20)
    first.insideout.model.data.attributes["density"].data.foreach_set("value", np.zeros(200, np.float32))
    _forget(first)
    assert section_live._redraw_live() is not None
    assert drawn == [], "they are not read yet"
    assert _calls() > 8
    assert drawn == [first]
    assert _sampled().max() == 0


def test_two_models_that_were_edited_are_both_read_to_the_end(two_scenes, monkeypatch):
    """One is kept at a time: in turns, each would have the other begin anew."""
    first, second, drawn = two_scenes
    monkeypatch.setattr(section_live, "_QUICK_S", 0.0)
    monkeypatch.setattr(section_numpy, "_ROWS", 20)
    for scene in (first, second):
        _forget(scene)
    _calls()
    assert sorted(scene.name for scene in drawn) == sorted([first.name, second.name])


def test_splats_that_are_edited_again_while_they_are_read_are_read_again(two_scenes, monkeypatch):
    first, _, drawn = two_scenes
    monkeypatch.setattr(section_live, "_QUICK_S", 0.0)
    _forget(first)
    section_live._redraw_live()
    first.insideout.model.data.attributes["density"].data.foreach_set("value", np.zeros(200, np.float32))
    _forget(first)
    _calls()
    assert drawn == [first]
    assert _sampled().max() == 0


def test_splats_that_change_in_each_frame_are_drawn_all_the_same(two_scenes, monkeypatch):
    """Each frame would have a reading begin anew, and none would ever end."""
    first, _, drawn = two_scenes
    monkeypatch.setattr(section_live, "_QUICK_S", 0.0)
    monkeypatch.setattr(section_numpy, "_ROWS", 20)
    for _ in range(60):
        _forget(first)
        section_live._redraw_live()
    assert len(drawn) >= 2


def test_of_damaged_splats_the_picture_is_empty(two_scenes):
    first, _, drawn = two_scenes
    data = first.insideout.model.data
    data.attributes.remove(data.attributes["density"])
    data.attributes.new("density", "INT", "POINT")
    _forget(first)
    _calls()
    assert drawn == [first]
    assert _drawn().max() == 0


def test_a_picture_gets_coarser_where_the_cut_itself_takes_the_time(cut, monkeypatch):
    live, plane = section_live.live, cut.sections[0].object
    for cut_s, divisor in ((10.0, section_live._COARSEST), (0.0, 1)):
        plane.location.z += 1
        bpy.context.view_layer.update()
        assert 0 < live._cut_s < 10, "Blender has just cut the model"
        monkeypatch.setattr(live, "_cut_s", cut_s)
        # However long a picture takes here.
        monkeypatch.setattr(section_live, "_QUICK_S", 9.0)
        monkeypatch.setattr(section_live, "_LEAST_S", 1e-9)
        live._draw_quickly(bpy.context.scene)
        assert live._divisor == divisor
