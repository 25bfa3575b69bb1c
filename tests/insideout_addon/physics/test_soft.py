"""A model as a soft body: what it weighs, how it falls and bends, what it leaves behind when it is whole again."""

from __future__ import annotations

import bpy
import numpy as np
import pytest

from insideout.core.errors import SettingError
from insideout.core.gaussians import GaussianSet, Modality
from insideout.insideout_addon.physics import soft
from insideout.insideout_addon.physics.baking import bake, bake_in_steps
from insideout.insideout_addon.physics.breaking import make_whole
from insideout.insideout_addon.physics.soft import SoftOptions, make_soft
from insideout.insideout_addon.physics.soft_nodes import has_solver
from insideout.insideout_addon.physics.whole import make_rigid
from insideout.insideout_addon.physics.world import bodies_of, is_floor
from insideout.insideout_addon.scene.node_tree import shared_group
from insideout.insideout_addon.scene.splats import read_splats
from insideout.insideout_addon.scene.weighing import MASS_KEY

FACTOR = 50.0
QUICK = SoftOptions(resolution=5, g_cm3_per_mm_inv=FACTOR, drop_mm=20.0)


def options(**changes):
    return SoftOptions(**{**QUICK.__dict__, **changes})


@pytest.fixture
def ball(imported, shapes):
    return imported(shapes.ball(20.0), shapes.filling(lambda p: np.linalg.norm(p, axis=1) < 19, 20.0))


@pytest.fixture
def vertices():
    """`vertices(cage)`: (V, 3) of a cage in the world, now."""

    def at(cage):
        shown = cage.evaluated_get(bpy.context.evaluated_depsgraph_get())
        places = np.empty(3 * len(shown.data.vertices), np.float32)
        shown.data.vertices.foreach_get("co", places)
        return places.reshape(-1, 3) @ np.array(shown.matrix_world)[:3, :3].T + np.array(shown.matrix_world)[:3, 3]

    return at


@pytest.fixture
def shown_splats():
    """`shown_splats(model)`: the splats as nodes show them, without the display, in the model's frame."""

    def at(model):
        display = model.modifiers["InsideOut Splats"]
        display.show_viewport = False
        bpy.context.view_layer.update()
        found = read_splats(model.evaluated_get(bpy.context.evaluated_depsgraph_get()))
        display.show_viewport = True
        return found

    return at


def floor_of(scene):
    return next(thing for thing in bodies_of(scene) if is_floor(thing))


def play(scene, last, first=1):
    for frame in range(first, last + 1):
        scene.frame_set(frame)
        yield frame


class TestMass:
    @pytest.mark.parametrize("weighed", [True, False])
    def test_it_weighs_what_the_model_does(self, ball, weighed):
        if weighed:
            bpy.ops.insideout.weigh(cavities=False)
            grams = ball[MASS_KEY]
        else:
            grams = FACTOR * 1e-3 * read_splats(ball).integrals().sum()
        cage = make_soft(ball, bpy.context, QUICK)
        assert cage[MASS_KEY] == pytest.approx(grams, rel=0.005)

    def test_as_a_rigid_body_it_weighs_the_same(self, ball):
        body = make_rigid(ball, bpy.context.scene, FACTOR)
        grams = body[MASS_KEY]
        make_whole(ball, bpy.context.scene)
        assert make_soft(ball, bpy.context, QUICK)[MASS_KEY] == pytest.approx(grams, rel=1e-6)


