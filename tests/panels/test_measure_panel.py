"""The Measure panel: what it offers with a model, with a section, and what it tells of the last results."""

from __future__ import annotations

import bpy
import numpy as np
import pytest

from insideout.insideout_addon.scene.following import follow, stay
from insideout.insideout_addon.scene.following_nodes import CORNERS
from insideout.insideout_addon.scene.splats import read_splats
from insideout.panels.measure import CLASSES


@pytest.fixture
def texts(draw_panels):
    return lambda: draw_panels(classes=CLASSES, width=2000)


@pytest.fixture
def imported(blender, tmp_path, random_set):
    random_set.save(tmp_path / "fused.ply")
    bpy.ops.insideout.import_run(filepath=str(tmp_path / "fused.ply"))


def test_it_asks_for_a_model(texts):
    assert texts() == ["Import a model first, under Model"]


def test_it_says_how_to_begin(texts, imported):
    assert {"Add Point", "Measure", "Probe at Cursor", "Save Section Sheet...", "Save Histogram..."} <= set(texts())
    assert any(text.startswith("Set the 3D cursor") for text in texts())
    assert "Add a section plane to measure walls" in texts()
    assert "Wall Thickness" not in texts()


def test_it_tells_what_was_measured(texts, imported):
    for place in ((0, 0, 0), (3, 4, 0)):
        bpy.ops.insideout.point_add(location=place)
    bpy.ops.insideout.measure()
    assert "5.00 mm" in texts()
    assert not any(text.startswith("Set the 3D cursor") for text in texts())


def test_it_tells_what_the_probe_found(texts, imported):
    bpy.ops.insideout.probe(point=(1, 2, 3))
    assert "At 1.00 2.00 3.00 mm" in texts()
    assert any(text.startswith("Density ") and text.endswith(" mm⁻¹") for text in texts())
    assert any(text.startswith("Nearest splat ") for text in texts())


def test_it_tells_how_thick_walls_are(texts, imported):
    bpy.ops.insideout.section_add()
    bpy.ops.insideout.thickness()
    assert "Wall Thickness" in texts()
    assert any(text.startswith("Least ") and " mm, most " in text for text in texts())


class TestOfTwoModels:
    @pytest.fixture
    def first(self, imported):
        """A model that was measured, beside another one that is shown."""
        first = bpy.context.scene.insideout.model
        for place in ((0, 0, 0), (3, 4, 0)):
            bpy.ops.insideout.point_add(location=place)
        bpy.ops.insideout.measure()
        bpy.ops.insideout.section_add()
        bpy.ops.insideout.thickness()
        second = first.copy()
        second.data = first.data.copy()
        bpy.context.scene.collection.objects.link(second)
        bpy.context.scene.insideout.model = second
        return first

    def test_figures_of_the_one_are_not_told_of_the_other(self, texts, first):
        assert not any(text.startswith(("Least ", "5.00 mm")) for text in texts())
        bpy.context.scene.insideout.model = first
        assert {"Least ", "5.00 mm"} <= {text[: len("5.00 mm")] if text[0] == "5" else text[:6] for text in texts()}


CHANGED = "The plane, Contour or the splats have changed since; press Wall Thickness again"


def _move_plane():
    bpy.context.scene.insideout.sections[0].position_mm = 3.0


def _change_level():
    bpy.context.scene.insideout.level = 0.03


def _move_splats():
    data = bpy.context.scene.insideout.model.data
    places = [coordinate for point in data.points for coordinate in (*point.co[:2], point.co[2] + 1.0)]
    data.attributes["position"].data.foreach_set("vector", places)


@pytest.mark.parametrize("change", [_move_plane, _change_level, _move_splats])
def test_it_tells_where_walls_were_measured_and_whether_that_is_still_so(texts, imported, change):
    bpy.ops.insideout.section_add()
    bpy.context.scene.insideout.sections[0].position_mm = 1.5
    bpy.ops.insideout.thickness()
    assert "At y = 1.50 mm" in texts()
    assert CHANGED not in texts()
    change()
    bpy.context.view_layer.update()
    assert "At y = 1.50 mm" in texts()
    assert CHANGED in texts()
    bpy.ops.insideout.thickness()
    assert CHANGED not in texts()


