"""A model in pieces: closed, of the whole's volume and mass, coloured, its splats with them; and whole again."""

from __future__ import annotations

import dataclasses

import bpy
import numpy as np
import pytest
from mathutils import Matrix

from insideout.core.errors import MeshFileError, SettingError
from insideout.core.mesh.mass import gaussian_mass_properties
from insideout.core.mesh.solids import is_closed, solid_labels, volume_and_centroid
from insideout.insideout_addon.physics import breaking, intersect
from insideout.insideout_addon.physics.breaking import BreakOptions, break_model, make_whole, pieces_of
from insideout.insideout_addon.physics.meshes import COLOR, OUTSIDE, read_mesh
from insideout.insideout_addon.physics.whole import make_rigid, mesh_path
from insideout.insideout_addon.scene.exporting import edited_splats
from insideout.insideout_addon.scene.placement import apply_transform
from insideout.insideout_addon.scene.section import shown_plane
from insideout.insideout_addon.scene.splats import read_splats

FACTOR = 50.0


def broken(model, **options):
    return break_model(
        model, bpy.context, BreakOptions(**{"g_cm3_per_mm_inv": FACTOR, "pieces": 6, "spacing_mm": 2.0, **options})
    )


def volumes(pieces):
    found = [read_mesh(piece.data) for piece in pieces]
    assert all(is_closed(surface.faces) for surface in found)
    return np.array([volume_and_centroid(surface.vertices, surface.faces)[0] for surface in found])


def masses(pieces):
    return np.array([piece["insideout_mass_g"] for piece in pieces])


def enclosed(body):
    return volume_and_centroid(body.vertices, body.faces)[0]


def grams(gaussians):
    return gaussian_mass_properties(gaussians, FACTOR).mass_g


@pytest.mark.parametrize("kind", ["hollow_ball", "shells"])
def test_volumes_and_masses_add_up_to_the_whole(imported, request, kind):
    body, gaussians = request.getfixturevalue(kind)
    pieces = broken(imported(body, gaussians))
    assert len(pieces) >= 6
    assert volumes(pieces).sum() == pytest.approx(enclosed(body), rel=1e-4)
    assert (volumes(pieces) > 0).all()
    assert masses(pieces).sum() == pytest.approx(grams(gaussians), rel=1e-6)
    assert (masses(pieces) > 0).all()


def test_a_piece_weighs_what_its_share_of_the_material_does(imported, hollow_ball):
    """Splats go whole to the piece that holds their centre, so single pieces are a little off."""
    body, gaussians = hollow_ball
    pieces = broken(imported(body, gaussians), pieces=4)
    share = volumes(pieces) / enclosed(body)
    np.testing.assert_allclose(masses(pieces) / grams(gaussians), share, atol=0.04)


def test_each_solid_of_a_cell_is_a_piece_of_its_own(imported, shells):
    """Two halves of three shells are six pieces."""
    body, gaussians = shells
    model = imported(body, gaussians)
    bpy.ops.insideout.section_add()
    shown_plane(bpy.context.scene).location = (0, 0, 0)
    bpy.context.view_layer.update()
    pieces = broken(model, along_planes=True)
    assert len(pieces) == 6
    for piece in pieces:
        surface = read_mesh(piece.data)
        assert solid_labels(surface.vertices, surface.faces).max() == 0
    found = np.sort(volumes(pieces))
    np.testing.assert_allclose(found[::2], found[1::2], rtol=0.01)
    np.testing.assert_allclose(found[::2].sum(), enclosed(body) / 2, rtol=0.01)


def test_pieces_stand_where_they_are_in_the_model(imported, hollow_ball, place):
    body, gaussians = hollow_ball
    model = imported(body, gaussians)
    model.matrix_world = np.array([[0, -1, 0, 5], [1, 0, 0, -3], [0, 0, 1, 2], [0, 0, 0, 1]]).T
    bpy.context.view_layer.update()
    pieces = broken(model)
    corners = np.concatenate(
        [
            (place(piece) @ np.c_[read_mesh(piece.data).vertices, np.ones(len(piece.data.vertices))].T).T
            for piece in pieces
        ]
    )
    distance = np.linalg.norm(corners[:, :3] - [5, -3, 2], axis=1)
    assert distance.max() == pytest.approx(20.0, abs=0.01)


