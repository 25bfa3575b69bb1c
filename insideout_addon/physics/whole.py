"""The whole model as one rigid body, with its measured mass about its measured centre of mass."""

from __future__ import annotations

import math
import os
from collections.abc import Generator
from dataclasses import replace
from pathlib import Path

import bpy
import numpy as np
from bpy.app.translations import pgettext_n as n_
from bpy.app.translations import pgettext_rpt as rpt_
from mathutils import Vector

from ...core.errors import MeshFileError, SettingError
from ...core.gaussians import GaussianSet
from ...core.mesh.density_map import WATER_G_CM3
from ...core.mesh.glb_reader import TriangleMesh, read_glb
from ...core.steps import part_of_work, run_through
from ..scene.following import following_modifier
from ..scene.hidden_for_now import is_hidden_for_now
from ..scene.importing import densities_are_relative, lengths_are_arbitrary
from ..scene.placement import applied_to_splats
from ..scene.provenance import provenance_of, was_imported_from_a_run
from ..scene.section import has_size
from ..scene.section_image import PER_MM
from ..scene.sources import run_of, source_path
from ..scene.splats import read_density, require_own, shows_density
from ..scene.standing import place_in_world
from ..scene.weighing import MASS_KEY, kept_curve, kept_weight, water_per_mm
from ..scene.weight_text import calibration_text
from .hulls import hull_in_steps, splat_surface
from .masses import center_of_mass, factors_in_steps, splat_masses
from .world import add_floor, bodies_of, make_body

# Share of the work that is done when masses are known.
_WEIGHED = 0.4
# For those who have cropped a model.
WHOLE_MESH = n_("Splats were deleted or added since the import: the mesh is still that of the whole run")


def make_rigid(
    model: bpy.types.Object,
    scene: bpy.types.Scene,
    g_cm3_per_mm_inv: float,
    floor: bool = True,
    drop_mm: float = 0.0,
) -> bpy.types.Object:
    """Gives a model a body, the convex hull of its mesh or else of its splats, that it follows.

    Args:
        g_cm3_per_mm_inv: g/cm³ per mm⁻¹; what the model was weighed to be goes before.
        floor: add one, `drop_mm` below the model, if the scene has none.

    Raises:
        SettingError: the model has no density or no size, is of another file, is a part of something already, or has
            a body.
    """
    return run_through(rigid_in_steps(model, scene, g_cm3_per_mm_inv, floor, drop_mm))


def rigid_in_steps(
    model: bpy.types.Object, scene: bpy.types.Scene, g_cm3_per_mm_inv: float, floor: bool = True, drop_mm: float = 0.0
) -> Generator[float, None, bpy.types.Object]:
    """As `make_rigid`, with breaks that tell the share that is done; closed before its end it changes nothing."""
    require_own(model)
    require_whole(model, scene)
    require_size(model)
    if model.parent is not None:
        raise SettingError(
            "{model} follows {parent}; clear its parent first.", model=model.name, parent=model.parent.name
        )
    gaussians = read_density(model)
    weight = kept_weight(model)
    yield 0.0
    masses = yield from part_of_work(masses_in_steps(model, gaussians, g_cm3_per_mm_inv), 0.0, _WEIGHED)
    center = center_of_mass(gaussians, masses) if weight is None else weight.properties.center_mm
    try:
        points = read_model_mesh(model).vertices
    except MeshFileError:
        points = splat_surface(gaussians)
    yield _WEIGHED
    vertices, faces = yield from part_of_work(hull_in_steps(points), _WEIGHED, 1.0)
    matrix = place_in_world(model)
    _, turn, scale = matrix.decompose()
    mesh = bpy.data.meshes.new(f"{model.name} Body")
    outward = faces if np.prod(scale) > 0 else faces[:, ::-1]
    mesh.from_pydata(((vertices - center) * np.array(scale)).tolist(), [], outward.tolist())
    body = bpy.data.objects.new(f"{model.name} Body", mesh)
    for collection in model.users_collection:
        collection.objects.link(body)
    body.rotation_mode, body.rotation_quaternion = "QUATERNION", turn
    body.location = matrix @ Vector(center)
    body.display_type, body.hide_render = "WIRE", True
    body[MASS_KEY] = float(masses.sum())
    make_body(body, model, scene, float(masses.sum()))
    bpy.context.view_layer.update()
    model.parent, model.matrix_parent_inverse = body, place_in_world(body).inverted()
    if floor:
        add_floor(model, scene, world_box(body), drop_mm)
    return body


def is_taken_apart(model: bpy.types.Object, scene: bpy.types.Scene) -> bool:
    """Whether there is something to make whole again: bodies, or a model that hides, or bends, for deleted ones."""
    return is_hidden_for_now(model) or following_modifier(model) is not None or bool(bodies_of(scene, model))


