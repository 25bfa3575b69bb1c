"""Models in Blender's physics: how they fall, come to rest, right themselves, and play from keyframes."""

from __future__ import annotations

import bpy
import numpy as np
import pytest

from insideout.core.errors import SettingError
from insideout.core.gaussians import GaussianSet, Modality
from insideout.insideout_addon.physics.baking import bake, bake_in_steps, is_baked
from insideout.insideout_addon.physics.breaking import BreakOptions, break_model, make_whole
from insideout.insideout_addon.physics.whole import make_rigid
from insideout.insideout_addon.physics.world import bodies_of, is_left_over

FACTOR = 50.0


@pytest.fixture
def solid_ball(imported, shapes):
    return imported(shapes.ball(20.0), shapes.filling(lambda p: np.linalg.norm(p, axis=1) < 19, 20.0))


def _vertices(piece):
    found = np.empty(3 * len(piece.data.vertices), np.float32)
    piece.data.vertices.foreach_get("co", found)
    return found.reshape(-1, 3)


def egg():
    """Half a ball of 20 mm below, a pointed half above, 34 mm high: vertices and triangles."""
    around, along = 64, 40
    tilt = np.linspace(-np.pi / 2, np.pi / 2, along + 1)[1:-1]
    height = np.where(tilt < 0, 20.0, 34.0) * np.sin(tilt)
    turn = 2 * np.pi * np.arange(around) / around
    rings = [
        20 * np.cos(t) * np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1) + [0, 0, h]
        for t, h in zip(tilt, height, strict=True)
    ]
    vertices = np.concatenate([*rings, [[0, 0, -20.0]], [[0, 0, 34.0]]])
    bottom, top = len(vertices) - 2, len(vertices) - 1
    faces = []
    for k in range(around):
        n = (k + 1) % around
        faces += [(bottom, n, k), (top, k + (along - 2) * around, n + (along - 2) * around)]
        for ring in range(along - 2):
            a, b = ring * around, (ring + 1) * around
            faces += [(a + k, a + n, b + n), (a + k, b + n, b + k)]
    return vertices, np.array(faces)


def egg_splats(lead):
    """Its thin wall as splats, with or without a lump of lead at the bottom."""
    vertices, _ = egg()
    area = np.maximum(np.hypot(vertices[:, 0], vertices[:, 1]), 0.5) / 20
    wall = GaussianSet.create(0.96 * vertices, 1.0, density=0.02 * area, modality=Modality.XRAY, opacities=0.9)
    if not lead:
        return wall
    lump = GaussianSet.create(
        [[0, 0, -13.0], [3, 0, -13], [-3, 0, -13], [0, 3, -13], [0, -3, -13]], 2.0, density=1.0, modality=Modality.XRAY
    )
    return GaussianSet.concatenate([wall, lump])


@pytest.mark.parametrize(("lead", "stands"), [(True, True), (False, False)])
def test_a_leaden_foot_rights_a_toy_and_an_empty_one_stays_down(imported, shapes, place, lead, stands):
    vertices, faces = egg()
    model = imported(shapes.Body(vertices, faces, np.ones_like(vertices)), egg_splats(lead))
    # Lying on its side.
    model.rotation_euler = (np.pi / 2, 0, 0)
    bpy.context.view_layer.update()
    make_rigid(model, bpy.context.scene, FACTOR)
    bpy.context.scene.frame_end = 400
    bpy.context.scene.rigidbody_world.point_cache.frame_end = 400
    upright = np.array([place(model, frame)[2, 2] for frame in range(1, 361)])
    assert abs(upright[0]) < 0.01
    # Its axis over the last two seconds.
    if stands:
        assert upright[-48:].min() > 0.95
    else:
        assert upright[-48:].max() < 0.3


def test_the_centre_of_mass_is_where_the_lead_is(imported, shapes):
    vertices, faces = egg()
    model = imported(shapes.Body(vertices, faces, np.ones_like(vertices)), egg_splats(True))
    body = make_rigid(model, bpy.context.scene, FACTOR)
    assert body.location.z < -5
    np.testing.assert_allclose(body.location.xy, 0, atol=0.05)
    np.testing.assert_allclose(np.array(model.matrix_world), np.eye(4), atol=1e-5)


@pytest.mark.parametrize("metres", [0.001, 1.0])
def test_it_falls_as_on_earth(blender, imported, shapes, place, metres):
    """g·t²/2 to 2 %, whether a unit is a millimetre or a metre."""
    units = bpy.context.scene.unit_settings
    units.scale_length = metres
    if metres == 1.0:
        # The user's own scene: its units stay.
        bpy.ops.mesh.primitive_uv_sphere_add()
    model = imported(shapes.ball(20.0), shapes.filling(lambda p: np.linalg.norm(p, axis=1) < 19, 20.0))
    make_rigid(model, bpy.context.scene, FACTOR, drop_mm=2000.0)
    first = place(model, 1)[2, 3]
    for frame in range(2, 13):
        last = place(model, frame)[2, 3]
    seconds = 11 / bpy.context.scene.render.fps
    assert (first - last) * metres == pytest.approx(9.81 / 2 * seconds**2, rel=0.02)


