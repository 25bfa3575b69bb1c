"""The Measure panel: what it offers with a model, with a section, and what it tells of the last results."""

from __future__ import annotations

import bpy
import pytest

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


def test_of_photos_alone_it_measures_points_without_a_unit(texts, blender, photo_run):
    bpy.ops.insideout.import_run(filepath=str(photo_run / "fused.ply"))
    bpy.ops.insideout.probe(point=(3, 1, -2))
    found = texts()
    assert "Photos alone have no density to measure" in found
    assert not {"Save Section Sheet...", "Wall Thickness"} & set(found)
    assert not any("mm" in text for text in found)
