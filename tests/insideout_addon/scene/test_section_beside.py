"""The CT on a section plane, and the difference to it, beside the model's own picture."""

from __future__ import annotations

from contextlib import nullcontext
from types import SimpleNamespace
from unittest.mock import MagicMock

import bpy
import numpy as np
import pytest

from insideout.core import volume
from insideout.insideout_addon.scene import ct_volume, section, section_face, section_live, section_picture, sections
from insideout.insideout_addon.scene.color_bar import bar_parts
from insideout.insideout_addon.scene.following import follow
from insideout.insideout_addon.scene.following_nodes import CORNERS
from insideout.insideout_addon.scene.section_beside import BAR_SHIFT, beside_parts
from insideout.insideout_addon.scene.splats import read_splats
from insideout.operators import scan_read, waiting


@pytest.fixture
def plane(scanned):
    """A section plane through the scanned model; chosen() has its settings."""
    return sections.add_section_plane(scanned, bpy.context)


def _chosen():
    return bpy.context.scene.insideout.sections[0]


def _show(beside):
    _chosen().beside = beside
    section_picture.refresh_sections(bpy.context.scene)


def _faces(plane):
    return [part for part in beside_parts(plane) if part.type == "MESH"]


def _texts(plane):
    return [part.data.body for part in beside_parts(plane) if part.type == "FONT"]


def _pixels(face):
    image = section_face.face_image(face)
    pixels = np.empty(image.size[0] * image.size[1] * 4, np.float32)
    image.pixels.foreach_get(pixels)
    return pixels.reshape(image.size[1], image.size[0], 4)[::-1]


def _corners(face):
    return np.array([vertex.co[:] for vertex in face.data.vertices])


def test_nothing_is_beside_a_plane_unless_asked_for(plane):
    section_picture.refresh_sections(bpy.context.scene)
    assert beside_parts(plane) == []


def test_the_ct_has_the_same_colours_and_pixels_as_the_model(plane):
    _show("CT")
    (face,) = _faces(plane)
    values, view = section.sample_section(bpy.context.scene)
    wanted = section_picture.picture_of(values, view, bpy.context.scene, "CT").rgba
    np.testing.assert_allclose(_pixels(face), wanted, atol=0.5 / 255 + 1e-6)
    model = section_picture.picture_of(values, view, bpy.context.scene, "MODEL").rgba
    np.testing.assert_allclose(_pixels(plane), model, atol=0.5 / 255 + 1e-6)


def test_the_difference_is_a_third_picture_and_says_its_range(plane):
    bpy.context.scene.insideout.low, bpy.context.scene.insideout.high = 0.0, 0.04
    _show("BOTH")
    values, view = section.sample_section(bpy.context.scene)
    for face, kind in zip(_faces(plane), ("CT", "DIFFERENCE"), strict=True):
        wanted = section_picture.picture_of(values, view, bpy.context.scene, kind).rgba
        np.testing.assert_allclose(_pixels(face), wanted, atol=0.5 / 255 + 1e-6)
    assert sorted(_texts(plane)) == ["CT", "Model", "Model - CT, -0.0100 (blue) to 0.0100 (red) mm⁻¹"]


def test_pictures_stand_to_the_right_of_one_another_in_the_plane(plane):
    _show("BOTH")
    size = plane[section.SIZE_KEY]
    ct, difference = (_corners(face) for face in _faces(plane))
    np.testing.assert_allclose(ct - _corners(plane), [[size, 0, 0]] * 4, atol=1e-4)
    assert difference[:, 0].min() > ct[:, 0].max()
    for part in beside_parts(plane):
        assert part.parent == plane
        assert part.matrix_basis.is_identity


def test_the_colour_bar_stands_right_of_the_ct_and_goes_back(plane):
    def left():
        (strip,) = [part for part in bar_parts(plane) if part.get("insideout_bar") == "strip"]
        return _corners(strip)[:, 0].min()

    section_picture.refresh_sections(bpy.context.scene)
    before = left()
    _show("CT")
    assert left() - before == pytest.approx(BAR_SHIFT * plane[section.SIZE_KEY], rel=1e-5)
    _show("NONE")
    assert left() == pytest.approx(before)