@pytest.mark.parametrize("mirrored", [1, -1])
def test_a_transform_that_was_applied_to_the_splats_is_one_of_the_mesh_too(imported, hollow_ball, mirrored):
    body, gaussians = hollow_ball
    model = imported(body, gaussians)
    model.location, model.scale = (100, 0, 0), (2, 2, mirrored * 3)
    bpy.context.view_layer.update()
    apply_transform(model)
    pieces = broken(model, spacing_mm=4.0)
    assert volumes(pieces).sum() == pytest.approx(12 * enclosed(body), rel=1e-3)
    assert masses(pieces).sum() == pytest.approx(12 * grams(gaussians), rel=1e-3)
    # Each piece holds splats, whose share of the mass is that of its volume.
    shares = [parts / parts.sum() for parts in (masses(pieces), volumes(pieces))]
    np.testing.assert_allclose(*shares, atol=0.06)


def test_a_model_that_blender_itself_moved_breaks_where_it_is(imported, hollow_ball, place):
    model = imported(*hollow_ball)
    model.location, model.rotation_euler = (100, 0, 0), (0, 0, 1)
    bpy.ops.object.select_all(action="SELECT")
    bpy.ops.object.transform_apply()
    for piece in broken(model, spacing_mm=4.0):
        assert np.linalg.norm(place(piece)[:3, 3] - [100, 0, 0]) < 20.0


def test_a_weight_of_what_the_model_was_does_not_count(imported, hollow_ball):
    """Stretched since it was weighed, it has eight times the mass."""
    body, gaussians = hollow_ball
    model = imported(body, gaussians)
    bpy.ops.insideout.weigh(water=1 / FACTOR, cavities=False)
    model.scale = (2, 2, 2)
    bpy.context.view_layer.update()
    apply_transform(model)
    assert masses(broken(model, spacing_mm=4.0)).sum() == pytest.approx(8 * grams(gaussians), rel=1e-3)


def test_a_piece_of_a_scene_in_metres_goes_out_in_mm(imported, hollow_ball):
    body, gaussians = hollow_ball
    # The user's own scene: its units stay.
    bpy.ops.mesh.primitive_uv_sphere_add()
    model = imported(body, gaussians)
    assert model.matrix_world.to_scale().x == pytest.approx(0.001)
    piece = broken(model)[0]
    cloud = next(child for child in piece.children if child.type == "POINTCLOUD")
    found = edited_splats(cloud, bpy.context)
    np.testing.assert_allclose(found.scales, gaussians.scales[0, 0], rtol=1e-4)
    assert np.linalg.norm(found.means, axis=1).min() > 8


def test_the_origin_of_a_piece_is_its_centre_of_mass(imported, shapes):
    """A heavy half on a light one: the middle is in the heavy one."""
    body = shapes.ball(20.0)
    gaussians = shapes.filling(lambda p: np.linalg.norm(p, axis=1) < 19, 20.0)
    heavy = dataclasses.replace(gaussians, density=gaussians.density * np.where(gaussians.means[:, 2] < 0, 9, 1))
    pieces = broken(imported(body, heavy.select(slice(None)), "heavy"))
    together = sum(m * np.array(piece.location) for m, piece in zip(masses(pieces), pieces, strict=True))
    expected = gaussian_mass_properties(heavy, FACTOR).center_mm
    np.testing.assert_allclose(together / masses(pieces).sum(), expected, atol=0.1)
    assert expected[2] < -5


def test_outside_has_the_photos_colours_and_broken_faces_those_of_the_density(imported, hollow_ball):
    body, gaussians = hollow_ball
    for piece in broken(imported(body, gaussians), pieces=3, spacing_mm=0.0):
        surface = read_mesh(piece.data)
        distance = np.linalg.norm(surface.vertices + piece.location, axis=1)[surface.faces]
        outer = (surface.wall == OUTSIDE) & (distance.min(axis=1) > 19.5)
        red = np.broadcast_to([0.9, 0.2, 0.1], (outer.sum(), 3, 3))
        np.testing.assert_allclose(surface.colors[outer], red, atol=0.02)
        cut = surface.wall != OUTSIDE
        assert cut.any()
        # The middle of the wall is as dense as it gets, and shown bright; its rim fades into the air.
        middle = np.abs(distance - 16).max(axis=1) < 1.5
        assert surface.colors[cut & middle].mean() > 0.5
        assert len(np.unique(surface.colors[cut].round(2).reshape(-1, 3), axis=0)) > 10
        slots = [material.name for material in piece.data.materials]
        assert slots == ["InsideOut Outside", "InsideOut Broken"]
        assert piece.data.color_attributes.active_color_name == COLOR


