"""Bodies, pieces and floors that the user has disabled in viewports are baked, and gone again, like all others."""

from __future__ import annotations

import bpy
import numpy as np
import pytest

from insideout.insideout_addon.physics import baking
from insideout.insideout_addon.physics.baking import bake, is_baked
from insideout.insideout_addon.physics.breaking import BreakOptions, break_model, make_whole
from insideout.insideout_addon.physics.whole import make_rigid
from insideout.insideout_addon.physics.world import bodies_of, is_floor

FACTOR = 50.0


@pytest.fixture
def ball(imported, shapes):
    return imported(shapes.ball(20.0), shapes.filling(lambda p: np.linalg.norm(p, axis=1) < 19, 20.0))


@pytest.fixture
def pieces(ball):
    return break_model(ball, bpy.context, BreakOptions(pieces=3, g_cm3_per_mm_inv=FACTOR, spacing_mm=6.0))


def floor_of(scene):
    return next(thing for thing in bodies_of(scene) if is_floor(thing))


@pytest.mark.parametrize("which", ["piece", "floor", "all"])
def test_what_is_disabled_goes_with_the_rest(ball, pieces, which):
    scene = bpy.context.scene
    for thing in {"piece": pieces[1:2], "floor": [floor_of(scene)], "all": bodies_of(scene)}[which]:
        thing.hide_viewport = True
    assert make_whole(ball, scene) >= 4
    assert bodies_of(scene) == []
    assert scene.rigidbody_world is None
    assert not ball.hide_viewport


def test_so_does_the_body_of_a_whole_model(ball):
    body = make_rigid(ball, bpy.context.scene, FACTOR)
    body.hide_viewport = True
    make_whole(ball, bpy.context.scene)
    assert bpy.context.scene.rigidbody_world is None
    np.testing.assert_allclose(np.array(ball.matrix_basis), np.eye(4), atol=1e-6)


def test_a_bake_has_the_motion_of_the_others_and_leaves_it_disabled(pieces, place):
    scene = bpy.context.scene
    floor = floor_of(scene)
    before = place(pieces[1])
    pieces[1].hide_viewport = floor.hide_viewport = True
    bake(scene, 1, 8)
    assert scene.rigidbody_world is None
    assert all(is_baked(piece) and piece.rigid_body is None for piece in pieces)
    assert [piece.hide_viewport for piece in pieces] == [False, True, False]
    assert floor.hide_viewport
    assert place(pieces[0], 8)[2, 3] < place(pieces[0], 1)[2, 3] - 1
    pieces[1].hide_viewport = False
    np.testing.assert_allclose(place(pieces[1], 1), before, atol=1e-4)


def test_an_error_while_bodies_go_loses_no_motion(pieces, monkeypatch):
    """What was simulated may have taken minutes."""

    def fail(*_):
        raise RuntimeError("no body may go")

    monkeypatch.setattr(baking, "release", fail)
    with pytest.raises(RuntimeError):
        bake(bpy.context.scene, 1, 4)
    assert all(piece.animation_data is not None for piece in pieces)
