"""The last probe of a scene, kept with it and told in words."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from bpy.app.translations import pgettext_iface as iface_
from bpy.app.translations import pgettext_n as n_

from ...core.digits import fixed, length_decimals
from ...core.gaussians import Modality
from ..scene.following import bends_alike, taken_away
from ..scene.section_image import PER_MM, Unit
from ..scene.splats import stored_splats
from .probe import Probe

KEY = "insideout_probe"
# In it: how many splats the model had, position and density of the nearest as they were stored, and how it was bent.
_COUNT_KEY, _NEAREST_KEY, _BENT_KEY = "splats", "nearest_stored", "bent"
# A soft body is bent as it was to this part of the nearest splat's size.
_SAME_BENDING = 1e-3
_MODALITIES = {Modality.RGB: n_("photos"), Modality.XRAY: n_("X-ray"), Modality.CLONE: n_("clone of photos")}


def keep_probe(scene: bpy.types.Scene, model: bpy.types.Object, found: Probe) -> None:
    """Notes what was found on the scene, for scripts and the panel."""
    color = {} if found.color is None else {"color": found.color}
    scene[KEY] = {
        **color,
        "model": model.name,
        _COUNT_KEY: len(model.data.points),
        _NEAREST_KEY: stored_splats(model, [found.nearest]),
        _BENT_KEY: taken_away(model).ravel().tolist(),
        "point_mm": found.point_mm,
        "density": found.density,
        "color_is_here": found.color_is_here,
        "nearest": found.nearest,
        "modality": int(found.modality),
        "center_mm": found.center_mm,
        "scales_mm": found.scales_mm,
        "distance_mm": found.distance_mm,
    }


def kept_probe(scene: bpy.types.Scene, model: bpy.types.Object) -> Probe | None:
    """The last probe of a scene, if it was of this model's splats as they are: of one that has since lost or won some,
    whose nearest was edited, or that bends otherwise, it would tell other figures.
    """
    kept: Any = scene.get(KEY)
    if kept is None or kept["model"] != model.name or not _is_of_these_splats(kept, model):
        return None
    return Probe(
        point_mm=tuple(kept["point_mm"]),
        density=kept["density"],
        color=tuple(kept["color"]) if "color" in kept else None,
        color_is_here=bool(kept["color_is_here"]),
        nearest=kept["nearest"],
        modality=Modality(kept["modality"]),
        center_mm=tuple(kept["center_mm"]),
        scales_mm=tuple(kept["scales_mm"]),
        distance_mm=kept["distance_mm"],
    )


def forget_probe(scene: bpy.types.Scene, model: bpy.types.Object) -> None:
    """Takes the last probe of a scene away if it was of this model."""
    if KEY in scene and scene[KEY]["model"] == model.name:
        del scene[KEY]


def _is_of_these_splats(kept: Any, model: bpy.types.Object) -> bool:
    if kept.get(_COUNT_KEY) != len(model.data.points):
        return False
    stored = stored_splats(model, [kept["nearest"]])
    if stored is None or not np.array_equal(kept[_NEAREST_KEY], stored, equal_nan=True):
        return False
    # Files of before kept nothing of how it was bent.
    return _BENT_KEY not in kept or bends_alike(model, kept[_BENT_KEY], _SAME_BENDING * max(kept["scales_mm"]))


def told(found: Probe, in_mm: bool, densities: Unit = PER_MM) -> str:
    """A probe in one line; see `lines`."""
    return "; ".join(lines(found, in_mm, densities))


def lines(found: Probe, in_mm: bool, densities: Unit = PER_MM) -> list[str]:
    """A probe line by line.

    Args:
        in_mm: else lengths have no unit, and there is no density.
        densities: what they are written in.
    """
    unit = " mm" if in_mm else ""
    # Nothing is to be told apart that is smaller than a splat; those of photos are flat, some by nanometres.
    places = length_decimals(max(found.scales_mm), 2)

    def numbers(values: tuple[float, ...]) -> str:
        return " ".join(fixed(value, places) for value in values)

    told = [iface_("At {place}").format(place=f"{numbers(found.point_mm)}{unit}")]
    if in_mm:
        number = densities.factor * found.density + densities.offset
        told.append(iface_("Density {density}").format(density=f"{number:.4g} {densities.label}"))
    if found.color is None:
        told.append(iface_("No color here"))
    else:
        here, near = iface_("Color {rgb} (sRGB)"), iface_("Color {rgb} (sRGB, of the nearest opaque splat)")
        rgb = " ".join(f"{round(255 * part)}" for part in found.color)
        told.append((here if found.color_is_here else near).format(rgb=rgb))
    distance, kind = f"{fixed(found.distance_mm, places)}{unit}", iface_(_MODALITIES[found.modality])
    nearest = iface_("Nearest splat {number}, {kind}, {distance} away")
    told.append(nearest.format(number=found.nearest, kind=kind, distance=distance))
    place = f"{numbers(found.center_mm)}{unit}"
    sizes = " ".join(fixed(size, length_decimals(size, 2)) for size in found.scales_mm) + unit
    told.append(iface_("Its center {place}, sizes {sizes}").format(place=place, sizes=sizes))
    return told
