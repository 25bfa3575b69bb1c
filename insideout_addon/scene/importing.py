"""A run's result brought into the scene."""

from __future__ import annotations

from pathlib import Path

import bpy

from ...core.errors import GaussianFileError
from ...core.gaussians import GaussianSet, Modality
from ...core.ply import read_ply
from .display import show_splats
from .memory import chosen_display
from .node_tree import set_modifier_input
from .section import model_box
from .splats import create_splats
from .surroundings import air_threshold, surrounding_density

# Where a run may have left a set, the best first.
_CANDIDATES = {
    "fused": ("fused.ply", "fuse/fused.ply"),
    "rgb": ("rgb.ply", "internal/rgb.ply", "align/rgb.ply", "surface/rgb.ply"),
    "xray": ("xray.ply", "internal/xray.ply", "align/xray.ply", "surface/xray.ply"),
}


def find_set(run: Path, which: str) -> Path:
    """The .ply of a run that holds "fused", "rgb" or "xray" as far as the run has got.

    Raises:
        GaussianFileError: the run has none.
    """
    run = Path(run)
    if run.suffix.lower() == ".ply":
        return run
    for name in _CANDIDATES[which]:
        if (run / name).is_file():
            return run / name
    raise GaussianFileError(
        f"{run}: holds no {which} splats yet ({_CANDIDATES[which][0]}); choose a finished run, or other splats."
    )


def available_sets(run: Path) -> list[str]:
    """Which of "fused", "rgb" and "xray" a run holds."""
    return [which for which, names in _CANDIDATES.items() if any((Path(run) / name).is_file() for name in names)]


def import_splats(
    path: Path,
    name: str,
    context: bpy.types.Context,
    display: str = "AUTOMATIC",
    view_dependent: bool = False,
) -> bpy.types.Object:
    """Reads a .ply, then changes the scene: a point cloud that is shown, selected and set as the model.

    Raises:
        GaussianFileError: nothing is changed then.
    """
    gaussians = read_ply(Path(path))
    if len(gaussians) == 0:
        raise GaussianFileError(f"{path}: holds no splats; choose another file.")
    splats = create_splats(gaussians, name, context, view_dependent)
    splats["insideout_source"] = bpy.path.relpath(str(path)) if bpy.data.filepath else str(path)
    modifier = show_splats(splats, chosen_display(display, len(gaussians)) == "ELLIPSOIDS")
    threshold = air_threshold(surrounding_density(gaussians), gaussians.modality == Modality.XRAY)
    set_modifier_input(modifier, "Minimum Density", threshold)
    _use_millimetres(context.scene)
    _show_true_colors(context.scene)
    _widen_views(gaussians)
    for other in context.view_layer.objects:
        other.select_set(other == splats)
    context.view_layer.objects.active = splats
    context.scene.insideout.model = splats
    return splats


def _use_millimetres(scene: bpy.types.Scene) -> None:
    """One unit is a millimetre, unless the user has chosen units already."""
    units = scene.unit_settings
    if units.system == "METRIC" and units.scale_length == 1.0:
        units.scale_length = 0.001
        units.length_unit = "MILLIMETERS"


def _show_true_colors(scene: bpy.types.Scene) -> None:
    """Blender's default view would dull the photos' colours and shift those of the colour bar."""
    if scene.view_settings.view_transform == "AgX":
        scene.view_settings.view_transform = "Standard"


def _widen_views(gaussians: GaussianSet) -> None:
    """Lets viewports see all of a model of many units, and puts colours on screen."""
    box = model_box(gaussians)
    extent = float((box[1] - box[0]).max())
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                space = area.spaces.active
                # The nearer clipping starts, the coarser depth is where the section lies on the cut.
                space.clip_start = max(space.clip_start, extent / 500)
                space.clip_end = max(space.clip_end, 20 * extent)
                if space.shading.type == "SOLID":
                    space.shading.type = "MATERIAL"