class TestMotion:
    @pytest.mark.parametrize("metres", [0.001, 1.0])
    def test_it_falls_as_on_earth(self, blender, imported, shapes, vertices, metres):
        """g·t²/2 to 2 %, whether a unit is a millimetre or a metre."""
        scene = bpy.context.scene
        scene.unit_settings.scale_length = metres
        if metres == 1.0:
            # The user's own scene: its units stay.
            bpy.ops.mesh.primitive_uv_sphere_add()
        model = imported(shapes.ball(20.0), shapes.filling(lambda p: np.linalg.norm(p, axis=1) < 19, 20.0))
        cage = make_soft(model, bpy.context, options(drop_mm=2000.0))
        heights = [vertices(cage)[:, 2].mean() for _ in play(scene, 9)]
        seconds = 8 / scene.render.fps
        assert (heights[0] - heights[-1]) * metres == pytest.approx(9.81 / 2 * seconds**2, rel=0.02)

    def test_a_scaled_model_keeps_its_size(self, ball, vertices):
        """Without gravity and touched by nothing yet: it stays as it is shown."""
        scene = bpy.context.scene
        scene.use_gravity = False
        bpy.ops.mesh.primitive_cube_add(size=10, location=(0, 0, -500))
        bpy.ops.object.modifier_add(type="COLLISION")
        ball.scale = (2, 1, 1)
        bpy.context.view_layer.update()
        cage = make_soft(ball, bpy.context, QUICK)
        before = np.ptp(vertices(cage), axis=0)
        for _ in play(scene, 6):
            pass
        np.testing.assert_allclose(np.ptp(vertices(cage), axis=0), before, rtol=0.01)

    def test_a_ball_flattens_where_it_hits_and_does_not_fall_through(self, ball, vertices, shown_splats):
        """The softer one more; mass stays, and matter that is pressed together is denser."""
        scene, flattest, densest = bpy.context.scene, {}, {}
        before = read_splats(ball)
        for kpa in (8.0, 100.0):
            cage = make_soft(ball, bpy.context, options(stiffness_kpa=kpa, drop_mm=30.0))
            floor = floor_of(scene).location.z
            heights, lowest, squashed = [], [], None
            for _ in play(scene, 9):
                places = vertices(cage)
                heights.append(np.ptp(places[:, 2]))
                lowest.append(places[:, 2].min() - floor)
                if heights[-1] == min(heights):
                    squashed = shown_splats(ball)
            assert heights[0] == pytest.approx(40.0, abs=0.1)
            assert min(lowest) > -4.0
            assert 0 < vertices(cage)[:, 2].mean() - floor < 40
            np.testing.assert_allclose(squashed.integrals().sum(), before.integrals().sum(), rtol=1e-5)
            flattest[kpa], densest[kpa] = min(heights), float(np.percentile(squashed.density, 90))
            make_whole(ball, scene)
        assert flattest[8.0] < 34
        assert flattest[8.0] + 3 < flattest[100.0] < 40.1
        assert densest[8.0] > max(1.1 * float(before.density.max()), densest[100.0])

    def test_the_splats_stay_in_the_cage(self, ball, vertices, shown_splats):
        """And move by what the cage's middle moves."""
        scene, start = bpy.context.scene, read_splats(ball).means
        cage = make_soft(ball, bpy.context, options(stiffness_kpa=10.0))
        rest = vertices(cage).mean(axis=0)
        for frame in play(scene, 7):
            if frame in (4, 5, 7):
                means, places = shown_splats(ball).means, vertices(cage)
                assert (means > places.min(axis=0) - 2.0).all()
                assert (means < places.max(axis=0) + 2.0).all()
                moved = means.mean(axis=0) - start.mean(axis=0)
                np.testing.assert_allclose(moved, places.mean(axis=0) - rest, atol=2.0)

    def test_slow_motion_shows_the_same_later(self, ball, vertices):
        cage = make_soft(ball, bpy.context, options(slow_motion=4.0, drop_mm=500.0))
        start = vertices(cage)[:, 2].mean()
        for _ in play(bpy.context.scene, 13):
            pass
        fallen = 9810 / 2 * (3 / bpy.context.scene.render.fps) ** 2
        assert start - vertices(cage)[:, 2].mean() == pytest.approx(fallen, rel=0.03)

    def test_where_it_is_not_of_the_frame_rate_any_more_that_is_said(self, ball, draw_panels):
        """Blender's modifier is told its speed by the frame; the solver by nodes asks how long a frame is."""
        told = (
            "The frame rate has changed, and the soft body keeps the one of before; "
            "press Back to Whole, then Make Soft again"
        )
        make_soft(ball, bpy.context, QUICK)
        assert told not in draw_panels(4000)
        bpy.context.scene.render.fps = 60
        assert (told in draw_panels(4000)) != has_solver()

    def test_without_gravity_it_hangs_until_something_touches_it(self, ball, vertices):
        scene = bpy.context.scene
        scene.use_gravity = False
        bpy.ops.mesh.primitive_cube_add(size=40, location=(0, 0, -60))
        hammer = bpy.context.object
        bpy.ops.object.modifier_add(type="COLLISION")
        hammer.keyframe_insert("location", frame=3)
        hammer.location.z = -30
        hammer.keyframe_insert("location", frame=9)
        scene.frame_set(1)
        cage = make_soft(ball, bpy.context, options(stiffness_kpa=50.0))
        assert not any(is_floor(thing) for thing in bodies_of(scene))
        heights = {frame: vertices(cage)[:, 2].mean() for frame in play(scene, 12)}
        assert heights[4] == pytest.approx(heights[1], abs=0.05)
        assert heights[12] > heights[1] + 3

    def test_a_part_that_touches_nothing_falls_as_if_alone(self, imported, shapes, vertices):
        """Two balls, one above the other, which hits the floor within a frame."""
        centers = np.array([[0.0, 0, 0], [0, 0, 60]])
        body = shapes.together(*(shapes.ball(10.0, center) for center in centers))

        def inside(points):
            return np.linalg.norm(points[:, None] - centers, axis=2).min(axis=1) < 9

        cage = make_soft(imported(body, shapes.filling(inside, 70.0)), bpy.context, options(resolution=8, drop_mm=5.0))
        upper = vertices(cage)[:, 2] > 30
        start = vertices(cage)[upper, 2].mean()
        for _ in play(bpy.context.scene, 3):
            pass
        fallen = 9810 / 2 * (2 / bpy.context.scene.render.fps) ** 2
        assert start - vertices(cage)[upper, 2].mean() == pytest.approx(fallen, rel=0.03)

    def test_a_bake_begins_at_rest_whatever_was_played(self, ball, vertices):
        scene = bpy.context.scene
        cage = make_soft(ball, bpy.context, options(drop_mm=2000.0))
        rest = vertices(cage)[:, 2].mean()
        for _ in play(scene, 12):
            pass
        bake(scene, 10, 14)
        found = [rest - vertices(cage)[:, 2].mean() for _ in play(scene, 14, first=10)]
        np.testing.assert_allclose(found, 9810 / 2 * (np.arange(5) / scene.render.fps) ** 2, rtol=0.05, atol=0.2)

    def test_a_bake_that_is_ended_changes_nothing(self, ball, vertices):
        scene = bpy.context.scene
        cage = make_soft(ball, bpy.context, options(drop_mm=2000.0))
        before, rest = facts(scene), vertices(cage)[:, 2].mean()
        steps = bake_in_steps(scene, 3, 50)
        for _ in range(4):
            next(steps)
        assert vertices(cage)[:, 2].mean() < rest - 50
        steps.close()
        assert facts(scene) == before
        found = [rest - vertices(cage)[:, 2].mean() for _ in play(scene, 5)]
        np.testing.assert_allclose(found, 9810 / 2 * (np.arange(5) / scene.render.fps) ** 2, rtol=0.05, atol=0.2)

    def test_it_does_not_fall_through_a_table_far_below(self, ball, vertices):
        """Which is thick, so that its lowest point says nothing."""
        bpy.ops.mesh.primitive_cube_add(size=400, location=(0, 0, -1200))
        bpy.ops.object.modifier_add(type="COLLISION")
        cage = make_soft(ball, bpy.context, options(stiffness_kpa=2.0))
        for _ in play(bpy.context.scene, 16):
            pass
        assert -1004 < vertices(cage)[:, 2].min() < -980

    def test_what_is_out_of_the_view_layer_does_not_stop_it(self, ball):
        scene = bpy.context.scene
        bpy.ops.mesh.primitive_plane_add(size=400, location=(0, 0, -1000))
        bpy.ops.object.modifier_add(type="COLLISION")
        table, away = bpy.context.object, bpy.data.collections.new("Away")
        scene.collection.children.link(away)
        away.objects.link(table)
        scene.collection.objects.unlink(table)
        bpy.context.view_layer.layer_collection.children["Away"].exclude = True
        assert make_soft(ball, bpy.context, QUICK)

    def test_what_a_crushing_blow_leaves_are_still_splats(self, ball, shown_splats):
        """Far too soft for its fall: boxes turn inside out."""
        make_soft(ball, bpy.context, options(stiffness_kpa=0.2, drop_mm=100.0))
        for frame in play(bpy.context.scene, 9):
            if frame > 4:
                found = shown_splats(ball)
                for field in ("means", "quats", "scales", "density"):
                    assert np.isfinite(getattr(found, field)).all(), field
                assert (found.scales > 0).all()
        np.testing.assert_allclose(found.integrals().sum(), read_splats(ball).integrals().sum(), rtol=1e-5)


