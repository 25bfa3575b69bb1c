"""What tools need before they can be used; a greyed-out button says it."""

from __future__ import annotations

import bpy

from ..insideout_addon.engine.job import job_running
from ..insideout_addon.scene.importing import densities_are_relative
from ..insideout_addon.scene.section import shown_plane
from ..insideout_addon.scene.splats import shown_model, shows_density
from ..insideout_addon.scene.weighing import kept_weight
from .waiting import InSteps


class NeedsModel:
    """A model in the scene."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if shown_model(context.scene) is None:
            cls.poll_message_set("Import a model first")
            return False
        return nothing_in_work(cls)


class NeedsDensity:
    """A model that X-rays saw."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        model = shown_model(context.scene)
        if model is None:
            cls.poll_message_set("Import a model first")
            return False
        if not shows_density(model):
            cls.poll_message_set("Photos alone have no density")
            return False
        return nothing_in_work(cls)


class NeedsPlane:
    """A section plane, through a model that X-rays saw if there is one."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if shown_plane(context.scene) is None:
            cls.poll_message_set("Add a section plane first")
            return False
        model = shown_model(context.scene)
        if model is not None and not shows_density(model):
            cls.poll_message_set("Photos alone have no density")
            return False
        return nothing_in_work(cls)


def nothing_in_work(operator: type[bpy.types.Operator]) -> bool:
    """Whether no operator of ours works in steps, in whichever window, as a `poll` says it.

    Another would change what that one works on, or the other way round.
    """
    if any(isinstance(running, InSteps) and running.in_work for running in _modal_operators()):
        operator.poll_message_set("Wait until what is in work is done, or end it with Esc")
        return False
    return True


def _modal_operators() -> list[bpy.types.Operator]:
    """Those that run now, and those whose file browser is open."""
    return [operator for window in bpy.context.window_manager.windows for operator in window.modal_operators]


def engine_is_free(operator: type[bpy.types.Operator]) -> bool:
    """Whether the engine has nothing to do, as a `poll` says it."""
    if job_running():
        operator.poll_message_set("Wait until the engine is done, or cancel it")
        return False
    return True


def is_relative(context: bpy.types.Context) -> bool:
    """Whether the model's densities are grey values that were only scaled, which have no unit."""
    model = shown_model(context.scene)
    return model is not None and densities_are_relative(model)


def draw_density_factor(layout: bpy.types.UILayout, operator: bpy.types.Operator, context: bpy.types.Context) -> None:
    """Asks how heavy a model that was not weighed is."""
    model = shown_model(context.scene)
    if model is None or kept_weight(model) is not None:
        return
    if is_relative(context):
        layout.prop(operator, "density_factor", text="g/cm³ at 1 (relative)")
    else:
        layout.prop(operator, "density_factor")
