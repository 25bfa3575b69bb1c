"""Sections made and taken away: planes and boxes that the user moves like any object."""

from __future__ import annotations

from collections.abc import Callable, Generator

import bpy
import numpy as np
from mathutils import Matrix, Vector

from ...core.errors import SettingError
from ...core.steps import run_through
from ...core.views import Plane
from .color_bar import BOX_BAR_KEY, REACH_KEY, bar_parts
from .color_bar import NAME as COLOR_BAR
from .kept_splats import kept_splats
from .leftovers import known_looks, remove_unused_looks, remove_unused_pictures
from .linking import open_collection
from .section import SIZE_KEY, check_sizes, shown_planes, shown_sections, use_found_window, view_of
from .section_beside import NAME as BESIDE
from .section_beside import is_beside_part
from .section_box import NAME as BOX_FACES
from .section_box import face_views, is_box_pictures
from .section_cut import apply_cuts
from .section_face import NAME, hide_from_light
from .section_faces import plane_mesh
from .section_picture import draw_picture, forget_scan_unless_shown, picture_pixels
from .section_survey import Survey, Views, survey_in_steps, window_is_unknown
from .standing import place_in_world

BOX_NAME = "InsideOut Box"
_PART_NAMES = (COLOR_BAR, BESIDE, BOX_FACES)
# Where local z of a plane, its hidden side, points: at the user in the front view first, then left, from where an
# imported model is seen, then up.
_FACINGS = (
    Matrix(((1, 0, 0), (0, 0, -1), (0, 1, 0))),
    Matrix(((0, 0, -1), (-1, 0, 0), (0, 1, 0))),
    Matrix(((1, 0, 0), (0, 1, 0), (0, 0, 1))),
)
# Of a plane, in that of the model.
_SIZE = 1.12
# A box reaches out of the model by this part of it.
_BEYOND = 0.1


def add_section_plane(model: bpy.types.Object, context: bpy.types.Context) -> bpy.types.Object:
    """A further plane half way into the model, chosen as the scene's section.

    The first one faces the front view, the second one is seen from the left, the third one from above.

    Raises:
        SettingError: the model is linked from another file.
        DamagedSplatsError: an attribute is missing, or of another type.
    """
    return run_through(add_plane_in_steps(model, context))


def add_plane_in_steps(model: bpy.types.Object, context: bpy.types.Context) -> Generator[float, None, bpy.types.Object]:
    """As `add_section_plane`, with breaks, in which Blender draws, that tell the share that is done, 0 to 1.

    `context` is asked anew after each. The scene changes only at the end; closed before, nothing stays.

    Raises:
        ReferenceError: in a break the model was taken away, or another scene was chosen.
    """
    return (yield from _add_in_steps(model, context, _plane_views, _new_plane))


def add_section_box(model: bpy.types.Object, context: bpy.types.Context) -> bpy.types.Object:
    """A further box, chosen as the scene's section: it takes the front left upper eighth out of the model.

    Raises:
        SettingError, DamagedSplatsError: as `add_section_plane`.
    """
    return run_through(add_box_in_steps(model, context))


def add_box_in_steps(model: bpy.types.Object, context: bpy.types.Context) -> Generator[float, None, bpy.types.Object]:
    """As `add_section_box`; breaks and errors as those of `add_plane_in_steps`."""
    return (yield from _add_in_steps(model, context, _box_views, _new_box))


def _add_in_steps(
    model: bpy.types.Object,
    context: bpy.types.Context,
    views: Views,
    make: Callable[[Survey, bpy.types.Context], bpy.types.Object],
) -> Generator[float, None, bpy.types.Object]:
    _check_own(model)
    before, scene = known_looks(), context.scene.session_uid
    try:
        survey = yield from survey_in_steps(model, context, views)
        if context.scene.session_uid != scene or context.scene not in survey.model.users_scene:
            raise ReferenceError("another scene is shown, or the model is no longer in it")
        return make(survey, context)
    finally:
        remove_unused_looks(before)


def _plane_at(model: bpy.types.Object, box: np.ndarray, scene: bpy.types.Scene) -> tuple[Matrix, float, float]:
    """Where a new plane comes, the length of its sides, and how far the model reaches to the right on it."""
    frame, box = _upright(model, box)
    facing = len(shown_planes(scene)) % len(_FACINGS)
    middle = Matrix.Translation(Vector(box.mean(axis=0)))
    # The front of the world: a model of photos alone is turned upright.
    matrix = frame @ middle @ _FACINGS[facing].to_4x4()
    return matrix, _SIZE * float((box[1] - box[0]).max()), 0.5 * float((box[1] - box[0])[(0, 1, 0)[facing]])


def _plane_views(model: bpy.types.Object, box: np.ndarray, scene: bpy.types.Scene) -> list[Plane]:
    check_sizes(model)
    matrix, size, _ = _plane_at(model, box, scene)
    return [view_of(place_in_world(model).inverted() @ _as_kept(matrix), size, picture_pixels(scene, "PLANE"))]


def _new_plane(survey: Survey, context: bpy.types.Context) -> bpy.types.Object:
    model = survey.model
    matrix, size, reach = _plane_at(model, survey.box, context.scene)
    plane = bpy.data.objects.new(NAME, plane_mesh(NAME, size))
    plane[SIZE_KEY], plane[REACH_KEY] = size, reach
    plane.matrix_world = matrix
    plane.show_wire = True
    hide_from_light(plane)
    _add(plane, "PLANE", survey, context)
    return plane


