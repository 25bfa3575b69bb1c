"""Gaussians as a Blender point cloud and back.

Attribute names and types are those of Blender 5.3's native splats, so a .blend made in 4.5 is one of native
splats there; `density` (mm⁻¹), `modality` and `display_color` (for materials) are added.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import fields

import bpy
import numpy as np

from ...core.errors import InsideOutError, SettingError
from ...core.gaussians import GaussianSet, Modality
from ...core.spherical_harmonics import sh_to_rgb
from ...core.srgb import srgb_to_linear
from ...core.steps import run_through
from .cut_slots import HEIGHTS, NORMALS
from .framing import has_density
from .linking import open_collection
from .native import draws_splats, make_native
from .surroundings import surrounding_density
from .watching import watched

DISPLAY_COLOR = "display_color"
# Density around a splat, all splats together; of splats that no X-ray saw a number above every threshold.
SURROUNDINGS = "surrounding_density"
# How far from the object's middle a splat reaches; 0 where none is background.
REACH = "reach"
# Worked out when they are first asked for, see `inside`: mm under the outer surface, and mm⁻¹ of all splats together.
DEPTH, DENSITY_HERE = "surface_depth", "density_here"
# Disagreement with the projections, %; not a number where no ray passed.
RESIDUAL = "residual"
# Where Blender 5.3 draws splats itself, and smaller beside a cut: their axes as they are.
WHOLE_SCALE = "whole_scale"
# On points in other colours than their own: what these were made from, as text.
COLORS_KEY = "insideout_colors"
# On models of a scan in Hounsfield units: attenuation of water in them, mm⁻¹.
WATER_KEY = "insideout_water"
# What lengths of a model are in.
UNIT_KEY = "insideout_unit"
# On each scene: its water, where a model's scan gave it that, mm⁻¹.
WATER_SET_KEY = "insideout_water_of_model"
_NOT_XRAY = 1e6
_OTHERS = "the splats are not those that were to be read"
_LOOKED_AT = 32
# How many harmonics beyond the constant one colours of degree 0 to 3 have.
_FULL_DEGREES = (0, 3, 8, 15)
_DENSITY_KEY = "insideout_has_density"
# Attribute -> (Blender's type, field of an element, numbers an element).
_Layout = tuple[str, str, int]
_BASE = "radiance:base"
# As Blender 5.3 has it; before 5.2 a point can have four numbers only as a colour.
_NATIVE_BASE: _Layout = ("FLOAT4", "vector", 4)
_LAYOUT: dict[str, _Layout] = {
    "position": ("FLOAT_VECTOR", "vector", 3),
    "scale": ("FLOAT_VECTOR", "vector", 3),
    "rotation": ("QUATERNION", "value", 4),
    _BASE: ("FLOAT_COLOR", "color", 4),
    "density": ("FLOAT", "value", 1),
    "modality": ("INT8", "value", 1),
    "radius": ("FLOAT", "value", 1),
    SURROUNDINGS: ("FLOAT", "value", 1),
    REACH: ("FLOAT", "value", 1),
    DEPTH: ("FLOAT", "value", 1),
    DENSITY_HERE: ("FLOAT", "value", 1),
    RESIDUAL: ("FLOAT", "value", 1),
    WHOLE_SCALE: ("FLOAT_VECTOR", "vector", 3),
    # Not "color": Cycles takes that name, and "density", for a volume's grid and finds nothing on a mesh.
    DISPLAY_COLOR: ("FLOAT_COLOR", "color", 4),
}


class DamagedSplatsError(InsideOutError):
    """A point cloud has lost what makes its points splats."""


def create_splats(
    gaussians: GaussianSet,
    name: str,
    context: bpy.types.Context,
    view_dependent: bool = True,
    surroundings: np.ndarray | None = None,
    reach: np.ndarray | None = None,
    residual: np.ndarray | None = None,
) -> bpy.types.Object:
    """A new point cloud object in the active collection.

    Args:
        gaussians: numpy set, N splats, lengths in mm, which become Blender's units.
        view_dependent: keep the spherical harmonics of degree 1 and up as `radiance:sh_k`.
        surroundings: (N,) `surrounding_density` where it is known already.
        reach: (N,) `framing.reach` where some are background.
        residual: (N,) % of the run that the splats are from, if it tells.
    """
    return run_through(create_in_steps(gaussians, name, context, view_dependent, surroundings, reach, residual))


def create_in_steps(
    gaussians: GaussianSet,
    name: str,
    context: bpy.types.Context,
    view_dependent: bool = True,
    surroundings: np.ndarray | None = None,
    reach: np.ndarray | None = None,
    residual: np.ndarray | None = None,
) -> Generator[float, None, bpy.types.Object]:
    """As `create_splats`, with a break after the point cloud and after each of its attributes: the share that is done.

    In the breaks, in which Blender draws, the cloud is in no collection. Closed before its end there is none.
    """
    splats = _point_cloud(gaussians.means, name, context)
    data, most = splats.data, len(_LAYOUT) + gaussians.sh.shape[1]
    try:
        splats[_DENSITY_KEY] = has_density(gaussians)
        for collection in splats.users_collection:
            collection.objects.unlink(splats)
        yield 1 / most
        attributes = _attributes(gaussians, view_dependent, surroundings, reach)
        for done, (attribute, layout, values) in enumerate(attributes, start=2):
            _write(data, attribute, values, layout)
            yield done / most
        if residual is not None:
            write_values(splats, RESIDUAL, residual)
        make_native(data)
        open_collection(context).objects.link(splats)
    except BaseException:
        # What an undo or a purge in a break has taken is gone; of that `batch_remove` makes Blender crash.
        for blocks, block in ((bpy.data.objects, splats), (bpy.data.pointclouds, data)):
            with suppress(ReferenceError):
                blocks.remove(block)
        raise
    data.update_tag()
    return splats


def rewrite_splats(splats: bpy.types.Object, gaussians: GaussianSet) -> None:
    """Gives the points of a point cloud of splats other values, their own colours and no depth any more.

    Args:
        gaussians: numpy set, as many splats as there are points.
    """
    for attribute, layout, values in _attributes(gaussians, True, None, None):
        _write(splats.data, attribute, values, layout)
    for name in {DEPTH, DENSITY_HERE} & set(splats.data.attributes.keys()):
        splats.data.attributes.remove(splats.data.attributes[name])
    splats.data.pop(COLORS_KEY, None)
    splats.data.update_tag()


def move_cuts(splats: bpy.types.Object, linear: np.ndarray) -> None:
    """Lets planes that cut splats for good, as in the pieces of a broken model, go with splats that are moved.

    Args:
        linear: (3, 3) of that move, without its shift, which heights over a splat's centre do not feel.

    Raises:
        DamagedSplatsError: one of their attributes is of another type; nothing is changed then.
    """
    data, back, moved = splats.data, np.linalg.inv(linear), []
    there = [names for names in zip(NORMALS, HEIGHTS, strict=True) if set(names) <= set(data.attributes.keys())]
    for normal, height in there:
        # Normals are turned by the inverse transpose, n' = L⁻ᵀ n, and shortened to unit length with the heights.
        turned = _read(data, normal, _LAYOUT["scale"]).astype(np.float64) @ back
        length = np.linalg.norm(turned, axis=1)
        length[length == 0] = 1.0
        moved.append((normal, turned / length[:, None], _LAYOUT["scale"]))
        moved.append((height, _read(data, height, _LAYOUT["density"]) / length, _LAYOUT["density"]))
    for name, values, layout in moved:
        _write(data, name, values, layout)


def _attributes(
    gaussians: GaussianSet, view_dependent: bool, surroundings: np.ndarray | None, reach: np.ndarray | None
) -> Iterator[tuple[str, _Layout, np.ndarray]]:
    """Name, layout and values of what a point cloud of splats has, computed one by one."""

    def named(name: str, values: np.ndarray) -> tuple[str, _Layout, np.ndarray]:
        return name, _LAYOUT[name], values

    yield named("position", gaussians.means)
    yield named("scale", gaussians.scales)
    yield named("rotation", gaussians.quats)
    layout = _NATIVE_BASE if draws_splats() else _LAYOUT[_BASE]
    yield _BASE, layout, np.column_stack([gaussians.sh[:, 0], gaussians.opacities])
    yield named("density", gaussians.density)
    yield named("modality", gaussians.modality)
    yield named("radius", gaussians.scales.mean(axis=1))
    around = surrounding_density(gaussians) if surroundings is None else surroundings
    yield named(SURROUNDINGS, np.where(gaussians.modality == Modality.XRAY, around, _NOT_XRAY))
    if reach is not None:
        yield named(REACH, reach)
    yield named(DISPLAY_COLOR, np.column_stack([_own_colors(gaussians.sh[:, 0]), gaussians.opacities]))
    # Most of the memory, so when nothing else is to be computed any more.
    if view_dependent:
        for k in range(1, gaussians.sh.shape[1]):
            yield f"radiance:sh_{k - 1}", _LAYOUT["scale"], gaussians.sh[:, k]


def read_splats(splats: bpy.types.Object) -> GaussianSet:
    """The GaussianSet of a point cloud made by `create_splats`, in the object's own frame (mm).

    Raises:
        DamagedSplatsError: names the attribute that is missing, or is of another type.
    """
    return run_through(read_in_steps(splats))


def read_in_steps(splats: bpy.types.Object) -> Generator[float, None, GaussianSet]:
    """As `read_splats`, with a break before each attribute that tells the share that is done, 0 to 1.

    Raises:
        ReferenceError: in a break splats were edited, or an undo has taken them away.
    """
    data = splats.data
    harmonics = sum(name.startswith("radiance:sh_") for name in data.attributes.keys())  # noqa: SIM118
    # Where some are missing the first of them is to be named.
    rest = next((full for full in _FULL_DEGREES if full >= harmonics), harmonics)
    base = _read_base(data)
    sh = np.zeros((len(base), 1 + rest, 3), np.float32)
    sh[:, 0] = base[:, :3]
    names = ("position", "rotation", "scale", "density", "modality", *(f"radiance:sh_{k}" for k in range(rest)))
    found: dict[str, np.ndarray] = {}

    def read(name: str) -> np.ndarray:
        return _read(data, name, _LAYOUT["scale"] if name.startswith("radiance") else None)

    with watched(data) as may_be_edited:
        for index, name in enumerate(names, start=1):
            yield index / (len(names) + 1)
            if len(data.points) != len(base):
                raise ReferenceError(_OTHERS)
            found[name] = read(name)
        same = not may_be_edited() or (
            np.array_equal(_read_base(data), base, equal_nan=True)
            and all(np.array_equal(read(name), values, equal_nan=True) for name, values in found.items())
        )
    if not same:
        raise ReferenceError(_OTHERS)
    for k in range(rest):
        sh[:, 1 + k] = found[f"radiance:sh_{k}"]
    return GaussianSet(
        means=found["position"],
        quats=found["rotation"],
        scales=found["scale"],
        opacities=base[:, 3].copy(),
        sh=sh,
        density=found["density"],
        modality=found["modality"].astype(np.uint8),
    )


def _read_base(data: bpy.types.PointCloud) -> np.ndarray:
    """(N, 4) colour of degree 0 and opacity, of whichever Blender wrote them."""
    attribute = data.attributes.get(_BASE)
    native = attribute is not None and attribute.data_type == _NATIVE_BASE[0]
    return _read(data, _BASE, _NATIVE_BASE if native else None)


def renew_base(data: bpy.types.PointCloud) -> None:
    """Gives colours of a file from an older Blender the type that Blender's own splats have, where it draws them."""
    attribute, older = data.attributes.get(_BASE), (_LAYOUT[_BASE][0], "POINT")
    if draws_splats() and attribute is not None and (attribute.data_type, attribute.domain) == older:
        _write(data, _BASE, _read_base(data), _NATIVE_BASE)


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