def test_splats_follow_their_piece(imported, hollow_ball, place):
    body, gaussians = hollow_ball
    model = imported(body, gaussians)
    pieces, centers, weighs = broken(model, show="SPLATS"), [], 0.0
    for piece in pieces:
        (cloud,) = piece.children
        held = read_splats(cloud)
        assert not cloud.hide_render
        assert piece.hide_render
        centers.append(held.means[held.modality != 2])
        weighs += grams(held)
        # The model's own frame, in which a splat is where it was.
        np.testing.assert_allclose(np.array(cloud.matrix_world), np.eye(4), atol=1e-4)
    found = np.concatenate(centers)
    np.testing.assert_array_equal(found[np.lexsort(found.T)], gaussians.means[np.lexsort(gaussians.means.T)])
    assert weighs == pytest.approx(grams(gaussians), rel=1e-5)
    before = [place(thing, 1) for thing in (pieces[0], pieces[0].children[0])]
    for frame in range(2, 6):
        bpy.context.scene.frame_set(frame)
    piece, cloud = (place(thing) for thing in (pieces[0], pieces[0].children[0]))
    assert piece[2, 3] < before[0][2, 3] - 10
    np.testing.assert_allclose(cloud, piece @ np.linalg.inv(before[0]) @ before[1], atol=1e-3)


def test_splats_that_a_wall_cuts_are_on_both_sides_with_the_plane(imported, hollow_ball):
    body, gaussians = hollow_ball
    pieces = broken(imported(body, gaussians))
    clouds = [piece.children[0] for piece in pieces]
    assert sum(len(cloud.data.points) for cloud in clouds) > 1.2 * len(gaussians)
    cloud = clouds[0].data
    normals, heights = np.empty(3 * len(cloud.points)), np.empty(len(cloud.points))
    cloud.attributes["cut_normal_0"].data.foreach_get("vector", normals)
    cloud.attributes["cut_height_0"].data.foreach_get("value", heights)
    lengths = np.linalg.norm(normals.reshape(-1, 3), axis=1)
    used = lengths > 0.5
    np.testing.assert_allclose(lengths[used], 1, atol=1e-5)
    assert used.any()
    assert not used.all()
    # All points of the piece are on the side that stays.
    held = read_splats(clouds[0])
    corners = read_mesh(pieces[0].data).vertices + pieces[0].location
    for normal, height, mean in zip(normals.reshape(-1, 3)[used], heights[used], held.means[used], strict=True):
        assert ((corners - mean) @ normal).max() < height + 1e-2


def test_pieces_are_active_bodies_and_the_model_is_hidden(imported, hollow_ball):
    model = imported(*hollow_ball)
    pieces = broken(model)
    for piece in pieces:
        assert piece.rigid_body.type == "ACTIVE"
        assert piece.rigid_body.mass == pytest.approx(1e6 * piece["insideout_mass_g"], rel=1e-5)
    assert model.hide_viewport
    assert model.hide_render
    assert pieces_of(bpy.context.scene, model) == pieces


def counts():
    kinds = ("objects", "meshes", "pointclouds", "scenes", "collections", "materials", "actions", "node_groups")
    return {kind: len(getattr(bpy.data, kind)) for kind in kinds}


def test_whole_again_leaves_nothing_behind(imported, hollow_ball):
    model = imported(*hollow_ball)
    before, splats = counts(), read_splats(model)
    gravity = tuple(bpy.context.scene.gravity)
    broken(model)
    assert bpy.context.scene.gravity.z == pytest.approx(-9810)
    make_whole(model, bpy.context.scene)
    assert counts() == before
    assert not model.hide_viewport
    assert bpy.context.scene.rigidbody_world is None
    assert tuple(bpy.context.scene.gravity) == gravity
    assert len(broken(model)) >= 6
    np.testing.assert_array_equal(read_splats(model).means, splats.means)


