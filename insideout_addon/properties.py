"""What the panels show and the operators read: settings on the scene, the running job on the window manager."""

from __future__ import annotations

from typing import Any

import bpy
from bpy.props import (
    BoolProperty,
    CollectionProperty,
    EnumProperty,
    FloatProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)

from ..core.run_folder import STAGES
from .effects import EFFECT_TEXTS
from .scene.importing import hide_background
from .scene.look import MODALITIES, on_look_changed
from .scene.section import move_plane, plane_position
from .scene.section_image import hounsfield
from .scene.section_live import on_high_changed, on_low_changed, on_model_changed, on_section_changed, on_show_changed
from .scene.sources import on_path_chosen
from .scene.splats import in_scene, is_splats, shown_model
from .starting_over import OF_ONE_SCENE

PRESETS = (
    ("draft", "Draft", "Minutes: fewer iterations, smaller images"),
    ("standard", "Standard", "The recommended balance of time and accuracy"),
    ("paper", "Paper", "The longest: more steps, photos of up to 1600 pixels"),
)
ROUTES = (
    ("joint", "Together", "Photos and X-rays refine one model together"),
    ("apart", "Apart", "Photos refine the color splats, X-rays the radiative ones, as in the paper"),
)
EFFECTS_ITEMS = (
    ("NONE", "None", "Photos and X-rays are taken as they are"),
    (
        "AUTO",
        "Look for Them",
        "Look for all of them, and use what is found and can be used",
    ),
    ("NAMED", "By Name", "Use those that are chosen here"),
)
_STAGE_TEXTS = {
    "initialize": "First splats: structure from motion for the photos, FDK for the X-rays",
    "surface": "Color splats from the photos, radiative splats from the projections",
    "align": "Brings the photos' frame onto the X-ray frame, in millimeters",
    "internal": "Refines both on photos, projections and sections of the volume",
    "fuse": "One model of both",
}
STAGE_ITEMS = (
    ("ALL", "All Stages", "Everything that is not done yet"),
    *((name, name.capitalize(), _STAGE_TEXTS[name]) for name in STAGES),
)
SET_ITEMS = (
    ("fused", "Fused", "Colored outside, true inside"),
    ("rgb", "Photos", "The colored outside alone, from the photos"),
    ("xray", "X-ray", "The inside alone, from the X-rays"),
)
DISPLAY_ITEMS = (
    ("AUTOMATIC", "Automatic", "Ellipsoids for small models, mixed for large ones"),
    ("POINTS", "Points", "Spheres: millions of splats with little memory"),
    ("ELLIPSOIDS", "Ellipsoids", "True shapes, cut as solids; more memory"),
    ("MIXED", "Mixed", "Points, and ellipsoids where they matter: chosen splats, those at cuts, the largest"),
)
DISPLAY_TEXT = "What stands for the splats in the scene; ellipsoids need more memory than points"
PICTURE_ITEMS = (
    ("MODEL", "Model", "The model's density"),
    ("CT", "CT", "The scan: your volume, or the usual CT reconstruction (FDK) of the projections"),
    ("DIFFERENCE", "Difference", "The model's density less that of the scan: red where the model is denser"),
)
BESIDE_ITEMS = (
    ("NONE", "Nothing", "The model's density alone"),
    ("CT", "CT", "The scan on the same plane, with the same colors"),
    ("BOTH", "CT and Difference", "Also how far the model is above or below the scan"),
)
COLOR_ITEMS = (
    ("INFERNO", "Inferno", "Black, violet, orange, yellow"),
    ("VIRIDIS", "Viridis", "Violet, blue, green, yellow"),
    ("CIVIDIS", "Cividis", "Blue, gray, yellow; the same to color-blind eyes"),
    ("GREY", "Gray", "As radiographs are printed"),
)
COLOR_BY_ITEMS = (
    ("PHOTOS", "Photos", "The splats' own colors"),
    ("DENSITY", "Density", "The density at each splat, in the colors and between the densities of sections"),
    (
        "RESIDUAL",
        "Residual",
        "How far radiographs of the model differ from those measured, along the rays through a splat: bright does not "
        "fit",
    ),
    ("MODALITY", "Modality", "Yellow of photos, blue of X-rays, red details that photos added to those of X-rays"),
)
COLOR_BY_TEXT = "What the splats' colors stand for; export keeps their own"
_MODALITY_TEXTS = (
    ("Photos", "Splats that photos gave"),
    ("X-rays", "Splats that X-rays gave"),
    ("Clones", "Details of photos, added to the splats of X-rays"),
)
MODALITY_ITEMS = tuple(
    (name, *texts, 1 << number) for number, (name, texts) in enumerate(zip(MODALITIES, _MODALITY_TEXTS, strict=True))
)
UNIT_ITEMS = (
    ("PER_MM", "mm⁻¹", "Attenuation"),
    ("HU", "HU", "Hounsfield units: -1000 is air, 0 is water"),
)
SHAPE_ITEMS = (
    ("PLANE", "Plane", "Cuts on one side and shows the density"),
    ("BOX", "Box", "Cuts out, or leaves, what is in it"),
)