class TestRefusals:
    def test_photos_alone(self, blender, photo_run):
        bpy.ops.insideout.import_run(filepath=str(photo_run / "fused.ply"))
        model = bpy.context.scene.insideout.model
        with pytest.raises(SettingError, match="is of photos alone, which have no mass"):
            make_soft(model, bpy.context, QUICK)
        assert len(bpy.data.objects) == 1

    def test_splats_without_density(self, blender, tmp_path):
        cloud = GaussianSet.create(np.random.default_rng(0).normal(size=(20, 3)), 1.0, modality=Modality.XRAY)
        cloud.save(tmp_path / "fused.ply")
        bpy.ops.insideout.import_file(filepath=str(tmp_path / "fused.ply"))
        with pytest.raises(SettingError):
            make_soft(bpy.context.scene.insideout.model, bpy.context, QUICK)
        assert len(bpy.data.objects) == 1

    def test_what_is_a_body_already(self, ball):
        make_soft(ball, bpy.context, QUICK)
        with pytest.raises(SettingError, match="has a body already; press Back to Whole first"):
            make_soft(ball, bpy.context, QUICK)
        with pytest.raises(SettingError, match="has a body already"):
            make_rigid(ball, bpy.context.scene, FACTOR)

    def test_what_follows_something(self, ball):
        empty = bpy.data.objects.new("Empty", None)
        bpy.context.scene.collection.objects.link(empty)
        ball.parent = empty
        with pytest.raises(SettingError, match="follows Empty; clear its parent first"):
            make_soft(ball, bpy.context, QUICK)

    def test_what_shares_its_splats(self, ball):
        """A cage's numbers would be written over those of the other."""
        copy = ball.copy()
        bpy.context.scene.collection.objects.link(copy)
        with pytest.raises(SettingError, match="2 objects share its splats; make it a single user"):
            make_soft(ball, bpy.context, QUICK)
        copy.data = copy.data.copy()
        # Kept for the file whether an object has them or not: nobody shares them.
        ball.data.use_fake_user = True
        for each in (ball, copy):
            make_soft(each, bpy.context, QUICK)

    def test_nothing_that_would_bend_it(self, ball):
        bpy.context.scene.use_gravity = False
        before = set(bpy.data.objects)
        with pytest.raises(SettingError, match="has no gravity and nothing to touch the model"):
            make_soft(ball, bpy.context, QUICK)
        assert set(bpy.data.objects) == before

    @pytest.mark.skipif(has_solver(), reason="the solver by nodes has no such limit")
    def test_what_the_modifier_cannot_slow_down(self, ball):
        before = set(bpy.data.objects)
        with pytest.raises(
            SettingError, match=r"cannot be 132 times slower; choose 1 to 131, or a Blender from 5\.2 on"
        ):
            make_soft(ball, bpy.context, options(slow_motion=132.0))
        assert set(bpy.data.objects) == before
        make_soft(ball, bpy.context, options(slow_motion=131.0))
        speeds = [m.settings.speed for thing in bpy.data.objects for m in thing.modifiers if m.type == "SOFT_BODY"]
        assert speeds == [pytest.approx(1000**0.5 / 24 / 131, rel=1e-5)]

    def test_a_time_that_cannot_be(self, ball):
        with pytest.raises(SettingError, match="times slower cannot be"):
            make_soft(ball, bpy.context, options(slow_motion=0.0))


