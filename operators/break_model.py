"""Breaks the model into rigid bodies."""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path

import bpy
from bpy.app.translations import pgettext_rpt as rpt_
from bpy.props import BoolProperty, EnumProperty, FloatProperty, FloatVectorProperty, IntProperty, StringProperty

from ..core.errors import InsideOutError, SettingError
from ..core.mesh.weight import mass_text
from ..insideout_addon.error_text import sentence
from ..insideout_addon.physics.breaking import BreakOptions, break_in_steps
from ..insideout_addon.physics.intersect import has_manifold
from ..insideout_addon.physics.masses import G_CM3_PER_MM_INV
from ..insideout_addon.physics.whole import WHOLE_MESH, mass_calibration, mesh_is_of_other_splats
from ..insideout_addon.scene.splats import shown_model
from ..insideout_addon.scene.standing import place_in_world
from ..insideout_addon.scene.weighing import MASS_KEY
from .needs import NeedsDensity, chosen_density_factor, draw_density_factor
from .waiting import AskedInSteps

_WAYS = (
    ("RANDOM", "Random", "Voronoi cells around random places in the material"),
    ("PLANES", "Along Sections", "The parts on all sides of the scene's section planes"),
)
_SHOWN = (
    ("MESH", "Mesh", "Surfaces colored from the photos, broken faces from the inside"),
    ("SPLATS", "Splats", "The model's splats, cut at the broken faces"),
)


class INSIDEOUT_OT_break_model(NeedsDensity, AskedInSteps, bpy.types.Operator):
    """Break the model into closed pieces, each a rigid body with its own mass; the model itself is only hidden"""

    bl_idname = "insideout.break_model"
    bl_label = "Break..."
    bl_options = {"UNDO", "PRESET"}  # noqa: RUF012

    _has_manifold = True

    way: EnumProperty(name="Break", description="Where the model breaks", items=_WAYS)
    pieces: IntProperty(
        name="Pieces",
        description="Cells; where one holds several solids there are more pieces",
        default=12,
        min=2,
        max=500,
    )
    seed: IntProperty(name="Seed", description="Another number, other pieces", default=0, min=0)
    use_impact: BoolProperty(name="Impact", description="Smaller pieces around a point")
    # This and the mesh are one model's, no preset's.
    impact: FloatVectorProperty(
        name="Impact (mm)", description="In the model's own frame", size=3, options={"SKIP_PRESET"}
    )
    show: EnumProperty(name="Show", description="What the pieces are made of", items=_SHOWN)
    # One scan's, as its water is: no preset's, and not as in the call before.
    density_factor: FloatProperty(
        name="g/cm³ per mm⁻¹",
        description="Mass density of an attenuation of 1, where the model was not weighed; by default water's",
        default=G_CM3_PER_MM_INV,
        min=1e-6,
        options={"SKIP_SAVE"},
    )
    detail_mm: FloatProperty(
        name="Detail (mm)", description="Fineness of the broken faces' colors; 0 is automatic", default=0.0, min=0.0
    )
    low: FloatProperty(name="Low (mm⁻¹)", description="Density shown darkest on broken faces", precision=4)
    high: FloatProperty(
        name="High (mm⁻¹)", description="Density shown brightest on broken faces; 0 is automatic", min=0.0, precision=4
    )
    use_floor: BoolProperty(name="Floor", description="Add a floor if there is nothing to fall onto", default=True)
    drop_mm: FloatProperty(name="Drop (mm)", description="How far the floor is below the model", default=50.0, min=0.0)
    mesh: StringProperty(
        name="Mesh",
        description="A closed .glb in the model's frame; empty: the run's",
        subtype="FILE_PATH",
        options={"PATH_SUPPORTS_BLEND_RELATIVE", "SKIP_PRESET"},
    )

    def ask(self, context: bpy.types.Context) -> set[str]:
        model = shown_model(context.scene)
        self.density_factor = chosen_density_factor(self, context)
        self.impact = place_in_world(model).inverted_safe() @ context.scene.cursor.location
        # Found out here: while it draws, an operator may make nothing.
        self._has_manifold = has_manifold()
        return context.window_manager.invoke_props_dialog(self, width=400, confirm_text="Break")

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.row().prop(self, "way", expand=True)
        if self.way == "RANDOM":
            layout.prop(self, "pieces")
            layout.prop(self, "seed")
            layout.prop(self, "use_impact", text="Smaller at the 3D Cursor")
        layout.row().prop(self, "show", expand=True)
        draw_density_factor(layout, self, context)
        layout.prop(self, "use_floor")
        row = layout.row()
        row.active = self.use_floor
        row.prop(self, "drop_mm")
        if not self._has_manifold:
            column = layout.column(align=True)
            column.label(text="This Blender was built without the library manifold:", icon="ERROR")
            column.label(text="breaking takes minutes here, and often fails in the end;", icon="BLANK1")
            column.label(text="use a Blender from blender.org", icon="BLANK1")

    def steps(self, context: bpy.types.Context) -> Generator[float, None, set[str]]:
        model, scene, factor = shown_model(context.scene), context.scene, chosen_density_factor(self, context)
        try:
            options = BreakOptions(
                pieces=self.pieces,
                seed=self.seed,
                impact_mm=tuple(self.impact) if self.use_impact else None,
                along_planes=self.way == "PLANES",
                g_cm3_per_mm_inv=factor,
                spacing_mm=self.detail_mm,
                window=self._window(),
                show=self.show,
                floor=self.use_floor,
                drop_mm=self.drop_mm,
                mesh=Path(bpy.path.abspath(self.mesh)) if self.mesh else None,
            )
            pieces = yield from break_in_steps(model, context, options)
        except (InsideOutError, OSError) as error:
            self.report({"ERROR"}, sentence(error))
            return {"CANCELLED"}
        if not options.mesh and mesh_is_of_other_splats(model):
            self.report({"WARNING"}, WHOLE_MESH)
        total = mass_text(sum(piece[MASS_KEY] for piece in pieces))
        told = rpt_("{count} pieces, {mass} together {calibration}; play to see them fall")
        calibration = mass_calibration(model, scene, factor)
        self.report({"INFO"}, told.format(count=len(pieces), mass=total, calibration=calibration))
        return {"FINISHED"}

    def _window(self) -> tuple[float, float] | None:
        """What is shown darkest and brightest on broken faces; None for automatic."""
        if self.high == 0:
            return None
        if self.low >= self.high:
            raise SettingError(
                "Low ({low:g} mm⁻¹) is not below High ({high:g} mm⁻¹); lower it, or give 0 as High, which chooses "
                "both.",
                low=self.low,
                high=self.high,
            )
        return self.low, self.high


CLASSES = (INSIDEOUT_OT_break_model,)