@pytest.mark.parametrize("floor", [True, False])
@pytest.mark.parametrize("splats_too", [True, False])
def test_pieces_deleted_by_hand_can_be_undone_like_others(imported, hollow_ball, draw_panels, floor, splats_too):
    model = imported(*hollow_ball)
    before = counts()
    pieces = broken(model, floor=floor)
    bpy.ops.object.select_all(action="DESELECT")
    for thing in [*pieces, *(child for piece in pieces for child in piece.children if splats_too)]:
        thing.hide_viewport = False
        thing.select_set(True)
    bpy.ops.object.delete()
    assert pieces_of(bpy.context.scene, model) == []
    assert "Back to Whole" in (texts := draw_panels())
    assert not any("rigid body" in text or "Baked" in text for text in texts)
    for attempt in (broken, lambda model: make_rigid(model, bpy.context.scene, FACTOR)):
        with pytest.raises(SettingError, match="press Back to Whole first"):
            attempt(model)
    assert bpy.ops.insideout.unbreak() == {"FINISHED"}
    assert not model.hide_viewport
    assert not model.hide_render
    for kind in ("objects", "collections"):
        assert counts()[kind] == before[kind], kind
    assert [cloud for cloud in bpy.data.pointclouds if cloud.users] == [model.data]
    assert bpy.context.scene.rigidbody_world is None
    assert "Break..." in draw_panels()


def test_what_the_user_has_parented_to_a_piece_stays(imported, hollow_ball):
    model = imported(*hollow_ball)
    other = imported(*hollow_ball, "other")
    other.parent = broken(model)[0]
    make_whole(model, bpy.context.scene)
    assert set(bpy.context.scene.objects) == {model, other}


def test_what_keeps_solids_apart_goes_with_a_body_that_was_deleted_by_hand(imported, shells):
    model = imported(*shells)
    before = counts()["objects"]
    pieces = broken(model, pieces=2)
    empties = [thing for thing in bpy.data.objects if thing.rigid_body_constraint]
    assert empties
    for piece in pieces:
        bpy.data.objects.remove(piece)
    make_whole(model, bpy.context.scene)
    assert counts()["objects"] == before


def test_a_splat_without_a_place_weighs_nothing(imported, shells, tmp_path):
    """Each cell holds several solids; without the mesh the hull is that of the splats."""
    body, gaussians = shells
    model = imported(body, gaussians)
    means = gaussians.means.copy()
    means[0] = np.nan
    model.data.attributes["position"].data.foreach_set("vector", means.ravel())
    pieces = broken(model)
    assert all(np.isfinite(piece.location).all() for piece in pieces)
    assert masses(pieces).sum() == pytest.approx(grams(gaussians.select(slice(1, None))), rel=1e-6)
    make_whole(model, bpy.context.scene)
    for whose_hull in ("mesh", "splats"):
        if whose_hull == "splats":
            mesh_path(model).unlink()
        found = make_rigid(model, bpy.context.scene, FACTOR)
        np.testing.assert_allclose(found.location, 0, atol=0.1)
        assert np.isfinite([vertex.co for vertex in found.data.vertices]).all()
        make_whole(model, bpy.context.scene)


def test_it_breaks_again_in_the_same_way(imported, hollow_ball):
    model = imported(*hollow_ball)
    found = []
    for seed in (1, 1, 2):
        found.append(np.sort(volumes(broken(model, seed=seed))))
        make_whole(model, bpy.context.scene)
    np.testing.assert_array_equal(found[0], found[1])
    assert not np.array_equal(found[0], found[2])


def test_a_crumb_stays_with_its_neighbour(imported, hollow_ball, shapes):
    body, gaussians = hollow_ball
    speck = shapes.ball(0.3, center=(0.0, 0.0, 11.0))
    whole = shapes.together(body, speck)
    pieces = broken(imported(whole, gaussians))
    assert volumes(pieces).sum() == pytest.approx(enclosed(whole), rel=1e-4)
    assert volumes(pieces).min() > 10 * enclosed(speck)


