"""A run's result brought into the scene."""

from __future__ import annotations

import json
import math
from collections.abc import Generator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Euler, Quaternion, Vector

from ...core.capture.volumes import RELATIVE
from ...core.errors import GaussianFileError
from ...core.gaussians import GaussianSet, Modality
from ...core.ply import read_in_steps
from ...core.residual_file import load_residuals
from ...core.steps import part_of_work, run_through
from ..told_text import told_text
from .display import display_in_steps, display_modifier
from .framing import Body, find_body, reach
from .leftovers import known_looks, remove_unused_looks
from .memory import chosen_display
from .node_tree import set_modifier_input
from .placement import millimetre, remember_placement
from .provenance import keep_provenance, provenance_of, read_provenance
from .run_facts import ARBITRARY, MILLIMETRE, RunFacts, read_run_facts
from .section import turned_box
from .showing import show_as
from .sources import SOURCE_KEY, remember_source, run_of, source_name
from .splats import UNIT_KEY, WATER_KEY, create_in_steps, is_splats, shown_model
from .standing import place_in_world
from .startup import adapt_startup, is_startup_cube
from .surroundings import floating_threshold, surrounding_density

# On each model: the unit of its lengths, the warnings of its run a line each, what these are translated by as JSON, the
# radius of the object or 0.
WARNINGS_KEY, BODY_KEY = "insideout_warnings", "insideout_body"
TOLD_KEY = "insideout_warnings_told"
# What the user may have made, by type.
_SHAPES = {"MESH", "CURVE", "SURFACE", "META", "FONT", "CURVES", "POINTCLOUD", "VOLUME", "GREASEPENCIL", "GPENCIL"}
# Where a run may have left a set, the best first.
_CANDIDATES = {
    "fused": ("fused.ply", "fuse/fused.ply"),
    "rgb": ("rgb.ply", "internal/rgb.ply", "align/rgb.ply", "surface/rgb.ply"),
    "xray": ("xray.ply", "internal/xray.ply", "align/xray.ply", "surface/xray.ply"),
}


def find_set(run: Path, which: str) -> Path:
    """The .ply of a run that holds "fused", "rgb" or "xray" as far as the run has got.

    Raises:
        GaussianFileError: the run has none.
    """
    run = Path(run)
    if run.suffix.lower() == ".ply":
        return run
    if not run.exists():
        raise GaussianFileError("{run}: there is no such folder; choose the folder of a run.", run=run)
    if not run.is_dir():
        raise GaussianFileError("{run}: is a file, not a folder; choose the folder of a run.", run=run)
    for name in _CANDIDATES[which]:
        if (run / name).is_file() and _is_current(run / name, run):
            return run / name
    raise GaussianFileError(
        "{run}: holds no {which} splats yet ({file}); choose a finished run, or other splats.",
        run=run,
        which=which,
        file=_CANDIDATES[which][0],
    )


def available_sets(run: Path) -> list[str]:
    """Which of "fused", "rgb" and "xray" a run holds."""
    found = []
    for which in _CANDIDATES:
        # What cannot be read is told where it is imported.
        with suppress(GaussianFileError, OSError):
            find_set(run, which)
            found.append(which)
    return found


def _is_current(path: Path, run: Path) -> bool:
    """Whether what made a set is done: the report beside it is gone while a stage, or the run, is made again."""
    return not (run / "capture.json").exists() or (path.parent / "report.json").exists()


# Shares of the loading that are done when the file is read, then what is around each splat, then where the object is;
# of the placing when the node groups are built; and of the import when what needs no Blender is done.
_READ, _SURROUNDED, _FRAMED, _BUILT, _LOADED = 0.6, 0.8, 0.9, 0.3, 0.5
_FROM_THE_FRONT = Euler((math.radians(75), 0.0, math.radians(-25))).to_quaternion()


