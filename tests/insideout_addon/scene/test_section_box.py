"""The density on the faces of a section box: where it lies, what it shows, what it follows."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from mathutils import Euler, Matrix

from insideout.core.errors import CaptureError
from insideout.core.render.section_numpy import SectionSplats, section_density
from insideout.core.views import Plane
from insideout.insideout_addon.scene import section_face, section_picture, sections
from insideout.insideout_addon.scene.color_bar import bar_parts
from insideout.insideout_addon.scene.display import show_splats
from insideout.insideout_addon.scene.section_box import box_pictures
from insideout.insideout_addon.scene.section_image import Window, section_rgba
from insideout.insideout_addon.scene.section_live import live
from insideout.insideout_addon.scene.splats import create_splats, read_density


@pytest.fixture
def model(model):
    """As that of all sections, in finer pictures."""
    bpy.context.scene.insideout.pixels = 128
    return model


@pytest.fixture
def box(model):
    """From -6 to 12 mm, 0 to 18 mm and -10 to 4 mm: all its faces lie in the material; what is in it is hidden."""
    found = sections.add_section_box(model, bpy.context)
    found.matrix_world = Matrix.LocRotScale((3.0, 9.0, -3.0), None, (9.0, 9.0, 7.0))
    _refresh()
    return found


def _settings():
    return bpy.context.scene.insideout


def _refresh():
    bpy.context.view_layer.update()
    live.refresh(bpy.context.scene)


def _image(box):
    image = section_face.face_image(box_pictures(box))
    pixels = np.empty(image.size[0] * image.size[1] * 4, np.float32)
    image.pixels.foreach_get(pixels)
    return pixels.reshape(image.size[1], image.size[0], 4)


def _faces(box):
    """Of each polygon the corners (n, 3) in the world, and (n, 2) in the image, pixels from its lower left."""
    thing = box_pictures(box)
    mesh, matrix = thing.data, np.array(thing.matrix_world)
    size = np.array(section_face.face_image(thing).size)
    for polygon in mesh.polygons:
        places = np.array([mesh.vertices[index].co for index in polygon.vertices]) @ matrix[:3, :3].T + matrix[:3, 3]
        yield places, np.array([mesh.uv_layers["UVMap"].data[index].uv for index in polygon.loop_indices]) * size


def _shown_and_true(box, model, shares=((0.5, 0.5), (0.3, 0.6), (0.8, 0.25))):
    """(n, 4) the picture's colours at places on all faces, and those of the density there."""
    image, splats = _image(box), SectionSplats(read_density(model))
    window = Window(_settings().low, _settings().high)
    back = np.array(model.matrix_world.inverted())
    shown, true = [], []
    for places, pixels in _faces(box):
        across, up = pixels[1] - pixels[0], pixels[3] - pixels[0]
        for u, v in shares:
            pixel = np.floor(pixels[0] + u * across + v * up).astype(int)
            shown.append(image[pixel[1], pixel[0]])
            # Where the middle of this pixel lies.
            u, v = np.linalg.solve(np.stack([across, up], axis=1), pixel + 0.5 - pixels[0])
            place = places[0] + u * (places[1] - places[0]) + v * (places[3] - places[0])
            place = back[:3, :3] @ place + back[:3, 3]
            values = section_density(splats, Plane(place, np.array([1e-6, 0, 0]), np.array([0, 1e-6, 0]), 1, 1))
            true.append(section_rgba(values, window)[0, 0])
    return np.array(shown), np.array(true)


@pytest.mark.parametrize("hides_inside", [True, False])
def test_all_six_faces_show_the_density_where_they_are(model, box, hides_inside):
    _settings().sections[0].flip = hides_inside
    _refresh()
    faces = list(_faces(box))
    assert len(faces) == 6
    ends = {(axis, round(float(places[:, axis].mean()))) for places, _ in faces for axis in range(3)}
    assert {(0, -6), (0, 12), (1, 0), (1, 18), (2, -10), (2, 4)} <= ends
    shown, true = _shown_and_true(box, model)
    assert np.ptp(true[:, :3], axis=0).max() > 0.3
    assert (true[:, 3] > 0.5).any()
    np.testing.assert_allclose(shown, true, atol=0.03)


def test_pictures_lie_on_the_visible_side_of_the_cut(model, box):
    """Inside of a hole, outside of what is left."""

    def heights():
        for places, _ in _faces(box):
            axis = np.ptp(places, axis=0).argmin()
            yield abs(places[:, axis].mean() - (3, 9, -3)[axis]) / (9, 9, 7)[axis]

    _refresh()
    assert all(0.99 < height < 0.999 for height in heights())
    _settings().sections[0].flip = False
    _refresh()
    assert all(1.001 < height < 1.01 for height in heights())