def test_pieces_fall_onto_the_floor_and_stay_there(solid_ball, place):
    pieces = break_model(
        solid_ball, bpy.context, BreakOptions(pieces=5, g_cm3_per_mm_inv=FACTOR, spacing_mm=3.0, drop_mm=30.0)
    )
    bpy.context.scene.rigidbody_world.point_cache.frame_end = 250
    before = [place(piece, 1)[:3, 3] for piece in pieces]
    floor = next(thing for thing in bodies_of(bpy.context.scene) if thing not in pieces)
    for frame in range(2, 97):
        bpy.context.scene.frame_set(frame)
    after = [place(piece)[:3, 3] for piece in pieces]
    corners = np.concatenate([_vertices(piece) @ place(piece)[:3, :3].T + place(piece)[:3, 3] for piece in pieces])
    assert floor.location.z == pytest.approx(-50, abs=0.1)
    for old, new in zip(before, after, strict=True):
        assert new[2] < old[2] - 20
        assert floor.location.z < new[2] < floor.location.z + 40
    assert corners[:, 2].min() == pytest.approx(floor.location.z, abs=1.0)
    # What lies still is not thrown about.
    for frame in range(97, 109):
        bpy.context.scene.frame_set(frame)
    assert max(np.linalg.norm(place(piece)[:3, 3] - old) for piece, old in zip(pieces, after, strict=True)) < 1.0


def test_bodies_come_to_rest_on_the_floor_that_is_seen(solid_ball, place):
    scene = bpy.context.scene
    body = make_rigid(solid_ball, scene, FACTOR, drop_mm=10.0)
    floor = next(thing for thing in bodies_of(scene) if thing != body)
    for frame in range(1, 73):
        scene.frame_set(frame)
    assert place(body)[2, 3] - floor.location.z == pytest.approx(20.0, abs=0.5)


def test_before_they_fall_pieces_do_not_push_each_other_apart(imported, shells, place):
    """Shells in each other: hulls that overlapped would burst."""
    pieces = break_model(
        imported(*shells), bpy.context, BreakOptions(pieces=4, g_cm3_per_mm_inv=FACTOR, spacing_mm=3.0, drop_mm=2000.0)
    )
    before = [place(piece, 1)[:3, 3] for piece in pieces]
    for frame in range(2, 7):
        bpy.context.scene.frame_set(frame)
    fallen = 9810 / 2 * (5 / 24) ** 2
    for piece, old in zip(pieces, before, strict=True):
        np.testing.assert_allclose(place(piece)[:3, 3], old - [0, 0, fallen], atol=0.03 * fallen)


def test_baked_motion_is_that_of_the_physics_and_needs_none(solid_ball, place):
    scene = bpy.context.scene
    pieces = break_model(solid_ball, bpy.context, BreakOptions(pieces=4, g_cm3_per_mm_inv=FACTOR, spacing_mm=3.0))
    simulated = {frame: [place(piece, frame) for piece in pieces] for frame in range(1, 21)}
    assert bake(scene, 1, 20) == pieces
    assert scene.rigidbody_world is None
    assert all(is_baked(piece) for piece in pieces)
    # In any order, as no simulation can be.
    for frame in (20, 7, 13, 1):
        for piece, matrix in zip(pieces, simulated[frame], strict=True):
            np.testing.assert_allclose(place(piece, frame), matrix, atol=2e-3)


def test_the_whole_model_follows_its_baked_body(solid_ball, place):
    make_rigid(solid_ball, bpy.context.scene, FACTOR, drop_mm=500.0)
    bake(bpy.context.scene, 1, 8)
    assert place(solid_ball, 8)[2, 3] < place(solid_ball, 1)[2, 3] - 100


@pytest.mark.parametrize("baked", [False, True])
def test_a_floor_stays_for_the_other_model_that_lies_on_it(solid_ball, imported, shapes, baked):
    scene = bpy.context.scene
    other = imported(shapes.ball(20.0), shapes.filling(lambda p: np.linalg.norm(p, axis=1) < 19, 20.0), "other")
    make_rigid(solid_ball, scene, FACTOR)
    make_rigid(other, scene, FACTOR)
    (floor,) = (thing for thing in bodies_of(scene) if thing.rigid_body.type == "PASSIVE")
    if baked:
        bake(scene, 1, 4)
    make_whole(solid_ball, scene)
    assert bodies_of(scene, solid_ball) == []
    assert floor in bodies_of(scene, other)
    make_whole(other, scene)
    assert set(scene.objects) == {solid_ball, other}
    assert scene.rigidbody_world is None