@dataclass(eq=False)
class LoadedSplats:
    """What of an import needs no Blender.

    Attributes:
        path: the .ply.
        gaussians: N splats, mm; None once they are placed, see `take`.
        surroundings: (N,) `surrounding_density`, mm⁻¹.
        facts: the unit of lengths, warnings of the run.
        provenance: `read_provenance`.
        body: where the object is if some splats are background.
        turn: brings the model upright.
        box: (2, 3) `turned_box` of the upright model.
        residual: (N,) `load_residuals` of the run that the .ply is of, if it has any.
    """

    path: Path
    gaussians: GaussianSet | None
    surroundings: np.ndarray
    facts: RunFacts
    provenance: dict[str, Any]
    body: Body | None
    turn: Quaternion
    box: np.ndarray
    residual: np.ndarray | None = None

    def take(self) -> GaussianSet:
        """The splats, which are held here no longer: whoever waits for the end of an import would keep them in memory
        while Blender, which has them by then, makes what it shows of them."""
        gaussians, self.gaussians = self.gaussians, None
        assert gaussians is not None, "they are placed once"
        return gaussians


def load_splats(path: Path, view_dependent: bool = True) -> LoadedSplats:
    """Reads a .ply; touches nothing of Blender, so another thread may do it.

    Args:
        view_dependent: whether the view-dependent colour is read, too.

    Raises:
        GaussianFileError: not a .ply of Gaussians, or one without any.
    """
    return run_through(load_in_steps(path, view_dependent))


def load_in_steps(path: Path, view_dependent: bool = True) -> Generator[float, None, LoadedSplats]:
    """As `load_splats`, with breaks that tell the share that is done, 0 to 1."""
    gaussians = yield from part_of_work(read_in_steps(Path(path), view_dependent), 0.0, _READ)
    if len(gaussians) == 0:
        raise GaussianFileError("{path}: holds no splats; choose another file.", path=path)
    facts = read_run_facts(path, gaussians)
    turn = Quaternion() if facts.up is None else Vector(facts.up).rotation_difference(Vector((0.0, 0.0, 1.0)))
    yield _READ
    surroundings = surrounding_density(gaussians)
    yield _SURROUNDED
    provenance, body = read_provenance(Path(path), gaussians, facts.unit), find_body(gaussians)
    yield _FRAMED
    return LoadedSplats(
        path=Path(path),
        gaussians=gaussians,
        surroundings=surroundings,
        facts=facts,
        provenance=provenance,
        body=body,
        turn=turn,
        box=turned_box(gaussians, turn),
        residual=load_residuals(run_of(Path(path)), Path(path), len(gaussians)),
    )


def place_splats(
    loaded: LoadedSplats,
    name: str,
    context: bpy.types.Context,
    display: str = "AUTOMATIC",
    view_dependent: bool = False,
) -> bpy.types.Object:
    """Puts splats into the scene, once: a point cloud that is shown, active and set as the model.

    Not selected: the outlines of all splats would cover their colours.
    """
    return run_through(place_in_steps(loaded, name, context, display, view_dependent))


def place_in_steps(
    loaded: LoadedSplats,
    name: str,
    context: bpy.types.Context,
    display: str = "AUTOMATIC",
    view_dependent: bool = False,
) -> Generator[float, None, bpy.types.Object]:
    """As `place_splats`, with breaks, in which Blender draws, that tell the share that is done, 0 to 1.

    `context` is asked anew after each. The scene changes only at the end; closed before, nothing stays. Some pieces
    cannot be divided: each node group of a file's first display, whose sockets an undo in a break would leave dangling,
    and Blender's evaluation of the new cloud.
    """
    before, gaussians = known_looks(), loaded.take()
    try:
        yield from part_of_work(display_in_steps(), 0.0, _BUILT)
        away = None if loaded.body is None else reach(gaussians, loaded.body.center)
        creating = create_in_steps(gaussians, name, context, view_dependent, loaded.surroundings, away, loaded.residual)
        splats = yield from part_of_work(creating, _BUILT, 1.0)
    except BaseException:
        remove_unused_looks(before)
        raise
    remember_source(splats, loaded.path)
    keep_provenance(splats, loaded.provenance)
    splats[UNIT_KEY], splats[WARNINGS_KEY] = loaded.facts.unit, "\n".join(loaded.facts.warnings)
    splats[TOLD_KEY] = json.dumps(loaded.facts.told)
    splats[BODY_KEY] = 0.0 if loaded.body is None else loaded.body.radius
    modifier = show_as(splats, chosen_display(display, len(gaussians)))
    threshold = floating_threshold(loaded.surroundings, gaussians.modality == Modality.XRAY)
    del gaussians
    set_modifier_input(modifier, "Minimum Density", threshold)
    hide_background(splats, context.scene.insideout.hide_background)
    ours, first = not _holds_others(context.scene), not _holds_further(splats, context.scene)
    if ours and first and loaded.facts.in_mm:
        _use_millimetres(context.scene)
    # An arbitrary unit is none of length; Blender's own is as good.
    unit = millimetre(context.scene) if loaded.facts.in_mm else 1.0
    splats.scale = [unit] * 3
    splats.rotation_euler = loaded.turn.to_euler()
    remember_placement(splats)
    context.view_layer.update()
    if ours:
        if first:
            _show_true_colors(context.scene)
        box = loaded.box * unit
        adapt_startup(context.scene, context.view_layer, box)
        _set_up_views(box, context.scene, first=shown_model(context.scene) is None)
    for other in context.view_layer.objects:
        other.select_set(False)
    context.view_layer.objects.active = splats
    _use_water(context.scene.insideout, splats, loaded.facts.water)
    _uncover(splats, shown_model(context.scene), context.scene)
    context.scene.insideout.model = splats
    return splats