def test_a_turned_box_of_a_turned_and_scaled_model(model, box):
    model.matrix_world = Matrix.LocRotScale((5, -3, 2), Euler((0.3, -0.5, 1.1)), (0.5, 0.5, 0.5))
    box.matrix_world = model.matrix_world @ Matrix.LocRotScale((2, 1, -3), Euler((0.7, 0.2, -0.4)), (12, 6, 9))
    _refresh()
    shown, true = _shown_and_true(box, model)
    np.testing.assert_allclose(shown, true, atol=0.03)


def test_they_follow_the_box(model, box):
    before = _image(box).copy()
    box.location.x += 4
    _refresh()
    assert np.abs(_image(box) - before).max() > 0.1
    shown, true = _shown_and_true(box, model)
    np.testing.assert_allclose(shown, true, atol=0.03)


def test_they_end_where_another_section_hides_the_model(model, box):
    sections.add_section_plane(model, bpy.context).matrix_world = Matrix.Translation((0, 0, 0))
    _refresh()
    image = _image(box)
    for places, pixels in _faces(box):
        x, y = pixels.mean(axis=0).astype(int)
        if places[:, 2].mean() > 0.5:
            assert image[y, x, 3] == 0
    low = next(pixels for places, pixels in _faces(box) if np.allclose(places[:, 2], -10, atol=0.1))
    left, bottom = low.min(axis=0).astype(int)
    right, top = low.max(axis=0).astype(int)
    assert (image[bottom:top, left:right, 3] > 0).any()


def test_each_part_is_where_a_plane_has_pulled_it(model, box):
    sections.add_section_plane(model, bpy.context).matrix_world = Matrix.Translation((0, 0, 0))
    _settings().sections[1].apart_mm = 6.0
    _refresh()
    faces = list(_faces(box))
    # Four faces are divided, top and bottom are moved.
    assert len(faces) == 10
    heights = np.concatenate([places[:, 2] for places, _ in faces])
    assert heights.min() == pytest.approx(-13, abs=0.1)
    assert heights.max() == pytest.approx(7, abs=0.1)
    assert not ((heights > -2.9) & (heights < 2.9)).any()


def test_they_can_be_switched_off_and_on(model, box):
    chosen = _settings().sections[0]
    chosen.show_density = False
    assert box_pictures(box).hide_viewport
    assert box_pictures(box).hide_render
    chosen.show_density = True
    assert not box_pictures(box).hide_viewport


def test_nothing_is_left_of_a_box_that_is_removed(model, box):
    assert bpy.ops.insideout.section_remove() == {"FINISHED"}
    assert [thing.name for thing in bpy.data.objects] == ["model"]


def test_nothing_is_left_of_a_box_that_was_deleted_by_hand(model, box):
    bpy.data.objects.remove(box)
    bpy.context.view_layer.update()
    assert [thing.name for thing in bpy.data.objects] == ["model"]


def test_they_are_kept_in_the_file(model, box):
    assert section_face.face_image(box_pictures(box)).packed_file is not None


def test_photos_alone_have_none(blender, random_set):
    splats = create_splats(random_set, "model", bpy.context)
    splats["insideout_has_density"] = False
    show_splats(splats, True)
    assert box_pictures(sections.add_section_box(splats, bpy.context)) is None


def test_without_the_scan_a_box_does_not_show_the_model_in_its_place(model, box, monkeypatch):
    def missing(*_):
        raise CaptureError("no volume")

    monkeypatch.setattr(section_picture, "scan_on", missing)
    _settings().sections[0].picture = "CT"
    _refresh()
    assert box_pictures(box) is None


def test_a_box_that_is_scaled_to_nothing_shows_nothing(model, box):
    box.scale.x = 0.0
    _refresh()
    assert box_pictures(box) is None
    box.scale.x = 9.0
    _refresh()
    assert len(list(_faces(box))) == 6


def test_a_full_copy_of_the_scene_has_pictures_of_its_own(model, box):
    bpy.ops.scene.new(type="FULL_COPY")
    other = bpy.context.scene
    live.refresh(other)
    images = {
        section_face.face_image(box_pictures(scene.insideout.sections[0].object)).name for scene in bpy.data.scenes
    }
    assert len(images) == 2


def test_the_panel_has_a_switch_and_the_window(model, box, draw_panels):
    texts = draw_panels()
    assert {"Hide Inside", "Density", "Low (mm⁻¹)", "Picture"} <= set(texts)
    assert "Save Section..." not in texts


def _bar_texts(thing):
    return sorted(part.data.body for part in bar_parts(thing) if part.type == "FONT")


def _bars():
    """The sections that have a colour bar which can be seen."""
    return [
        section.object.name
        for section in _settings().sections
        if any(not part.hide_viewport for part in bar_parts(section.object))
    ]