def test_a_body_that_the_user_lets_hold_still_is_no_floor_and_goes_with_its_model(solid_ball, imported, shapes):
    """So that another model falls onto it."""
    scene = bpy.context.scene
    other = imported(shapes.ball(20.0), shapes.filling(lambda p: np.linalg.norm(p, axis=1) < 19, 20.0), "other")
    body = make_rigid(solid_ball, scene, FACTOR)
    make_rigid(other, scene, FACTOR)
    body.rigid_body.type = "PASSIVE"
    make_whole(solid_ball, scene)
    assert solid_ball.parent is None
    assert bodies_of(scene, solid_ball) == []
    make_whole(other, scene)
    assert set(scene.objects) == {solid_ball, other}


def test_a_body_with_a_parent_is_baked_where_it_fell(solid_ball, place):
    """Physics moves it in the world; its location counts from the parent, which may move, too."""
    scene = bpy.context.scene
    body = make_rigid(solid_ball, scene, FACTOR, floor=False)
    holder = bpy.data.objects.new("holder", None)
    scene.collection.objects.link(holder)
    body.parent = holder
    holder.location, holder.rotation_euler = (100, 0, 0), (0.4, 0, 0)
    holder.keyframe_insert("location", frame=1)
    holder.location = (100, 60, 0)
    holder.keyframe_insert("location", frame=4)
    fell = {frame: place(body, frame) for frame in range(1, 5)}
    bake(scene, 1, 4)
    for frame, matrix in fell.items():
        np.testing.assert_allclose(place(body, frame), matrix, atol=2e-3)


def test_without_its_world_nothing_is_baked_and_all_can_be_undone(solid_ball, draw_panels):
    """Scene > Rigid Body World > Remove."""
    scene = bpy.context.scene
    make_rigid(solid_ball, scene, FACTOR)
    bpy.ops.rigidbody.world_remove()
    with pytest.raises(SettingError, match="world was removed, so nothing falls; press Back to Whole"):
        bake(scene, 1, 3)
    assert "Baked to keyframes" not in draw_panels()
    make_whole(solid_ball, scene)
    assert set(scene.objects) == {solid_ball}
    bpy.ops.rigidbody.world_add()
    assert not is_left_over(scene), "this one is the user's"


def test_nor_does_anything_of_pieces_in_each_other_stay_then(imported, shells):
    model = imported(*shells)
    before = set(bpy.data.objects), set(bpy.data.collections)
    break_model(model, bpy.context, BreakOptions(pieces=2, g_cm3_per_mm_inv=FACTOR, spacing_mm=3.0, floor=False))
    assert any(thing.type == "EMPTY" for thing in bpy.context.scene.objects)
    bpy.ops.rigidbody.world_remove()
    make_whole(model, bpy.context.scene)
    left = {each for each in bpy.data.collections if not each.name.startswith("RigidBody")}
    assert (set(bpy.data.objects), left) == before


def test_a_body_may_be_in_the_collection_that_the_user_has_chosen_for_rigid_bodies(solid_ball, place):
    scene = bpy.context.scene
    bpy.ops.rigidbody.world_add()
    mine = bpy.data.collections.new("Mine")
    scene.collection.children.link(mine)
    mine.objects.link(solid_ball)
    scene.collection.objects.unlink(solid_ball)
    scene.rigidbody_world.collection = mine
    body = make_rigid(solid_ball, scene, FACTOR, floor=False)
    assert body.rigid_body.type == "ACTIVE"
    heights = [place(body, frame)[2, 3] for frame in range(1, 6)]
    assert heights[-1] < heights[0] - 50
    assert bake(scene, 1, 5) == [body]
    assert bodies_of(scene, solid_ball) == [body]
    np.testing.assert_allclose([place(body, frame)[2, 3] for frame in range(1, 6)], heights, atol=2e-3)
    make_whole(solid_ball, scene)
    assert set(scene.objects) == {solid_ball}


@pytest.mark.parametrize("baked", [False, True])
def test_a_world_of_the_users_is_given_back_as_it_was(solid_ball, baked):
    """With their own body, gravity and frames, among which the model only fell."""
    scene = bpy.context.scene
    bpy.ops.mesh.primitive_cube_add()
    bpy.ops.rigidbody.object_add()
    own = bpy.context.object
    cache = scene.rigidbody_world.point_cache
    cache.frame_start, cache.frame_end = 3, 77
    gravity = tuple(scene.gravity)
    make_rigid(solid_ball, scene, FACTOR)
    assert tuple(scene.gravity) != gravity
    if baked:
        bake(scene, 1, 4)
    make_whole(solid_ball, scene)
    assert tuple(scene.gravity) == gravity
    assert own.rigid_body is not None
    cache = scene.rigidbody_world.point_cache
    assert (cache.frame_start, cache.frame_end) == (3, 77)


