"""A model that a parent stretches, or that is disabled, breaks where it is seen."""

from __future__ import annotations

from dataclasses import replace

import bpy
import numpy as np
import pytest

from insideout.insideout_addon.physics.breaking import BreakOptions, break_model, section_walls
from insideout.insideout_addon.physics.soft import SoftOptions, make_soft
from insideout.insideout_addon.physics.whole import make_rigid, world_box
from insideout.insideout_addon.scene.exporting import edited_splats
from insideout.insideout_addon.scene.splats import read_splats
from insideout.insideout_addon.scene.standing import place_in_world

FACTOR = 50.0
QUICK = BreakOptions(pieces=4, g_cm3_per_mm_inv=FACTOR, spacing_mm=5.0)


@pytest.fixture
def ball(imported, shapes):
    return imported(shapes.ball(20.0), shapes.filling(lambda p: np.linalg.norm(p, axis=1) < 19, 20.0))


def reopen(tmp_path):
    """The scene's model, after the file was saved and opened again."""
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    return bpy.context.scene.insideout.model


def corners(piece):
    places = np.empty(3 * len(piece.data.vertices), np.float32)
    piece.data.vertices.foreach_get("co", places)
    return places.reshape(-1, 3)


@pytest.mark.parametrize("mirror", [1, -1])
def test_pieces_of_a_sheared_model_fit_together(ball, place, mirror):
    parent = bpy.data.objects.new("Stretched", None)
    bpy.context.collection.objects.link(parent)
    parent.scale, parent.location = (1, mirror, 2), (5, 0, 0)
    ball.parent, ball.rotation_euler, ball.location = parent, (np.pi / 4, 0.3, 0), (0, 0, 7)
    bpy.context.view_layer.update()
    matrix = place(ball)
    assert abs(matrix[:3, 1] @ matrix[:3, 2]) > 1
    pieces = break_model(ball, bpy.context, replace(QUICK, show="SPLATS"))
    back = np.linalg.inv(matrix)
    for piece in pieces:
        assert piece.matrix_world.to_scale()[:] == pytest.approx((1, 1, 1), abs=1e-5)
        seen = corners(piece) @ place(piece)[:3, :3].T + place(piece)[:3, 3]
        in_model = seen @ back[:3, :3].T + back[:3, 3]
        # The outside is on the ball, and nothing is outside of it.
        assert np.linalg.norm(in_model, axis=1).max() == pytest.approx(20.0, abs=0.01)
        (cloud,) = piece.children
        np.testing.assert_allclose(place(cloud), matrix, atol=2e-4)
        outward = np.array([polygon.normal @ polygon.center for polygon in piece.data.polygons])
        assert outward.mean() > 0
        exported = edited_splats(cloud, bpy.context)
        moved = read_splats(cloud).means @ matrix[:3, :3].T + matrix[:3, 3]
        np.testing.assert_allclose(exported.means, moved, atol=2e-3)


def test_walls_are_those_of_planes_and_models_that_are_disabled(ball, tmp_path):
    ball.rotation_euler = (0, 0, 0.4)
    bpy.ops.insideout.section_add()
    plane = bpy.context.scene.insideout.sections[0].object
    plane.location = (3, 4, 5)
    bpy.context.view_layer.update()
    (before,) = section_walls(bpy.context.scene, ball)
    plane.hide_viewport = ball.hide_viewport = True
    model = reopen(tmp_path)
    (after,) = section_walls(bpy.context.scene, model)
    np.testing.assert_allclose(after.normal, before.normal, atol=1e-6)
    assert after.offset == pytest.approx(before.offset, abs=1e-4)


@pytest.mark.parametrize("how", ["rigid", "soft", "broken"])
def test_a_disabled_model_falls_from_where_it_is(ball, tmp_path, how):
    ball.location = (100, 0, 0)
    ball.hide_viewport = True
    model, scene = reopen(tmp_path), bpy.context.scene
    if how == "rigid":
        made = [make_rigid(model, scene, FACTOR)]
    elif how == "soft":
        made = [make_soft(model, bpy.context, SoftOptions(resolution=3, g_cm3_per_mm_inv=FACTOR))]
    else:
        made = break_model(model, bpy.context, QUICK)
    if how == "rigid":
        # It is where it was, as a part of the body.
        np.testing.assert_allclose(np.array(place_in_world(model))[:3, 3], (100, 0, 0), atol=1e-4)
    boxes = np.array([world_box(thing) for thing in made])
    assert boxes[:, 0, 0].min() == pytest.approx(80, abs=5)
    assert boxes[:, 1, 0].max() == pytest.approx(120, abs=5)