def _uncover(splats: bpy.types.Object, before: bpy.types.Object | None, scene: bpy.types.Scene) -> None:
    """Hides the model before where the same one was made again: in the same place, and not cut any more, it would
    cover what is cut open. One that another scene shows, too, stays there, and is taken out of this one."""
    if before is None or source_name(before) != source_name(splats):
        return
    digest = _digest(splats)
    again = before.get(SOURCE_KEY) == splats.get(SOURCE_KEY) or (digest and digest == _digest(before))
    if not again or not np.allclose(place_in_world(before), place_in_world(splats), rtol=1e-5, atol=1e-6):
        return
    if len(before.users_scene) == 1:
        before.hide_viewport = before.hide_render = True
        return
    elsewhere = {one for other in before.users_scene if other != scene for one in _collections(other)}
    for collection in set(before.users_collection) - elsewhere:
        collection.objects.unlink(before)


def _collections(scene: bpy.types.Scene) -> list[bpy.types.Collection]:
    return [scene.collection, *scene.collection.children_recursive]


def _digest(model: bpy.types.Object) -> str:
    """Of the capture that a model was made from, if it is known."""
    capture = provenance_of(model).get("capture")
    return str(capture.get("digest", "")) if isinstance(capture, dict) else ""


def _use_water(settings: bpy.types.PropertyGroup, splats: bpy.types.Object, water: float | None) -> None:
    """Lets 0 HU be where the model's scan has it, unless the user has set another water than the model before had."""
    before = shown_model(settings.id_data)
    told = 0.0 if before is None else before.get(WATER_KEY, 0.0)
    free = not settings.is_property_set("water") or math.isclose(settings.water, told, rel_tol=1e-5)
    if water is not None:
        splats[WATER_KEY] = water
        if free:
            settings.water = water
    elif free:
        settings.property_unset("water")


def lengths_are_arbitrary(model: bpy.types.Object) -> bool:
    """Whether a model's lengths are in no unit, because no X-ray gave it a scale."""
    return model.get(UNIT_KEY) == ARBITRARY


def warnings_of(model: bpy.types.Object) -> list[str]:
    """What a model's run warned of, in Blender's language where there is a translation."""
    lines = model.get(WARNINGS_KEY, "").splitlines()
    try:
        told = json.loads(model.get(TOLD_KEY, ""))
    except (ValueError, TypeError):
        return lines
    if not isinstance(told, list) or len(told) != len(lines):
        return lines
    return [told_text(one, line) for one, line in zip(told, lines, strict=True)]


def densities_are_relative(model: bpy.types.Object) -> bool:
    """Whether a model's densities are in no unit, because they are of grey values that have none."""
    return RELATIVE in model.get(WARNINGS_KEY, "")