def test_they_follow_a_plane_that_moves(plane):
    _show("CT")
    (face,) = _faces(plane)
    before = _pixels(face)
    plane.location.y += 8
    bpy.context.view_layer.update()
    assert section_picture.draw_picture(bpy.context.scene, _chosen(), divisor=2, quick=True)
    assert _faces(plane) == [face]
    assert _pixels(face).shape == (24, 24, 4)
    section_live.live.refresh(bpy.context.scene)
    assert np.abs(_pixels(face) - before).max() > 0.2


def test_they_end_where_another_section_hides_the_model(plane, scanned):
    _show("CT")
    other = sections.add_section_plane(scanned, bpy.context)
    other.location.x = _chosen().object.location.x
    bpy.context.view_layer.update()
    section_picture.refresh_sections(bpy.context.scene)
    (face,) = _faces(plane)
    assert _pixels(face)[:, :20, 3].max() == 0
    assert _pixels(face)[:, 28:, 3].max() > 0.9


def test_they_lie_on_the_visible_side(plane):
    _show("CT")
    _chosen().flip = True
    section_picture.refresh_sections(bpy.context.scene)
    (face,) = _faces(plane)
    assert _corners(face)[:, 2] == pytest.approx(_corners(plane)[:, 2])
    assert _corners(face)[0, 2] < 0


def test_seen_from_below_texts_are_no_mirror_writing_and_pictures_stand_on_the_right(plane):
    _chosen().flip = True
    _show("BOTH")
    bpy.context.view_layer.update()
    towards_viewer = -np.array(plane.matrix_world.col[2])[:3]
    towards_viewer /= np.linalg.norm(towards_viewer)
    texts = [part for part in [*bar_parts(plane), *beside_parts(plane)] if part.type == "FONT"]
    assert texts
    for part in texts:
        facing = np.array(part.matrix_world.col[2])[:3]
        np.testing.assert_allclose(facing @ towards_viewer, np.linalg.norm(facing), rtol=1e-5)
    for face in _faces(plane):
        assert _corners(face)[:, 0].max() < 0


def test_a_saved_comparison_says_what_its_pictures_are(plane, tmp_path, read_png):
    bpy.ops.insideout.section_save(filepath=str(tmp_path / "s.png"), content="COMPARISON")
    _, _, texts = read_png(tmp_path / "s.png")
    assert texts["Pictures"] == "Model, CT, Difference (model - CT)"


def test_of_a_flipped_plane_the_ct_is_saved_as_the_face_is_seen_too(plane, scanned):
    views = []
    for flip in (False, True):
        _chosen().flip = flip
        values, view = section.section_as_seen(bpy.context.scene)
        scan = section_picture.scan_on(view, scanned)
        assert np.median(np.abs(scan - values - 0.01)) < 0.002
        views.append((values, scan))
    for above, below in zip(*views, strict=True):
        np.testing.assert_allclose(below, above[:, ::-1], atol=1e-6)


def test_they_light_nothing_and_cannot_be_selected(plane):
    _show("BOTH")
    for face in _faces(plane):
        assert face.hide_select
        assert not any((face.visible_shadow, face.visible_diffuse, face.visible_glossy))


@pytest.mark.parametrize("kind", ["CT", "DIFFERENCE"])
def test_beside_another_picture_than_the_models_there_is_none(plane, kind):
    _show("BOTH")
    _chosen().picture = kind
    assert beside_parts(plane) == []


def test_without_a_ct_there_is_the_model_alone_and_the_panel_says_why(scanned, plane, draw_panels):
    _show("CT")
    scanned["insideout_source"] = "/nowhere/fused.ply"
    section_picture.refresh_sections(bpy.context.scene)
    assert beside_parts(plane) == []
    assert _pixels(plane).max() > 0
    assert any("no CT volume" in text for text in draw_panels())


