"""Splats that follow a cage: what nodes show, what sections and exports read, and that both are the same."""

from __future__ import annotations

import dataclasses

import bpy
import numpy as np
import pytest

from insideout.core.errors import SettingError
from insideout.core.gaussians import GaussianSet, Modality
from insideout.core.render.section_numpy import section_density
from insideout.core.rotations import quats_to_matrices
from insideout.core.spherical_harmonics import rotate_sh
from insideout.core.steps import run_through
from insideout.insideout_addon.measure.probe_result import kept_probe
from insideout.insideout_addon.scene import following
from insideout.insideout_addon.scene.exporting import edited_in_steps, edited_splats
from insideout.insideout_addon.scene.following import as_shown, bending_of, bent, follow, following_modifier, stay
from insideout.insideout_addon.scene.following_nodes import CORNERS
from insideout.insideout_addon.scene.placement import apply_transform
from insideout.insideout_addon.scene.section import place_plane, sample_section
from insideout.insideout_addon.scene.splats import create_splats, read_density, read_splats

SIDES = np.array([10.0, 8.0, 12.0])
# Eight boxes around the origin.
GRID = np.array([[x, y, z] for z in (-1, 0, 1) for y in (-1, 0, 1) for x in (-1, 0, 1)])
TURN = quats_to_matrices(np.array([[0.8, 0.36, 0.48, 0.0]]))[0]
BENT = {
    "turned": lambda v: v @ TURN.T + [3, 4, 5],
    "stretched and sheared": lambda v: v @ np.array([[1.4, 0.5, 0.0], [0.0, 0.7, 0.2], [0.3, 0.0, 1.1]]).T,
    "bent": lambda v: v + np.stack([0.02 * v[:, 2] ** 2, 0.01 * v[:, 0] * v[:, 1], 0.1 * v[:, 0]], axis=1),
    "in disorder": lambda v: v + np.random.default_rng(4).normal(0, 3, v.shape),
    "inside out": lambda v: v * [1, -1, 1],
    "flat": lambda v: v * [1, 1, 0],
    "a line": lambda v: v * [1, 0, 0] + 1e-3 * v,
    "partly not a number": lambda v: np.where(v[:, :1] > 5, np.nan, v),
    "torn apart": lambda v: 1e7 * v,
}


@pytest.fixture
def soft(blender):
    """`(splats, gaussians, cage, places)`: 300 splats in eight boxes, and some around them that stay."""
    rng = np.random.default_rng(0)
    means = np.concatenate([rng.uniform(-1.2, 1.2, (300, 3)) * SIDES, rng.uniform(40, 60, (20, 3))])
    gaussians = GaussianSet.create(
        means,
        rng.uniform(0.2, 1.5, (320, 3)),
        quats=rng.normal(size=(320, 4)),
        sh=rng.normal(0, 0.3, (320, 4, 3)),
        density=rng.uniform(0.01, 0.05, 320),
        modality=Modality.XRAY,
    )
    splats = create_splats(gaussians, "model", bpy.context)
    bpy.context.scene.insideout.model = splats
    mesh = bpy.data.meshes.new("cage")
    mesh.from_pydata((GRID * SIDES).tolist(), [(0, 1)], [])
    numbers = np.zeros((27, 8), np.int32)
    for k in range(8):
        numbers[:, k] = np.arange(27) + (k & 1) + 3 * (k >> 1 & 1) + 9 * (k >> 2)
    for k, name in enumerate(CORNERS, 1):
        mesh.attributes.new(name, "INT", "POINT").data.foreach_set("value", np.minimum(numbers[:, k], 26))
    cage = bpy.data.objects.new("cage", mesh)
    bpy.context.scene.collection.objects.link(cage)
    box = np.clip(np.floor(means / SIDES) + 1, 0, 1).astype(int)
    cells = np.where(np.arange(320) < 300, box @ [1, 3, 9], -1)
    follow(splats, cage, cells, means / SIDES + 1 - box, SIDES)
    return splats, gaussians, cage


def bend(cage, change):
    cage.data.vertices.foreach_set("co", np.ascontiguousarray(change(GRID * SIDES), np.float32).ravel())
    cage.data.update()
    bpy.context.view_layer.update()


def shown(splats):
    """What the nodes make of the splats."""
    return read_splats(splats.evaluated_get(bpy.context.evaluated_depsgraph_get()))


def same(found, expected, digits=2e-5):
    """Asserts that two sets are the same splats."""
    spread = np.linalg.norm(expected.covariances(), axis=(1, 2))
    np.testing.assert_allclose(found.means, expected.means, atol=1e-4 + 1e-6 * np.abs(expected.means).max())
    assert (np.linalg.norm(found.covariances() - expected.covariances(), axis=(1, 2)) < digits * spread).all()
    np.testing.assert_allclose(found.density, expected.density, rtol=digits)


def test_at_rest_nothing_is_different(soft):
    splats, gaussians, _ = soft
    same(shown(splats), gaussians, 1e-5)
    same(as_shown(splats, gaussians), gaussians, 1e-5)


