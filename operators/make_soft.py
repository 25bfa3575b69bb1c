"""Makes the whole model one soft body."""

from __future__ import annotations

from collections.abc import Generator

import bpy
from bpy.app.translations import pgettext_rpt as rpt_
from bpy.props import BoolProperty, FloatProperty, IntProperty

from ..core.errors import InsideOutError
from ..core.mesh.weight import mass_text
from ..insideout_addon.error_text import sentence
from ..insideout_addon.physics.cage import FEWEST, MOST
from ..insideout_addon.physics.masses import G_CM3_PER_MM_INV
from ..insideout_addon.physics.soft import SoftOptions, make_soft_in_steps
from ..insideout_addon.physics.whole import mass_calibration
from ..insideout_addon.scene.splats import shown_model
from ..insideout_addon.scene.weighing import MASS_KEY
from .needs import NeedsDensity, chosen_density_factor, draw_density_factor
from .waiting import AskedInSteps


class INSIDEOUT_OT_make_soft(NeedsDensity, AskedInSteps, bpy.types.Operator):
    """Make the model soft: a cage of springs with masses from its density, stiffer where denser, bends the splats"""

    bl_idname = "insideout.make_soft"
    bl_label = "Make Soft..."
    bl_options = {"UNDO", "PRESET"}  # noqa: RUF012

    stiffness_kpa: FloatProperty(
        name="Stiffness (kPa)",
        description="Young's modulus of the model's typical material: 10 is jelly, 1000 rubber; denser is stiffer",
        default=SoftOptions.stiffness_kpa,
        min=0.1,
        max=1e5,
        soft_max=1000.0,
    )
    resolution: IntProperty(
        name="Resolution",
        description="Boxes of the cage along the model's longest side; time grows with its third power and more",
        default=SoftOptions.resolution,
        min=FEWEST,
        max=MOST,
        soft_max=16,
    )
    slow_motion: FloatProperty(
        name="Slow Motion",
        description="How many times slower than in reality; small soft things wobble faster than frames follow",
        default=SoftOptions.slow_motion,
        min=1.0,
        max=1000.0,
        soft_max=20.0,
    )
    # One scan's, as its water is: no preset's, and not as in the call before.
    density_factor: FloatProperty(
        name="g/cm³ per mm⁻¹",
        description="Mass density of an attenuation of 1, where the model was not weighed; by default water's",
        default=G_CM3_PER_MM_INV,
        min=1e-6,
        options={"SKIP_SAVE"},
    )
    use_floor: BoolProperty(name="Floor", description="Add a floor if there is nothing to fall onto", default=True)
    drop_mm: FloatProperty(
        name="Drop (mm)", description="How far the floor is below the model", default=SoftOptions.drop_mm, min=0.0
    )

    def ask(self, context: bpy.types.Context) -> set[str]:
        self.density_factor = chosen_density_factor(self, context)
        return context.window_manager.invoke_props_dialog(self, confirm_text="Make Soft")

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        for name in ("stiffness_kpa", "resolution", "slow_motion"):
            layout.prop(self, name)
        draw_density_factor(layout, self, context)
        layout.prop(self, "use_floor")
        row = layout.row()
        row.active = self.use_floor
        row.prop(self, "drop_mm")

    def steps(self, context: bpy.types.Context) -> Generator[float, None, set[str]]:
        model, scene, factor = shown_model(context.scene), context.scene, chosen_density_factor(self, context)
        options = SoftOptions(
            stiffness_kpa=self.stiffness_kpa,
            resolution=self.resolution,
            slow_motion=self.slow_motion,
            g_cm3_per_mm_inv=factor,
            floor=self.use_floor,
            drop_mm=self.drop_mm,
        )
        try:
            cage = yield from make_soft_in_steps(model, context, options)
        except (InsideOutError, OSError) as error:
            self.report({"ERROR"}, sentence(error))
            return {"CANCELLED"}
        told = rpt_("{name}: {mass} {calibration}; play to see it bend")
        calibration = mass_calibration(model, scene, factor)
        self.report({"INFO"}, told.format(name=cage.name, mass=mass_text(cage[MASS_KEY]), calibration=calibration))
        return {"FINISHED"}


CLASSES = (INSIDEOUT_OT_make_soft,)
