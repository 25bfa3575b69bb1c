"""The window of densities that sections show: in which unit, which of its ends gives way, and that it is drawn."""

from __future__ import annotations

from dataclasses import replace

import bpy
import numpy as np
import pytest

from insideout.insideout_addon.scene import section_live, section_picture, sections
from insideout.insideout_addon.scene.display import show_splats
from insideout.insideout_addon.scene.splats import create_splats


def _settings():
    return bpy.context.scene.insideout


def test_densities_in_hounsfield_units(model, bar_texts):
    plane = sections.add_section_plane(model, bpy.context)
    settings = _settings()
    settings.low, settings.high, settings.water, settings.unit = 0.0, 0.04, 0.02, "HU"
    section_picture.refresh_sections(bpy.context.scene)
    assert {"HU", "-1000", "0", "1000"} <= set(bar_texts(plane))
    settings.unit = "PER_MM"
    section_picture.refresh_sections(bpy.context.scene)
    assert "mm⁻¹" in bar_texts(plane)


def test_the_window_can_be_given_in_hounsfield_units(model, draw_panels):
    sections.add_section_plane(model, bpy.context)
    settings = _settings()
    assert {"Low (mm⁻¹)", "High (mm⁻¹)"} <= set(draw_panels())
    settings.water, settings.unit = 0.02, "HU"
    assert {"Low (HU)", "High (HU)"} <= set(draw_panels())
    settings.low_hu, settings.high_hu = -500, 1000
    assert (settings.low, settings.high) == pytest.approx((0.01, 0.04))
    settings.high = 0.02
    assert settings.high_hu == pytest.approx(0, abs=1e-3)
    section_live.live.refresh(bpy.context.scene)
    settings.low_hu = -900
    assert section_live.live._out_of_date(bpy.context.scene, None), "the picture is drawn anew"


@pytest.mark.parametrize(
    ("name", "value", "window"),
    [
        ("low", 0.06, (0.06, 0.0601)),
        ("low", 0.05, (0.05, 0.0501)),
        ("high", 0.01, (0.0099, 0.01)),
        ("low_hu", 2000, (0.06, 0.0601)),
        ("high_hu", -500, (0.0099, 0.01)),
        ("low", 5e4, (5e4, 50005)),
        ("high", -3, (-1e-4, 1e-6)),
    ],
)
def test_an_end_of_the_window_moves_the_other_along(model, monkeypatch, name, value, window, bar_texts):
    """As Blender's own pairs of least and most; at once, not as two changes."""
    plane = sections.add_section_plane(model, bpy.context)
    settings = _settings()
    settings.water, settings.low, settings.high = 0.02, 0.02, 0.05
    looks, marks = [], []
    monkeypatch.setattr(section_live, "apply_look", looks.append)
    monkeypatch.setattr(section_live.live, "mark", marks.append)
    setattr(settings, name, value)
    assert (settings.low, settings.high) == pytest.approx(window, abs=2e-6)
    assert settings.low < settings.high
    assert (len(looks), len(marks)) == (1, 1)
    section_picture.refresh_sections(bpy.context.scene)
    (lowest, *_, highest) = [float(text) for text in bar_texts(plane)[:5]]
    assert lowest < highest, "as the colour bar says it"


def test_both_ends_of_a_window_can_be_set_in_either_order(model):
    for low, high in ((0.5, 1.5), (0.01, 0.02), (0.03, 0.0301), (-0.2, 0.004)):
        _settings().low, _settings().high = low, high
        assert (_settings().low, _settings().high) == pytest.approx((low, high))
    for low, high in ((0.5, 1.5), (0.01, 0.02), (0.03, 0.0301), (-0.2, 0.004)):
        _settings().high, _settings().low = high, low
        assert (_settings().low, _settings().high) == pytest.approx((low, high))


@pytest.mark.parametrize("add", [sections.add_section_plane, sections.add_section_box])
def test_the_first_section_finds_the_window(model, add):
    before = _settings().high
    add(model, bpy.context)
    assert 0 <= _settings().low < _settings().high < 1.0
    assert _settings().high != before


@pytest.mark.parametrize("add", [sections.add_section_plane, sections.add_section_box])
@pytest.mark.parametrize("window", [{"low": 0.001, "high": 0.5}, {"high": 0.5}, {"low": 0.001}])
def test_a_window_that_the_user_has_set_stays_with_the_first_section(model, add, window):
    for end, density in window.items():
        setattr(_settings(), end, density)
    before = _settings().low, _settings().high
    add(model, bpy.context)
    assert (_settings().low, _settings().high) == before
    sections.remove_sections(bpy.context.scene)
    add(model, bpy.context)
    assert (_settings().low, _settings().high) == before


def _by_the_button():
    bpy.ops.insideout.section_window()


def _by_colors():
    _settings().color_by = "DENSITY"


def _by_a_section():
    sections.add_section_plane(_settings().model, bpy.context)
    sections.remove_sections(bpy.context.scene)


@pytest.mark.parametrize("find", [_by_the_button, _by_colors, _by_a_section])
def test_a_window_that_was_found_gives_way_to_that_of_another_model(model, random_set, find):
    _settings().model = model
    find()
    before = _settings().high
    denser = create_splats(replace(random_set, density=3 * random_set.density), "denser", bpy.context)
    show_splats(denser, True)
    sections.add_section_plane(denser, bpy.context)
    assert _settings().high == pytest.approx(3 * before, rel=1e-3)


@pytest.mark.parametrize("name", ["low", "high", "water", "level"])
def test_a_pixel_of_a_drag_is_a_small_part_of_the_window(blender, name):
    """Blender takes a hundredth of a step for each pixel."""
    known = _settings().bl_rna.properties
    assert 0.01 * known[name].step < 0.01 * known["high"].default


@pytest.mark.parametrize("unit", ["PER_MM", "HU"])
def test_densities_of_grey_values_claim_no_unit(model, unit, draw_panels, bar_texts):
    model["insideout_warnings"] = "volume.tif: has grey values; 900 was taken for 0.05 mm⁻¹, so densities are relative"
    plane = sections.add_section_plane(model, bpy.context)
    _settings().unit = unit
    section_picture.refresh_sections(bpy.context.scene)
    assert "rel" in bar_texts(plane)
    assert not {"mm⁻¹", "HU"} & set(bar_texts(plane))
    bpy.ops.insideout.probe(point=(0, 0, 0))
    texts = draw_panels()
    assert any(text.startswith("Density ") and text.endswith(" rel") for text in texts)
    assert "Contour (relative)" in texts
    assert not {"Unit", "Water (mm⁻¹)", "Low (mm⁻¹)", "Contour (mm⁻¹)"} & set(texts)


def test_a_window_that_is_undone_is_drawn_again(model, monkeypatch, drawn):
    """Pictures are drawn between the steps of undo, so these do not bring them back."""
    # In a window undo leaves the model alone where it did not change; without one it reads all of the file again.
    monkeypatch.setattr(section_live.kept_splats, "edited", lambda data: False)
    plane = sections.add_section_plane(model, bpy.context)
    name = plane.name
    section_live.live.refresh(bpy.context.scene)
    before = drawn(plane)
    bpy.ops.ed.undo_push(message="before")
    _settings().high *= 3
    bpy.ops.ed.undo_push(message="after")
    section_live.live.refresh(bpy.context.scene)
    assert np.abs(drawn(plane) - before).max() > 0.05
    bpy.ops.ed.undo()
    section_live.live.refresh(bpy.context.scene)
    np.testing.assert_allclose(drawn(bpy.data.objects[name]), before, atol=1e-6)