@pytest.mark.parametrize("name", BENT)
def test_nodes_show_what_is_read(soft, name):
    """Nodes of single precision and numpy of double, by different algorithms."""
    splats, gaussians, cage = soft
    bend(cage, BENT[name])
    found, expected = shown(splats), as_shown(splats, gaussians)
    for field in ("means", "quats", "scales", "density"):
        assert np.isfinite(getattr(found, field)).all(), field
    assert (found.scales > 0).all()
    np.testing.assert_allclose(found.integrals(), gaussians.integrals(), rtol=5e-6)
    same(found, expected)


def test_an_affine_bend_is_the_affine_map(soft):
    splats, gaussians, cage = soft
    linear = np.array([[1.4, 0.5, 0.0], [0.0, 0.7, 0.2], [0.3, 0.0, 1.1]])
    bend(cage, lambda v: v @ linear.T + [1, 2, 3])
    found = shown(splats).select(slice(0, 300))
    before = gaussians.select(slice(0, 300))
    np.testing.assert_allclose(found.means, before.means @ linear.T + [1, 2, 3], atol=1e-4)
    np.testing.assert_allclose(found.covariances(), linear @ before.covariances() @ linear.T, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(found.density, before.density / np.linalg.det(linear), rtol=1e-5)


def test_what_has_no_box_stays(soft):
    splats, gaussians, cage = soft
    bend(cage, BENT["turned"])
    np.testing.assert_array_equal(shown(splats).means[300:], gaussians.means[300:])
    np.testing.assert_array_equal(shown(splats).quats[300:], gaussians.quats[300:])


def test_the_map_is_continuous_across_a_face(soft):
    vertices = BENT["in disorder"](GRID * SIDES)
    left, right = (np.array([[0, 1, 3, 4, 9, 10, 12, 13]]) + step for step in (0, 1))
    points, _ = bent(vertices[left], np.array([[1.0, 0.3, 0.6]]), SIDES)
    again, _ = bent(vertices[right], np.array([[0.0, 0.3, 0.6]]), SIDES)
    np.testing.assert_allclose(points, again)


def test_cage_and_model_may_stand_anywhere(soft):
    splats, gaussians, cage = soft
    splats.location, splats.rotation_euler, splats.scale = (5, 6, 7), (0.3, 0.2, 0.1), (2, 2, 2)
    cage.location = (1, 2, 3)
    bend(cage, BENT["bent"])
    found = shown(splats)
    same(found, as_shown(splats, gaussians))
    world = found.means[:300] @ np.array(splats.matrix_world)[:3, :3].T + np.array(splats.matrix_world)[:3, 3]
    boxes = BENT["bent"](GRID * SIDES) + np.array([1, 2, 3])
    assert (world > boxes.min(axis=0) - SIDES).all()
    assert (world < boxes.max(axis=0) + SIDES).all()


def test_without_its_cage_the_model_is_as_before(soft):
    splats, gaussians, cage = soft
    bend(cage, BENT["bent"])
    bpy.data.objects.remove(cage)
    bpy.context.view_layer.update()
    np.testing.assert_array_equal(shown(splats).means, gaussians.means)
    assert as_shown(splats, gaussians) is gaussians


def test_let_go_it_has_nothing_left_of_it(soft):
    splats, gaussians, cage = soft
    bend(cage, BENT["bent"])
    stay(splats)
    assert following_modifier(splats) is None
    assert not [a.name for a in splats.data.attributes if a.name.startswith("cage")]
    np.testing.assert_array_equal(shown(splats).means, gaussians.means)


def test_deleted_points_take_their_places_along(soft):
    """Geometry nodes that delete some; the others still know where they are."""
    splats, _, cage = soft
    bend(cage, BENT["bent"])
    tree = bpy.data.node_groups.new("Deleting", "GeometryNodeTree")
    for way in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
    index, less = tree.nodes.new("GeometryNodeInputIndex"), tree.nodes.new("FunctionNodeCompare")
    delete = tree.nodes.new("GeometryNodeDeleteGeometry")
    less.data_type, less.operation = "INT", "LESS_THAN"
    tree.links.new(index.outputs[0], next(s for s in less.inputs if s.enabled and s.name == "A"))
    next(s for s in less.inputs if s.enabled and s.name == "B").default_value = 100
    tree.links.new(less.outputs[0], delete.inputs["Selection"])
    tree.links.new(tree.nodes.new("NodeGroupInput").outputs[0], delete.inputs["Geometry"])
    tree.links.new(delete.outputs[0], tree.nodes.new("NodeGroupOutput").inputs[0])
    splats.modifiers.new("Deleting", "NODES").node_group = tree
    found = edited_splats(splats, bpy.context)
    assert len(found) == 220
    same(found, as_shown(splats, read_splats(splats)).select(slice(100, None)))


@pytest.mark.parametrize("visible_only", [False, True])
def test_an_export_is_bent_and_its_colours_turn(soft, visible_only):
    splats, gaussians, cage = soft
    bend(cage, BENT["turned"])
    found = edited_splats(splats, bpy.context, visible_only=visible_only)
    same(found, as_shown(splats, gaussians))
    np.testing.assert_allclose(found.sh[:300], rotate_sh(gaussians.sh[:300], TURN), atol=1e-4)
    np.testing.assert_allclose(found.sh[300:], gaussians.sh[300:], atol=1e-4)


@pytest.mark.parametrize("visible_only", [False, True])
def test_an_export_of_a_crushed_body_has_colours(soft, visible_only):
    splats, gaussians, cage = soft
    bend(cage, BENT["partly not a number"])
    found = edited_splats(splats, bpy.context, visible_only=visible_only)
    same(found, as_shown(splats, gaussians))
    assert np.isfinite(found.sh).all()


@pytest.mark.parametrize("by_nodes", [False, True])
def test_an_export_has_the_cage_of_when_it_began(soft, by_nodes, monkeypatch):
    """While it works a script, or a playing animation, may bend the cage further."""
    monkeypatch.setattr(following, "_AT_ONCE", 50)
    splats, _gaussians, cage = soft
    bend(cage, BENT["turned"])
    wanted = edited_splats(splats, bpy.context, visible_only=by_nodes)
    steps = edited_in_steps(splats, bpy.context, visible_only=by_nodes)
    next(steps)
    bend(cage, BENT["bent"])
    assert np.abs(edited_splats(splats, bpy.context).means - wanted.means).max() > 1
    found = run_through(steps)
    for field in ("means", "quats", "scales", "sh", "density"):
        np.testing.assert_array_equal(getattr(found, field), getattr(wanted, field))


def test_bending_in_steps_is_the_bending_at_once(soft, monkeypatch):
    splats, gaussians, cage = soft
    bend(cage, BENT["in disorder"])
    wanted = as_shown(splats, gaussians)
    monkeypatch.setattr(following, "_AT_ONCE", 50)
    shares = []
    found = run_through(bending_of(splats).in_steps(gaussians), shares.append)
    assert len(shares) == 7
    assert shares == sorted(shares)
    for field in ("means", "quats", "scales", "sh", "density", "opacities", "modality"):
        np.testing.assert_array_equal(getattr(found, field), getattr(wanted, field))


def test_a_section_shows_the_bent_body(soft):
    """Pressed to half its height, it is twice as dense in half of the room."""
    _splats, _, cage = soft
    bpy.ops.insideout.section_add()
    place_plane(bpy.context.scene, (0, 0, 0))
    bpy.context.view_layer.update()
    before, view = sample_section(bpy.context.scene, 64)
    bend(cage, lambda v: v * [1, 1, 0.5])
    bpy.context.scene.frame_set(2)
    after, _ = sample_section(bpy.context.scene, 64)
    rows = np.abs(view.origin[2] + np.arange(64) * view.v[2])
    assert before[rows > 8].sum() > 5 * after[rows > 8].sum()
    assert after.sum() == pytest.approx(before.sum(), rel=0.15)


def test_a_probe_is_told_as_long_as_the_body_bends_as_it_did(soft):
    splats, _, cage = soft
    scene = bpy.context.scene
    bpy.ops.insideout.probe(point=(0, 0, 0))
    found = kept_probe(scene, splats)
    assert found is not None
    cage.location.x += 15
    bpy.context.view_layer.update()
    assert kept_probe(scene, splats) is None
    bpy.ops.insideout.probe(point=(0, 0, 0))
    bent = kept_probe(scene, splats)
    assert bent.density != found.density
    stay(splats)
    bpy.context.view_layer.update()
    assert kept_probe(scene, splats) is None


@pytest.mark.parametrize("moved", ["the model", "its cage", "a vertex of its cage"])
def test_a_section_is_of_the_body_where_it_is_moved_by_hand(soft, moved):
    """The plane stays, and so does the cage where the model alone is moved in it."""
    splats, _, cage = soft
    bpy.ops.insideout.section_add()
    place_plane(bpy.context.scene, (0, 0, 0))
    before, _ = sample_section(bpy.context.scene, 32)
    if moved == "a vertex of its cage":
        bend(cage, lambda v: v + np.where((v == 0).all(axis=1)[:, None], [8, 0, 0], 0))
    else:
        (splats if moved == "the model" else cage).location.x += 8
    bpy.context.view_layer.update()
    found, view = sample_section(bpy.context.scene, 32)
    expected = section_density(as_shown(splats, read_density(splats)), view)
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert (np.abs(found - before).max() > 1e-3) == (moved != "the model")


def test_a_transform_cannot_be_applied_to_it(soft):
    splats, gaussians, _ = soft
    splats.scale = (2, 2, 2)
    with pytest.raises(SettingError, match="is a soft body, whose cage holds its splats; press Back to Whole first"):
        apply_transform(splats)
    np.testing.assert_array_equal(read_splats(splats).means, gaussians.means)


def test_round_splats_keep_their_axes_at_rest(blender, soft):
    splats, gaussians, _cage = soft
    round_ones = dataclasses.replace(gaussians, scales=np.full_like(gaussians.scales, 0.7))
    found = as_shown(splats, round_ones)
    np.testing.assert_allclose(np.abs((found.quats * gaussians.quats).sum(axis=1)), 1.0, atol=1e-5)