def test_a_body_that_is_bent_is_not_compared_with_the_ct_of_before(scanned, plane, draw_panels, tmp_path):
    """Its motion would pass for wrong densities."""
    mesh = bpy.data.meshes.new("cage")
    corners = [(x, y, z) for z in (-30, 30) for y in (-30, 30) for x in (-30, 30)]
    mesh.from_pydata(corners, [(0, 1)], [])
    for k, name in enumerate(CORNERS, 1):
        mesh.attributes.new(name, "INT", "POINT").data.foreach_set("value", [k] + [0] * 7)
    cage = bpy.data.objects.new("cage", mesh)
    bpy.context.scene.collection.objects.link(cage)
    places = (read_splats(scanned).means + 30) / 60
    follow(scanned, cage, np.zeros(len(places)), places, np.array([60.0] * 3))
    bpy.context.view_layer.update()

    _show("BOTH")
    assert len(_faces(plane)) == 2, "at rest"
    told = "A soft body is not shown with its CT while it is bent"
    assert told not in draw_panels(width=2000)
    mesh.vertices[7].co.z -= 10
    mesh.update()
    bpy.context.view_layer.update()
    section_picture.refresh_sections(bpy.context.scene)
    assert beside_parts(plane) == []
    assert told in draw_panels(width=2000)
    assert _pixels(plane).max() > 0
    with pytest.raises(RuntimeError, match="is bent as a soft body"):
        bpy.ops.insideout.section_save(filepath=str(tmp_path / "c.png"), content="COMPARISON")
    _chosen().picture = "DIFFERENCE"
    section_picture.refresh_sections(bpy.context.scene)
    assert _pixels(plane).max() == 0


def test_density_off_hides_them(plane):
    _show("CT")
    _chosen().show_density = False
    assert all(part.hide_render and part.hide_viewport for part in beside_parts(plane))


@pytest.mark.parametrize("by_hand", [False, True])
def test_they_go_with_their_plane(plane, by_hand):
    _show("BOTH")
    if by_hand:
        bpy.data.objects.remove(plane)
        section_live.remove_lost(bpy.context.scene)
    else:
        sections.remove_section(bpy.context.scene, _chosen())
    assert [thing.name for thing in bpy.data.objects] == ["model"]


def test_what_was_deleted_by_hand_comes_again(plane):
    _show("CT")
    bpy.data.objects.remove(_faces(plane)[0])
    section_picture.refresh_sections(bpy.context.scene)
    assert len(_faces(plane)) == 1


@pytest.mark.parametrize("end", ["hidden", "removed", "new file"])
def test_the_ct_is_not_held_longer_than_it_is_shown(plane, scanned, end):
    _show("CT")
    assert ct_volume.kept_volume._volume is not None
    if end == "hidden":
        _show("NONE")
    elif end == "removed":
        sections.remove_section(bpy.context.scene, _chosen())
    else:
        bpy.ops.wm.read_homefile(use_empty=True)
    assert ct_volume.kept_volume._volume is None


def test_a_comparison_that_was_saved_does_not_hold_the_ct(plane, tmp_path):
    assert bpy.ops.insideout.section_save(filepath=str(tmp_path / "s.png"), content="COMPARISON") == {"FINISHED"}
    assert ct_volume.kept_volume._volume is None


def test_they_are_saved_with_the_blend(plane):
    _show("CT")
    assert section_face.face_image(_faces(plane)[0]).packed_file is not None


def test_a_full_copy_of_the_scene_has_pictures_of_its_own(plane):
    _show("CT")
    before = _pixels(_faces(plane)[0])
    bpy.ops.scene.new(type="FULL_COPY")
    copied = bpy.context.scene
    copied.insideout.high *= 3
    section_picture.refresh_sections(copied)
    np.testing.assert_array_equal(_pixels(_faces(plane)[0]), before)
    assert np.abs(_pixels(_faces(copied.insideout.sections[0].object)[0]) - before).max() > 0.05


class _Pressed:
    """What a button's `steps` are given."""

    content = "COMPARISON"

    def __init__(self, path):
        self.filepath, self.told = str(path), []

    def report(self, kinds, text):
        self.told.append(text)


