"""Weighs the model: mass, centre of mass, inertia, hollows."""

from __future__ import annotations

from collections.abc import Generator

import bpy
from bpy.app.translations import pgettext_n as n_
from bpy.app.translations import pgettext_rpt as rpt_
from bpy_extras.io_utils import ExportHelper

from ..core.capture.volumes import MU_WATER_PER_MM
from ..core.errors import InsideOutError, SettingError
from ..core.mesh.density_map import DensityCurve, curve_of_materials, curve_of_points, curve_of_water
from ..core.mesh.material_table import ENERGIES_KEV, MATERIALS
from ..core.mesh.weight import save_weight
from ..core.render.volume_numpy import MOST_VOXELS
from ..insideout_addon.error_text import error_text, sentence
from ..insideout_addon.scene.section_image import PER_MM, RELATIVE_UNIT
from ..insideout_addon.scene.splats import WATER_KEY, shown_model
from ..insideout_addon.scene.weighing import add_center_marker, kept_weight, water_per_mm, weigh_model_in_steps
from ..insideout_addon.scene.weight_text import GUESS, mass_is_a_guess, weight_text
from ..insideout_addon.told_text import displayable
from .needs import NeedsDensity, is_relative, nothing_in_work
from .saving import FILE_PATH, chosen_file
from .waiting import AskedInSteps

_CALIBRATIONS = (
    (
        "WATER",
        "Water",
        "Density in proportion to attenuation, through water: for tissue and the like, or a first guess",
    ),
    ("POINTS", "Two Points", "The line through two attenuations whose density you know, such as air and one material"),
    ("MATERIALS", "Materials", "Through the materials that the object is made of, at the scan's photon energy"),
)


def _identifier(name: str) -> str:
    return name.upper().replace(" ", "_")


# Blender's texts are American.
_AMERICAN = {"aluminium": "aluminum", "dentine": "dentin"}


def _label(name: str) -> str:
    return " ".join(word[0].upper() + word[1:] for word in _AMERICAN.get(name, name).split())


_MATERIALS = tuple(
    (_identifier(m.name), _label(m.name), f"{m.density_g_cm3:g} g/cm³") for m in MATERIALS if m.name != "air"
)


def _attenuation(name: str, default: float, keep: bool = True) -> bpy.props.FloatProperty:
    return bpy.props.FloatProperty(
        name=name,
        description="Attenuation in mm⁻¹, as a section with this unit shows it",
        default=default,
        min=0.0,
        precision=4,
        options=set() if keep else {"SKIP_SAVE"},
    )


def _density(name: str, default: float) -> bpy.props.FloatProperty:
    return bpy.props.FloatProperty(
        name=name, description="Mass density in g/cm³", default=default, min=0.0, precision=3
    )


class _NeedsWeight:
    """A model that was weighed."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        model = shown_model(context.scene)
        if model is None or kept_weight(model) is None:
            cls.poll_message_set("Weigh the model first")
            return False
        return nothing_in_work(cls)


def _chosen_water(operator: bpy.types.Operator, context: bpy.types.Context) -> float:
    """The attenuation that an operator was given, or else that of the water of the model's scan, mm⁻¹."""
    if operator.properties.is_property_set("water"):
        return operator.water
    return water_per_mm(shown_model(context.scene), context.scene)


