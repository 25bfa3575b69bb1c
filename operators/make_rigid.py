"""Makes the whole model one rigid body."""

from __future__ import annotations

from collections.abc import Generator

import bpy
from bpy.app.translations import pgettext_rpt as rpt_
from bpy.props import BoolProperty, FloatProperty

from ..core.errors import InsideOutError
from ..core.mesh.weight import mass_text
from ..insideout_addon.error_text import sentence
from ..insideout_addon.physics.masses import G_CM3_PER_MM_INV
from ..insideout_addon.physics.whole import WHOLE_MESH, mass_calibration, mesh_is_of_other_splats, rigid_in_steps
from ..insideout_addon.scene.splats import shown_model
from ..insideout_addon.scene.weighing import MASS_KEY
from .needs import NeedsDensity, chosen_density_factor, draw_density_factor
from .waiting import AskedInSteps


class INSIDEOUT_OT_make_rigid(NeedsDensity, AskedInSteps, bpy.types.Operator):
    """Make the model one rigid body with the mass and the center of mass that its density gives"""

    bl_idname = "insideout.make_rigid"
    bl_label = "Make Rigid..."
    bl_options = {"UNDO", "PRESET"}  # noqa: RUF012

    # One scan's, as its water is: no preset's, and not as in the call before.
    density_factor: FloatProperty(
        name="g/cm³ per mm⁻¹",
        description="Mass density of an attenuation of 1, where the model was not weighed; by default water's",
        default=G_CM3_PER_MM_INV,
        min=1e-6,
        options={"SKIP_SAVE"},
    )
    use_floor: BoolProperty(name="Floor", description="Add a floor if there is nothing to fall onto", default=True)
    drop_mm: FloatProperty(name="Drop (mm)", description="How far the floor is below the model", default=50.0, min=0.0)

    def ask(self, context: bpy.types.Context) -> set[str]:
        self.density_factor = chosen_density_factor(self, context)
        return context.window_manager.invoke_props_dialog(self, confirm_text="Make Rigid")

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        draw_density_factor(layout, self, context)
        layout.prop(self, "use_floor")
        row = layout.row()
        row.active = self.use_floor
        row.prop(self, "drop_mm")

    def steps(self, context: bpy.types.Context) -> Generator[float, None, set[str]]:
        model, scene, factor = shown_model(context.scene), context.scene, chosen_density_factor(self, context)
        try:
            body = yield from rigid_in_steps(model, scene, factor, self.use_floor, self.drop_mm)
        except (InsideOutError, OSError) as error:
            self.report({"ERROR"}, sentence(error))
            return {"CANCELLED"}
        if mesh_is_of_other_splats(model):
            self.report({"WARNING"}, WHOLE_MESH)
        told = rpt_("{name}: {mass} {calibration}; play to see it fall")
        calibration = mass_calibration(model, scene, factor)
        self.report({"INFO"}, told.format(name=body.name, mass=mass_text(body[MASS_KEY]), calibration=calibration))
        return {"FINISHED"}


CLASSES = (INSIDEOUT_OT_make_rigid,)
