"""The scene's sections: which there are, where they lie in the model, and the density on a plane."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace

import bpy
import numpy as np
from mathutils import Matrix, Quaternion, Vector

from ...core.errors import InsideOutError, SettingError
from ...core.gaussians import GaussianSet
from ...core.render.section_numpy import CUTOFF_SIGMAS, SectionSplats, section_in_steps
from ...core.steps import part_of_work, run_through
from ...core.views import Plane
from .framing import without_background
from .kept_splats import kept_splats
from .section_image import Window
from .section_position import Position
from .splats import in_scene, shown_model
from .standing import place_in_world, put_in_world

# On each plane: the length of its sides in its own frame, mm.
SIZE_KEY = "insideout_size_mm"
# On each scene, and on the splats that it was found in: the ends of the window that was found for it, mm⁻¹.
_FOUND_KEY = "insideout_found_window"
_FEWEST, _NOTHING = 8, 1e-9
# Share of a section that is done when the splats are known, and of the box that is when its ends are found.
_KNOWN, _ENDS = 0.3, 0.7
# Cosine between a plane's rows and columns from which lengths and areas on it are wrong by more than rounding.
_SKEWED = 1e-3
# Sine from which a normal is upright but for rounding.
_LEVEL = 1e-6


class NoSectionError(InsideOutError, ValueError):
    """There is nothing to sample; the message tells the user what is missing."""


@dataclass(frozen=True, eq=False)
class Known:
    """Densities on planes that were worked out before they are drawn.

    Attributes:
        splats: whose they are.
        values: planes, each with its (height, width) mm⁻¹.
    """

    splats: SectionSplats
    values: Sequence[tuple[Plane, np.ndarray]]

    def on(self, view: Plane, splats: SectionSplats) -> np.ndarray | None:
        """Those on a plane, if it is one of them and the splats are still these."""
        same = (values for plane, values in self.values if splats is self.splats and _is_same(plane, view))
        return next(same, None)


def _is_same(one: Plane, other: Plane) -> bool:
    sizes = (one.width, one.height, one.thickness_mm) == (other.width, other.height, other.thickness_mm)
    return sizes and all(np.array_equal(getattr(one, name), getattr(other, name)) for name in ("origin", "u", "v"))


def shown_sections(scene: bpy.types.Scene) -> list[bpy.types.PropertyGroup]:
    """The scene's sections, without those whose plane or box was deleted by hand."""
    return [section for section in scene.insideout.sections if in_scene(section.object, scene)]


def shown_planes(scene: bpy.types.Scene) -> list[bpy.types.PropertyGroup]:
    """The scene's sections by planes."""
    return [section for section in shown_sections(scene) if section.shape == "PLANE"]


def active_section(scene: bpy.types.Scene) -> bpy.types.PropertyGroup | None:
    """The section that is chosen in the sidebar; the first one where that was deleted by hand."""
    shown, settings = shown_sections(scene), scene.insideout
    if 0 <= settings.section_index < len(settings.sections):
        chosen = settings.sections[settings.section_index]
        if chosen in shown:
            return chosen
    return shown[0] if shown else None


def shown_plane(scene: bpy.types.Scene) -> bpy.types.Object | None:
    """The plane of the chosen section; the first plane where that is a box."""
    section = active_section(scene)
    if section is not None and section.shape == "PLANE":
        return section.object
    planes = shown_planes(scene)
    return planes[0].object if planes else None


def model_box(gaussians: GaussianSet) -> np.ndarray:
    """(2, 3) the box of the object; its background and stray splats (half a percent at each end) do not count."""
    return run_through(box_in_steps(gaussians))


def turned_box(gaussians: GaussianSet, turn: Quaternion) -> np.ndarray:
    """(2, 3) `model_box` of a model that is turned about its origin."""
    return run_through(box_in_steps(gaussians, turn))


def box_in_steps(gaussians: GaussianSet, turn: Quaternion | None = None) -> Generator[float, None, np.ndarray]:
    """As `model_box`, or `turned_box`, with breaks that tell the share that is done, 0 to 1."""
    yield 0.0
    if turn is not None:
        gaussians = replace(gaussians, means=gaussians.means @ np.array(turn.to_matrix(), np.float32).T)
    gaussians = without_background(gaussians)
    # One that is nowhere, or of no size, would leave no box at all.
    known = np.isfinite(gaussians.means.sum(axis=1) + gaussians.scales.sum(axis=1))
    gaussians = gaussians if known.all() else gaussians.select(known)
    if len(gaussians) == 0:
        return np.array([[-1.0] * 3, [1.0] * 3])
    ends = np.empty((2, 3))
    for axis in range(3):
        yield _ENDS * (axis + 1) / 4
        ends[:, axis] = np.percentile(gaussians.means[:, axis], [0.5, 99.5])
    yield _ENDS
    return ends + np.array([[-1.0], [1.0]]) * np.median(gaussians.scales)


