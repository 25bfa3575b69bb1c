"""What tools need before they can be used; a greyed-out button says it."""

from __future__ import annotations

import bpy

from ..insideout_addon.engine.job import job_running
from ..insideout_addon.in_work import is_importing, works_in_steps
from ..insideout_addon.physics.whole import water_factor
from ..insideout_addon.scene.importing import densities_are_relative
from ..insideout_addon.scene.section import shown_plane
from ..insideout_addon.scene.splats import shown_model, shows_density
from ..insideout_addon.scene.weighing import kept_weight


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
    """A section plane through a model that X-rays saw."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        model = shown_model(context.scene)
        if model is None:
            cls.poll_message_set("Import a model first")
            return False
        if shown_plane(context.scene) is None:
            cls.poll_message_set("Add a section plane first")
            return False
        if not shows_density(model):
            cls.poll_message_set("Photos alone have no density")
            return False
        return nothing_in_work(cls)


def nothing_in_work(operator: type[bpy.types.Operator]) -> bool:
    """Whether nothing of ours works in steps, in whichever window, as a `poll` says it.

    Another would change what that one works on, or the other way round.
    """
    if works_in_steps():
        operator.poll_message_set("Wait until what is in work is done, or end it with Esc")
        return False
    if is_importing():
        operator.poll_message_set("Wait until the model is imported")
        return False
    return True


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


def chosen_density_factor(operator: bpy.types.Operator, context: bpy.types.Context) -> float:
    """The mass density of an attenuation of 1 that an operator was given, or else water's, g/cm³."""
    if operator.properties.is_property_set("density_factor"):
        return operator.density_factor
    return water_factor(shown_model(context.scene), context.scene)


def draw_density_factor(layout: bpy.types.UILayout, operator: bpy.types.Operator, context: bpy.types.Context) -> None:
    """Asks how heavy a model that was not weighed is."""
    model = shown_model(context.scene)
    if model is None or kept_weight(model) is not None:
        return
    if is_relative(context):
        layout.prop(operator, "density_factor", text="g/cm³ at 1 (relative)")
    else:
        layout.prop(operator, "density_factor")
