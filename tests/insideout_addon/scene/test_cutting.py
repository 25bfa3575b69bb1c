"""Several planes and boxes cut one model: halves, quarters, corners, notches, parts pulled apart."""

from __future__ import annotations

import bmesh
import bpy
import numpy as np
import pytest
from mathutils import Euler, Vector

from insideout.core.gaussians import GaussianSet
from insideout.insideout_addon.scene.cut_slots import HEIGHTS, NORMALS, SLOTS
from insideout.insideout_addon.scene.cutting import cut_group
from insideout.insideout_addon.scene.display import show_splats
from insideout.insideout_addon.scene.node_tree import set_modifier_input
from insideout.insideout_addon.scene.splats import create_splats

BALL = GaussianSet.create([[0.0, 0, 0]], 1.0)
X, Y, Z = (0, np.pi / 2, 0), (-np.pi / 2, 0, 0), (0, 0, 0)
"""Turns that point an object's z, the hidden side of a plane, along an axis."""


@pytest.fixture
def model(blender):
    """`model(gaussians, *cuts)`: splats shown as ellipsoids of 2 sigma; a cut is (place, turn, inputs)."""

    def make(gaussians, *cuts, ellipsoids=True):
        splats = create_splats(gaussians, "model", bpy.context)
        for slot, (place, turn, inputs) in enumerate(cuts):
            section = bpy.data.objects.new("section", None)
            section.location, section.rotation_euler = place, turn
            section.scale = inputs.pop("size", (1, 1, 1))
            bpy.context.collection.objects.link(section)
            modifier = splats.modifiers.new("cut", "NODES")
            modifier.node_group = cut_group()
            for name, value in {"Slot": slot, **inputs, "Section": section}.items():
                set_modifier_input(modifier, name, value)
        display = show_splats(splats, ellipsoids)
        for name, value in (("Size", 2.0), ("Detail", 4), ("Soft", False), ("Cut", bool(cuts))):
            set_modifier_input(display, name, value)
        return splats

    return make


def _evaluated(splats):
    depsgraph = bpy.context.evaluated_depsgraph_get()
    depsgraph.update()
    return splats.evaluated_get(depsgraph).evaluated_geometry()


@pytest.fixture
def parts_of(cut_ellipsoids):
    """`parts_of(splats)`: closed meshes of the cut ellipsoids, vertices (n, 3) and volume each."""
    return lambda splats: _parts(cut_ellipsoids(splats))


def _parts(form):
    assert all(edge.is_manifold for edge in form.edges)
    left, found = set(form.verts), []
    while left:
        part, todo = set(), [left.pop()]
        while todo:
            vertex = todo.pop()
            part.add(vertex)
            around = {edge.other_vert(vertex) for edge in vertex.link_edges} - part
            todo.extend(around)
            left -= around
        part_form = bmesh.new()
        kept = {vertex: part_form.verts.new(vertex.co) for vertex in part}
        for face in {face for vertex in part for face in vertex.link_faces}:
            part_form.faces.new([kept[vertex] for vertex in face.verts])
        found.append((np.array([v.co[:] for v in part_form.verts]), part_form.calc_volume(signed=False)))
        part_form.free()
    form.free()
    return found


def _points(splats, name, width=1):
    """A named attribute of the points, (n, width)."""
    geometry = _evaluated(splats)
    data = geometry.pointcloud.attributes[name].data
    values = np.empty(len(data) * width, np.float32)
    data.foreach_get("vector" if width == 3 else "value", values)
    return values.reshape(-1, width)


@pytest.fixture
def whole(whole_ellipsoids):
    """`whole(splats)`: places of the whole ellipsoids."""
    return lambda splats: sorted(tuple(place) for place in np.round(whole_ellipsoids(splats)[:, :3, 3], 4).tolist())


FULL = 4 / 3 * np.pi * 2**3