def facts(scene):
    return {
        "objects": sorted(thing.name for thing in bpy.data.objects),
        "meshes": len(bpy.data.meshes),
        "collections": len(bpy.data.collections),
        "node groups": sorted(group.name for group in bpy.data.node_groups),
        "shapes": len(bpy.data.shape_keys),
        "actions": len(bpy.data.actions),
        "modifiers": sorted(modifier.name for thing in bpy.data.objects for modifier in thing.modifiers),
        "attributes": sorted(layer.name for layer in scene.insideout.model.data.attributes),
        "gravity": tuple(scene.gravity),
        "keys": sorted(scene.keys()),
        "world": scene.rigidbody_world is not None,
        "simulation": (scene.use_custom_simulation_range, scene.simulation_frame_start, scene.simulation_frame_end),
    }


class TestWholeAgain:
    def test_nothing_is_left(self, ball):
        scene = bpy.context.scene
        before, start = facts(scene), read_splats(ball)
        make_soft(ball, bpy.context, QUICK)
        assert facts(scene) != before
        for _ in play(scene, 4):
            pass
        make_whole(ball, scene)
        assert facts(scene) == before
        np.testing.assert_array_equal(read_splats(ball).means, start.means)

    def test_nothing_is_left_of_one_that_was_baked(self, ball):
        before = facts(bpy.context.scene)
        make_soft(ball, bpy.context, QUICK)
        bake(bpy.context.scene, 1, 3)
        make_whole(ball, bpy.context.scene)
        assert facts(bpy.context.scene) == before

    def test_what_another_soft_body_needs_stays(self, ball, imported, shapes):
        other = imported(shapes.ball(20.0), shapes.filling(lambda p: np.linalg.norm(p, axis=1) < 19, 20.0), "other")
        for model in (ball, other):
            make_soft(model, bpy.context, QUICK)
        soft = sorted(group.name for group in bpy.data.node_groups)
        make_whole(ball, bpy.context.scene)
        assert sorted(group.name for group in bpy.data.node_groups) == soft
        assert other.modifiers[0].node_group.name == "InsideOut Follow Cage"

    def test_a_cage_that_was_deleted_by_hand(self, ball):
        """With a table of the user's there is no floor either: only the splats know of it."""
        scene = bpy.context.scene
        bpy.ops.mesh.primitive_plane_add(size=400, location=(0, 0, -50))
        bpy.ops.object.modifier_add(type="COLLISION")
        before = facts(scene)
        cage = make_soft(ball, bpy.context, QUICK)
        for thing in [cage, *(other for other in scene.objects if other.get("insideout_twin_of") == cage)]:
            mesh = thing.data
            bpy.data.objects.remove(thing)
            bpy.data.meshes.remove(mesh)
        with pytest.raises(SettingError, match="press Back to Whole first"):
            make_soft(ball, bpy.context, QUICK)
        assert bpy.ops.insideout.unbreak() == {"FINISHED"}
        assert facts(scene) == before

    def test_a_stop_halfway_changes_nothing(self, ball):
        scene = bpy.context.scene
        before = facts(scene)

        def stop(share):
            if share > 0.5:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            make_soft(ball, bpy.context, QUICK, stop)
        assert facts(scene) == before

    def test_a_solver_that_cannot_be_built_changes_nothing(self, ball, monkeypatch):
        """As an experimental one may be another in the next Blender."""

        def build(b, given):
            raise KeyError("no such socket")

        monkeypatch.setattr(soft, "has_solver", lambda: True)
        monkeypatch.setattr(soft, "soft_group", lambda: shared_group("InsideOut Test", (), build))
        before = facts(bpy.context.scene)
        for _ in range(2):
            with pytest.raises(KeyError):
                make_soft(ball, bpy.context, QUICK)
        assert facts(bpy.context.scene) == before
        assert "InsideOut Test" not in bpy.data.node_groups

    def test_no_rigid_body_world_is_made_for_it(self, ball):
        make_soft(ball, bpy.context, QUICK)
        assert bpy.context.scene.rigidbody_world is None

    def test_a_floor_is_shared_with_rigid_bodies(self, ball, imported, shapes):
        scene = bpy.context.scene
        other = imported(shapes.ball(20.0), shapes.filling(lambda p: np.linalg.norm(p, axis=1) < 19, 20.0), "other")
        make_soft(ball, bpy.context, QUICK)
        make_rigid(other, scene, FACTOR)
        (floor,) = (thing for thing in bodies_of(scene) if is_floor(thing))
        make_whole(ball, scene)
        assert floor in bodies_of(scene, other)
        assert tuple(scene.gravity)[2] < -9000
        make_whole(other, scene)
        assert set(scene.objects) == {ball, other}
        assert tuple(scene.gravity)[2] > -10

    def test_what_the_user_has_to_fall_onto_stays(self, ball):
        scene = bpy.context.scene
        bpy.ops.mesh.primitive_plane_add(size=400, location=(0, 0, -50))
        table = bpy.context.object
        bpy.ops.object.modifier_add(type="COLLISION")
        make_soft(ball, bpy.context, QUICK)
        assert not any(is_floor(thing) for thing in bodies_of(scene))
        make_whole(ball, scene)
        assert set(scene.objects) == {ball, table}
        assert [modifier.type for modifier in table.modifiers] == ["COLLISION"]
