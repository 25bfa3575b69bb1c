"""Peeling and colours by density, prepared as a button or a script does it."""

from __future__ import annotations

import bpy
import numpy as np
import pytest

from insideout.insideout_addon.scene.splats import DENSITY_HERE, DEPTH
from insideout.operators.waiting import InSteps


@pytest.fixture
def settings(blender, tmp_path, random_set):
    random_set.save(tmp_path / "fused.ply")
    bpy.context.scene.insideout.display = "POINTS"
    bpy.ops.insideout.import_run(filepath=str(tmp_path / "fused.ply"))
    return bpy.context.scene.insideout


def known(settings):
    return {DEPTH, DENSITY_HERE} & set(settings.model.data.attributes.keys())


def colors(settings):
    values = np.empty(4 * len(settings.model.data.points), np.float32)
    settings.model.data.attributes["display_color"].data.foreach_get("color", values)
    return values


def test_it_changes_nothing_that_can_be_seen(settings):
    before = colors(settings)
    assert bpy.ops.insideout.look_prepare() == {"FINISHED"}
    assert known(settings) == {DEPTH, DENSITY_HERE}
    np.testing.assert_array_equal(colors(settings), before)


def test_a_script_need_not_prepare_anything(settings):
    settings.peel_mm = 1.0
    assert known(settings) == {DEPTH, DENSITY_HERE}


def test_colours_are_as_those_of_the_setting(settings):
    before = colors(settings)
    assert bpy.ops.insideout.color_by(color_by="DENSITY") == {"FINISHED"}
    assert settings.color_by == "DENSITY"
    assert settings.look_problem == ""
    by_operator = colors(settings)
    assert np.abs(by_operator - before).max() > 0.1
    settings.color_by = "PHOTOS"
    settings.color_by = "DENSITY"
    np.testing.assert_array_equal(colors(settings), by_operator)
    assert bpy.ops.insideout.color_by(color_by="PHOTOS") == {"FINISHED"}
    np.testing.assert_array_equal(colors(settings), before)


@pytest.mark.parametrize("color_by", ["MODALITY", "PHOTOS", "RESIDUAL"])
def test_other_colours_need_no_look_inside(settings, color_by):
    assert bpy.ops.insideout.color_by(color_by=color_by) == {"FINISHED"}
    assert settings.color_by == color_by
    assert known(settings) == set()


@pytest.mark.parametrize("wanted", ["look_prepare", "color_by"])
def test_ended_early_the_model_is_as_it_was(settings, wanted):
    class Pressed:
        color_by = "DENSITY"

        def report(self, *_):
            raise AssertionError("nothing to tell")

    cls, before = getattr(bpy.types, f"INSIDEOUT_OT_{wanted}"), colors(settings)
    steps = cls.steps(Pressed(), bpy.context)
    for _ in range(3):
        assert 0 <= next(steps) <= 1
    steps.close()
    assert settings.color_by == "PHOTOS"
    assert known(settings) == set()
    np.testing.assert_array_equal(colors(settings), before)


class _Pressed(InSteps):
    """As a button is in a window whose first break is one in which something is undone."""

    color_by, density = "DENSITY", "MATERIAL"

    def __init__(self, wanted):
        self.of, self.told = getattr(bpy.types, f"INSIDEOUT_OT_{wanted}"), []

    def steps(self, context):
        steps = self.of.steps(self, context)
        yield next(steps)
        bpy.ops.ed.undo()
        return (yield from steps)

    def report(self, kinds, text):
        self.told.append(text)


_UNDONE = "What this works on was undone or changed before its end; press the button again."
_OTHER_MODEL = "The model changed before its window was found; press the button again."


@pytest.mark.parametrize(
    ("wanted", "told"),
    [("look_prepare", _UNDONE), ("color_by", _UNDONE), ("apply_transform", _UNDONE), ("section_window", _OTHER_MODEL)],
)
def test_where_the_model_is_undone_meanwhile_it_is_told(blender, tmp_path, random_set, wanted, told):
    random_set.save(tmp_path / "fused.ply")
    bpy.ops.ed.undo_push(message="Before")
    bpy.ops.insideout.import_run(filepath=str(tmp_path / "fused.ply"))
    bpy.context.view_layer.objects.active = bpy.context.scene.insideout.model
    bpy.ops.ed.undo_push(message="Import")
    pressed = _Pressed(wanted)
    assert pressed.execute(bpy.context) == {"CANCELLED"}
    assert pressed.told == [told]


def test_a_model_that_lost_what_makes_it_splats_is_told(settings):
    data = settings.model.data
    data.attributes.remove(data.attributes["modality"])
    with pytest.raises(RuntimeError, match="has lost the attribute 'modality'"):
        bpy.ops.insideout.look_prepare()


def test_photos_alone_have_nothing_to_prepare(settings, draw_panels):
    settings.model["insideout_has_density"] = False
    assert not bpy.ops.insideout.look_prepare.poll()
    assert bpy.ops.insideout.color_by(color_by="DENSITY") == {"FINISHED"}
    assert "photos alone" in settings.look_problem
    assert "Prepare Peeling" not in draw_panels()


def test_without_a_model_there_is_nothing_to_colour(blender):
    assert not bpy.ops.insideout.color_by.poll()
