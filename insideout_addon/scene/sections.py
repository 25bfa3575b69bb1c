"""Sections made and taken away: planes and boxes that the user moves like any object."""

from __future__ import annotations

import bpy
import numpy as np
from mathutils import Matrix, Vector

from ...core.errors import SettingError
from ...core.gaussians import GaussianSet
from .color_bar import BOX_BAR_KEY, REACH_KEY
from .color_bar import NAME as COLOR_BAR
from .following import read_shown_density
from .section import SIZE_KEY, automatic_window, model_box, shown_planes, shown_sections, turned_box
from .section_beside import NAME as BESIDE
from .section_box import NAME as BOX_FACES
from .section_cut import apply_cuts
from .section_face import NAME, hide_from_light
from .section_faces import plane_mesh
from .section_picture import draw_picture, forget_scan_unless_shown
from .splats import shows_density

BOX_NAME = "InsideOut Box"
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
    _check_own(model)
    gaussians = read_shown_density(model)
    place, turn, scale = model.matrix_world.decompose()
    box = turned_box(gaussians, turn)
    facing = len(shown_planes(context.scene)) % len(_FACINGS)
    size = _SIZE * float((box[1] - box[0]).max())
    plane = bpy.data.objects.new(NAME, plane_mesh(NAME, size))
    plane[SIZE_KEY] = size
    plane[REACH_KEY] = 0.5 * float((box[1] - box[0])[(0, 1, 0)[facing]])
    middle = Matrix.Translation(Vector(box.mean(axis=0)))
    # The front of the world: a model of photos alone is turned upright.
    plane.matrix_world = Matrix.LocRotScale(place, None, scale) @ middle @ _FACINGS[facing].to_4x4()
    plane.show_wire = True
    hide_from_light(plane)
    unknown = _window_is_unknown(context.scene)
    section = _add(plane, "PLANE", model, context)
    if unknown:
        _find_window(context.scene, model, gaussians)
    draw_picture(context.scene, section)
    return plane


def add_section_box(model: bpy.types.Object, context: bpy.types.Context) -> bpy.types.Object:
    """A further box, chosen as the scene's section: it takes the front left upper eighth out of the model.

    Raises:
        SettingError, DamagedSplatsError: as `add_section_plane`.
    """
    _check_own(model)
    gaussians = read_shown_density(model)
    place, turn, scale = model.matrix_world.decompose()
    low, high = turned_box(gaussians, turn)
    middle, beyond = 0.5 * (low + high), _BEYOND * (high - low)
    near = np.array([low[0] - beyond[0], low[1] - beyond[1], middle[2]])
    far = np.array([middle[0], middle[1], high[2] + beyond[2]])
    box = bpy.data.objects.new(BOX_NAME, None)
    box.empty_display_type, box.empty_display_size = "CUBE", 1.0
    center = 0.5 * (near + far)
    box[BOX_BAR_KEY] = [_SIZE * float((high - low).max()), float((high - center)[0]), float((middle - center)[2])]
    inside = Matrix.LocRotScale(Vector(center), None, Vector(0.5 * (far - near)))
    box.matrix_world = Matrix.LocRotScale(place, None, scale) @ inside
    unknown = _window_is_unknown(context.scene)
    section = _add(box, "BOX", model, context)
    section.flip = True
    if unknown:
        _find_window(context.scene, model, gaussians)
    draw_picture(context.scene, section)
    return box


def remove_section(scene: bpy.types.Scene, section: bpy.types.PropertyGroup) -> None:
    """Takes a plane or box, its colour bar, what is beside it and its cut away, whatever of them there is."""
    settings, thing = scene.insideout, section.object
    index = list(settings.sections).index(section)
    settings.sections.remove(index)
    chosen = settings.section_index - (index < settings.section_index)
    settings.section_index = max(min(chosen, len(settings.sections) - 1), 0)
    names = (COLOR_BAR, BESIDE, BOX_FACES)
    parts = [part for part in scene.objects if part.name.startswith(names) and part.parent in (None, thing)]
    for part in [*parts, thing]:
        # What other scenes show too stays there.
        if part is not None and set(part.users_scene) <= {scene}:
            bpy.data.objects.remove(part)
    apply_cuts(scene)
    forget_scan_unless_shown()
    for other in shown_sections(scene):
        draw_picture(scene, other)


def remove_sections(scene: bpy.types.Scene) -> None:
    """Makes the model whole again."""
    while len(scene.insideout.sections):
        remove_section(scene, scene.insideout.sections[0])


def _check_own(model: bpy.types.Object) -> None:
    if not model.is_editable:
        raise SettingError(
            f"{model.name}: is linked from another file and cannot be cut here; "
            "make it local, or a library override, first (Object > Library Override > Make)."
        )


def _window_is_unknown(scene: bpy.types.Scene) -> bool:
    """Before the first section; also where older files have boxes, which had no pictures."""
    return not shown_sections(scene) or not scene.insideout.is_property_set("high")


def _find_window(scene: bpy.types.Scene, model: bpy.types.Object, gaussians: GaussianSet) -> None:
    # Photos alone have no density to find a window of, and would leave a made-up one to the next model.
    if shows_density(model):
        window = automatic_window(gaussians, model_box(gaussians))
        scene.insideout.low, scene.insideout.high = window.low, window.high


def _add(
    thing: bpy.types.Object, shape: str, model: bpy.types.Object, context: bpy.types.Context
) -> bpy.types.PropertyGroup:
    scene = context.scene
    context.collection.objects.link(thing)
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
    return section
