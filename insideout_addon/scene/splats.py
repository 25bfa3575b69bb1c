"""Gaussians as a Blender point cloud and back.

Attribute names and types are those of Blender 5.3's native splats, so a .blend made in 4.5 is one of native
splats there; `density` (mm⁻¹), `modality` and `display_color` (for materials) are added.
"""

from __future__ import annotations

import bpy
import numpy as np

from ...core.gaussians import GaussianSet, Modality
from ...core.spherical_harmonics import sh_to_rgb
from .surroundings import surrounding_density

DISPLAY_COLOR = "display_color"
# Density around a splat, all splats together; of splats that no X-ray saw a number above every threshold.
SURROUNDINGS = "surrounding_density"
_NOT_XRAY = 1e6
# Attribute -> (Blender's type, field of an element, numbers an element).
_LAYOUT = {
    "position": ("FLOAT_VECTOR", "vector", 3),
    "scale": ("FLOAT_VECTOR", "vector", 3),
    "rotation": ("QUATERNION", "value", 4),
    "radiance:base": ("FLOAT_COLOR", "color", 4),
    "density": ("FLOAT", "value", 1),
    "modality": ("INT8", "value", 1),
    "radius": ("FLOAT", "value", 1),
    SURROUNDINGS: ("FLOAT", "value", 1),
    # Not "color": Cycles takes that name, and "density", for a volume's grid and finds nothing on a mesh.
    DISPLAY_COLOR: ("FLOAT_COLOR", "color", 4),
}


def create_splats(
    gaussians: GaussianSet, name: str, context: bpy.types.Context, view_dependent: bool = True
) -> bpy.types.Object:
    """A new point cloud object in the active collection.

    Args:
        gaussians: numpy set, N splats, lengths in mm, which become Blender's units.
        view_dependent: keep the spherical harmonics of degree 1 and up as `radiance:sh_k`.
    """
    splats = _empty_point_cloud(len(gaussians), name, context)
    _write(splats.data, "position", gaussians.means)
    _write(splats.data, "scale", gaussians.scales)
    _write(splats.data, "rotation", gaussians.quats)
    _write(splats.data, "radiance:base", np.column_stack([gaussians.sh[:, 0], gaussians.opacities]))
    if view_dependent:
        for k in range(1, gaussians.sh.shape[1]):
            _write(splats.data, f"radiance:sh_{k - 1}", gaussians.sh[:, k], _LAYOUT["scale"])
    _write(splats.data, "density", gaussians.density)
    _write(splats.data, "modality", gaussians.modality)
    _write(splats.data, "radius", gaussians.scales.mean(axis=1))
    thin = np.where(gaussians.modality == Modality.XRAY, surrounding_density(gaussians), _NOT_XRAY)
    _write(splats.data, SURROUNDINGS, thin)
    rgb = srgb_to_linear(sh_to_rgb(gaussians.sh[:, 0]))
    _write(splats.data, DISPLAY_COLOR, np.column_stack([rgb, gaussians.opacities]))
    splats.data.update_tag()
    return splats


def read_splats(splats: bpy.types.Object) -> GaussianSet:
    """The GaussianSet of a point cloud made by `create_splats`, in the object's own frame (mm)."""
    data = splats.data
    base = _read(data, "radiance:base")
    count = len(base)
    rest = sum(name.startswith("radiance:sh_") for name in data.attributes.keys())  # noqa: SIM118
    sh = np.zeros((count, 1 + rest, 3), np.float32)
    sh[:, 0] = base[:, :3]
    for k in range(rest):
        sh[:, 1 + k] = _read(data, f"radiance:sh_{k}", _LAYOUT["scale"])
    return GaussianSet(
        means=_read(data, "position"),
        quats=_read(data, "rotation"),
        scales=_read(data, "scale"),
        opacities=base[:, 3].copy(),
        sh=sh,
        density=_read(data, "density"),
        modality=_read(data, "modality"),
    )


def read_density(splats: bpy.types.Object) -> GaussianSet:
    """Like `read_splats` without colours, which sections do not need: a fraction of the time."""
    data = splats.data
    return GaussianSet.create(
        _read(data, "position"),
        _read(data, "scale"),
        quats=_read(data, "rotation"),
        density=_read(data, "density"),
        modality=_read(data, "modality"),
    )


def is_splats(candidate: bpy.types.Object | None) -> bool:
    """Whether an object is a point cloud of splats that this module reads."""
    return (
        candidate is not None
        and candidate.type == "POINTCLOUD"
        and all(name in candidate.data.attributes for name in ("scale", "rotation", "density", "radiance:base"))
    )


def srgb_to_linear(rgb: np.ndarray) -> np.ndarray:
    """Scene-linear colours of display colours in 0..1 (IEC 61966-2-1)."""
    return np.where(rgb <= 0.04045, rgb / 12.92, ((np.maximum(rgb, 0) + 0.055) / 1.055) ** 2.4)


def _empty_point_cloud(count: int, name: str, context: bpy.types.Context) -> bpy.types.Object:
    data = bpy.data.pointclouds.new(name)
    if hasattr(data, "resize"):
        data.resize(count)
        splats = bpy.data.objects.new(name, data)
        context.collection.objects.link(splats)
        return splats
    # Before Blender 5.2 a point cloud gets its size only by conversion from a mesh.
    bpy.data.pointclouds.remove(data)
    mesh = bpy.data.meshes.new(name)
    mesh.vertices.add(count)
    splats = bpy.data.objects.new(name, mesh)
    context.collection.objects.link(splats)
    with context.temp_override(
        active_object=splats, object=splats, selected_objects=[splats], selected_editable_objects=[splats]
    ):
        for other in context.view_layer.objects:
            other.select_set(other == splats)
        context.view_layer.objects.active = splats
        bpy.ops.object.convert(target="POINTCLOUD")
    splats.data.name = name
    if mesh.users == 0:
        bpy.data.meshes.remove(mesh)
    return splats


def _write(
    data: bpy.types.PointCloud, name: str, values: np.ndarray, layout: tuple[str, str, int] | None = None
) -> None:
    kind, field, _ = layout or _LAYOUT[name]
    attribute = data.attributes.get(name) or data.attributes.new(name, kind, "POINT")
    dtype = np.int8 if kind == "INT8" else np.float32
    attribute.data.foreach_set(field, np.ascontiguousarray(values, dtype).ravel())


def _read(data: bpy.types.PointCloud, name: str, layout: tuple[str, str, int] | None = None) -> np.ndarray:
    kind, field, width = layout or _LAYOUT[name]
    attribute = data.attributes[name]
    dtype = np.int8 if kind == "INT8" else np.float32
    values = np.empty(len(attribute.data) * width, dtype)
    attribute.data.foreach_get(field, values)
    return values.reshape(-1, width) if width > 1 else values