def test_two_planes_leave_a_quarter_of_a_ball(model, parts_of):
    ((vertices, volume),) = parts_of(model(BALL, ((0, 0, 0), X, {}), ((0, 0, 0), Z, {})))
    assert vertices[:, 0].max() == pytest.approx(0, abs=1e-5)
    assert vertices[:, 2].max() == pytest.approx(0, abs=1e-5)
    assert volume == pytest.approx(FULL / 4, rel=0.04)


def test_the_edge_of_two_planes_may_lie_off_the_middle(model, parts_of):
    """x <= 1 and z <= -1 of a ball of radius 2."""
    ((vertices, volume),) = parts_of(model(BALL, ((1, 0, 0), X, {}), ((0, 0, -1), Z, {})))
    rng = np.random.default_rng(0)
    sample = rng.uniform(-2, 2, (400_000, 3))
    inside = (np.linalg.norm(sample, axis=1) < 2) & (sample[:, 0] < 1) & (sample[:, 2] < -1)
    assert volume == pytest.approx(64 * inside.mean(), rel=0.05)
    assert vertices[:, 0].max() <= 1 + 1e-5
    assert vertices[:, 2].max() <= -1 + 1e-5


def test_a_turned_ellipsoid_at_an_edge_stays_inside_itself_and_both_planes(model, parts_of):
    quats = np.array([[0.8, 0.3, -0.4, 0.2]])
    slanted = GaussianSet.create([[0.3, 0, -0.2]], [[0.5, 1.0, 2.0]], quats=quats)
    ((vertices, volume),) = parts_of(model(slanted, ((0, 0, 0), X, {}), ((0, 0, 0), Y, {})))
    apart = vertices - slanted.means[0]
    inside = np.einsum("ni,ij,nj->n", apart, np.linalg.inv(slanted.covariances()[0]), apart)
    assert inside.max() <= 4 + 1e-3
    assert vertices[:, :2].max() <= 1e-5
    assert volume > 0


def test_planes_that_leave_nothing_of_a_ball_leave_nothing(model, parts_of):
    """x <= -1.5 and z <= -1.5 reach into a ball of radius 2 each, but not together."""
    assert parts_of(model(BALL, ((-1.5, 0, 0), X, {}), ((0, 0, -1.5), Z, {}))) == []


def test_a_box_crops(model, parts_of):
    crop = {"Box": True, "size": (3, 3, 3)}
    ((vertices, volume),) = parts_of(model(BALL, ((3, 3, 3), Z, crop)))
    assert vertices.min() >= -1e-5
    assert volume == pytest.approx(FULL / 8, rel=0.05)


def test_a_box_may_be_turned(model):
    grid = np.stack(np.meshgrid(*[np.arange(-6, 7, 3.0)] * 3), axis=-1).reshape(-1, 3)
    tiny = GaussianSet.create(grid, 0.01)
    cut = model(tiny, ((0, 0, 0), (0, 0, np.pi / 4), {"Box": True, "size": (4, 4, 4)}), ellipsoids=False)
    turned = grid @ np.array([[1, -1, 0], [1, 1, 0], [0, 0, np.sqrt(2)]]) / np.sqrt(2)
    assert len(_points(cut, "position", 3)) == (np.abs(turned) < 4).all(axis=1).sum()


def test_a_box_takes_a_corner_out(model, parts_of):
    """Of a ball whose middle is the box's corner three overlapping halves are left, none in the box."""
    notch = {"Box": True, "Flip": True, "size": (3, 3, 3)}
    parts = parts_of(model(BALL, ((3, 3, 3), Z, notch)))
    assert len(parts) == 3
    for vertices, volume in parts:
        assert volume == pytest.approx(FULL / 2, rel=0.04)
        assert vertices.min(axis=1).max() <= 1e-5


def test_beside_a_notch_splats_are_whole_and_single_and_in_it_none(model, whole):
    means = np.array([[-9.0, 0, 0], [-9, -9, -9], [9, 9, 9], [3, -9, 3], [5, 5, 5]])
    notch = {"Box": True, "Flip": True, "size": (6, 6, 6)}
    assert whole(model(GaussianSet.create(means, 0.6), ((6, 6, 6), Z, notch))) == [
        (-9.0, -9.0, -9.0),
        (-9.0, 0.0, 0.0),
        (3.0, -9.0, 3.0),
    ]


