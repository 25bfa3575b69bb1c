"""Break: the model in Blender's physics, in pieces or whole, rigid or soft."""

from __future__ import annotations

import bpy
from bpy.app.translations import pgettext_iface as iface_

from ..core.mesh.weight import mass_text
from ..insideout_addon.physics.baking import is_baked
from ..insideout_addon.physics.breaking import pieces_of
from ..insideout_addon.physics.soft_modifier import is_of_other_rate
from ..insideout_addon.physics.whole import WHOLE_MESH, is_taken_apart, mesh_is_of_other_splats
from ..insideout_addon.physics.world import CAGE_KEY, bodies_of, is_left_over, is_simulated
from ..insideout_addon.scene.importing import densities_are_relative
from ..insideout_addon.scene.splats import shown_model, shows_density
from ..insideout_addon.scene.weighing import MASS_KEY, kept_weight
from ..insideout_addon.scene.weight_text import GUESS, mass_is_a_guess
from .layout import SidebarPanel, draw_left_behind, wrapped


class INSIDEOUT_PT_physics(SidebarPanel, bpy.types.Panel):
    bl_label = "Break"
    bl_idname = "INSIDEOUT_PT_physics"
    bl_order = 8
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    def draw(self, context: bpy.types.Context) -> None:
        scene, model = context.scene, shown_model(context.scene)
        apart = model is not None and is_taken_apart(model, scene)
        if model is None:
            wrapped(self.layout, "Import a model first, under Model", context, "INFO")
        elif apart:
            _draw_bodies(self.layout, context, model)
        else:
            _draw_tools(self.layout, context, model)
        if apart or is_left_over(scene):
            self.layout.operator("insideout.unbreak", icon="LOOP_BACK")


def _draw_tools(layout: bpy.types.UILayout, context: bpy.types.Context, model: bpy.types.Object) -> None:
    if not shows_density(model):
        wrapped(layout, "Photos alone have no density, so they have no mass to break", context, "INFO")
        return
    draw_left_behind(layout, model, context)
    if kept_weight(model) is None and densities_are_relative(model):
        wrapped(layout, "Not weighed, and densities are relative: so are masses", context, "INFO")
    elif kept_weight(model) is None:
        wrapped(layout, "Not weighed: what attenuates like water counts as heavy as water", context, "INFO")
    elif mass_is_a_guess(model):
        wrapped(layout, GUESS, context, "ERROR")
    if mesh_is_of_other_splats(model):
        wrapped(layout, WHOLE_MESH, context, "ERROR")
    layout.operator("insideout.break_model", icon="MOD_EXPLODE")
    layout.operator("insideout.make_rigid", icon="RIGID_BODY")
    layout.operator("insideout.make_soft", icon="MOD_SOFT")


def _draw_bodies(layout: bpy.types.UILayout, context: bpy.types.Context, model: bpy.types.Object) -> None:
    bodies, pieces = bodies_of(context.scene, model), pieces_of(context.scene, model)
    masses = [thing[MASS_KEY] for thing in (pieces or bodies) if MASS_KEY in thing]
    if not masses:
        # Deleted by hand; there is a floor at most.
        return
    soft = any(CAGE_KEY in thing for thing in bodies)
    one = iface_("One soft body, {mass}") if soft else iface_("One rigid body, {mass}")
    what = iface_("{count} pieces, {mass}") if pieces else one
    told = what.format(count=len(pieces), mass=mass_text(sum(masses)))
    layout.label(text=told, translate=False, icon="MOD_SOFT" if soft else "RIGID_BODY")
    if any(map(is_simulated, bodies)):
        wrapped(layout, "Play the animation to see it move", context)
        if any(is_of_other_rate(thing, context.scene) for thing in bodies if CAGE_KEY in thing):
            wrapped(
                layout,
                "The frame rate has changed, and the soft body keeps the one of before; "
                "press Back to Whole, then Make Soft again",
                context,
                "ERROR",
            )
        if soft:
            wrapped(layout, "Bake it before you render, or open it in an older Blender", context, "INFO")
        layout.operator("insideout.bake_physics", icon="KEYTYPE_KEYFRAME_VEC")
    elif any(map(is_baked, bodies)):
        layout.label(text="Baked to keyframes", icon="CHECKMARK")


CLASSES = (INSIDEOUT_PT_physics,)