def require_whole(model: bpy.types.Object, scene: bpy.types.Scene) -> None:
    """Raises SettingError for a model that is taken apart already."""
    if is_taken_apart(model, scene):
        raise SettingError("{model} is broken or has a body already; press Back to Whole first.", model=model.name)


def require_size(model: bpy.types.Object) -> None:
    """Raises SettingError for a model that is scaled to nothing: what it falls as would be flat, or a point."""
    if not has_size(model):
        raise SettingError("{model} is scaled to nothing; give it a size again.", model=model.name)


def masses_in_steps(
    model: bpy.types.Object, gaussians: GaussianSet, g_cm3_per_mm_inv: float
) -> Generator[float, None, np.ndarray]:
    """(N,) grams of a model's splats: as it was weighed, with that calibration, else in proportion to attenuation.

    Yields the share that is done.

    Raises:
        SettingError: the model is of photos alone; or as `splat_masses`.
    """
    if not shows_density(model) or lengths_are_arbitrary(model):
        raise SettingError("{model} is of photos alone, which have no mass; choose one with X-rays.", model=model.name)
    # Of Weigh's own sum over a grid each splat has its share.
    weight, curve = kept_weight(model), kept_curve(model)
    if weight is None or curve is None:
        return splat_masses(gaussians, g_cm3_per_mm_inv)
    factors = yield from factors_in_steps(gaussians, curve)
    return splat_masses(gaussians, factors, weight.properties.mass_g)


def water_factor(model: bpy.types.Object, scene: bpy.types.Scene) -> float:
    """g/cm³ per mm⁻¹ by which what attenuates like water in a model's scan is as heavy as water."""
    return WATER_G_CM3 / water_per_mm(model, scene)


def mass_calibration(model: bpy.types.Object, scene: bpy.types.Scene, g_cm3_per_mm_inv: float) -> str:
    """What the masses of `masses_in_steps` are calibrated by, in words that follow a mass: "by two points".

    Args:
        model: the object.
        scene: whose water is that of the model's scan.
        g_cm3_per_mm_inv: mass density of an attenuation of 1, which counts where the model was not weighed.
    """
    weight = kept_weight(model)
    if weight is not None:
        return calibration_text(weight.calibration)
    if math.isclose(g_cm3_per_mm_inv, water_factor(model, scene), rel_tol=1e-6):
        return rpt_("with densities taken as water's")
    if densities_are_relative(model):
        return rpt_("by {factor:.4g} g/cm³ for a density of 1").format(factor=g_cm3_per_mm_inv)
    return rpt_("by {factor:.4g} g/cm³ per {unit}").format(factor=g_cm3_per_mm_inv, unit=PER_MM.label)


def mesh_path(model: bpy.types.Object) -> Path:
    """The mesh.glb of the run that a model is from.

    Raises:
        MeshFileError: there is none.
    """
    source = source_path(model)
    if source is None or not was_imported_from_a_run(model, source):
        raise MeshFileError("{model}: was not imported from a run, so it has no mesh; import a run.", model=model.name)
    path = run_of(source) / "mesh.glb"
    if not os.path.isfile(path):
        raise MeshFileError(
            "{path}: is not there; finish the run, or relink the model if the run has moved.", path=path
        )
    return path


def mesh_is_of_other_splats(model: bpy.types.Object) -> bool:
    """Whether splats were deleted or added since the import, of which the run's mesh, if it has one, knows nothing."""
    file = provenance_of(model).get("file")
    known = file.get("splats") if isinstance(file, dict) else None
    if not isinstance(known, int) or known == len(model.data.points):
        return False
    try:
        return os.path.isfile(mesh_path(model))
    except MeshFileError:
        return False


def read_model_mesh(model: bpy.types.Object, path: Path | None = None) -> TriangleMesh:
    """The mesh of a model, mm in its frame, from its run or another file that is in that frame.

    Raises:
        MeshFileError: there is none, or it cannot be read.
    """
    if path is not None:
        return read_glb(path)
    mesh, applied = read_glb(mesh_path(model)), applied_to_splats(model)
    mirrored = np.linalg.det(applied.linear) < 0
    return replace(mesh, vertices=applied.apply(mesh.vertices), faces=mesh.faces[:, ::-1] if mirrored else mesh.faces)


def world_box(thing: bpy.types.Object) -> np.ndarray:
    """(2, 3) the box of a mesh object in the world, Blender units."""
    matrix = place_in_world(thing)
    corners = np.array([matrix @ vertex.co for vertex in thing.data.vertices])
    return np.stack([corners.min(axis=0), corners.max(axis=0)])


def release_whole(model: bpy.types.Object, body: bpy.types.Object) -> None:
    """Puts a model that follows a body back to where it was before."""
    if model.parent == body:
        model.parent = None
        model.matrix_parent_inverse.identity()
