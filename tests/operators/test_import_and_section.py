"""Import and section operators, as a script or a button calls them."""

from __future__ import annotations

import csv
import re
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from mathutils import Quaternion

from insideout.insideout_addon.scene import section, section_picture
from insideout.insideout_addon.scene.kept_splats import kept_splats


@pytest.fixture
def imported(blender, tmp_path, one_ball):
    one_ball.save(tmp_path / "fused.ply")
    settings = bpy.context.scene.insideout
    settings.run = str(tmp_path)
    assert bpy.ops.insideout.import_run() == {"FINISHED"}
    return settings


@pytest.fixture
def cut(imported):
    assert bpy.ops.insideout.section_add() == {"FINISHED"}
    imported.sections[0].object.location = (3, -2, 1)
    imported.level = 0.04 * float(np.exp(-(4.0**2) / 50))
    bpy.context.view_layer.update()
    return imported


def test_import_of_a_run(imported, tmp_path):
    assert imported.model.name == f"{tmp_path.name} fused"
    assert len(imported.model.data.points) == 1


def test_import_of_a_file(blender, tmp_path, random_set):
    random_set.save(tmp_path / "other.ply")
    bpy.ops.insideout.import_run(filepath=str(tmp_path / "other.ply"))
    assert bpy.context.scene.insideout.model.name == "other"


def test_an_import_without_a_run_takes_no_file_of_the_working_folder(blender, tmp_path, random_set, monkeypatch):
    random_set.save(tmp_path / "fused.ply")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(RuntimeError, match="Choose the folder of a run first"):
        bpy.ops.insideout.import_run()
    assert len(bpy.data.objects) == 0


def test_import_names_the_fields_that_are_missing(blender, tmp_path):
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 0\nproperty float x\nend_header\n"
    (tmp_path / "mesh.ply").write_bytes(header.encode())
    with pytest.raises(RuntimeError, match=r"lacks y, z, opacity.*rot_3"):
        bpy.ops.insideout.import_run(filepath=str(tmp_path / "mesh.ply"))
    assert len(bpy.data.objects) == 0


def test_the_section_needs_a_model(blender):
    assert not bpy.ops.insideout.section_add.poll()


def test_photos_alone_have_no_contours_and_no_walls(blender, photo_run):
    bpy.ops.insideout.import_run(filepath=str(photo_run / "fused.ply"))
    assert bpy.ops.insideout.section_add() == {"FINISHED"}
    for name in ("contours_save", "contours_curve", "section_save", "thickness", "thickness_save"):
        assert not getattr(bpy.ops.insideout, name).poll(), name


def test_section_as_values(cut, tmp_path, read_png):
    bpy.ops.insideout.section_save(filepath=str(tmp_path / "s.png"), content="VALUES")
    pixels, _, texts = read_png(tmp_path / "s.png")
    high = float(texts["Density high (1/mm)"])
    assert pixels.shape == (512, 512)
    assert pixels.max() / 65535 * high == pytest.approx(min(0.04, high), rel=2e-3)


def test_section_as_picture(cut, tmp_path, read_png):
    bpy.ops.insideout.section_save(filepath=str(tmp_path / "s.png"))
    pixels, *_ = read_png(tmp_path / "s.png")
    assert pixels.ndim == 3
    assert pixels.shape[1] > 512


def test_a_section_that_cannot_be_written_is_told(cut, tmp_path):
    (tmp_path / "file").write_text("", "utf-8")
    with pytest.raises(RuntimeError, match="file"):
        bpy.ops.insideout.section_save(filepath=str(tmp_path / "file" / "s.png"))