def _box_at(model: bpy.types.Object, box: np.ndarray) -> tuple[Matrix, list[float]]:
    """Where a new box comes, and its `BOX_BAR_KEY`."""
    frame, (low, high) = _upright(model, box)
    middle, beyond = 0.5 * (low + high), _BEYOND * (high - low)
    near = np.array([low[0] - beyond[0], low[1] - beyond[1], middle[2]])
    far = np.array([middle[0], middle[1], high[2] + beyond[2]])
    center = 0.5 * (near + far)
    inside = Matrix.LocRotScale(Vector(center), None, Vector(0.5 * (far - near)))
    bar = [_SIZE * float((high - low).max()), float((high - center)[0]), float((middle - center)[2])]
    return frame @ inside, bar


def _upright(model: bpy.types.Object, box: np.ndarray) -> tuple[Matrix, np.ndarray]:
    """The frame of a model as large and where it is, but not turned, and its box (2, 3) in there.

    A mirrored one's scales are all negative: there its box is, and no plane or box that is mirrored, too.
    """
    place, _, scale = place_in_world(model).decompose()
    size = Vector(map(abs, scale))
    return Matrix.LocRotScale(place, None, size), np.sort(np.sign(scale) * box, axis=0)


def _box_views(model: bpy.types.Object, box: np.ndarray, scene: bpy.types.Scene) -> list[Plane]:
    check_sizes(model)
    matrix, _ = _box_at(model, box)
    return face_views(place_in_world(model).inverted() @ _as_kept(matrix), picture_pixels(scene, "BOX"))


def _new_box(survey: Survey, context: bpy.types.Context) -> bpy.types.Object:
    matrix, bar = _box_at(survey.model, survey.box)
    box = bpy.data.objects.new(BOX_NAME, None)
    box.empty_display_type, box.empty_display_size = "CUBE", 1.0
    box[BOX_BAR_KEY] = bar
    box.matrix_world = matrix
    _add(box, "BOX", survey, context)
    return box


def _as_kept(matrix: Matrix) -> Matrix:
    """A matrix as an object has it that is given it, and keeps a place, a turn and a scale."""
    thing = bpy.data.objects.new(NAME, None)
    try:
        thing.matrix_world = matrix
        return thing.matrix_basis.copy()
    finally:
        bpy.data.objects.remove(thing)


def remove_section(scene: bpy.types.Scene, section: bpy.types.PropertyGroup) -> None:
    """Takes a plane or box, its colour bar, what is beside it and its cut away, whatever of them there is.

    Their meshes, texts, materials and images go with them, but for what else is used.
    """
    settings, thing = scene.insideout, section.object
    index = list(settings.sections).index(section)
    settings.sections.remove(index)
    chosen = settings.section_index - (index < settings.section_index)
    settings.section_index = max(min(chosen, len(settings.sections) - 1), 0)
    parts = [part for part in scene.objects if _is_part(part, thing)]
    # What other scenes show too stays there.
    gone = [part for part in {*parts, thing} - {None} if set(part.users_scene) <= {scene}]
    # Of a plane that a script has removed the mesh is still there.
    known = [data for data in (*bpy.data.meshes, *bpy.data.curves) if data.name.startswith((NAME, *_PART_NAMES))]
    data = {*known, *(part.data for part in gone)} - {None}
    bpy.data.batch_remove(gone)
    bpy.data.batch_remove([each for each in data if each.users == 0 and each.library is None])
    apply_cuts(scene)
    forget_scan_unless_shown()
    for other in shown_sections(scene):
        draw_picture(scene, other)
    for name in (NAME, COLOR_BAR):
        remove_unused_pictures(name)


def _is_part(part: bpy.types.Object, thing: bpy.types.Object | None) -> bool:
    """Whether an object is drawn for a plane or a box, or for one that a script has removed: it stands alone then."""
    if thing is not None and part.parent == thing:
        known = part in bar_parts(thing) or is_beside_part(part) or is_box_pictures(part)
        return known or part.name.startswith(_PART_NAMES)
    # Of those that stand alone one with another name was taken out to be kept.
    return part.parent is None and part.name.startswith(_PART_NAMES)


def remove_sections(scene: bpy.types.Scene) -> None:
    """Makes the model whole again."""
    while len(scene.insideout.sections):
        remove_section(scene, scene.insideout.sections[0])


def _check_own(model: bpy.types.Object) -> None:
    if not model.is_editable:
        raise SettingError(
            "{model}: is linked from another file and cannot be cut here; "
            "make it local, or a library override, first (Object > Library Override > Make).",
            model=model.name,
        )


def _add(thing: bpy.types.Object, shape: str, survey: Survey, context: bpy.types.Context) -> None:
    scene, model = context.scene, survey.model
    unknown = window_is_unknown(scene)
    open_collection(context).objects.link(thing)
    # Lets each frame of an animation have its own section: see `section_live.on_frame_changed`.
    scene.render.use_lock_interface = True
    settings = scene.insideout
    if settings.model != model:
        settings.model = model
    section = settings.sections.add()
    section.object, section.shape = thing, shape
    settings.section_index = len(settings.sections) - 1
    context.view_layer.update()
    apply_cuts(scene)
    if shape == "BOX":
        section.flip = True
    if unknown and survey.window is not None:
        use_found_window(settings, survey.window, model)
    # Else the splats would be read, and the picture drawn, once more.
    with kept_splats.shown_otherwise():
        context.view_layer.update()
    draw_picture(scene, section, known=survey.known)
