"""What of a model is shown, and in which colours: the scene's settings brought to its splats."""

from __future__ import annotations

from collections.abc import Generator
from typing import Any

import bpy
from bpy.app.translations import pgettext_iface as iface_

from ...core.errors import InsideOutError
from ..error_text import error_text
from .coloring import choose_window, color_splats
from .display import display_modifier, renew_display
from .hiding import SHOWN
from .inside import is_looked_into, look_in_steps, look_inside, was_joined
from .kept_splats import kept_splats
from .native import draws_splats
from .node_tree import input_names, modifier_input, set_modifier_input
from .showing import shown_as
from .splats import DEPTH, is_splats, shown_model, shows_density

# `scene.insideout.modalities`, in the order of `core.gaussians.Modality`.
MODALITIES = ("PHOTOS", "XRAY", "CLONES")
# The display's inputs that take something away by what is inside, and the scene's settings for them.
_INSIDE = {
    "Peel": "peel_mm",
    "Layer": "peel_layer_mm",
    "Density From": "peel_density_from",
    "Density To": "peel_density_to",
}
# On splats that the settings have peeled.
_PEELED_KEY = "insideout_peeled"
# The scene's settings of both, besides the window and colours of its sections.
SETTINGS = (*_INSIDE.values(), "modalities", "color_by", "residual_high")


def on_look_changed(settings: bpy.types.PropertyGroup, context: bpy.types.Context) -> None:
    """Property callback of the scene."""
    with kept_splats.outlast(settings.id_data):
        apply_look(settings.id_data)


def apply_look(scene: bpy.types.Scene) -> None:
    """Peels and colours the scene's model as its settings ask for; the one before is whole again, in its own colours.

    What cannot be done is left, and `scene.insideout.look_problem` says why. Models of other scenes stay as they are,
    and so does what was peeled by hand, in the modifier. In a window a model to which splats were joined waits for
    `prepare_in_steps`: Blender would stand still, and nothing could end that.
    """
    settings, model = scene.insideout, shown_model(scene)
    problems = [] if model is None else _apply(model, settings)
    for splats in [thing for thing in scene.objects if is_splats(thing) and thing != model]:
        if not any(shown_model(other) == splats for other in bpy.data.scenes):
            _apply(splats, None)
    problem = " ".join(dict.fromkeys(problems))
    if settings.look_problem != problem:
        settings.look_problem = problem


def is_peeled(settings: bpy.types.PropertyGroup) -> bool:
    """Whether the scene's settings hide a part of the model by what is inside, or by what it is from."""
    return any(getattr(settings, own) for own in _INSIDE.values()) or set(MODALITIES) != set(settings.modalities)


def needs_a_look_inside(model: bpy.types.Object) -> bool:
    """Whether peeling a model by depth or density, and colouring it by density, has to be prepared first."""
    return shows_density(model) and _is_own(model) and (not is_looked_into(model) or was_joined(model))


def prepare_in_steps(model: bpy.types.Object) -> Generator[float, None, None]:
    """Prepares that, with breaks that tell the share that is done; closed before its end it changes nothing.

    Where it was not done, it is done at once with the first setting that needs it.

    Raises:
        SettingError: the model is of photos alone.
        DamagedSplatsError: an attribute is missing, or of another type.
    """
    # Of another file's model the settings say why not.
    if _is_own(model):
        yield from look_in_steps(model)


def show_all(scene: bpy.types.Scene) -> None:
    """Shows all of the model again, in its own colours; what was peeled by hand, in the modifier, too."""
    for name in SETTINGS:
        scene.insideout.property_unset(name)
    model = shown_model(scene)
    display = None if model is None or not model.is_editable else display_modifier(model)
    if display is not None:
        whole = {**dict.fromkeys(_INSIDE, 0.0), **dict.fromkeys(SHOWN, True)}
        # One of an older version hides nothing by these, and stays.
        _set(display, {name: value for name, value in whole.items() if name in input_names(display.node_group)})
    apply_look(scene)


def _apply(splats: bpy.types.Object, settings: bpy.types.PropertyGroup | None) -> list[str]:
    """Why something could not be done, a sentence each."""
    inside = {name: 0.0 if settings is None else getattr(settings, own) for name, own in _INSIDE.items()}
    shown = {name: settings is None or own in settings.modalities for name, own in zip(SHOWN, MODALITIES, strict=True)}
    peels = any(inside.values()) or not all(shown.values())
    if not _is_own(splats):
        if not peels and (settings is None or settings.color_by == "PHOTOS"):
            return []
        told = iface_("{model} is linked from another file; make it local first (Object > Relations > Make Local).")
        return [told.format(model=splats.name)]
    by_density = settings is not None and settings.color_by == "DENSITY"
    problems = []
    if (any(inside.values()) or by_density) and _lost_its_inside(splats):
        told = iface_("Splats were joined to {model}, whose depth is not known yet; press Prepare Peeling.")
        problems.append(told.format(model=splats.name))
        inside, by_density = dict.fromkeys(inside, 0.0), False
        settings = settings if settings is not None and settings.color_by != "DENSITY" else None
    try:
        if any(inside.values()):
            look_inside(splats)
    except InsideOutError as error:
        problems.append(error_text(error))
        inside = dict.fromkeys(inside, 0.0)
    if peels or _PEELED_KEY in splats:
        _peel(splats, {**inside, **shown}, peels)
    try:
        if by_density and shows_density(splats):
            choose_window(splats, settings)
        color_splats(splats, settings)
        other = settings is not None and settings.color_by != "PHOTOS"
        if other and draws_splats() and shown_as(splats) != "ELLIPSOIDS":
            told = iface_("Blender draws splats itself, in their own colors; choose Ellipsoids under Shown as.")
            problems.append(told)
    except InsideOutError as error:
        problems.append(error_text(error))
        color_splats(splats, None)
    return problems


def _lost_its_inside(splats: bpy.types.Object) -> bool:
    return not bpy.app.background and DEPTH in splats.data.attributes and needs_a_look_inside(splats)


def _is_own(splats: bpy.types.Object) -> bool:
    return splats.is_editable and splats.data.is_editable


def _peel(splats: bpy.types.Object, inputs: dict[str, Any], peels: bool) -> None:
    """Sets the display's inputs; one of an older version is renewed first."""
    display = display_modifier(splats)
    if display is None:
        return
    if not input_names(display.node_group) >= set(inputs):
        renew_display(display)
    _set(display, inputs)
    splats.pop(_PEELED_KEY, None)
    if peels:
        splats[_PEELED_KEY] = True


def _set(display: bpy.types.NodesModifier, inputs: dict[str, Any]) -> None:
    for name, value in inputs.items():
        if modifier_input(display, name) != value:
            set_modifier_input(display, name, value)