def test_halves_are_pulled_apart(model, parts_of):
    parts = parts_of(model(BALL, ((0, 0, 0.5), Z, {"Apart": 6.0})))
    (low, _), (high, _) = sorted(parts, key=lambda part: part[0][:, 2].mean())
    assert low[:, 2].max() == pytest.approx(0.5 - 3, abs=1e-4)
    assert high[:, 2].min() == pytest.approx(0.5 + 3, abs=1e-4)
    assert sum(volume for _, volume in parts) == pytest.approx(FULL, rel=0.02)


def test_halves_that_were_pulled_apart_can_be_cut_again(model, parts_of):
    """Into quarters, and the first cut stays closed."""
    parts = parts_of(model(BALL, ((0, 0, 0), Z, {"Apart": 6.0}), ((0, 0, 0), X, {})))
    assert len(parts) == 2
    for vertices, volume in parts:
        assert vertices[:, 0].max() == pytest.approx(0, abs=1e-5)
        assert np.abs(vertices[:, 2]).min() == pytest.approx(3, abs=1e-4)
        assert volume == pytest.approx(FULL / 4, rel=0.05)


@pytest.mark.parametrize("first", [True, False])
def test_a_second_plane_cuts_the_model_as_it_was_before_it_was_pulled_apart(model, parts_of, first):
    """Whichever comes first: a slanted cut goes on in the other half, and is moved with it."""
    apart, slanted = ((0, 0, 0), Z, {"Apart": 6.0}), ((0.2, 0, 0), (0, np.pi / 4, 0), {})
    cuts = [apart, slanted] if first else [slanted, apart]
    splats = model(BALL, *[(place, turn, dict(inputs)) for place, turn, inputs in cuts])
    normal = np.array([1, 0, 1]) / np.sqrt(2)
    low, high = sorted((vertices for vertices, _ in parts_of(splats)), key=lambda vertices: vertices[:, 2].mean())
    for vertices, step in ((low, -3), (high, 3)):
        assert ((vertices - [0.2, 0, step]) @ normal).max() == pytest.approx(0, abs=1e-5)
    assert low[:, 2].max() == pytest.approx(-3, abs=1e-4)
    assert high[:, 2].min() == pytest.approx(3, abs=1e-4)


def test_two_planes_pull_quarters_apart(model, parts_of):
    parts = parts_of(model(BALL, ((0, 0, 0), Z, {"Apart": 6.0}), ((0, 0, 0), X, {"Apart": 2.0})))
    middles = sorted(tuple(np.sign(vertices.mean(axis=0)[[0, 2]])) for vertices, _ in parts)
    assert middles == [(-1, -1), (-1, 1), (1, -1), (1, 1)]
    for vertices, volume in parts:
        assert np.abs(vertices[:, 0]).min() == pytest.approx(1, abs=1e-3)
        assert np.abs(vertices[:, 2]).min() == pytest.approx(3, abs=1e-3)
        assert volume == pytest.approx(FULL / 4, rel=0.05)


def test_a_slab_is_closed_on_both_sides(model, parts_of):
    ((vertices, volume),) = parts_of(model(BALL, ((0, 0, 0.5), Z, {"Slab": 1.0})))
    assert vertices[:, 2].max() == pytest.approx(0.5, abs=1e-5)
    assert vertices[:, 2].min() == pytest.approx(-0.5, abs=1e-5)
    assert volume == pytest.approx(np.pi * (4 - 0.25 / 3), rel=0.05)


def test_without_a_slot_splats_are_hidden_whole(model, whole):
    means = np.array([[0.0, 0, -0.5], [0, 0, 0.5]])
    splats = model(GaussianSet.create(means, 1.0), ((0, 0, 0), Z, {"Slot": -1}))
    assert whole(splats) == [(0.0, 0.0, -0.5)]


