"""The display shows splats and closes those that a plane cuts: sides, caps, points."""

from __future__ import annotations

import bpy
import numpy as np
import pytest

from insideout.core.gaussians import GaussianSet, Modality
from insideout.insideout_addon.scene.cutting import cut_group
from insideout.insideout_addon.scene.display import display_modifier, show_splats
from insideout.insideout_addon.scene.materials import SOFT_SIZE
from insideout.insideout_addon.scene.node_tree import KIND_KEY, modifier_input, set_modifier_input
from insideout.insideout_addon.scene.splats import create_splats

pytestmark = pytest.mark.builds_groups


@pytest.fixture
def shown(blender):
    """`shown(gaussians, ellipsoids, **inputs)`: the object; with `Cut=True` cut by an empty at the origin as plane."""

    def show(gaussians, ellipsoids=True, plane_z=0.0, Flip=False, Slab=0.0, **inputs):
        splats = create_splats(gaussians, "model", bpy.context)
        if inputs.get("Cut"):
            cut = splats.modifiers.new("cut", "NODES")
            cut.node_group = cut_group()
            plane = bpy.data.objects.new("plane", None)
            plane.location.z = plane_z
            bpy.context.collection.objects.link(plane)
            for name, value in {"Section": plane, "Flip": Flip, "Slab": Slab, "Slot": 0}.items():
                set_modifier_input(cut, name, value)
        modifier = show_splats(splats, ellipsoids)
        for name, value in inputs.items():
            set_modifier_input(modifier, name.replace("_", " "), value)
        return splats

    return show


@pytest.fixture
def whole_places(whole_ellipsoids):
    """`whole_places(splats)`: (n, 3) places of the whole ellipsoids."""
    return lambda splats: whole_ellipsoids(splats)[:, :3, 3]


@pytest.fixture
def cut_mesh(cut_ellipsoids):
    """`cut_mesh(splats)`: vertices (n, 3), volume, faces' (normal z, centre z, area), whether all are closed."""

    def measure(splats):
        form = cut_ellipsoids(splats)
        vertices = np.array([v.co[:] for v in form.verts])
        faces = np.array([(f.normal.z, f.calc_center_median().z, f.calc_area()) for f in form.faces])
        closed = all(edge.is_manifold for edge in form.edges)
        volume = form.calc_volume(signed=False)
        form.free()
        return vertices, volume, faces, closed

    return measure


def _points(splats):
    depsgraph = bpy.context.evaluated_depsgraph_get()
    depsgraph.update()
    geometry = splats.evaluated_get(depsgraph).evaluated_geometry()
    cloud = geometry.pointcloud
    count = len(cloud.points)
    places, radii = np.empty(3 * count, np.float32), np.empty(count, np.float32)
    cloud.attributes["position"].data.foreach_get("vector", places)
    cloud.attributes["radius"].data.foreach_get("value", radii)
    return places.reshape(-1, 3), radii


def _column():
    """Splats of 1 mm at z = -10, -9, ..., 10."""
    means = np.zeros((21, 3))
    means[:, 2] = np.arange(-10, 11)
    return GaussianSet.create(means, 1.0)


def test_every_splat_is_an_ellipsoid(shown, whole_places):
    assert len(whole_places(shown(_column()))) == 21


def test_ellipsoids_are_where_and_as_large_as_the_splats(shown, random_set, whole_ellipsoids):
    matrices = whole_ellipsoids(shown(random_set, Size=1.5))
    assert len(matrices) == len(random_set)
    shape = matrices[:, :3, :3] @ matrices[:, :3, :3].swapaxes(1, 2)
    np.testing.assert_allclose(shape, 1.5**2 * random_set.covariances(), rtol=1e-3, atol=1e-3)


def test_faint_splats_are_not_shown(shown, whole_places):
    faint = GaussianSet.create(np.eye(3) * 5, 1.0, opacities=np.array([0.05, 0.5, 0.9]))
    assert len(whole_places(shown(faint, Minimum_Opacity=0.1))) == 2


def test_xray_splats_in_air_are_not_shown(shown, whole_places):
    means = np.concatenate([np.random.default_rng(0).uniform(-3, 3, (200, 3)), [[40.0, 0, 0]]])
    model = GaussianSet.create(means, 1.0, density=0.01, modality=Modality.XRAY)
    assert len(whole_places(shown(model, Minimum_Density=0.002))) == 200


