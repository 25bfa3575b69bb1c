"""What the display shows of a model, as Blender evaluates it."""

from __future__ import annotations

import bmesh
import bpy
import numpy as np
import pytest
from mathutils import Matrix

from insideout.core.render.section_numpy import SectionSplats, section_density
from insideout.core.views import Plane
from insideout.core.volume import Volume
from insideout.insideout_addon.scene.display import show_splats
from insideout.insideout_addon.scene.splats import create_splats


def _instances(splats, cut):
    """Matrix in the model's frame and mesh of its whole ellipsoids, or of those that one plane cuts.

    Whole ones are icospheres, all triangles; cut ones have rings of quads. Geometry of its own is an instance too,
    where it is.
    """
    depsgraph = bpy.context.evaluated_depsgraph_get()
    depsgraph.update()
    back = splats.evaluated_get(depsgraph).matrix_world.inverted()
    for instance in depsgraph.object_instances:
        if not (instance.is_instance and instance.parent.original == splats and instance.object.type == "MESH"):
            continue
        matrix, mesh = np.array(back @ instance.matrix_world), instance.object.data
        own = np.allclose(matrix, np.eye(4), atol=1e-6)
        if not own and any(face.loop_total == 4 for face in mesh.polygons) == cut:
            yield matrix, mesh


@pytest.fixture
def whole_ellipsoids():
    """`whole_ellipsoids(splats)`: (n, 4, 4) from the unit ball to each whole ellipsoid in the model's frame."""
    return lambda splats: np.array([matrix for matrix, _ in _instances(splats, cut=False)]).reshape(-1, 4, 4)


@pytest.fixture
def cut_ellipsoids():
    """`cut_ellipsoids(splats)`: one bmesh of all cut ellipsoids in the model's frame."""

    def collect(splats):
        form = bmesh.new()
        for matrix, mesh in _instances(splats, cut=True):
            first = len(form.verts)
            form.from_mesh(mesh)
            form.verts.ensure_lookup_table()
            bmesh.ops.transform(form, matrix=Matrix(matrix), verts=form.verts[first:])
        geometry = splats.evaluated_get(bpy.context.evaluated_depsgraph_get()).evaluated_geometry()
        if geometry.mesh is not None:
            form.from_mesh(geometry.mesh)
        form.normal_update()
        return form

    return collect


@pytest.fixture
def scanned(blender, random_set, tmp_path):
    """A model, shown and not cut, of a run whose CT volume is the splats' own density, 0.01 mm⁻¹ too high."""
    model = create_splats(random_set, "model", bpy.context)
    show_splats(model, True)
    bpy.context.scene.insideout.pixels = 48
    splats = SectionSplats(random_set)
    slices = [
        section_density(
            splats, Plane(np.array([-30.5, -30.5, z]), np.array([1.0, 0, 0]), np.array([0, 1.0, 0]), 61, 61)
        )
        for z in range(-30, 31)
    ]
    volume = Volume.centered(np.stack(slices) + np.float32(0.01), np.ones(3))
    volume.save(tmp_path / "initialize" / "volume.npz")
    model["insideout_source"] = str(tmp_path / "fused.ply")
    return model
