"""What the colours of splats stand for: their own, density, disagreement with the projections, or modality."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import bpy
import numpy as np

from ...core.colormap import density_colors
from ...core.errors import SettingError
from ...core.gaussians import Modality
from ...core.srgb import srgb_to_linear
from .inside import look_inside
from .section import automatic_window, model_box, use_found_window
from .section_survey import lacks_window
from .splats import (
    COLORS_KEY,
    DENSITY_HERE,
    RESIDUAL,
    read_density,
    read_values,
    show_colors,
    shown_model,
    shows_density,
)

# sRGB, of Paul Tol's "high-contrast" scheme (technical note SRON/EPS/TN/09-002, 2021), which colour-blind eyes and grey
# prints keep apart.
MODALITY_COLORS = {
    Modality.RGB: (0xDD / 255, 0xAA / 255, 0x33 / 255),
    Modality.XRAY: (0x00 / 255, 0x44 / 255, 0x88 / 255),
    Modality.CLONE: (0xBB / 255, 0x55 / 255, 0x66 / 255),
}
_UNKNOWN = (0.45, 0.45, 0.45)
_SHADES = 2048
_HIGHEST_PERCENTILE = 99.0


def color_splats(model: bpy.types.Object, settings: bpy.types.PropertyGroup | None) -> None:
    """Colours a model as the scene's settings ask for, or in its own colours if there are none; if it is not so yet.

    Without settings, points that the model shares with a scene's model stay as they are coloured for that.

    Raises:
        SettingError: the model has no density, or no residuals.
        DamagedSplatsError: as `read_splats`.
    """
    by = "PHOTOS" if settings is None else settings.color_by
    if by != "PHOTOS":
        made_from = _made_from(model, settings)
        if model.data.get(COLORS_KEY) != made_from:
            show_colors(model, _COLORS[by](model, settings), made_from)
    elif COLORS_KEY in model.data and not (settings is None and _colors_another(model)):
        show_colors(model, None)


def _colors_another(model: bpy.types.Object) -> bool:
    """Whether the points are another object's, too, which is a scene's model: their colours are for that to choose."""
    models = [shown_model(scene) for scene in bpy.data.scenes]
    return any(other not in (None, model) and other.data == model.data for other in models)


def residual_window(model: bpy.types.Object, highest: float) -> tuple[float, float] | None:
    """Residuals, %, shown darkest and brightest; None of a model without any.

    Args:
        highest: shown brightest; 0: what one splat in a hundred exceeds.
    """
    percent = read_values(model, RESIDUAL)
    if percent is None or not np.isfinite(percent).any():
        return None
    return 0.0, float(highest or np.nanpercentile(percent, _HIGHEST_PERCENTILE))


def _made_from(model: bpy.types.Object, settings: bpy.types.PropertyGroup) -> str:
    window = (settings.low, settings.high) if settings.color_by == "DENSITY" else (settings.residual_high,)
    told = () if settings.color_by == "MODALITY" else (settings.colors, *window)
    return repr((settings.color_by, len(model.data.points), *told))


def _by_density(model: bpy.types.Object, settings: bpy.types.PropertyGroup) -> np.ndarray:
    look_inside(model)
    density = read_values(model, DENSITY_HERE)
    assert density is not None
    return _shaded(density, settings.low, settings.high, settings.colors)


def _by_residual(model: bpy.types.Object, settings: bpy.types.PropertyGroup) -> np.ndarray:
    if not shows_density(model):
        raise SettingError(
            "{model} is of photos alone, so no projections can differ; choose one with X-rays.", model=model.name
        )
    percent, window = read_values(model, RESIDUAL), residual_window(model, settings.residual_high)
    if percent is None or window is None:
        raise SettingError(
            "{model} has no residuals, which need projections: press Reconstruct again, which keeps what is done, and "
            "import the model anew.",
            model=model.name,
        )
    colors = _shaded(np.nan_to_num(percent), *window, settings.colors)
    colors[~np.isfinite(percent)] = srgb_to_linear(np.array(_UNKNOWN))
    return colors


def _by_modality(model: bpy.types.Object, settings: bpy.types.PropertyGroup) -> np.ndarray:
    table = srgb_to_linear(np.array([MODALITY_COLORS[modality] for modality in Modality])).astype(np.float32)
    return table[np.clip(read_density(model).modality, 0, len(table) - 1)]


_COLORS: dict[str, Callable[[bpy.types.Object, bpy.types.PropertyGroup], np.ndarray]] = {
    "DENSITY": _by_density,
    "RESIDUAL": _by_residual,
    "MODALITY": _by_modality,
}


def _shaded(values: np.ndarray, low: float, high: float, colors: str) -> np.ndarray:
    """(N, 3) linear colours of values in a window, from a table: the slider is to be followed."""
    place = (values - low) * ((_SHADES - 1) / max(high - low, 1e-12)) + 0.5
    return _table(colors)[np.clip(place, 0, _SHADES - 1).astype(np.int32)]


@cache
def _table(colors: str) -> np.ndarray:
    return srgb_to_linear(density_colors(np.linspace(0, 1, _SHADES), 0.0, 1.0, colors.lower())).astype(np.float32)


def choose_window(model: bpy.types.Object, settings: bpy.types.PropertyGroup) -> None:
    """Gives a scene that has no window of the model's densities yet the one that its first section would get."""
    if lacks_window(model, settings.id_data):
        gaussians = read_density(model)
        use_found_window(settings, automatic_window(gaussians, model_box(gaussians)), model)