def test_what_the_user_has_weighed_counts(imported, hollow_ball):
    body, gaussians = hollow_ball
    model = imported(body, gaussians)
    bpy.ops.insideout.weigh(water=0.5 / FACTOR, cavities=False)
    assert masses(broken(model)).sum() == pytest.approx(2 * grams(gaussians), rel=1e-6)


@pytest.mark.parametrize(
    ("weighed", "options", "told"),
    [
        (None, {}, "together with densities taken as water's; play"),
        (None, {"density_factor": FACTOR}, "together by 50 g/cm³ per mm⁻¹; play"),
        ({"calibration": "WATER"}, {"density_factor": FACTOR}, "together by water; play"),
        ({"calibration": "POINTS"}, {}, "together by two points; play"),
        ({"calibration": "MATERIALS", "materials": {"PMMA"}}, {}, "together by materials; play"),
    ],
)
def test_the_mass_is_told_with_its_calibration(imported, hollow_ball, capfd, weighed, options, told):
    model = imported(*hollow_ball)
    if weighed is not None:
        bpy.ops.insideout.weigh(cavities=False, **weighed)
    assert bpy.ops.insideout.break_model(pieces=2, detail_mm=5.0, **options) == {"FINISHED"}
    pieces = pieces_of(bpy.context.scene, model)
    out = capfd.readouterr().out
    assert f"{len(pieces)} pieces, {masses(pieces).sum():.4g} g {told} to see them fall" in out


def test_pieces_share_the_mass_by_the_calibration_of_the_weighing(imported, shapes):
    """What attenuates nine times as much is twice as dense, so its half weighs twice as much, and not nine times."""
    gaussians = shapes.filling(lambda p: np.linalg.norm(p, axis=1) < 19, 20.0)
    heavy = dataclasses.replace(gaussians, density=gaussians.density * np.where(gaussians.means[:, 2] < 0, 9, 1))
    model = imported(shapes.ball(20.0), heavy)
    bpy.ops.insideout.weigh(
        calibration="POINTS", first_attenuation=0.04, first_density=1.0, second_attenuation=0.36, second_density=2.0
    )
    bpy.ops.insideout.section_add()
    plane = shown_plane(bpy.context.scene)
    plane.location, plane.rotation_euler = (0, 0, -1), (0, 0, 0)
    bpy.context.view_layer.update()
    pieces = broken(model, along_planes=True)
    heights = [piece.location.z for piece in pieces]
    light, dense = masses(pieces)[np.argsort(heights)[::-1]]
    ratio = np.count_nonzero(heavy.means[:, 2] < -1) / np.count_nonzero(heavy.means[:, 2] > -1)
    assert dense / light == pytest.approx(2 * ratio, rel=0.2)
    assert dense + light == pytest.approx(model["insideout_mass_g"])


def test_what_is_scaled_to_nothing_does_not_break(imported, hollow_ball):
    model = imported(*hollow_ball)
    model.scale = (0, 0, 0)
    bpy.context.view_layer.update()
    with pytest.raises(SettingError, match="is scaled to nothing; give it a size again"):
        broken(model)
    assert list(bpy.context.scene.objects) == [model]
    assert not model.hide_viewport


def test_a_model_without_a_mesh_is_told(imported, hollow_ball, tmp_path):
    model = imported(*hollow_ball)
    (tmp_path / "run" / "mesh.glb").unlink()
    with pytest.raises(MeshFileError, match=r"mesh\.glb: is not there; finish the run"):
        broken(model)
    assert pieces_of(bpy.context.scene, model) == []


def test_a_mesh_with_a_hole_is_told_and_nothing_is_left(imported, hollow_ball, shapes):
    body, gaussians = hollow_ball
    model = imported(shapes.Body(body.vertices, body.faces[40:], body.colors), gaussians)
    before = len(bpy.data.objects), len(bpy.data.scenes), len(bpy.data.meshes)
    with pytest.raises(MeshFileError, match="has holes"):
        broken(model)
    assert (len(bpy.data.objects), len(bpy.data.scenes), len(bpy.data.meshes)) == before


def test_a_blender_without_the_library_manifold_breaks_what_it_can(imported, shells, monkeypatch):
    monkeypatch.setattr(intersect, "has_manifold", lambda: False)
    body, gaussians = shells
    assert volumes(broken(imported(body, gaussians))).sum() == pytest.approx(enclosed(body), rel=1e-4)


