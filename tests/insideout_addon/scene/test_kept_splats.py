"""Splats kept for sections: what has them read again, and what does not."""

from __future__ import annotations

from types import SimpleNamespace

import bpy
import numpy as np
import pytest

from insideout.insideout_addon.scene import kept_splats as module
from insideout.insideout_addon.scene import section_live, sections
from insideout.insideout_addon.scene.display import show_splats
from insideout.insideout_addon.scene.kept_splats import kept_splats
from insideout.insideout_addon.scene.splats import create_splats


@pytest.fixture
def scene(blender, random_set, monkeypatch):
    """A model with a plane and a box, in what seems to be a window; the splats are kept."""
    splats = create_splats(random_set, "model", bpy.context)
    show_splats(splats, True)
    sections.add_section_plane(splats, bpy.context)
    sections.add_section_box(splats, bpy.context)
    scene = bpy.context.scene
    scene.insideout.pixels = 32
    window = SimpleNamespace(app=SimpleNamespace(background=False), context=bpy.context, types=bpy.types)
    monkeypatch.setattr(module, "bpy", window)
    scene.insideout.peel_mm = 0.5
    scene.insideout.peel_mm = 0.0
    section_live.live.refresh(scene)
    kept_splats.of(splats)
    return scene


SHOWN = {
    "cut": lambda settings: setattr(settings.sections[0], "cut", False),
    "flip": lambda settings: setattr(settings.sections[0], "flip", True),
    "slab": lambda settings: setattr(settings.sections[0], "slab_mm", 3.0),
    "apart": lambda settings: setattr(settings.sections[0], "apart_mm", 3.0),
    "a box": lambda settings: setattr(settings.sections[1], "flip", False),
    "peel": lambda settings: setattr(settings, "peel_mm", 1.0),
    "modalities": lambda settings: setattr(settings, "modalities", {"XRAY"}),
    "colours": lambda settings: setattr(settings, "color_by", "DENSITY"),
    "window": lambda settings: setattr(settings, "low", 0.001),
}


@pytest.mark.parametrize("name", SHOWN)
def test_how_splats_are_shown_does_not_have_them_read_again(scene, name):
    """Blender says that they were edited. A slider would read 200,000 anew with each change: 0.2 s."""
    before = kept_splats.of(scene.insideout.model)
    SHOWN[name](scene.insideout)
    bpy.context.view_layer.update()
    assert kept_splats.has(scene.insideout.model)
    assert kept_splats.of(scene.insideout.model) is before


@pytest.mark.parametrize("name", SHOWN)
def test_an_edit_just_before_is_noticed(scene, name):
    model = scene.insideout.model
    model.data.attributes["density"].data.foreach_set("value", np.full(200, 0.5, np.float32))
    model.data.update_tag()
    SHOWN[name](scene.insideout)
    bpy.context.view_layer.update()
    assert kept_splats.of(model).density.min() == 0.5


def test_a_reading_in_work_outlasts_how_splats_are_shown(scene):
    """After an edit, or in a file that was just opened, sliders would have it begin anew with each step."""
    model = scene.insideout.model
    kept_splats.clear()
    reading = kept_splats.of_in_steps(model)
    next(reading)
    scene.insideout.sections[0].slab_mm = 3.0
    bpy.context.view_layer.update()
    for _ in reading:
        pass
    assert kept_splats.has(model)


def test_an_edit_afterwards_is_noticed(scene):
    scene.insideout.sections[0].flip = True
    model = scene.insideout.model
    model.data.attributes["density"].data.foreach_set("value", np.full(200, 0.5, np.float32))
    model.data.update_tag()
    bpy.context.view_layer.update()
    assert not kept_splats.has(model)
    assert kept_splats.of(model).density.min() == 0.5


def test_of_another_scene_than_the_windows_they_are_read_again(scene):
    """Its view layers are not evaluated in this window, so nothing tells which change was whose."""
    other = bpy.data.scenes.new("Other")
    before = kept_splats.of(scene.insideout.model)
    with bpy.context.temp_override(scene=other, view_layer=other.view_layers[0]):
        scene.insideout.sections[0].flip = True
    bpy.context.view_layer.update()
    assert kept_splats.of(scene.insideout.model) is not before


def test_the_set_itself_is_read_each_time_and_kept_splats_stay(scene, random_set):
    model, known = scene.insideout.model, kept_splats.of(scene.insideout.model)
    reading = kept_splats.read_in_steps(model)
    try:
        while True:
            next(reading)
    except StopIteration as end:
        gaussians, splats = end.value
    assert splats is known
    np.testing.assert_array_equal(gaussians.means, random_set.means)