class INSIDEOUT_OT_weigh(NeedsDensity, AskedInSteps, bpy.types.Operator):
    """Work out mass, center of mass, inertia and closed cavities from the density inside"""

    bl_idname = "insideout.weigh"
    bl_label = "Weigh..."
    bl_options = {"UNDO", "PRESET"}  # noqa: RUF012

    calibration: bpy.props.EnumProperty(
        name="Calibration", description="By what an attenuation becomes a mass density", items=_CALIBRATIONS
    )
    # One scan's: no preset's, and not as in the call before.
    water: _attenuation("Water (mm⁻¹)", MU_WATER_PER_MM, keep=False)
    first_attenuation: _attenuation("First (mm⁻¹)", 0.0)
    first_density: _density("First (g/cm³)", 0.0)
    second_attenuation: _attenuation("Second (mm⁻¹)", MU_WATER_PER_MM)
    second_density: _density("Second (g/cm³)", 1.0)
    materials: bpy.props.EnumProperty(
        name="Materials", description="What the object is made of", items=_MATERIALS, options={"ENUM_FLAG"}
    )
    energy_kev: bpy.props.FloatProperty(
        name="Energy (keV)",
        description="Effective photon energy of the scan, a third to a half of the tube's kilovolts",
        default=60.0,
        min=ENERGIES_KEV[0],
        max=ENERGIES_KEV[-1],
        precision=1,
    )
    cavities: bpy.props.BoolProperty(name="Cavities", description="Look for closed hollows too", default=True)
    edge: bpy.props.FloatProperty(
        name="Edge (mm⁻¹)",
        description="What attenuates less is air in a hollow; 0: half of the lightest material of the calibration",
        min=0.0,
        precision=4,
    )
    smallest_mm3: bpy.props.FloatProperty(
        name="Smallest (mm³)", description="Smaller hollows are left out; 0: 64 voxels", min=0.0
    )
    voxels: bpy.props.IntProperty(
        name="Voxels",
        description="Along the longest side of the grid that is summed up; 0: as large as splats, finer shows no more",
        min=0,
        max=MOST_VOXELS,
    )

    def ask(self, context: bpy.types.Context) -> set[str]:
        self.water = _chosen_water(self, context)
        return context.window_manager.invoke_props_dialog(self, width=400, confirm_text="Weigh")

    def draw(self, context: bpy.types.Context) -> None:
        column = self.layout.column()
        column.row().prop(self, "calibration", expand=True)
        if self.calibration == "MATERIALS":
            self.layout.column_flow(columns=3, align=True).prop(self, "materials")
        settings = self.layout.column()
        settings.use_property_split = True
        settings.use_property_decorate = False
        labels = _RELATIVE if is_relative(context) else {}

        def show(where: bpy.types.UILayout, name: str) -> None:
            # Without `text` it is the property's own.
            where.prop(self, name, **({"text": labels[name]} if name in labels else {}))

        for name in _SHOWN[self.calibration]:
            show(settings, name)
        if labels and self.calibration != "POINTS":
            settings.label(text="Densities are relative: grams need two points you know", icon="ERROR")
        settings.prop(self, "cavities")
        hollows = settings.column()
        hollows.active = self.cavities
        show(hollows, "edge")
        hollows.prop(self, "smallest_mm3")
        settings.prop(self, "voxels")
        settings.label(text="0 is chosen from the model")

    def steps(self, context: bpy.types.Context) -> Generator[float, None, set[str]]:
        try:
            weight = yield from weigh_model_in_steps(
                shown_model(context.scene),
                self._curve(context),
                cavities=self.cavities,
                edge_mm_inv=self.edge,
                smallest_mm3=self.smallest_mm3,
                voxels=self.voxels,
            )
        except InsideOutError as error:
            self.report({"ERROR"}, error_text(error))
            return {"CANCELLED"}
        self.report({"INFO"}, weight_text(weight))
        if mass_is_a_guess(shown_model(context.scene)):
            self.report({"WARNING"}, GUESS)
        return {"FINISHED"}

    def _curve(self, context: bpy.types.Context) -> DensityCurve:
        unit = (RELATIVE_UNIT if is_relative(context) else PER_MM).label
        if self.calibration == "WATER":
            return curve_of_water(_chosen_water(self, context), unit)
        if self.calibration == "POINTS":
            return curve_of_points(
                (self.first_attenuation, self.first_density), (self.second_attenuation, self.second_density), unit
            )
        model = shown_model(context.scene)
        if is_relative(context):
            raise SettingError(
                "{model} has relative densities, which a table of materials cannot turn into grams; choose Two Points, "
                "with two attenuations whose density you know.",
                model=model.name,
            )
        return curve_of_materials(self.materials, self.energy_kev, model.get(WATER_KEY))


_SHOWN = {
    "WATER": ("water",),
    "POINTS": ("first_attenuation", "first_density", "second_attenuation", "second_density"),
    "MATERIALS": ("energy_kev",),
}
# Labels where grey values were only scaled.
_RELATIVE = {
    "water": n_("Water (relative)"),
    "first_attenuation": n_("First (relative)"),
    "second_attenuation": n_("Second (relative)"),
    "edge": n_("Edge (relative)"),
}


class INSIDEOUT_OT_weigh_center(_NeedsWeight, bpy.types.Operator):
    """Mark the center of mass with an empty that follows the model"""

    bl_idname = "insideout.weigh_center"
    bl_label = "Add Center of Mass"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            add_center_marker(shown_model(context.scene), context)
        except InsideOutError as error:
            self.report({"ERROR"}, sentence(error))
            return {"CANCELLED"}
        return {"FINISHED"}


class INSIDEOUT_OT_weigh_save(_NeedsWeight, bpy.types.Operator, ExportHelper):
    """Save mass, center of mass, inertia and cavities as a table"""

    bl_idname = "insideout.weigh_save"
    bl_label = "Save Mass Table..."

    filename_ext = ".csv"
    filepath: FILE_PATH
    filter_glob: bpy.props.StringProperty(default="*.csv", options={"HIDDEN"})

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            path, model = chosen_file(self.filepath), shown_model(context.scene)
            save_weight(path, kept_weight(model), GUESS if mass_is_a_guess(model) else "")
        except (InsideOutError, OSError) as error:
            self.report({"ERROR"}, sentence(error))
            return {"CANCELLED"}
        self.report({"INFO"}, rpt_("Saved {path}").format(path=displayable(path)))
        return {"FINISHED"}


CLASSES = (INSIDEOUT_OT_weigh, INSIDEOUT_OT_weigh_center, INSIDEOUT_OT_weigh_save)