# Paths may start with "//", the folder of the .blend: then both can be moved together.
_RELATIVE = {"PATH_SUPPORTS_BLEND_RELATIVE"}
_FOLDER = {"subtype": "DIR_PATH", "options": _RELATIVE, "update": on_path_chosen}


def _on_background_changed(settings: bpy.types.PropertyGroup, context: bpy.types.Context) -> None:
    model = shown_model(settings.id_data)
    if model is not None:
        hide_background(model, settings.hide_background)


def _in_hu(name: str) -> dict[str, Any]:
    """How a setting that is kept in mm⁻¹ is read, set and shown in Hounsfield units."""

    def read(settings: bpy.types.PropertyGroup) -> float:
        unit = hounsfield(settings.water)
        return unit.factor * getattr(settings, name) + unit.offset

    def write(settings: bpy.types.PropertyGroup, value: float) -> None:
        unit = hounsfield(settings.water)
        setattr(settings, name, (value - unit.offset) / unit.factor)

    return {"get": read, "set": write, "step": 500, "precision": 0, "options": set()}


def _position(section: bpy.types.PropertyGroup) -> float:
    position = plane_position(section)
    return 0.0 if position is None else position.mm


class InsideOutFinding(bpy.types.PropertyGroup):
    """One line of the capture's check."""

    level: StringProperty()
    subject: StringProperty()
    message: StringProperty()
    advice: StringProperty()
    told: StringProperty(description="What both are translated by, as JSON; empty in files of before")


class InsideOutForecast(bpy.types.PropertyGroup):
    """What a run with one preset will take; `name` is the preset."""

    seconds: FloatProperty()
    quality: StringProperty(description="What the decibels are of: photos or projections; empty where none are known")
    least_db: FloatProperty()
    most_db: FloatProperty()
    cameras: BoolProperty(description="Cameras have to be found first, whose time nobody can tell well")


class InsideOutSection(bpy.types.PropertyGroup):
    """One of `scene.insideout.sections`: a plane or a box that cuts the model; it is called as its object is."""

    object: PointerProperty(name="Object", description="The plane or box", type=bpy.types.Object)
    shape: EnumProperty(name="Shape", description="Whether a plane or a box cuts the model", items=SHAPE_ITEMS)
    # As all that callbacks follow, not to be keyframed: Blender calls none then.
    cut: BoolProperty(
        name="Cut", description="Hide the splats on one side", default=True, options=set(), update=on_show_changed
    )
    flip: BoolProperty(
        name="Flip",
        description="Hide the other side of the plane, or the inside of the box",
        options=set(),
        update=on_show_changed,
    )
    # Kept nowhere else than in the place of the plane, which the gizmos move too.
    position_mm: FloatProperty(
        name="Position (mm)",
        description="Where the plane lies along its normal, in mm from the origin of the model's own frame; at right "
        "angles to x, y or z it is that coordinate, as on section sheets",
        step=10,
        precision=2,
        options=set(),
        get=_position,
        set=move_plane,
    )
    slab_mm: FloatProperty(
        name="Slab (mm)",
        description="Show only this depth below the plane, in mm; 0 shows everything",
        min=0.0,
        options=set(),
        update=on_show_changed,
    )
    apart_mm: FloatProperty(
        name="Apart (mm)",
        description="Show both sides of the plane, pulled this far apart, in mm; 0 hides one side",
        min=0.0,
        options=set(),
        update=on_show_changed,
    )
    show_density: BoolProperty(
        name="Density on the Cut",
        description="Draw the attenuation on the plane, or on the faces of the box, as an image",
        default=True,
        options=set(),
        update=on_show_changed,
    )
    picture: EnumProperty(
        name="Picture",
        description="What is drawn on the cut",
        items=PICTURE_ITEMS,
        options=set(),
        update=on_show_changed,
    )
    beside: EnumProperty(
        name="Beside",
        description="Pictures to the right of the model's density, on the same plane",
        items=BESIDE_ITEMS,
        options=set(),
        update=on_show_changed,
    )