def test_an_input_of_zero_hides_none(shown, whole_places):
    splats = shown(_column(), Minimum_Opacity=0.0, Minimum_Density=0.0)
    splats.data.attributes["surrounding_density"].data[3].value = -1.0
    splats.data.attributes["radiance:base"].data[4].color = (0, 0, 0, 0)
    splats.data.update_tag()
    assert len(whole_places(splats)) == 21


def test_photo_splats_are_shown_whatever_x_rays_say(shown, whole_places):
    assert len(whole_places(shown(_column(), Minimum_Density=0.5))) == 21


def test_soft_splats_are_larger_and_have_soft_edges(shown):
    splats = shown(GaussianSet.create([[0, 0, -9.0]], 1.0), Soft_in_Viewport=True, Cut=True)
    depsgraph = bpy.context.evaluated_depsgraph_get()
    depsgraph.update()
    (found,) = [
        (i.matrix_world.to_scale()[0], i.object.data.materials[-1].name)
        for i in depsgraph.object_instances
        if i.is_instance and i.parent.original == splats and i.matrix_world.to_scale()[0] > 1.01
    ]
    assert found == (pytest.approx(SOFT_SIZE), "InsideOut Soft Splats")


def test_no_soft_splat_reaches_through_the_plane(shown, whole_places):
    whole = whole_places(shown(_column(), Cut=True, Soft_in_Viewport=True))
    assert whole[:, 2].max() < -SOFT_SIZE


def test_the_plane_hides_its_upper_side(shown, whole_places, cut_mesh):
    splats = shown(_column(), Cut=True, Size=1.5)
    whole = whole_places(splats)
    vertices, *_ = cut_mesh(splats)
    # Reaching 1.5 mm, those at -10 ... -2 are whole; -1, 0 and 1 are cut; the rest is gone.
    np.testing.assert_allclose(sorted(whole[:, 2]), np.arange(-10, -1), atol=1e-5)
    assert vertices[:, 2].max() == pytest.approx(0, abs=1e-5)
    assert vertices[:, 2].min() == pytest.approx(-2.5, abs=1e-3)


def test_flip_hides_the_other_side(shown, whole_places, cut_mesh):
    splats = shown(_column(), Cut=True, Flip=True, Size=1.5)
    np.testing.assert_allclose(sorted(whole_places(splats)[:, 2]), np.arange(2, 11), atol=1e-5)
    assert cut_mesh(splats)[0][:, 2].min() == pytest.approx(0, abs=1e-5)


def test_a_slab_hides_what_is_deeper_and_is_closed_there(shown, whole_places, cut_mesh):
    splats = shown(_column(), Cut=True, Slab=5.0, Size=1.5)
    np.testing.assert_allclose(sorted(whole_places(splats)[:, 2]), [-3, -2], atol=1e-5)
    assert cut_mesh(splats)[0][:, 2].min() == pytest.approx(-5, abs=1e-5)


def test_the_plane_may_be_moved_and_the_model_too(shown, whole_places):
    splats = shown(_column(), Cut=True, plane_z=4.0, Size=1.5)
    splats.location.z = 3.0
    whole = whole_places(splats)
    # In the model's frame the plane is at 1 mm.
    np.testing.assert_allclose(sorted(whole[:, 2]), np.arange(-10, 0), atol=1e-5)


@pytest.mark.parametrize("offset", [-0.8, 0.0, 0.8])
def test_a_cut_ellipsoid_is_a_closed_solid_with_a_flat_cap(shown, offset, cut_mesh):
    """Cap and volume against the exact ellipse and the exact part of the ellipsoid."""
    scales = np.array([2.0, 3.0, 1.0])
    splats = shown(GaussianSet.create([[0, 0, offset]], scales[None]), Cut=True, Size=2.0, Detail=5)
    _, volume, faces, closed = cut_mesh(splats)
    half = 2.0 * scales
    level = -offset / half[2]
    cap = faces[(faces[:, 0] > 0.999) & (np.abs(faces[:, 1]) < 1e-4)]
    exact_cap = np.pi * half[0] * half[1] * (1 - level**2)
    exact_volume = np.pi * np.prod(half) * (2 / 3 + level - level**3 / 3)
    assert closed
    assert cap[:, 2].sum() == pytest.approx(exact_cap, rel=0.04)
    assert volume == pytest.approx(exact_volume, rel=0.03)