@pytest.mark.parametrize("baked", [False, True])
def test_a_gravity_that_the_user_has_set_since_stays(solid_ball, baked):
    scene = bpy.context.scene
    make_rigid(solid_ball, scene, FACTOR)
    scene.gravity.z = -1620.0
    if baked:
        bake(scene, 1, 4)
        assert scene.gravity.z == -1620
    make_whole(solid_ball, scene)
    assert scene.gravity.z == -1620
    assert not {"insideout_gravity", "insideout_own_gravity"} & set(scene.keys())
    make_rigid(solid_ball, scene, FACTOR)
    make_whole(solid_ball, scene)
    assert scene.gravity.z == -1620


def test_what_a_file_of_before_made_of_gravity_is_undone(solid_ball):
    """It does not say what it was set to."""
    scene = bpy.context.scene
    gravity = tuple(scene.gravity)
    make_rigid(solid_ball, scene, FACTOR)
    del scene["insideout_own_gravity"]
    make_whole(solid_ball, scene)
    assert tuple(scene.gravity) == gravity


def test_a_bake_that_is_ended_changes_nothing(solid_ball, place):
    """As by Esc, while Blender draws between its frames."""
    scene = bpy.context.scene
    body = make_rigid(solid_ball, scene, FACTOR, drop_mm=100.0)
    cache = scene.rigidbody_world.point_cache
    scene.frame_set(7)

    def facts():
        custom = scene.use_custom_simulation_range, scene.simulation_frame_start, scene.simulation_frame_end
        return (scene.frame_current, *custom, cache.frame_start, cache.frame_end, tuple(scene.gravity))

    before = facts()
    steps = bake_in_steps(scene, 3, 50)
    shares = [next(steps) for _ in range(5)]
    np.testing.assert_allclose(shares, np.arange(1, 6) / 48)
    assert scene.frame_current == 7
    assert place(body)[2, 3] < -1
    steps.close()
    assert facts() == before
    assert body.rigid_body is not None
    assert body.animation_data is None


def test_a_bake_begins_at_rest_whatever_was_played(solid_ball, place):
    scene = bpy.context.scene
    body = make_rigid(solid_ball, scene, FACTOR, drop_mm=2000.0)
    rest = place(body, 1)[2, 3]
    for frame in range(2, 13):
        scene.frame_set(frame)
    bake(scene, 10, 14)
    fallen = 9810 / 2 * (np.arange(5) / scene.render.fps) ** 2
    np.testing.assert_allclose([rest - place(body, 10 + k)[2, 3] for k in range(5)], fallen, rtol=0.06, atol=0.1)


def test_there_is_nothing_to_bake_without_bodies(blender):
    with pytest.raises(SettingError, match="break the model, or make it rigid or soft, first"):
        bake(bpy.context.scene, 1, 10)


def test_frames_that_are_none_are_refused(solid_ball):
    make_rigid(solid_ball, bpy.context.scene, FACTOR)
    with pytest.raises(SettingError, match="choose an end after the start"):
        bake(bpy.context.scene, 10, 10)


def test_a_break_rendered_as_a_sequence_of_images(solid_ball, tmp_path):
    scene = bpy.context.scene
    break_model(solid_ball, bpy.context, BreakOptions(pieces=4, g_cm3_per_mm_inv=FACTOR, spacing_mm=3.0, drop_mm=20.0))
    bake(scene, 1, 5)
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.collection.objects.link(camera)
    scene.camera, camera.location = camera, (0, -200, 0)
    camera.rotation_euler, camera.data.clip_end = (np.pi / 2, 0, 0), 1000
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.device = 1, "CPU"
    scene.render.resolution_x = scene.render.resolution_y = 64
    scene.render.image_settings.file_format = "PNG"
    scene.frame_start, scene.frame_end, scene.render.filepath = 1, 5, str(tmp_path / "frame")
    scene.world = bpy.data.worlds.new("World")
    light = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
    light.data.energy = 3.0
    scene.collection.objects.link(light)
    bpy.ops.render.render(animation=True)
    frames = []
    for frame in range(1, 6):
        image = bpy.data.images.load(str(tmp_path / f"frame{frame:04d}.png"))
        frames.append(np.array(image.pixels).reshape(64, 64, 4)[..., :3])
    red = [(frame[..., 0] > 2 * frame[..., 1]) & (frame[..., 0] > 0.1) for frame in frames]
    heights = [np.nonzero(mask)[0].mean() for mask in red]
    assert all(mask.sum() > 50 for mask in red)
    # They fall for three frames, and lie then.
    assert (np.diff(heights)[:3] < 0).all()
    assert abs(heights[4] - heights[3]) < 1