@contextmanager
def unchanged(splats: bpy.types.Object, read: Callable[[bpy.types.Object], GaussianSet]) -> Iterator[GaussianSet]:
    """What `read` reads of splats, for a block of work with breaks in which another window may edit them.

    Raises:
        ReferenceError: at the end of the block, if what it was made of has changed.
    """
    data = splats.data
    with watched(data) as may_be_edited:
        before = read(splats)
        yield before
        same = len(data.points) == len(before)
        if same and may_be_edited():
            now = read(splats)
            names = (field.name for field in fields(before))
            same = all(np.array_equal(getattr(now, name), getattr(before, name), equal_nan=True) for name in names)
        if not same:
            raise ReferenceError(_OTHERS)


def stored_splats(splats: bpy.types.Object, indices: Iterable[int]) -> list[float] | None:
    """Where some splats are and how dense, four numbers each as they are stored: a few of a million take no time.

    None where that is no longer there, or is something else.
    """
    attributes = splats.data.attributes
    position, density = attributes.get("position"), attributes.get("density")
    if position is None or density is None or (density.data_type, density.domain) != ("FLOAT", "POINT"):
        return None
    return [number for i in indices for number in (*position.data[i].vector, density.data[i].value)]


def some_splats(splats: bpy.types.Object) -> list[float]:
    """How many splats there are, and a few of them as they are stored: other numbers where some were deleted, or all
    moved. For panels, which ask each time that they are drawn."""
    count = len(splats.data.points)
    some = stored_splats(splats, np.linspace(0, count - 1, min(count, _LOOKED_AT)).astype(int).tolist())
    return [float(count), *(some or ())]