def hide_background(splats: bpy.types.Object, hide: bool) -> None:
    """Hides or shows the splats that are no part of the object, as far as the import told them apart."""
    modifier = display_modifier(splats)
    if modifier is not None and BODY_KEY in splats:
        set_modifier_input(modifier, "Farthest", splats[BODY_KEY] if hide else 0.0)


def import_splats(
    path: Path,
    name: str,
    context: bpy.types.Context,
    display: str = "AUTOMATIC",
    view_dependent: bool = False,
) -> bpy.types.Object:
    """Reads a .ply, then places its splats.

    Raises:
        GaussianFileError: nothing is changed then.
    """
    return run_through(import_in_steps(path, name, context, display, view_dependent))


def import_in_steps(
    path: Path,
    name: str,
    context: bpy.types.Context,
    display: str = "AUTOMATIC",
    view_dependent: bool = False,
) -> Generator[float, None, bpy.types.Object]:
    """As `import_splats`, with breaks that tell the share that is done, 0 to 1; closed before its end nothing stays."""
    loaded = yield from part_of_work(load_in_steps(path, view_dependent), 0.0, _LOADED)
    return (yield from part_of_work(place_in_steps(loaded, name, context, display, view_dependent), _LOADED, 1.0))


def _holds_others(scene: bpy.types.Scene) -> bool:
    """Whether the user has made something in the scene: then units, colours and views are left as they are."""
    return any(
        (thing.type in _SHAPES or thing.instance_collection is not None)
        and not is_splats(thing)
        and not thing.name.startswith("InsideOut")
        and not is_startup_cube(thing)
        for thing in scene.objects
    )


def _holds_further(splats: bpy.types.Object, scene: bpy.types.Scene) -> bool:
    """Whether a model in millimetres is there beside a new one: it stands in the unit and colours of the scene."""
    return any(thing != splats and is_splats(thing) and thing.get(UNIT_KEY) == MILLIMETRE for thing in scene.objects)


def _use_millimetres(scene: bpy.types.Scene) -> None:
    """One unit is a millimetre, unless the user has chosen units already."""
    units = scene.unit_settings
    if units.system == "METRIC" and units.scale_length == 1.0:
        units.scale_length = 0.001
        units.length_unit = "MILLIMETERS"


def _show_true_colors(scene: bpy.types.Scene) -> None:
    """Blender's default view would dull the photos' colours and shift those of the colour bar."""
    if scene.view_settings.view_transform == "AgX":
        scene.view_settings.view_transform = "Standard"


def _set_up_views(box: np.ndarray, scene: bpy.types.Scene, first: bool) -> None:
    """Lets a scene's viewports see all of a model of many units, in colour, and turns them to its first model."""
    extent = float((box[1] - box[0]).max())
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas if window.scene == scene else ():
            if area.type == "VIEW_3D":
                space = area.spaces.active
                # The nearer clipping starts, the coarser depth is where the section lies on the cut.
                space.clip_start = max(space.clip_start, extent / 500)
                # Home shows all of the floor that pieces fall on, from fifty times the model's size away.
                space.clip_end = max(space.clip_end, 100 * extent)
                if space.shading.type == "SOLID":
                    space.shading.type = "MATERIAL"
                if first:
                    # Measured points and their figures belong to the model, and a dashed line to its middle from each
                    # would hide them.
                    space.overlay.show_relationship_lines = False
                if first and space.region_3d.view_perspective != "CAMERA":
                    frame_box(space.region_3d, box)


def frame_box(view: bpy.types.RegionView3D, box: np.ndarray) -> None:
    """Moves a view to see all of a box (2, 3) from the front, a little from above, unless it sees the box already.

    A new Blender looks from 18 units, and a model of 80 mm would be seen from within. Sections face the front: seen
    as it is turned there, they would be slanted.
    """
    center, extent = box.mean(axis=0), float((box[1] - box[0]).max())
    beside = float(np.linalg.norm(np.array(view.view_location) - center))
    if beside > 0.5 * extent or not 1.5 * extent < view.view_distance < 10 * extent:
        view.view_location = center
        view.view_distance = 2.4 * extent
        view.view_rotation = _FROM_THE_FRONT