@pytest.mark.parametrize("ellipsoids", [True, False])
def test_whole_splats_at_the_edges_of_a_box_are_shown_once(model, whole, ellipsoids):
    """Without a slot, and as points in any: beyond one face, two, three, and in the box."""
    means = np.array([[-0.1, 3, 3], [-0.1, -0.2, 3], [-0.1, -0.2, -0.3], [0.1, 3, 3]])
    notch = {"Box": True, "Flip": True, "size": (6, 6, 6), "Slot": -1 if ellipsoids else 0}
    splats = model(GaussianSet.create(means, 1.0), ((6, 6, 6), Z, notch), ellipsoids=ellipsoids)
    shown = whole(splats) if ellipsoids else _points(splats, "position", 3)
    np.testing.assert_allclose(sorted(map(tuple, shown)), sorted(map(tuple, means[:3])), atol=1e-4)


def test_planes_are_noted_on_the_splats_in_mm(model):
    splats = model(BALL, ((0, 0, 0.7), Z, {"Slot": 2}), ellipsoids=False)
    np.testing.assert_allclose(_points(splats, NORMALS[2], 3), [[0, 0, 1]], atol=1e-6)
    assert _points(splats, HEIGHTS[2]) == pytest.approx(0.7)
    assert len(NORMALS) == len(HEIGHTS) == SLOTS


def test_points_shrink_at_all_planes(model):
    """A ball of 2 mm, 0.5 mm under one plane and 0.3 mm beside another."""
    splats = model(BALL, ((0, 0, 0.5), Z, {}), ((0.3, 0, 0), X, {}), ellipsoids=False)
    assert _points(splats, "radius") == pytest.approx(0.3)


@pytest.fixture
def in_section(parts_of):
    """`in_section(splats)`: the vertices of what is left in the frame of the plane or box."""

    def vertices_of(splats):
        bpy.context.view_layer.update()
        ((vertices, _),) = parts_of(splats)
        place = np.array(bpy.data.objects["section"].matrix_world.inverted() @ splats.matrix_world)
        return vertices @ place[:3, :3].T + place[:3, 3]

    return vertices_of


@pytest.mark.parametrize("scale", [(0.001, 0.001, 0.001), (2, 1, 1), (1, 1, -1), (-1, 0.5, 2)])
def test_the_cut_face_lies_on_the_plane_however_the_model_is_scaled(model, scale, in_section):
    splats = model(BALL, ((0, 0, 0), (0.3, 0.8, 0.1), {}))
    splats.scale = scale
    heights = in_section(splats)[:, 2]
    assert heights.max() == pytest.approx(0, abs=1e-5 * max(scale))
    assert heights.min() < -1.5 * min(map(abs, scale))


@pytest.mark.parametrize("scale", [(3, 3, 3), (1, 1, -1), (-1, 1, 1)])
def test_a_plane_hides_the_side_that_its_z_points_to_however_it_is_scaled(model, scale, in_section):
    heights = in_section(model(BALL, ((0, 0, 0), (0.3, 0.8, 0.1), {"size": scale})))[:, 2]
    assert heights.max() == pytest.approx(0, abs=1e-5)
    assert heights.min() < -0.6


@pytest.mark.parametrize("scale", [(0.001, 0.001, 0.001), (2, 1, 1), (-1, 0.5, 2)])
def test_a_turned_box_crops_a_scaled_model_at_its_own_faces(model, scale, in_section):
    """A corner of the box is in the middle of the ball."""
    turn, size = Euler((0.3, 0.8, 0.1)), 5 * max(map(abs, scale))
    corner = turn.to_matrix() @ Vector((size, size, size))
    splats = model(BALL, (corner, turn, {"Box": True, "size": [size] * 3}))
    splats.scale = scale
    vertices = in_section(splats)
    np.testing.assert_allclose(vertices.min(axis=0), -1, atol=1e-5)
    assert (vertices.max(axis=0) > -0.95).all()