def show_colors(splats: bpy.types.Object, rgb: np.ndarray | None, made_from: str = "") -> None:
    """Shows splats in linear colours (N, 3), noting what these were made from, or in their own if None.

    Their own stay in `radiance:base`.

    Raises:
        DamagedSplatsError: as `read_splats`.
    """
    base = _read_base(splats.data)
    shown = np.column_stack([_own_colors(base) if rgb is None else rgb, base[:, 3]])
    _write(splats.data, DISPLAY_COLOR, shown, _LAYOUT[DISPLAY_COLOR])
    splats.data.pop(COLORS_KEY, None)
    if rgb is not None:
        splats.data[COLORS_KEY] = made_from
    splats.data.update_tag()


def read_values(splats: bpy.types.Object, name: str) -> np.ndarray | None:
    """One of the attributes above, (N,) where it holds a number a splat; None where the splats do not have it."""
    return _read(splats.data, name) if name in splats.data.attributes else None


def write_values(splats: bpy.types.Object, name: str, values: np.ndarray) -> None:
    """Gives splats (N,) values of such an attribute."""
    _write(splats.data, name, values, _LAYOUT[name])


def is_splats(candidate: bpy.types.Object | None) -> bool:
    """Whether an object is a point cloud of splats that this module reads."""
    return (
        candidate is not None
        and candidate.type == "POINTCLOUD"
        and all(name in candidate.data.attributes for name in ("scale", "rotation", "density", _BASE))
    )