@pytest.mark.parametrize(("operator", "name"), [("section_save", "s.png"), ("contours_save", "c.svg")])
class TestWhereFilesGo:
    """The same for both operators that save."""

    def test_beside_the_blend(self, cut, tmp_path, operator, name):
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
        assert getattr(bpy.ops.insideout, operator)(filepath=f"//{name}") == {"FINISHED"}
        assert (tmp_path / name).is_file()
        assert not (tmp_path.parents[-1] / name).exists()

    def test_beside_a_blend_that_is_not_saved(self, cut, operator, name):
        with pytest.raises(RuntimeError, match="not saved yet; save it first"):
            getattr(bpy.ops.insideout, operator)(filepath=f"//{name}")

    def test_a_folder_is_told(self, cut, tmp_path, operator, name):
        (tmp_path / name).mkdir()
        with pytest.raises(RuntimeError, match="is a folder; give the file a name") as told:
            getattr(bpy.ops.insideout, operator)(filepath=str(tmp_path / name))
        assert "Errno" not in str(told.value)

    def test_a_name_that_is_too_long_is_told(self, cut, tmp_path, operator, name):
        with pytest.raises(RuntimeError, match="file name too long; choose another") as told:
            getattr(bpy.ops.insideout, operator)(filepath=str(tmp_path / ("x" * 300 + name)))
        assert "Errno" not in str(told.value)

    def test_a_model_scaled_to_nothing_is_told(self, cut, tmp_path, operator, name):
        cut.model.scale = (0, 0, 0)
        bpy.context.view_layer.update()
        with pytest.raises(RuntimeError, match="scaled to nothing"):
            getattr(bpy.ops.insideout, operator)(filepath=str(tmp_path / name))
        assert not (tmp_path / name).exists()


def test_a_stretched_plane_is_saved_in_its_real_size(cut, tmp_path, read_png):
    side = cut.sections[0].object.dimensions.x
    cut.sections[0].object.scale = (2, 1, 1)
    bpy.context.view_layer.update()
    bpy.ops.insideout.section_save(filepath=str(tmp_path / "s.png"), content="VALUES")
    pixels, per_metre, _ = read_png(tmp_path / "s.png")
    assert pixels.shape == (256, 512)
    assert 512 / per_metre * 1000 == pytest.approx(2 * side, rel=1e-3)
    bpy.ops.insideout.contours_save(filepath=str(tmp_path / "c.svg"))
    size = re.search(r'width="([\d.]+)mm" height="([\d.]+)mm"', (tmp_path / "c.svg").read_text("utf-8")).groups()
    assert [float(mm) for mm in size] == pytest.approx([2 * side, side], rel=1e-4)


