"""The README's tour: import, cut, measure, break, in its order and with the buttons' own defaults."""

from __future__ import annotations

import bpy
import numpy as np
import pytest

from insideout.insideout_addon.measure.rulers import LENGTH_KEY, rulers
from insideout.insideout_addon.measure.thickness_map import shown_figures, thickness_maps
from insideout.insideout_addon.physics.world import is_floor
from insideout.insideout_addon.scene.splats import shown_model
from insideout.insideout_addon.scene.weighing import MASS_KEY


def test_five_minutes_with_a_model(imported, shells, place):
    imported(*shells)
    scene = bpy.context.scene
    settings = scene.insideout
    assert scene.unit_settings.length_unit == "MILLIMETERS"
    settings.pixels = 128

    assert bpy.ops.insideout.section_add() == {"FINISHED"}
    settings.sections[0].apart_mm = 30.0
    assert bpy.ops.insideout.thickness() == {"FINISHED"}
    # Walls of 3 mm, and a core of 14 mm across.
    figures = shown_figures(thickness_maps(scene)[-1])
    assert figures.least_mm == pytest.approx(3.0, abs=1.5)
    settings.sections[0].apart_mm = 0.0

    for cursor in ((-20.0, 0.0, 0.0), (20.0, 0.0, 0.0)):
        scene.cursor.location = cursor
        assert bpy.ops.insideout.point_add() == {"FINISHED"}
    assert bpy.ops.insideout.measure() == {"FINISHED"}
    assert rulers(scene)[-1][LENGTH_KEY] == pytest.approx(40.0, rel=1e-4)

    assert bpy.ops.insideout.break_model() == {"FINISHED"}
    pieces = [thing for thing in bpy.data.objects if MASS_KEY in thing and not is_floor(thing)]
    assert len(pieces) >= 12
    assert sum(piece[MASS_KEY] for piece in pieces) > 10
    before = np.array([place(piece)[2, 3] for piece in pieces])
    for frame in range(scene.frame_start, scene.frame_start + 8):
        scene.frame_set(frame)
    assert (np.array([place(piece)[2, 3] for piece in pieces]) < before).all()
    assert bpy.ops.insideout.unbreak() == {"FINISHED"}
    assert not shown_model(scene).hide_viewport