def test_walls_that_were_moved_with_the_splats_are_still_those(texts, imported):
    bpy.ops.insideout.section_add()
    bpy.context.scene.insideout.sections[0].position_mm = 1.5
    bpy.ops.insideout.thickness()
    model = bpy.context.scene.insideout.model
    model.location.y += 10.0
    bpy.context.scene.insideout.sections[0].object.location.y += 10.0
    bpy.context.view_layer.objects.active = model
    assert bpy.ops.insideout.apply_transform() == {"FINISHED"}
    bpy.context.view_layer.update()
    assert "At y = 11.50 mm" in texts()
    assert CHANGED not in texts()


@pytest.mark.parametrize("back", [0.0, -1.0])
def test_walls_of_other_splats_are_no_newer_when_these_are_transformed(texts, imported, back):
    """Not either where that takes them back to where they were measured."""
    bpy.ops.insideout.section_add()
    bpy.ops.insideout.thickness()
    _move_splats()
    model = bpy.context.scene.insideout.model
    model.location.z, bpy.context.scene.insideout.sections[0].object.location.z = back, back
    bpy.context.view_layer.objects.active = model
    assert CHANGED in texts()
    assert bpy.ops.insideout.apply_transform() == {"FINISHED"}
    bpy.context.view_layer.update()
    assert CHANGED in texts()


def test_walls_of_a_soft_body_are_of_how_it_was_bent(texts, imported):
    model, mesh = bpy.context.scene.insideout.model, bpy.data.meshes.new("cage")
    mesh.from_pydata([(x, y, z) for z in (-30, 30) for y in (-30, 30) for x in (-30, 30)], [(0, 1)], [])
    for k, name in enumerate(CORNERS, 1):
        mesh.attributes.new(name, "INT", "POINT").data.foreach_set("value", [k] + [0] * 7)
    cage = bpy.data.objects.new("cage", mesh)
    bpy.context.scene.collection.objects.link(cage)

    def bend(by):
        mesh.vertices[7].co.z = 30 + by
        mesh.update()
        bpy.context.view_layer.update()

    bpy.ops.insideout.section_add()
    bpy.ops.insideout.thickness()
    follow(model, cage, np.zeros(len(model.data.points)), (read_splats(model).means + 30) / 60, np.array([60.0] * 3))
    bend(0)
    assert CHANGED not in texts()
    bend(-10)
    assert CHANGED in texts()
    bpy.ops.insideout.thickness()
    assert CHANGED not in texts()
    bend(-20)
    assert CHANGED in texts()
    bend(-10)
    assert CHANGED not in texts()
    stay(model)
    assert CHANGED in texts()


def test_it_says_that_lengths_of_a_scaled_object_are_those_of_before(draw_panels, imported):
    def told():
        return draw_panels(width=4000).count(
            "The object is scaled, but measures, pictures and tables have its size of before; "
            "use Object > Apply > Transform to Splats first"
        )

    model = bpy.context.scene.insideout.model
    bpy.ops.insideout.section_add()
    model.scale = (1.0, 1.0, -1.0)
    bpy.context.view_layer.update()
    assert told() == 0
    model.scale = (2.0,) * 3
    bpy.context.view_layer.update()
    assert told() == 3, "in Measure, Section and Weigh"
    bpy.context.view_layer.objects.active = model
    bpy.ops.insideout.apply_transform()
    assert told() == 0


@pytest.mark.parametrize("transform", [{"scale": (1.1,) * 3}, {"rotation_euler": (0, 0, 1)}])
def test_it_says_that_blenders_own_apply_has_turned_or_scaled_the_points_alone(draw_panels, imported, transform):
    model = bpy.context.scene.insideout.model
    bpy.ops.insideout.section_add()
    for name, value in transform.items():
        setattr(model, name, value)
    bpy.context.view_layer.objects.active = model
    model.select_set(True)
    bpy.ops.object.transform_apply()
    bpy.context.view_layer.update()
    told = (
        "Blender's own Apply has turned or scaled the points, but not the splats on them; "
        "undo it, then use Object > Apply > Transform to Splats"
    )
    assert draw_panels(width=4000).count(told) == 4, "in Measure, Section, Weigh and Break"


def test_of_photos_alone_it_measures_points_without_a_unit(texts, blender, photo_run):
    bpy.ops.insideout.import_run(filepath=str(photo_run / "fused.ply"))
    bpy.ops.insideout.probe(point=(3, 1, -2))
    found = texts()
    assert "Photos alone have no density to measure" in found
    assert not {"Save Section Sheet...", "Wall Thickness"} & set(found)
    assert not any("mm" in text for text in found)