def test_a_slanted_ellipsoid_stays_inside_itself(shown, cut_mesh):
    quat = np.array([[np.cos(0.4), np.sin(0.4), 0, 0]])
    slanted = GaussianSet.create([[0, 0, 0.5]], [[1.0, 1.0, 4.0]], quats=quat)
    vertices, _, _, closed = cut_mesh(shown(slanted, Cut=True, Size=1.0))
    apart = vertices - [0, 0, 0.5]
    inside = np.einsum("ni,ij,nj->n", apart, np.linalg.inv(slanted.covariances()[0]), apart)
    assert closed
    # Globes that splats share: 2.6 % of a half axis, less than what their twelve flat sides take of it.
    assert inside.max() <= 1.026**2
    assert vertices[:, 2].max() <= 1e-5


@pytest.mark.parametrize(("detail", "off"), [(1, 0.0524), (2, 0.0262), (3, 0.0131), (5, 0.0131)])
@pytest.mark.parametrize("height", [-1.99, -1.2, -0.31, 0.0, 0.47, 1.3, 1.98])
def test_the_rim_of_a_cap_is_where_plane_and_ellipsoid_meet(shown, height, cut_mesh, detail, off):
    """Above the middle to a part of the half axes, the smaller the finer, exactly below; every vertex as near."""
    ball = GaussianSet.create([[0.0, 0, -height]], 1.0)
    vertices = cut_mesh(shown(ball, Cut=True, Size=2.0, Detail=detail, Soft=False))[0]
    rim = vertices[vertices[:, 2] > -1e-4]
    radius = np.linalg.norm(rim[:, :2], axis=1).max()
    assert radius == pytest.approx(np.sqrt(4 - height**2), abs=1e-4 if height < 0 else 2 * off)
    side = vertices[vertices[:, 2] < -1e-4] - ball.means[0]
    away = np.linalg.norm(side, axis=1)
    np.testing.assert_allclose(away, 2, atol=2 * off)
    assert np.abs(vertices[:, 2]).min() < 1e-5
    assert vertices[:, 2].max() < 1e-5


def test_splats_that_a_modifier_made_vertices_are_closed_too(shown, cut_mesh):
    splats = shown(GaussianSet.create([[0.0, 0, 0]], 1.0), Cut=True, Size=2.0, Detail=5, Soft=False)
    tree = bpy.data.node_groups.new("as vertices", "GeometryNodeTree")
    for direction in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=direction, socket_type="NodeSocketGeometry")
    kinds = ("NodeGroupInput", "GeometryNodePointsToVertices", "NodeGroupOutput")
    given, vertices, made = (tree.nodes.new(kind) for kind in kinds)
    for first, second in ((given, vertices), (vertices, made)):
        tree.links.new(first.outputs[0], second.inputs[0])
    splats.modifiers.new("as vertices", "NODES").node_group = tree
    splats.modifiers.move(len(splats.modifiers) - 1, 0)
    _, volume, _, closed = cut_mesh(splats)
    assert closed
    assert volume == pytest.approx(2 / 3 * np.pi * 8, rel=0.03)


def test_a_cut_makes_no_geometry_for_each_splat(shown):
    """A million of them would take gigabytes."""
    splats = shown(GaussianSet.create(np.zeros((50, 3)), 1.0), Cut=True)
    evaluated = splats.evaluated_get(bpy.context.evaluated_depsgraph_get()).evaluated_geometry()
    assert evaluated.mesh is None
    assert len(evaluated.instances_pointcloud().points) == 50


def test_points_on_the_hidden_side_are_gone_and_none_pokes_through(shown):
    places, radii = _points(shown(_column(), ellipsoids=False, Cut=True, Size=1.5))
    np.testing.assert_allclose(sorted(places[:, 2]), np.arange(-10, 1), atol=1e-5)
    assert (places[:, 2] + radii).max() <= 1e-5
    assert radii.max() == pytest.approx(1.5)


def test_showing_again_changes_the_modifier_there_is(shown):
    splats = shown(_column())
    show_splats(splats, False)
    assert len(splats.modifiers) == 1
    assert modifier_input(display_modifier(splats), "Ellipsoids") is False


def test_a_display_is_known_whatever_its_node_group_is_called(shown):
    splats = shown(_column())
    display = display_modifier(splats)
    display.node_group.name = "My look"
    assert display_modifier(splats) == display
    show_splats(splats, False)
    assert len(splats.modifiers) == 1


def test_of_files_of_before_the_name_of_the_node_group_tells(shown):
    splats = shown(_column())
    display = display_modifier(splats)
    del display.node_group[KIND_KEY]
    assert display_modifier(splats) == display
    display.node_group.name = "Crop"
    assert display_modifier(splats) is None