def in_scene(candidate: bpy.types.Object | None, scene: bpy.types.Scene) -> bool:
    """Whether an object can be seen in a scene; one that the user deletes lives on where a property points at it."""
    if candidate is None:
        return False
    found = scene.objects.get(candidate.name)
    # A linked file may bring another object of this name.
    return found == candidate or (found is not None and candidate in scene.objects[:])


def shown_model(scene: bpy.types.Scene) -> bpy.types.Object | None:
    """The scene's model, unless it is none of splats or was deleted by hand."""
    model = scene.insideout.model
    return model if is_splats(model) and in_scene(model, scene) else None


def require_own(block: bpy.types.Object | bpy.types.PointCloud) -> None:
    """Raises SettingError for a model, or its splats, of another file: when this one is opened again, what was kept on
    them is gone. Of a library override Blender keeps what it shows, but none of our properties."""
    if block.override_library is not None:
        raise _linked(block)
    require_editable(block)


def require_editable(block: bpy.types.Object | bpy.types.PointCloud) -> None:
    """Raises SettingError as `require_own`, but library overrides will do."""
    if not block.is_editable:
        raise _linked(block)


def _linked(block: bpy.types.Object | bpy.types.PointCloud) -> SettingError:
    return SettingError(
        "{model} is linked from another file; make it local first (Object > Relations > Make Local).", model=block.name
    )