def _extent(box):
    """(2, 3) the box around all parts of the colour bar but the lettering, in the world."""
    bpy.context.view_layer.update()
    parts = [part for part in bar_parts(box) if part.type == "MESH"]
    corners = np.array([part.matrix_world @ vertex.co for part in parts for vertex in part.data.vertices])
    return np.stack([corners.min(axis=0), corners.max(axis=0)])


def test_a_box_alone_has_the_bars_of_a_plane(model, box):
    on_box = _bar_texts(box)
    plane = sections.add_section_plane(model, bpy.context)
    _refresh()
    on_plane = _bar_texts(plane)
    assert len(on_box) == 7
    assert on_box == on_plane
    assert "mm⁻¹" in on_box
    assert _bars() == [plane.name]


def test_the_bars_stand_right_of_the_model_whatever_the_size_of_the_box(model):
    box = sections.add_section_box(model, bpy.context)
    plane_size = 1.12 * 40
    before = _extent(box)
    means = read_density(model).means
    assert before[0, 0] > means[:, 0].max()
    assert np.ptp(before[:, 2]) == pytest.approx(0.723 * plane_size, rel=0.1)
    assert np.ptp(before[:, 1]) < 1e-4
    assert before[:, 2].mean() == pytest.approx(means[:, 2].mean(), abs=4)
    # In its shortest direction no less upright or thinner.
    box.scale = (3.0, 14.0, 5.0)
    _refresh()
    np.testing.assert_allclose(_extent(box), before, atol=1e-3)
    box.scale.x = 40.0
    _refresh()
    assert _extent(box)[0, 0] > box.location.x + 40.0


def test_the_scale_bar_is_as_long_as_it_says(model, box):
    model.matrix_world = Matrix.LocRotScale((5, -3, 2), Euler((0.3, -0.5, 1.1)), (0.5, 0.5, 0.5))
    box.matrix_world = model.matrix_world @ Matrix.LocRotScale((2, 1, -3), Euler((0.7, 0.2, -0.4)), (12, 6, 9))
    _refresh()
    bpy.context.view_layer.update()
    (bar,) = [part for part in bar_parts(box) if part.type == "MESH" and not part.data.uv_layers]
    ends = [bar.matrix_world @ bar.data.vertices[k].co for k in (0, 1)]
    (told,) = [text for text in _bar_texts(box) if text.endswith(" mm")]
    assert (ends[1] - ends[0]).length / 0.5 == pytest.approx(float(told.split()[0]), rel=1e-4)


def test_the_bars_have_the_unit_and_the_colours(model, box):
    _settings().unit, _settings().colors = "HU", "GREY"
    _refresh()
    assert "HU" in _bar_texts(box)
    (strip,) = [part for part in bar_parts(box) if part.type == "MESH" and part.data.uv_layers]
    assert [material.name for material in strip.data.materials] == ["InsideOut Colour Bar grey"]


def test_there_is_one_bar_beside_the_chosen_of_several_boxes(model, box):
    second = sections.add_section_box(model, bpy.context)
    assert _bars() == [second.name]
    _settings().section_index = 0
    _refresh()
    assert _bars() == [box.name]
    _settings().sections[0].show_density = False
    _refresh()
    assert _bars() == [second.name]
    _settings().sections[1].show_density = False
    _refresh()
    assert _bars() == []
    _settings().sections[0].show_density = True
    _refresh()
    assert _bars() == [box.name]


def test_where_the_plane_shows_no_density_the_bar_is_with_the_box(model, box):
    plane = sections.add_section_plane(model, bpy.context)
    assert _bars() == [plane.name]
    _settings().sections[1].show_density = False
    _refresh()
    assert _bars() == [box.name]
    _settings().sections[1].show_density = True
    _refresh()
    assert _bars() == [plane.name]
    sections.remove_section(bpy.context.scene, _settings().sections[1])
    assert _bars() == [box.name]


def test_a_box_of_an_older_file_gets_one_beside_itself(model, box):
    del box["insideout_box_bar_mm"]
    _refresh()
    live.outdate()
    _refresh()
    assert _extent(box)[0, 0] > 12.0


def test_bars_are_read_from_the_front_and_cannot_be_selected(model, box):
    bpy.context.view_layer.update()
    for part in bar_parts(box):
        np.testing.assert_allclose(part.matrix_world.to_3x3(), [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-5)
        assert part.hide_select


def test_photos_alone_and_a_box_of_no_size_have_no_bar(model, box):
    box.scale.x = 0.0
    _refresh()
    assert bar_parts(box) == []
    box.scale.x = 9.0
    _refresh()
    assert len(bar_parts(box)) == 9
    model["insideout_has_density"] = False
    live.outdate()
    _refresh()
    assert bar_parts(box) == []