def place_plane(
    scene: bpy.types.Scene, position: Sequence[float] | None = None, normal: Sequence[float] | None = None
) -> None:
    """Moves the chosen section plane; what is None stays.

    Args:
        position: (3,) mm in the model's frame, the middle of the plane.
        normal: (3,) of any length in the model's frame, towards the side that is hidden; up stays up on the plane.

    Raises:
        SettingError: the normal has no direction.
        NoSectionError: there is no model or no plane, or the model is scaled to nothing.
    """
    plane, model = _plane_and_model(scene)
    check_sizes(model)
    frame = place_in_world(model)
    place, turn, scale = (frame.inverted() @ place_in_world(plane)).decompose()
    if normal is not None:
        if not Vector(normal).length > 0:
            raise SettingError("The normal of the section plane is 0 0 0; give it a direction.")
        flipped = any(section.flip for section in shown_planes(scene) if section.object == plane)
        turn = _facing(Vector(normal), flipped)
        if scale.x < 0:
            # Of a mirrored model's plane; right and left change places, so that its normal and up are those asked for.
            scale = Vector((scale.x, -scale.y, -scale.z))
    put_in_world(plane, frame @ Matrix.LocRotScale(place if position is None else position, turn, scale))


def _facing(normal: Vector, flipped: bool) -> Quaternion:
    """Up is up; seen from above or below, where none is, right is right, also from the side that is seen if flipped."""
    if normal.xy.length > _LEVEL * normal.length:
        return normal.to_track_quat("Z", "Y")
    turn = Quaternion() if normal.z > 0 else Quaternion((0.0, 1.0, 0.0, 0.0))
    return turn @ Quaternion((0.0, 0.0, 0.0, 1.0)) if flipped else turn


def plane_position(section: bpy.types.PropertyGroup) -> Position | None:
    """Where the plane of a section lies in its scene's model; None of a box, and where one of the two is missing."""
    plane, model = section.object, shown_model(section.id_data)
    if section.shape != "PLANE" or plane is None or model is None:
        return None
    try:
        return Position.of(section_view(plane, model, _FEWEST))
    except NoSectionError:
        return None


def move_plane(section: bpy.types.PropertyGroup, mm: float) -> None:
    """Moves the plane of a section along its normal to another `Position`, where it has one."""
    position = plane_position(section)
    if position is None:
        return
    plane, model = section.object, shown_model(section.id_data)
    way = place_in_world(model).to_3x3() @ Vector((mm - position.mm) * position.normal)
    put_in_world(plane, Matrix.Translation(way) @ place_in_world(plane))


def automatic_window(gaussians: GaussianSet, box: np.ndarray) -> Window:
    """Densities to show: from 0 to the 99.5th percentile of three coarse sections through the middle."""
    return run_through(window_in_steps(SectionSplats(gaussians), box))


def window_in_steps(splats: SectionSplats, box: np.ndarray) -> Generator[float, None, Window]:
    """As `automatic_window`, with breaks that tell the share that is done, 0 to 1."""
    middle, size = box.mean(axis=0), float((box[1] - box[0]).max())
    pixels, values = 96, []
    axes = np.eye(3) * size / pixels
    for u, v in ((0, 1), (0, 2), (1, 2)):
        origin = middle - 0.5 * pixels * (axes[u] + axes[v])
        sampling = section_in_steps(splats, Plane(origin, axes[u], axes[v], pixels, pixels))
        done = len(values) / 3
        values.append((yield from part_of_work(sampling, done, done + 1 / 3)).ravel())
    found = np.concatenate(values)
    material = found[found > 0.02 * found.max(initial=0.0)]
    return Window(0.0, float(np.percentile(material, 99.5)) if material.size else 0.05)


def use_found_window(settings: bpy.types.PropertyGroup, window: Window, model: bpy.types.Object) -> None:
    """Spans the scene's colours by densities that were found in a model; those of another model may replace them."""
    # First: each end that is set has splats coloured anew, and they would have the window found once more.
    _keep_found(settings, model, [window.low, window.high])
    settings.low, settings.high = window.low, window.high
    _keep_found(settings, model, [settings.low, settings.high])


def _keep_found(settings: bpy.types.PropertyGroup, model: bpy.types.Object, ends: list[float]) -> None:
    model.data[_FOUND_KEY] = settings.id_data[_FOUND_KEY] = ends


def was_found_in(model: bpy.types.Object, scene: bpy.types.Scene) -> bool:
    """Whether the window that a scene has was found in this model."""
    chosen = any(scene.insideout.is_property_set(end) for end in ("low", "high"))
    return chosen and list(scene.get(_FOUND_KEY, (None, None))) == list(model.data.get(_FOUND_KEY, ()))


def has_own_window(settings: bpy.types.PropertyGroup) -> bool:
    """Whether the user has set an end of the window of densities, rather than have it found."""
    found = settings.id_data.get(_FOUND_KEY, (None, None))
    ends = zip(("low", "high"), found, strict=True)
    return any(settings.is_property_set(end) and getattr(settings, end) != value for end, value in ends)


def section_view(plane: bpy.types.Object, model: bpy.types.Object, pixels: int) -> Plane:
    """The section plane in the model's frame (mm), `pixels` along its longer side; pixels are as square as can be.

    Raises:
        NoSectionError: the model or the plane is scaled to nothing.
    """
    check_sizes(model, plane)
    return view_of(place_in_world(model).inverted() @ place_in_world(plane), float(plane[SIZE_KEY]), pixels)