@pytest.mark.parametrize("mirror", [(-1, 1, 1), (1, -2, 1), (-1, -1, -1)])
def test_pieces_of_a_mirrored_model_have_their_outside_outside(imported, hollow_ball, mirror):
    """Else they would be lit from within, and Blender would take them for holes."""
    body, gaussians = hollow_ball
    model = imported(body, gaussians)
    model.matrix_world = Matrix.LocRotScale((5, 0, 0), Matrix.Rotation(0.6, 3, "X"), mirror)
    bpy.context.view_layer.update()
    pieces = broken(model)
    expected = enclosed(body) * abs(np.prod(mirror))
    assert volumes(pieces).sum() == pytest.approx(expected, rel=1e-3)
    for piece in pieces:
        places = np.array([model.matrix_world.inverted() @ piece.matrix_world @ v.co for v in piece.data.vertices])
        outer = [p for p in piece.data.polygons if p.use_smooth and _far(places[p.vertices], 20.0)]
        assert outer
        # By area: where a wall just cuts a corner off, slivers point anywhere.
        turn, center = piece.matrix_world.to_3x3(), model.location
        outwards = [(turn @ p.normal) @ (piece.matrix_world @ p.center - center).normalized() for p in outer]
        assert np.average(outwards, weights=[p.area for p in outer]) > 0.7
        colors = np.empty(4 * len(piece.data.loops), np.float32)
        piece.data.attributes[COLOR].data.foreach_get("color_srgb", colors)
        seen = colors.reshape(-1, 4)[[loop for p in outer for loop in p.loop_indices], :3]
        assert (seen[:, 0] > seen[:, 1] + 0.2).all(), "the ball is red outside"


def _far(places, radius):
    return (np.linalg.norm(places, axis=1) > 0.97 * radius).all()


def test_a_body_of_a_mirrored_model_has_its_outside_outside(imported, hollow_ball):
    model = imported(*hollow_ball)
    model.scale = (-1, 1, 1)
    bpy.context.view_layer.update()
    body = make_rigid(model, bpy.context.scene, FACTOR)
    assert all(polygon.normal @ polygon.center > 0 for polygon in body.data.polygons)


def test_what_is_in_the_way_of_breaking_is_known_before(imported, hollow_ball, monkeypatch):
    model = imported(*hollow_ball)
    assert breaking.hindrance(model) == ""
    monkeypatch.setattr(breaking, "has_manifold", lambda: False)
    assert breaking.hindrance(model).endswith("use a Blender from blender.org.")
    mesh_path(model).unlink()
    assert "mesh.glb: is not there" in breaking.hindrance(model)


def test_parts_that_do_not_add_up_are_told(imported, hollow_ball, monkeypatch):
    """As of a solver that leaves meshes as they are, where Blender was built without it."""
    monkeypatch.setattr(intersect.Intersection, "with_", lambda self, cell: self._surface)
    with pytest.raises(MeshFileError, match="cannot be broken into closed pieces"):
        broken(imported(*hollow_ball))


def test_planes_need_a_section(imported, hollow_ball):
    with pytest.raises(SettingError, match="no section plane"):
        broken(imported(*hollow_ball), along_planes=True)


def test_breaking_twice_is_refused(imported, hollow_ball):
    model = imported(*hollow_ball)
    broken(model)
    with pytest.raises(SettingError, match="broken or has a body already"):
        broken(model)


@pytest.mark.parametrize("show", ["MESH", "SPLATS"])
def test_a_solid_without_splats_is_a_piece_of_its_volume(imported, shells, show):
    body, gaussians = shells
    around = gaussians.select(np.linalg.norm(gaussians.means, axis=1) > 9)
    model = imported(body, around)
    bpy.ops.insideout.section_add()
    pieces = broken(model, along_planes=True, show=show)
    assert volumes(pieces).sum() == pytest.approx(enclosed(body), rel=1e-4)
    assert masses(pieces).sum() == pytest.approx(grams(around), rel=1e-6)
    bare = [piece for piece in pieces if not piece.children]
    assert bare
    assert not any(piece.hide_render for piece in bare)