def shows_density(model: bpy.types.Object) -> bool:
    """Whether there is any density to show: not in a model of photos alone."""
    return bool(model.get(_DENSITY_KEY, True))


def _own_colors(base: np.ndarray) -> np.ndarray:
    """(N, 3) linear colours of coefficients of degree 0 (N, 3 or more), such as `radiance:base`."""
    return srgb_to_linear(sh_to_rgb(base[:, :3]))


def _point_cloud(means: np.ndarray, name: str, context: bpy.types.Context) -> bpy.types.Object:
    """An object of as many points, before Blender 5.2 in the active collection."""
    data = bpy.data.pointclouds.new(name)
    if hasattr(data, "resize"):
        data.resize(len(means))
        return bpy.data.objects.new(name, data)
    # Its size it gets only by conversion from a mesh, which is an operator's work on an object in the scene.
    bpy.data.pointclouds.remove(data)
    mesh = bpy.data.meshes.new(name)
    mesh.vertices.add(len(means))
    # Blender 5.0 keeps the bounding box that it finds when it converts.
    mesh.vertices.foreach_set("co", np.ascontiguousarray(means, np.float32).ravel())
    splats = bpy.data.objects.new(name, mesh)
    try:
        open_collection(context).objects.link(splats)
        _convert(splats, context)
    except BaseException:
        bpy.data.objects.remove(splats)
        raise
    finally:
        if mesh.users == 0:
            bpy.data.meshes.remove(mesh)
    splats.data.name = name
    return splats


def _convert(splats: bpy.types.Object, context: bpy.types.Context) -> None:
    """Makes a point cloud of a mesh object; what is active and selected stays so."""
    things = context.view_layer.objects
    # Without a window, as in a timer, the context has no `selected_objects`.
    active, selected = things.active, set(things.selected)
    with context.temp_override(
        active_object=splats, object=splats, selected_objects=[splats], selected_editable_objects=[splats]
    ):
        try:
            for other in things:
                other.select_set(other == splats)
            things.active = splats
            bpy.ops.object.convert(target="POINTCLOUD")
        finally:
            for other in things:
                other.select_set(other in selected)
            things.active = active


def _write(data: bpy.types.PointCloud, name: str, values: np.ndarray, layout: _Layout) -> None:
    kind, field, _ = layout
    attribute = data.attributes.get(name)
    if attribute is not None and attribute.data_type != kind:
        data.attributes.remove(attribute)
        attribute = None
    if attribute is None:
        attribute = data.attributes.new(name, kind, "POINT")
    dtype = np.int8 if kind == "INT8" else np.float32
    attribute.data.foreach_set(field, np.ascontiguousarray(values, dtype).ravel())


def _read(data: bpy.types.PointCloud, name: str, layout: _Layout | None = None) -> np.ndarray:
    kind, field, width = layout or _LAYOUT[name]
    attribute = data.attributes.get(name)
    if attribute is None or attribute.domain != "POINT":
        raise DamagedSplatsError(
            "{model}: has lost the attribute '{attribute}' of its points; undo what removed it, or import it again.",
            model=data.name,
            attribute=name,
        )
    if attribute.data_type != kind:
        raise DamagedSplatsError(
            "{model}: the attribute '{attribute}' is of the type {found} where splats have {expected}; "
            "undo what changed it, or import it again.",
            model=data.name,
            attribute=name,
            found=attribute.data_type,
            expected=kind,
        )
    dtype = np.int8 if kind == "INT8" else np.float32
    values = np.empty(len(attribute.data) * width, dtype)
    attribute.data.foreach_get(field, values)
    return values.reshape(-1, width) if width > 1 else values