class InsideOutEffects(bpy.types.PropertyGroup):
    """The effects that are asked for by name, each as `core.effect_names` calls it."""

    __annotations__ = {name: BoolProperty(name=title, description=text) for name, (title, text) in EFFECT_TEXTS.items()}


class InsideOutSettings(bpy.types.PropertyGroup):
    """`scene.insideout`."""

    capture: StringProperty(name="Capture", description="Folder with photos and X-rays of the object", **_FOLDER)
    checked: StringProperty(description="The capture folder that the findings are about")
    findings: CollectionProperty(type=InsideOutFinding)
    run: StringProperty(
        name="Run Folder",
        description="Where Reconstruct writes results and checkpoints and Import reads them: the same folder in both "
        "panels",
        **_FOLDER,
    )
    filled_run: StringProperty(description="Run folder that was filled in, where nobody chose one", **_FOLDER)
    preset: EnumProperty(
        name="Preset",
        description="How much time a reconstruction takes, and how accurate the model gets",
        items=PRESETS,
        default="draft",
    )
    limit_time: BoolProperty(
        name="Limit Time", description="Make the best model that can be had in a given time, with the preset that fits"
    )
    minutes: FloatProperty(
        name="Minutes", description="What the whole reconstruction is to take", default=10.0, min=0.5, soft_max=240.0
    )
    refine: EnumProperty(
        name="Refine", description="Whether photos and X-rays refine the same splats", items=ROUTES, default="joint"
    )
    effects: EnumProperty(
        name="Effects",
        description="What lens, shutter and scanner add to the images of the object",
        items=EFFECTS_ITEMS,
    )
    named_effects: PointerProperty(type=InsideOutEffects)
    stage: EnumProperty(
        name="Stages",
        description="What of the reconstruction is to be done; a stage needs those before it",
        items=STAGE_ITEMS,
    )
    import_when_done: BoolProperty(
        name="Import When Done", description="Show the model as soon as it is ready", default=True
    )
    which: EnumProperty(name="Splats", description="Which of the models of the run is imported", items=SET_ITEMS)
    display: EnumProperty(name="Show As", description=DISPLAY_TEXT, items=DISPLAY_ITEMS)
    view_dependent: BoolProperty(
        name="View-Dependent",
        description="Keep how colors change with the direction of view (spherical harmonics); needs memory",
        default=False,
    )
    hide_background: BoolProperty(
        name="Hide Background",
        description="Show the object alone: photos also give splats of what is far behind it",
        default=True,
        options=set(),
        update=_on_background_changed,
    )
    model: PointerProperty(
        name="Model",
        description="The imported model that the sections, measures and other tools are about",
        type=bpy.types.Object,
        poll=lambda settings, candidate: is_splats(candidate) and in_scene(candidate, settings.id_data),
        update=on_model_changed,
    )
    sections: CollectionProperty(type=InsideOutSection)
    section_index: IntProperty(
        name="Section", description="The section that is chosen", options=set(), update=on_section_changed
    )
    low: FloatProperty(
        name="Low (mm⁻¹)",
        description="Density shown darkest",
        # A pixel of a drag is a hundredth of it; a whole window is about 0.05.
        step=0.02,
        precision=4,
        options=set(),
        update=on_low_changed,
    )
    high: FloatProperty(
        name="High (mm⁻¹)",
        description="Density shown brightest",
        default=0.05,
        min=1e-6,
        step=0.02,
        precision=4,
        options=set(),
        update=on_high_changed,
    )
    low_hu: FloatProperty(name="Low (HU)", description="Density shown darkest", **_in_hu("low"))
    high_hu: FloatProperty(name="High (HU)", description="Density shown brightest", **_in_hu("high"))
    colors: EnumProperty(
        name="Colors",
        description="Color map from the lowest to the highest value",
        items=COLOR_ITEMS,
        options=set(),
        update=on_section_changed,
    )
    unit: EnumProperty(
        name="Unit",
        description="In which unit densities are shown and set",
        items=UNIT_ITEMS,
        options=set(),
        update=on_section_changed,
    )
    water: FloatProperty(
        name="Water (mm⁻¹)",
        description="Attenuation of water in this scan: that of 0 HU",
        default=0.0195,
        min=1e-6,
        step=0.02,
        precision=4,
        options=set(),
        update=on_section_changed,
    )
    pixels: IntProperty(
        name="Pixels",
        description="Pixels along a side of the section",
        default=512,
        min=32,
        max=4096,
        options=set(),
        update=on_section_changed,
    )
    color_by: EnumProperty(
        name="Color By",
        description=COLOR_BY_TEXT,
        items=COLOR_BY_ITEMS,
        options=set(),
        update=on_look_changed,
    )
    residual_high: FloatProperty(
        name="Up To (%)",
        description="Residual shown brightest, in % of the largest line integral; 0: what one splat in 100 exceeds",
        min=0.0,
        max=100.0,
        precision=2,
        options=set(),
        update=on_look_changed,
    )
    peel_mm: FloatProperty(
        name="Peel (mm)",
        description="Hide what is less deep under the outer surface; Visible Only leaves it out of an export. "
        "To animate it, use it once, then keyframe Peel of the modifier",
        min=0.0,
        soft_max=50.0,
        precision=2,
        options=set(),
        update=on_look_changed,
    )
    peel_layer_mm: FloatProperty(
        name="Layer (mm)",
        description="Show only a layer of this thickness under what is peeled off; 0 shows everything",
        min=0.0,
        soft_max=50.0,
        precision=2,
        options=set(),
        update=on_look_changed,
    )
    peel_density_from: FloatProperty(
        name="Denser Than (mm⁻¹)",
        description="Hide splats where the model has less density; those of photos count by their place, too",
        min=0.0,
        soft_max=0.5,
        step=0.1,
        precision=4,
        options=set(),
        update=on_look_changed,
    )
    peel_density_to: FloatProperty(
        name="Less Dense Than (mm⁻¹)",
        description="Hide splats where the model has more density; 0 hides none",
        min=0.0,
        soft_max=0.5,
        step=0.1,
        precision=4,
        options=set(),
        update=on_look_changed,
    )
    peel_density_from_hu: FloatProperty(
        name="Denser Than (HU)",
        description="Hide splats where the model has less density; those of photos count by their place, too",
        **_in_hu("peel_density_from"),
    )
    peel_density_to_hu: FloatProperty(
        name="Less Dense Than (HU)",
        description="Hide splats where the model has more density; -1000 hides none",
        **_in_hu("peel_density_to"),
    )
    modalities: EnumProperty(
        name="Show",
        description="Which splats are shown, by what they are from",
        items=MODALITY_ITEMS,
        default=set(MODALITIES),
        options={"ENUM_FLAG"},
        update=on_look_changed,
    )
    look_problem: StringProperty(description="Why the model does not look as it is asked to; empty if it does")
    level: FloatProperty(
        name="Contour At (mm⁻¹)",
        description="Density of the contours; 0: half of the material's median",
        min=0.0,
        step=0.02,
        precision=4,
    )