def test_a_comparison_is_saved_in_steps_and_ended_between_any_two_leaves_the_file_as_it_was(
    plane, tmp_path, monkeypatch
):
    """Also where the scan is read in many pieces."""
    bpy.ops.insideout.section_save(filepath=str(tmp_path / "at once.png"), content="COMPARISON")
    monkeypatch.setattr(volume, "_PIECE", 1 << 18)
    monkeypatch.setattr(volume, "_PIXELS", 480)
    path, cls = tmp_path / "s.png", bpy.types.INSIDEOUT_OT_section_save
    path.write_text("before", "utf-8")
    for count in range(1, 1000):
        pressed, shares = _Pressed(path), []
        steps = cls.steps(pressed, bpy.context)
        for _, share in zip(range(count), steps, strict=False):
            shares.append(share)
        if len(shares) < count:
            break
        steps.close()
        assert path.read_text("utf-8") == "before"
        assert pressed.told == []
        assert ct_volume.kept_volume._volume is None
    assert count > 12
    assert shares == sorted(shares)
    assert 0 <= shares[0] <= shares[-1] <= 1
    assert path.read_bytes() == (tmp_path / "at once.png").read_bytes()
    assert not list(tmp_path.glob(".*"))


def test_ended_while_the_scan_is_shown_it_is_kept(plane, tmp_path):
    _show("CT")
    kept = ct_volume.kept_volume._volume
    steps = bpy.types.INSIDEOUT_OT_section_save.steps(_Pressed(tmp_path / "s.png"), bpy.context)
    next(steps)
    steps.close()
    assert ct_volume.kept_volume._volume is kept is not None


class _Reading(waiting.InSteps):
    """The operator as Blender calls it; only Blender makes one of its own class."""

    bl_label = scan_read.INSIDEOUT_OT_scan_read.bl_label
    steps, cancel = scan_read.INSIDEOUT_OT_scan_read.steps, scan_read.INSIDEOUT_OT_scan_read.cancel


