"""Mixed display: at most so many ellipsoids, where they matter; every other splat that is shown is a point."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from mathutils import Matrix

from insideout.core.gaussians import GaussianSet
from insideout.insideout_addon.scene.cutting import cut_group
from insideout.insideout_addon.scene.display import display_modifier, show_splats
from insideout.insideout_addon.scene.mixing import CHOSEN
from insideout.insideout_addon.scene.node_tree import modifier_input, set_modifier_input
from insideout.insideout_addon.scene.showing import add_box, choose, chosen, show_as, shown_as
from insideout.insideout_addon.scene.splats import create_splats

OFF = 1e9
"""A size that no splat has."""


@pytest.fixture
def mixed(blender):
    """`mixed(gaussians, *cuts, **inputs)`: the object; a cut is (place, turn, slab depth)."""

    def make(gaussians, *cuts, **inputs):
        splats = create_splats(gaussians, "model", bpy.context)
        for slot, (place, turn, slab) in enumerate(cuts):
            plane = bpy.data.objects.new("plane", None)
            plane.location, plane.rotation_euler = place, turn
            bpy.context.collection.objects.link(plane)
            modifier = splats.modifiers.new("cut", "NODES")
            modifier.node_group = cut_group()
            for name, value in {"Section": plane, "Slot": slot, "Slab": slab}.items():
                set_modifier_input(modifier, name, value)
        modifier = show_splats(splats, True, mixed=True)
        for name, value in {"Soft": False, "Cut": bool(cuts), **inputs}.items():
            set_modifier_input(modifier, name.replace("_", " "), value)
        return splats

    return make


@pytest.fixture
def ellipsoids(whole_ellipsoids):
    """`ellipsoids(splats)`: (n, 3) places of the whole ellipsoids, sorted."""
    return lambda splats: np.array(sorted(whole_ellipsoids(splats)[:, :3, 3].tolist())).reshape(-1, 3)


def _counts(splats):
    """(instances, points, vertices of meshes) shown."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    depsgraph.update()
    geometry = splats.evaluated_get(depsgraph).evaluated_geometry()
    instances, cloud, mesh = geometry.instances_pointcloud(), geometry.pointcloud, geometry.mesh
    return tuple(
        len(items) if items else 0
        for items in (instances and instances.points, cloud and cloud.points, mesh and mesh.vertices)
    )


def _row(count=20, sizes=1.0):
    """Splats along x at 0, 10, 20, ..."""
    means = np.zeros((count, 3))
    means[:, 0] = 10.0 * np.arange(count)
    return GaussianSet.create(means, sizes if np.isscalar(sizes) else np.asarray(sizes)[:, None])


def test_the_largest_are_ellipsoids_and_all_others_points(mixed, ellipsoids):
    sizes = np.random.default_rng(0).permutation(np.arange(1.0, 21.0)) / 10
    splats = mixed(_row(sizes=sizes), Ellipsoids_at_Most=5)
    np.testing.assert_allclose(ellipsoids(splats)[:, 0], 10 * np.flatnonzero(sizes > 1.55), atol=1e-4)
    assert _counts(splats) == (5, 15, 0)


def test_only_from_a_size_on(mixed, ellipsoids):
    splats = mixed(_row(sizes=np.arange(1.0, 21.0)), Large_From=18.5)
    np.testing.assert_allclose(ellipsoids(splats)[:, 0], [180, 190], atol=1e-4)


@pytest.mark.parametrize("most", [0, 1, 7, 300, 10_000])
def test_there_are_never_more_than_told_even_of_equal_ones(mixed, most):
    cloud = GaussianSet.create(np.random.default_rng(0).uniform(-50, 50, (1000, 3)), 1.0)
    instances, points, _ = _counts(mixed(cloud, Ellipsoids_at_Most=most))
    assert instances + points == 1000
    assert 0.98 * min(most, 1000) - 1 <= instances <= most


def test_splats_that_are_not_shown_take_no_place(mixed, ellipsoids):
    splats = mixed(_row(4, sizes=[1, 2, 3, 4]), Ellipsoids_at_Most=2)
    opacity = splats.data.attributes["radiance:base"].data
    opacity[3].color = (0, 0, 0, 0.01)
    splats.data.update_tag()
    np.testing.assert_allclose(ellipsoids(splats)[:, 0], [10, 20], atol=1e-4)