def test_contours_as_points_in_mm(cut, tmp_path):
    bpy.ops.insideout.contours_save(filepath=str(tmp_path / "c.csv"))
    with open(tmp_path / "c.csv", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    points = np.array([[float(row[f"{axis}_mm"]) for axis in "xyz"] for row in rows])
    np.testing.assert_allclose(np.linalg.norm(points - [3, -2, 1], axis=1), 4.0, atol=0.01)
    assert float(rows[0]["area_mm2"]) == pytest.approx(np.pi * 16, rel=5e-3)


def test_contours_as_a_drawing_of_real_size(cut, tmp_path):
    bpy.ops.insideout.contours_save(filepath=str(tmp_path / "c.svg"))
    text = (tmp_path / "c.svg").read_text("utf-8")
    width = float(re.search(r'width="([\d.]+)mm"', text).group(1))
    assert re.search(r'viewBox="0 0 ([\d.]+)', text).group(1) == f"{width:.4f}"
    points = np.array([[float(v) for v in pair.split(",")] for pair in re.findall(r"[\d.]+,[\d.]+", text)])
    assert np.ptp(points[:, 0]) == pytest.approx(8.0, abs=0.03)


def test_contours_of_another_kind_are_refused(cut, tmp_path):
    with pytest.raises(RuntimeError, match=r"\.svg or \.csv"):
        bpy.ops.insideout.contours_save(filepath=str(tmp_path / "c.dxf"))


@pytest.fixture
def seen_both_ways(cut, tmp_path):
    """`seen_both_ways(save)`: what `save(path)` returns of a plane beside the ball, as it is and flipped."""
    plane = cut.sections[0].object
    plane.location = (2, -2, 1)
    bpy.context.view_layer.update()

    def both(save):
        found = []
        for flip in (False, True):
            cut.sections[0].flip = flip
            found.append(save(tmp_path / f"{flip}"))
        return found

    return both


def test_contours_of_a_flipped_plane_are_as_its_face_is_seen(cut, seen_both_ways):
    def save(path):
        bpy.ops.insideout.contours_save(filepath=str(path.with_suffix(".csv")))
        rows = np.genfromtxt(path.with_suffix(".csv"), delimiter=",", skip_header=1)
        return rows[:-1, 1:6].mean(axis=0)

    above, below = seen_both_ways(save)
    np.testing.assert_allclose(above[2:], [3, -2, 1], atol=0.05)
    np.testing.assert_allclose(below[2:], [3, -2, 1], atol=0.05)
    width = cut.sections[0].object[section.SIZE_KEY]
    assert above[0] == pytest.approx(width / 2 + 1, abs=0.1)
    assert below[0] == pytest.approx(width / 2 - 1, abs=0.1), "right is left from the other side"
    assert below[1] == pytest.approx(above[1], abs=0.05), "up stays up"


def test_a_flipped_section_is_saved_as_its_face_is_seen(seen_both_ways, read_png):
    def save(path):
        bpy.ops.insideout.section_save(filepath=str(path.with_suffix(".png")), content="VALUES")
        return read_png(path.with_suffix(".png"))

    (above, _, _), (below, _, texts) = seen_both_ways(save)
    assert (above != above[:, ::-1]).any()
    np.testing.assert_array_equal(below, above[:, ::-1])
    assert texts["Plane u (mm per pixel)"].startswith("-")


def test_a_skewed_section_is_not_measured(cut, tmp_path):
    cut.model.scale = (1, 1, 2)
    cut.sections[0].object.rotation_mode = "QUATERNION"
    cut.sections[0].object.rotation_quaternion @= Quaternion((0, 0, 1), 0.25 * np.pi)
    bpy.context.view_layer.update()
    saved = {
        "contours_save": {"filepath": str(tmp_path / "c.svg")},
        "section_save": {"filepath": str(tmp_path / "s.png"), "content": "VALUES"},
        "section_sheet": {"filepath": str(tmp_path / "sheet.png"), "axis": "PLANE", "count": 2, "dots_per_inch": 50},
        "histogram_save": {"filepath": str(tmp_path / "h.csv"), "of": "SECTION"},
        "thickness": {},
    }
    for name, given in saved.items():
        with pytest.raises(RuntimeError, match="Transform to Splats first"):
            getattr(bpy.ops.insideout, name)(**given)
    assert [path.name for path in tmp_path.iterdir()] == ["fused.ply"]
    bpy.context.view_layer.objects.active = cut.model
    assert bpy.ops.insideout.apply_transform() == {"FINISHED"}
    bpy.context.view_layer.update()
    assert bpy.ops.insideout.contours_save(**saved["contours_save"]) == {"FINISHED"}


def test_contours_as_a_curve(cut):
    bpy.ops.insideout.contours_curve()
    curve = bpy.data.objects["InsideOut Contours"]
    points = np.array([point.co[:3] for point in curve.data.splines[0].points])
    np.testing.assert_allclose(np.linalg.norm(points - [3, -2, 1], axis=1), 4.0, atol=0.01)
    assert curve.data.splines[0].use_cyclic_u


def test_a_curve_of_contours_that_is_ended_early_is_none(cut):
    cls, pressed = bpy.types.INSIDEOUT_OT_contours_curve, SimpleNamespace(report=lambda *_: None)
    before = len(bpy.data.curves), len(bpy.data.objects)
    whole = sum(1 for _ in cls.steps(pressed, bpy.context))
    assert len(bpy.data.curves) == before[0] + 1
    bpy.data.curves.remove(bpy.data.curves[-1])
    for count in range(1, whole + 1):
        steps = cls.steps(pressed, bpy.context)
        for _ in range(count):
            next(steps)
        steps.close()
        assert (len(bpy.data.curves), len(bpy.data.objects)) == before, f"after {count} of {whole} steps"
    assert whole > 3


def _undo():
    bpy.ops.ed.undo()


def _change_level():
    bpy.context.scene.insideout.level *= 3


@pytest.mark.parametrize("meanwhile", [_undo, _change_level])
def test_contours_are_those_that_were_asked_for_whatever_happens_in_a_break(cut, tmp_path, meanwhile):
    bpy.ops.insideout.contours_save(filepath=str(tmp_path / "at once.csv"))
    for message in ("Before", "Here"):
        bpy.ops.ed.undo_push(message=message)
    pressed = SimpleNamespace(filepath=str(tmp_path / "c.csv"), report=lambda *_: None)
    steps = bpy.types.INSIDEOUT_OT_contours_save.steps(pressed, bpy.context)
    next(steps)
    meanwhile()
    assert len(list(steps)) > 1
    assert (tmp_path / "c.csv").read_bytes() == (tmp_path / "at once.csv").read_bytes()


def _change_window():
    bpy.context.scene.insideout.high *= 3


@pytest.mark.parametrize("meanwhile", [_undo, _change_window])
def test_a_section_is_saved_as_it_was_asked_for_whatever_happens_in_a_break(cut, tmp_path, meanwhile):
    bpy.ops.insideout.section_save(filepath=str(tmp_path / "at once.png"), content="VALUES")
    for message in ("Before", "Here"):
        bpy.ops.ed.undo_push(message=message)
    pressed = SimpleNamespace(filepath=str(tmp_path / "s.png"), content="VALUES", report=lambda *_: None)
    steps = bpy.types.INSIDEOUT_OT_section_save.steps(pressed, bpy.context)
    next(steps)
    meanwhile()
    list(steps)
    assert (tmp_path / "s.png").read_bytes() == (tmp_path / "at once.png").read_bytes()


def test_a_curve_of_contours_that_is_undone_in_a_break_leaves_nothing_and_is_told(cut):
    told = []
    cls, pressed = bpy.types.INSIDEOUT_OT_contours_curve, SimpleNamespace(report=lambda kinds, text: told.append(text))
    for message in ("Before", "Here"):
        bpy.ops.ed.undo_push(message=message)
    before = sorted(bpy.data.curves.keys())
    steps = cls.steps(pressed, bpy.context)
    while sorted(bpy.data.curves.keys()) == before:
        next(steps)
    _undo()
    list(steps)
    assert told == ["The curve was undone before its end; press the button again."]
    assert sorted(bpy.data.curves.keys()) == before


def test_the_curve_of_contours_follows_its_model_though_another_is_shown_by_its_end(cut, one_ball, tmp_path):
    """A run may end meanwhile, and its result be imported."""
    measured = cut.model
    one_ball.save(tmp_path / "other.ply")
    steps = bpy.types.INSIDEOUT_OT_contours_curve.steps(SimpleNamespace(report=lambda *_: None), bpy.context)
    next(steps)
    bpy.ops.insideout.import_run(filepath=str(tmp_path / "other.ply"))
    assert cut.model != measured
    list(steps)
    assert bpy.data.objects["InsideOut Contours"].parent == measured


def test_the_curve_of_contours_follows_the_model(cut):
    bpy.ops.insideout.contours_curve()
    curve = bpy.data.objects["InsideOut Contours"]
    bpy.context.view_layer.update()
    assert curve.matrix_world == cut.model.matrix_world
    cut.model.location.x += 5
    bpy.context.view_layer.update()
    assert curve.matrix_world == cut.model.matrix_world


def test_contours_of_splats_that_lost_an_attribute_are_told(cut):
    cut.model.data.attributes.remove(cut.model.data.attributes["modality"])
    kept_splats.clear()
    with pytest.raises(RuntimeError, match=r"^Error: .* has lost the attribute 'modality'"):
        bpy.ops.insideout.contours_curve()


def test_no_contours_is_told(cut, tmp_path):
    cut.level = 1.0
    assert bpy.ops.insideout.contours_curve() == {"CANCELLED"}
    assert bpy.ops.insideout.contours_save(filepath=str(tmp_path / "c.svg")) == {"CANCELLED"}
    assert not (tmp_path / "c.svg").exists()


def test_automatic_window(cut):
    cut.high = 3.0
    bpy.ops.insideout.section_window()
    assert cut.high == pytest.approx(0.04, rel=0.1)


@pytest.mark.parametrize("tool", ["section_add", "section_add_box", "section_window"])
def test_splats_that_lost_an_attribute_are_told(imported, tool):
    imported.model.data.attributes.remove(imported.model.data.attributes["modality"])
    with pytest.raises(RuntimeError, match=r"^Error: .* has lost the attribute 'modality'"):
        getattr(bpy.ops.insideout, tool)()
    assert len(imported.sections) == 0


def test_a_cut_model_that_loses_an_attribute_is_no_traceback_in_a_timer(cut):
    cut.model.data.attributes.remove(cut.model.data.attributes["modality"])
    kept_splats.clear()
    assert not section_picture.draw_picture(bpy.context.scene, cut.sections[0])