class TestReadingTheScan:
    """In a window an operator reads it in steps before any section shows it."""

    @pytest.fixture
    def asked(self, monkeypatch):
        """How often the reading was begun, and what else goes on in each of two windows that show the scene."""
        told, moving = [], ([], [])
        windows = [SimpleNamespace(scene=bpy.context.scene, modal_operators=going_on) for going_on in moving]
        context = SimpleNamespace(
            window_manager=SimpleNamespace(windows=windows), temp_override=lambda **_: nullcontext()
        )
        ops = SimpleNamespace(insideout=SimpleNamespace(scan_read=told.append))
        monkeypatch.setattr(section_live, "bpy", SimpleNamespace(app=bpy.app, data=bpy.data, context=context, ops=ops))
        return told, moving

    def _steps(self):
        told = []
        pressed = SimpleNamespace(report=lambda kinds, text: told.append(text))
        return bpy.types.INSIDEOUT_OT_scan_read.steps(pressed, bpy.context), told

    def test_nothing_is_drawn_before_it_is_read(self, plane, asked):
        section_live.live.refresh(bpy.context.scene)
        before = _pixels(plane)
        _chosen().picture = "CT"
        assert section_live.live.redraw() > 0
        assert asked[0] == ["INVOKE_DEFAULT"]
        np.testing.assert_array_equal(_pixels(plane), before)
        assert ct_volume.kept_volume._volume is None
        assert bpy.ops.insideout.scan_read() == {"FINISHED"}
        section_live.live.redraw()
        assert asked[0] == ["INVOKE_DEFAULT"]
        assert np.abs(_pixels(plane) - before).max() > 0.05

    @pytest.mark.parametrize("window", [0, 1])
    @pytest.mark.parametrize("name", ["TRANSFORM_OT_translate", "INSIDEOUT_OT_scan_read"])
    def test_who_moves_a_plane_or_reads_it_already_is_not_interrupted(self, plane, asked, window, name):
        _chosen().beside = "BOTH"
        asked[1][window].append(SimpleNamespace(bl_idname=name))
        assert section_live.live.redraw() > 0
        assert asked[0] == []
        asked[1][window].clear()
        section_live.live.redraw()
        assert asked[0] == ["INVOKE_DEFAULT"]

    def test_what_other_add_ons_do_for_ever_is_not_waited_for(self, plane, asked):
        """They show pressed keys, say, from a button on; told apart by the names that Blender gives operators."""
        names = []

        class WM_OT_keys(bpy.types.Operator):
            bl_idname, bl_label = "wm.keys", "Keys"

            def execute(self, context):
                names.append(self.bl_idname)
                return {"FINISHED"}

        bpy.utils.register_class(WM_OT_keys)
        bpy.ops.wm.keys()
        bpy.utils.unregister_class(WM_OT_keys)
        _chosen().picture = "CT"
        for going_on in asked[1]:
            going_on += [SimpleNamespace(bl_idname=name) for name in names]
        assert section_live.live.redraw() > 0
        assert (names, asked[0]) == (["WM_OT_keys"], ["INVOKE_DEFAULT"])

    def test_what_shows_the_model_alone_asks_for_none(self, plane, asked):
        section_live.live.mark(bpy.context.scene)
        section_live.live.redraw()
        assert asked[0] == []
        assert not bpy.ops.insideout.scan_read.poll()

    @pytest.mark.parametrize(("picture", "beside"), [("CT", "NONE"), ("DIFFERENCE", "NONE"), ("MODEL", "BOTH")])
    def test_ended_early_the_model_is_shown_as_before(self, plane, monkeypatch, picture, beside):
        section_picture.refresh_sections(bpy.context.scene)
        before = _pixels(plane)
        monkeypatch.setattr(volume, "_PIECE", 1 << 16)
        _chosen().picture, _chosen().beside = picture, beside
        steps, told = self._steps()
        shares = [next(steps) for _ in range(5)]
        steps.close()
        assert 0 < shares[0] < shares[-1] < 1
        assert (_chosen().picture, _chosen().beside, told) == ("MODEL", "NONE", [])
        assert ct_volume.kept_volume._volume is None
        section_picture.refresh_sections(bpy.context.scene)
        np.testing.assert_array_equal(_pixels(plane), before)
        assert beside_parts(plane) == []

    @pytest.mark.parametrize("steps", [0, 3])
    def test_after_esc_the_model_is_shown_and_nothing_is_read_again(self, plane, asked, monkeypatch, steps):
        """Before the first step, too: Esc may come before Blender's timer."""
        monkeypatch.setattr(volume, "_PIECE", 1 << 16)
        monkeypatch.setattr(waiting, "bpy", SimpleNamespace(app=SimpleNamespace(background=False)))
        ticks = iter(x * 0.03 for x in range(1000))
        monkeypatch.setattr(waiting, "time", SimpleNamespace(monotonic=ticks.__next__))
        _chosen().picture = "CT"
        pressed = _Reading()
        window = MagicMock(scene=bpy.context.scene)
        assert pressed.invoke(window, None) == {"RUNNING_MODAL"}
        for _ in range(steps):
            assert pressed.modal(window, SimpleNamespace(type="TIMER")) == {"RUNNING_MODAL"}
        assert _chosen().picture == "CT"
        assert pressed.modal(window, SimpleNamespace(type="ESC")) == {"CANCELLED"}
        assert (_chosen().picture, _chosen().beside) == ("MODEL", "NONE")
        window.window_manager.event_timer_remove.assert_called_once()
        section_live.live.redraw()
        assert asked[0] == []

    def test_a_damaged_scan_is_told_once(self, plane, asked, scanned):
        ct_volume.volume_path(scanned).write_bytes(b"no archive")
        _chosen().picture = "CT"
        steps, told = self._steps()
        assert list(steps) == []
        assert "save it again" in told[0]
        assert _chosen().picture == "MODEL"
        section_live.live.redraw()
        assert asked[0] == []