class TestCuts:
    def test_splats_that_a_plane_crosses_come_before_large_ones(self, mixed, ellipsoids):
        """The plane at x = 100 hides what is beyond; the last one before it is far larger than those at the plane."""
        sizes = np.full(20, 1.0)
        sizes[3] = 4.0
        splats = mixed(_row(sizes=sizes), ((100, 0, 0), (0, np.pi / 2, 0), 0.0), Ellipsoids_at_Most=1)
        assert len(ellipsoids(splats)) == 0
        assert _counts(splats) == (1, 10, 0)

    def test_what_a_plane_hides_takes_no_place(self, mixed, ellipsoids):
        sizes = np.full(20, 1.0)
        sizes[15] = 3.0
        splats = mixed(_row(sizes=sizes), ((98, 0, 0), (0, np.pi / 2, 0), 0.0), Ellipsoids_at_Most=3)
        assert len(ellipsoids(splats)) == 3

    @pytest.mark.parametrize("most", [30, 1000])
    def test_a_plane_beside_the_model_changes_nothing(self, mixed, ellipsoids, most):
        """With a second plane splats are put in order whether or not there are too many; it is the same choice."""
        sizes = np.random.default_rng(1).permutation(np.arange(1.0, 201.0)) / 100
        cloud = GaussianSet.create(np.random.default_rng(0).uniform(-50, 50, (200, 3)), sizes[:, None])
        through, beside = ((0, 0, 3), (0.2, 0, 0), 0.0), ((0, 0, 500), (0, 0, 0), 0.0)
        models = [
            mixed(cloud, *cuts, Ellipsoids_at_Most=most, Large_From=0.5) for cuts in ((through,), (through, beside))
        ]
        np.testing.assert_allclose(ellipsoids(models[0]), ellipsoids(models[1]), atol=1e-5)
        assert _counts(models[0]) == _counts(models[1])

    def test_nothing_that_was_noted_on_the_way_is_left(self, mixed):
        splats = mixed(_row(), ((101, 0, 0), (0, np.pi / 2, 0), 0.0), Large_From=OFF)
        geometry = splats.evaluated_get(bpy.context.evaluated_depsgraph_get()).evaluated_geometry()
        for cloud in (geometry.pointcloud, geometry.instances_pointcloud()):
            own = {"cut_normal_0", "cut_height_0", "instance_transform", ".reference_index"}
            assert set(cloud.attributes.keys()) <= own | set(splats.data.attributes.keys())

    def test_a_slab_below_the_cut(self, mixed, ellipsoids):
        splats = mixed(_row(), ((105, 0, 0), (0, np.pi / 2, 0), 0.0), Large_From=OFF, Near_Cuts=26.0)
        np.testing.assert_allclose(ellipsoids(splats)[:, 0], [80, 90, 100], atol=1e-4)
        assert _counts(splats) == (3, 8, 0)

    def test_without_cuts_there_is_no_slab(self, mixed):
        assert _counts(mixed(_row(), Large_From=OFF, Near_Cuts=26.0)) == (0, 20, 0)

    def test_those_that_several_planes_cut_become_few_meshes(self, mixed):
        """In a thin slab every splat is cut twice; one of fifty of those allowed may be a mesh of its own."""
        cloud = GaussianSet.create(np.random.default_rng(0).uniform(-50, 50, (1000, 3)) * [1, 1, 0], 1.0)
        instances, points, vertices = _counts(mixed(cloud, ((0, 0, 0.5), (0, 0, 0), 1.0), Ellipsoids_at_Most=200))
        assert instances == 0
        assert 3 <= vertices / 162 <= 4
        assert points == 1000 - vertices / 162


class TestChosen:
    def test_chosen_ones_come_before_all_others(self, mixed, ellipsoids):
        splats = mixed(_row(sizes=np.arange(1.0, 21.0)), Ellipsoids_at_Most=2)
        assert choose(splats, np.arange(20) == 4) == 1
        np.testing.assert_allclose(ellipsoids(splats)[:, 0], [40, 190], atol=1e-4)
        assert chosen(splats).sum() == 1

    def test_of_too_many_the_largest(self, mixed, ellipsoids):
        splats = mixed(_row(sizes=np.arange(1.0, 21.0)), Ellipsoids_at_Most=2)
        choose(splats, np.arange(20) < 6)
        np.testing.assert_allclose(ellipsoids(splats)[:, 0], [40, 50], atol=1e-4)

    def test_a_script_may_write_the_attribute_itself(self, mixed, ellipsoids):
        splats = mixed(_row(), Large_From=OFF)
        layer = splats.data.attributes.new(CHOSEN, "BOOLEAN", "POINT")
        layer.data[7].value = True
        splats.data.update_tag()
        np.testing.assert_allclose(ellipsoids(splats)[:, 0], [70], atol=1e-4)


