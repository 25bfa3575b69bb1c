"""The display shows splats and closes those that a plane cuts: sides, caps, points."""

from __future__ import annotations

import bmesh
import bpy
import numpy as np
import pytest

from insideout.core.gaussians import GaussianSet, Modality
from insideout.insideout_addon.scene.cutting import cut_group
from insideout.insideout_addon.scene.display import display_modifier, show_splats
from insideout.insideout_addon.scene.materials import SOFT_SIZE
from insideout.insideout_addon.scene.node_tree import modifier_input, set_modifier_input
from insideout.insideout_addon.scene.splats import create_splats


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


def _instances(splats):
    """Places of the whole ellipsoids."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    depsgraph.update()
    found = [
        i.matrix_world.translation[:]
        for i in depsgraph.object_instances
        if i.is_instance
        and i.parent.original == splats
        and len(i.object.data.vertices) == 42
        and max(i.matrix_world.to_scale()) > 1.01
    ]
    return np.array(found).reshape(-1, 3)


def _mesh(splats):
    """Vertices (n, 3), signed volume and faces' (normal z, centre z, area) of the cut ellipsoids."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    depsgraph.update()
    geometry = splats.evaluated_get(depsgraph).evaluated_geometry()
    if geometry.mesh is None or len(geometry.mesh.vertices) == 0:
        return None
    form = bmesh.new()
    form.from_mesh(geometry.mesh)
    vertices = np.array([v.co[:] for v in form.verts])
    faces = np.array([(f.normal.z, f.calc_center_median().z, f.calc_area()) for f in form.faces])
    closed = all(edge.is_manifold for edge in form.edges)
    volume = form.calc_volume(signed=False)
    form.free()
    return vertices, volume, faces, closed


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


def test_every_splat_is_an_ellipsoid(shown):
    assert len(_instances(shown(_column()))) == 21


def test_ellipsoids_are_where_and_as_large_as_the_splats(shown, random_set):
    splats = shown(random_set, Size=1.5)
    depsgraph = bpy.context.evaluated_depsgraph_get()
    depsgraph.update()
    matrices = [
        np.array(i.matrix_world) for i in depsgraph.object_instances if i.is_instance and i.parent.original == splats
    ]
    whole = [m for m in matrices if not np.allclose(m, np.eye(4))]
    assert len(whole) == len(random_set)
    shape = np.array([m[:3, :3] @ m[:3, :3].T for m in whole])
    np.testing.assert_allclose(shape, 1.5**2 * random_set.covariances(), rtol=1e-3, atol=1e-3)


def test_faint_splats_are_not_shown(shown):
    faint = GaussianSet.create(np.eye(3) * 5, 1.0, opacities=np.array([0.05, 0.5, 0.9]))
    assert len(_instances(shown(faint, Minimum_Opacity=0.1))) == 2


def test_xray_splats_in_air_are_not_shown(shown):
    means = np.concatenate([np.random.default_rng(0).uniform(-3, 3, (200, 3)), [[40.0, 0, 0]]])
    model = GaussianSet.create(means, 1.0, density=0.01, modality=Modality.XRAY)
    assert len(_instances(shown(model, Minimum_Density=0.002))) == 200


def test_photo_splats_are_shown_whatever_x_rays_say(shown):
    assert len(_instances(shown(_column(), Minimum_Density=0.5))) == 21


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


def test_no_soft_splat_reaches_through_the_plane(shown):
    whole = _instances(shown(_column(), Cut=True, Soft_in_Viewport=True))
    assert whole[:, 2].max() < -SOFT_SIZE


def test_the_plane_hides_its_upper_side(shown):
    splats = shown(_column(), Cut=True, Size=1.5)
    whole = _instances(splats)
    vertices, *_ = _mesh(splats)
    # Reaching 1.5 mm, those at -10 ... -2 are whole; -1, 0 and 1 are cut; the rest is gone.
    np.testing.assert_allclose(sorted(whole[:, 2]), np.arange(-10, -1), atol=1e-5)
    assert vertices[:, 2].max() == pytest.approx(0, abs=1e-5)
    assert vertices[:, 2].min() == pytest.approx(-2.5, abs=1e-3)


def test_flip_hides_the_other_side(shown):
    splats = shown(_column(), Cut=True, Flip=True, Size=1.5)
    np.testing.assert_allclose(sorted(_instances(splats)[:, 2]), np.arange(2, 11), atol=1e-5)
    assert _mesh(splats)[0][:, 2].min() == pytest.approx(0, abs=1e-5)


def test_a_slab_hides_what_is_deeper_and_is_closed_there(shown):
    splats = shown(_column(), Cut=True, Slab=5.0, Size=1.5)
    np.testing.assert_allclose(sorted(_instances(splats)[:, 2]), [-3, -2], atol=1e-5)
    assert _mesh(splats)[0][:, 2].min() == pytest.approx(-5, abs=1e-5)


def test_the_plane_may_be_moved_and_the_model_too(shown):
    splats = shown(_column(), Cut=True, plane_z=4.0, Size=1.5)
    splats.location.z = 3.0
    whole = _instances(splats)
    np.testing.assert_allclose(sorted(whole[:, 2]), np.arange(-7, 3), atol=1e-5)


@pytest.mark.parametrize("offset", [-0.8, 0.0, 0.8])
def test_a_cut_ellipsoid_is_a_closed_solid_with_a_flat_cap(shown, offset):
    """Cap and volume against the exact ellipse and the exact part of the ellipsoid."""
    scales = np.array([2.0, 3.0, 1.0])
    splats = shown(GaussianSet.create([[0, 0, offset]], scales[None]), Cut=True, Size=2.0, Detail=5)
    _, volume, faces, closed = _mesh(splats)
    half = 2.0 * scales
    level = -offset / half[2]
    cap = faces[(faces[:, 0] > 0.999) & (np.abs(faces[:, 1]) < 1e-4)]
    exact_cap = np.pi * half[0] * half[1] * (1 - level**2)
    exact_volume = np.pi * np.prod(half) * (2 / 3 + level - level**3 / 3)
    assert closed
    assert cap[:, 2].sum() == pytest.approx(exact_cap, rel=0.04)
    assert volume == pytest.approx(exact_volume, rel=0.03)


def test_a_slanted_ellipsoid_stays_inside_itself(shown):
    quat = np.array([[np.cos(0.4), np.sin(0.4), 0, 0]])
    slanted = GaussianSet.create([[0, 0, 0.5]], [[1.0, 1.0, 4.0]], quats=quat)
    vertices, _, _, closed = _mesh(shown(slanted, Cut=True, Size=1.0))
    apart = vertices - [0, 0, 0.5]
    inside = np.einsum("ni,ij,nj->n", apart, np.linalg.inv(slanted.covariances()[0]), apart)
    assert closed
    assert inside.max() <= 1.0 + 1e-4
    assert vertices[:, 2].max() <= 1e-5


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