class InsideOutStageState(bpy.types.PropertyGroup):
    """One row of the progress list; `name` is the stage."""

    state: StringProperty()
    seconds: FloatProperty()
    reason: StringProperty()


class InsideOutJobState(bpy.types.PropertyGroup):
    """`window_manager.insideout`: what the engine does now and how the last job ended."""

    running: BoolProperty()
    title: StringProperty()
    panel: StringProperty(description="Where it was asked for: engine, capture, reconstruct", default="reconstruct")
    stage: StringProperty()
    part: StringProperty()
    fraction: FloatProperty()
    seconds_left: FloatProperty(default=-1.0)
    iteration: IntProperty()
    iterations: IntProperty()
    loss: FloatProperty()
    loss_curve: StringProperty()
    heldout_psnr: FloatProperty()
    curve: StringProperty(description="Points of the run's curve as JSON, as report.json has them")
    splats: IntProperty()
    message: StringProperty()
    error: StringProperty()
    stages: CollectionProperty(type=InsideOutStageState)
    # Here, not on the scene: in a file that is opened on another machine they would be taken for this one's.
    forecasts: CollectionProperty(type=InsideOutForecast)
    forecast_of: StringProperty(description="The route, effects, capture and run folder that the forecasts are about")
    forecast_known: BoolProperty(description="Decibels are told from a finished run of the capture")
    start_over: BoolProperty(
        name="Start Over",
        description="Discard what the run folder holds of this capture and begin again; only for the next run",
        **OF_ONE_SCENE,
    )
    start_over_in: IntProperty()
    engine_version: StringProperty()


CLASSES = (
    InsideOutFinding,
    InsideOutForecast,
    InsideOutSection,
    InsideOutEffects,
    InsideOutSettings,
    InsideOutStageState,
    InsideOutJobState,
)


def attach() -> None:
    """Puts the settings on scenes and the job on window managers; classes are registered already."""
    bpy.types.Scene.insideout = PointerProperty(type=InsideOutSettings)
    bpy.types.WindowManager.insideout = PointerProperty(type=InsideOutJobState)


def detach() -> None:
    """Takes both away again."""
    del bpy.types.WindowManager.insideout
    del bpy.types.Scene.insideout