class TestBox:
    def test_what_is_in_the_box_is_ellipsoids(self, mixed, ellipsoids):
        splats = mixed(_row(), Large_From=OFF)
        box = add_box(splats, bpy.context)
        box.matrix_world = Matrix.LocRotScale((55, 0, 0), None, (26, 1, 1))
        np.testing.assert_allclose(ellipsoids(splats)[:, 0], np.arange(30, 81, 10), atol=1e-4)

    def test_it_may_be_turned_and_the_model_moved_and_scaled(self, mixed, ellipsoids):
        splats = mixed(_row(), Large_From=OFF)
        splats.matrix_world = Matrix.LocRotScale((5, 5, 0), None, (0.1, 0.1, 0.1))
        box = add_box(splats, bpy.context)
        turn = Matrix.Rotation(np.pi / 2, 3, "Z").to_quaternion()
        box.matrix_world = Matrix.LocRotScale((10.5, 5, 0), turn, (1, 2.6, 1))
        np.testing.assert_allclose(ellipsoids(splats)[:, 0], np.arange(30, 81, 10), atol=1e-4)

    def test_a_new_one_is_in_the_middle_and_half_as_long_as_the_model(self, mixed):
        box = add_box(mixed(_row(21)), bpy.context)
        assert box.location[:] == pytest.approx((100, 0, 0), abs=1e-3)
        assert box.scale.x == pytest.approx(50, rel=0.02)

    def test_there_is_one_until_it_is_deleted(self, mixed):
        splats = mixed(_row(), Large_From=OFF)
        box = add_box(splats, bpy.context)
        assert add_box(splats, bpy.context) == box
        bpy.data.objects.remove(box)
        assert _counts(splats) == (0, 20, 0)
        assert add_box(splats, bpy.context).name in bpy.context.scene.objects


class TestCamera:
    def test_near_splats_count_as_larger(self, mixed, ellipsoids):
        camera = bpy.data.objects.new("camera", None)
        camera.location = (-5, 0, 0)
        splats = mixed(_row(), Ellipsoids_at_Most=3, Camera=camera)
        np.testing.assert_allclose(ellipsoids(splats)[:, 0], [0, 10, 20], atol=1e-4)

    def test_a_size_is_that_of_a_splat_in_the_middle(self, mixed, ellipsoids):
        """Seen from 100 mm away, those at a quarter of the middle's distance look four times as large."""
        camera = bpy.data.objects.new("camera", None)
        camera.location = (-5, 0, 0)
        splats = mixed(_row(), Large_From=3.9, Camera=camera)
        np.testing.assert_allclose(ellipsoids(splats)[:, 0], [0, 10, 20], atol=1e-4)


class TestShowAs:
    @pytest.mark.parametrize("display", ["POINTS", "ELLIPSOIDS", "MIXED"])
    def test_it_can_be_asked_for_again_and_again(self, mixed, display):
        splats = mixed(_row())
        show_as(splats, display)
        assert shown_as(splats) == display
        assert len(splats.modifiers) == 1

    def test_automatic_goes_by_the_number_of_splats(self, mixed, monkeypatch):
        splats = mixed(_row())
        show_as(splats, "AUTOMATIC")
        assert shown_as(splats) == "ELLIPSOIDS"
        monkeypatch.setattr("insideout.insideout_addon.scene.memory.AUTOMATIC_ELLIPSOIDS", 19)
        show_as(splats, "AUTOMATIC")
        assert shown_as(splats) == "MIXED"

    def test_the_size_from_which_splats_are_ellipsoids_leaves_as_many_as_told(self, mixed):
        """So that Blender does not have to sort all splats whenever a plane moves."""
        splats = mixed(_row(sizes=np.arange(1.0, 21.0)), Ellipsoids_at_Most=6)
        modifier = show_as(splats, "MIXED")
        assert modifier_input(modifier, "Large From") == 15
        assert _counts(splats)[0] == 6

    def test_what_the_user_has_set_stays(self, mixed):
        splats = mixed(_row(), Large_From=2.5, Ellipsoids_at_Most=7)
        for display in ("POINTS", "MIXED"):
            show_as(splats, display)
        modifier = display_modifier(splats)
        assert (modifier_input(modifier, "Large From"), modifier_input(modifier, "Ellipsoids at Most")) == (2.5, 7)

    def test_without_a_display_there_is_nothing_to_say(self, blender):
        assert shown_as(create_splats(_row(), "model", bpy.context)) == ""