def check_sizes(*things: bpy.types.Object) -> None:
    """Raises NoSectionError for one that is scaled to nothing."""
    for scaled in things:
        if not has_size(scaled):
            raise NoSectionError(
                "{name} is scaled to nothing, so there is no section; give it a size again.", name=scaled.name
            )


def has_size(thing: bpy.types.Object) -> bool:
    """Whether an object is not scaled to nothing along any of its axes."""
    return min(map(abs, place_in_world(thing).to_scale())) >= _NOTHING


def view_of(place: Matrix, size: float, pixels: int) -> Plane:
    """As `section_view`, of a plane with sides of `size` in its own frame, from which `place` leads to the model's."""
    matrix = np.array(place)
    sides = size * np.linalg.norm(matrix[:3, :2], axis=0)
    width, height = (max(round(pixels * side / sides.max()), _FEWEST) for side in sides)
    corner = matrix @ np.array([-0.5 * size, 0.5 * size, 0.0, 1.0])
    return Plane(corner[:3], matrix[:3, 0] * size / width, -matrix[:3, 1] * size / height, width, height)


def sample_section(
    scene: bpy.types.Scene,
    pixels: int | None = None,
    depsgraph: bpy.types.Depsgraph | None = None,
    plane: bpy.types.Object | None = None,
    cutoff_sigmas: float = CUTOFF_SIGMAS,
    known: Known | None = None,
) -> tuple[np.ndarray, Plane]:
    """Densities (height, width) on a section plane, mm⁻¹, and that plane in the model's frame.

    Args:
        pixels: along the longer side; the scene's setting if None.
        depsgraph: whose places of model and plane count, while one is rendered; else what the viewport shows.
        plane: one of the scene's section planes; the chosen one if None.
        cutoff_sigmas: as in `section_density`.
        known: taken where they are of this plane.

    Raises:
        NoSectionError: the scene has no model or no section plane, or one of them no size.
    """
    return run_through(sample_in_steps(scene, pixels, depsgraph, plane, cutoff_sigmas, known))


def sample_in_steps(
    scene: bpy.types.Scene,
    pixels: int | None = None,
    depsgraph: bpy.types.Depsgraph | None = None,
    plane: bpy.types.Object | None = None,
    cutoff_sigmas: float = CUTOFF_SIGMAS,
    known: Known | None = None,
) -> Generator[float, None, tuple[np.ndarray, Plane]]:
    """As `sample_section`, with breaks that tell the share that is done, 0 to 1."""
    plane, model = _plane_and_model(scene, plane)
    evaluated = [thing if depsgraph is None else thing.evaluated_get(depsgraph) for thing in (plane, model)]
    view = section_view(*evaluated, pixels or scene.insideout.pixels)
    splats = yield from part_of_work(kept_splats.of_in_steps(model, depsgraph), 0.0, _KNOWN)
    values = None if known is None else known.on(view, splats)
    if values is None:
        values = yield from part_of_work(section_in_steps(splats, view, cutoff_sigmas), _KNOWN, 1.0)
    return values, view


def section_as_seen(scene: bpy.types.Scene, pixels: int | None = None) -> tuple[np.ndarray, Plane]:
    """`sample_section` of the chosen plane to measure and save: from below where it is flipped, as its face is seen.

    Raises:
        NoSectionError: as `sample_section`.
        SettingError: its rows and columns are not at right angles in the model's frame, so nothing has its size there.
    """
    return run_through(seen_in_steps(scene, pixels))


def seen_in_steps(
    scene: bpy.types.Scene, pixels: int | None = None
) -> Generator[float, None, tuple[np.ndarray, Plane]]:
    """As `section_as_seen`, with breaks that tell the share that is done, 0 to 1."""
    plane, model = _plane_and_model(scene)
    # Before any break: an undo there leaves no references.
    name, flip = model.name, any(section.flip for section in shown_planes(scene) if section.object == plane)
    values, view = yield from sample_in_steps(scene, pixels)
    u, v = (np.asarray(way, np.float64) / np.linalg.norm(way) for way in (view.u, view.v))
    if abs(u @ v) > _SKEWED:
        raise SettingError(
            "{model} is scaled unevenly and the section plane is turned against that, so nothing on it has its "
            "true size; use Object > Apply > Transform to Splats first.",
            model=name,
        )
    if not flip:
        return values, view
    # From the other side right is left.
    right = np.asarray(view.u, np.float64)
    return values[:, ::-1], replace(view, origin=np.asarray(view.origin, np.float64) + view.width * right, u=-right)


def _plane_and_model(
    scene: bpy.types.Scene, plane: bpy.types.Object | None = None
) -> tuple[bpy.types.Object, bpy.types.Object]:
    plane, model = plane or shown_plane(scene), shown_model(scene)
    if plane is None or model is None:
        raise NoSectionError("The scene has no section yet; import a model and press Add Section Plane.")
    return plane, model
