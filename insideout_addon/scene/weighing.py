"""The model on the scales: what is found is kept on it, and its centre of mass can be marked."""

from __future__ import annotations

from collections.abc import Callable, Generator

import bpy
import numpy as np

from ...core.capture.volumes import MU_WATER_PER_MM
from ...core.errors import SettingError
from ...core.mesh.cavities import Cavity
from ...core.mesh.density_map import DensityCurve
from ...core.mesh.mass import MassProperties
from ...core.mesh.weight import Weight, weigh_in_steps
from ...core.steps import run_through
from .importing import densities_are_relative, lengths_are_arbitrary
from .linking import open_collection
from .placement import transformed_to_splats
from .splats import read_density, require_own, shows_density, some_splats

CENTER_NAME = "InsideOut Centre of Mass"
# What is kept on a weighed model. Numbers are in the model's own frame; a cavity's are its volume and its centre.
MASS_KEY, CENTER_KEY, INERTIA_KEY = "insideout_mass_g", "insideout_center_mm", "insideout_inertia_g_mm2"
CAVITY_COUNT_KEY, CAVITIES_KEY, CALIBRATION_KEY = (
    "insideout_cavity_count",
    "insideout_cavities_mm3_mm",
    "insideout_calibration",
)
# How many splats were weighed, the matrix (3, 4) of what had been applied to them, and some of them as stored.
_STATE_KEY = "insideout_weighed"
_OF_ALL = 13
# mm⁻¹ and g/cm³ of each point of the calibration.
_CURVE_KEY = "insideout_calibration_curve"
_KEYS = (MASS_KEY, CENTER_KEY, INERTIA_KEY, CAVITY_COUNT_KEY, CAVITIES_KEY, CALIBRATION_KEY, _STATE_KEY, _CURVE_KEY)
_NUMBERS_OF_CAVITY = 4
# On the empty at the centre of mass.
_MARKER_KEY = "insideout_center_marker"
_CENTER_SIZE = 0.1


def weigh_model(
    model: bpy.types.Object,
    curve: DensityCurve,
    *,
    cavities: bool = True,
    edge_mm_inv: float = 0.0,
    smallest_mm3: float = 0.0,
    voxels: int = 0,
    tick: Callable[[float], None] | None = None,
) -> Weight:
    """Weighs the splats as they are now and keeps the figures on the model; see `core.mesh.weight`.

    What modifiers of the user's hide or delete counts until they are applied.

    Lengths in the model's own frame are millimetres, however large the object is shown.

    Args:
        tick: called with the part that is done, 0..1; may raise to stop, and what was kept stays then.

    Raises:
        SettingError: the model has no density or no millimetres, is of another file, or a setting is out of range.
            What was kept stays.
    """
    steps = weigh_model_in_steps(
        model, curve, cavities=cavities, edge_mm_inv=edge_mm_inv, smallest_mm3=smallest_mm3, voxels=voxels
    )
    return run_through(steps, tick)


def weigh_model_in_steps(
    model: bpy.types.Object,
    curve: DensityCurve,
    *,
    cavities: bool = True,
    edge_mm_inv: float = 0.0,
    smallest_mm3: float = 0.0,
    voxels: int = 0,
) -> Generator[float, None, Weight]:
    """As `weigh_model`, with breaks that tell the part that is done; closed before its end it changes nothing."""
    require_own(model)
    if not shows_density(model) or lengths_are_arbitrary(model):
        raise SettingError(
            "{model} is of photos alone, which have no density to weigh; choose one with X-rays.", model=model.name
        )
    weight = yield from weigh_in_steps(
        read_density(model),
        curve,
        cavities=cavities,
        edge_mm_inv=edge_mm_inv,
        smallest_mm3=smallest_mm3,
        voxels=voxels,
    )
    keep_weight(model, weight, curve)
    marker = center_marker(model)
    if marker is not None:
        _put(marker, weight)
    return weight


def keep_weight(model: bpy.types.Object, weight: Weight, curve: DensityCurve) -> None:
    """Writes a weight, and the calibration that it was found with, into the model's custom properties."""
    for key in _KEYS:
        if key in model:
            del model[key]
    model[MASS_KEY] = weight.properties.mass_g
    model[CENTER_KEY] = weight.properties.center_mm.tolist()
    model[INERTIA_KEY] = weight.properties.inertia_g_mm2.ravel().tolist()
    model[CALIBRATION_KEY] = weight.calibration
    model[_CURVE_KEY] = np.column_stack([curve.attenuations_mm_inv, curve.densities_g_cm3]).ravel().tolist()
    model[_STATE_KEY] = _state(model)
    if weight.cavities is not None:
        model[CAVITY_COUNT_KEY] = len(weight.cavities)
        model[CAVITIES_KEY] = [x for cavity in weight.cavities for x in (cavity.volume_mm3, *cavity.center_mm.tolist())]


def kept_weight(model: bpy.types.Object) -> Weight | None:
    """The weight that a model was found to have.

    None where it was never weighed, or has since lost or won splats, or they were moved or edited, as Blender's own
    Apply does.
    """
    if MASS_KEY not in model or not _is_as_weighed(model):
        return None
    inertia = np.array(model[INERTIA_KEY], np.float64).reshape(3, 3)
    properties = MassProperties(float(model[MASS_KEY]), np.array(model[CENTER_KEY], np.float64), inertia)
    cavities = None
    if CAVITY_COUNT_KEY in model:
        rows = np.array(model[CAVITIES_KEY], np.float64).reshape(model[CAVITY_COUNT_KEY], _NUMBERS_OF_CAVITY)
        cavities = tuple(Cavity(float(row[0]), row[1:]) for row in rows)
    return Weight(properties, cavities, str(model[CALIBRATION_KEY]))


def kept_curve(model: bpy.types.Object) -> DensityCurve | None:
    """The calibration of `kept_weight`, None where there is none."""
    if kept_weight(model) is None:
        return None
    attenuations, densities = np.array(model[_CURVE_KEY], np.float64).reshape(-1, 2).T
    return DensityCurve(attenuations, densities, str(model[CALIBRATION_KEY]))


def water_per_mm(model: bpy.types.Object, scene: bpy.types.Scene) -> float:
    """Attenuation that counts as water's in a model until it is told otherwise: that of 0 HU in the scene's sections.

    Relative densities have no Hounsfield units, and whatever was set for those of another scan; theirs is a usual one.
    """
    return MU_WATER_PER_MM if densities_are_relative(model) else scene.insideout.water


def center_marker(model: bpy.types.Object) -> bpy.types.Object | None:
    """The empty at a model's centre of mass, if it was added."""
    return next(iter(sorted(filter(is_center_marker, model.children), key=lambda child: child.session_uid)), None)


def is_center_marker(thing: bpy.types.Object) -> bool:
    """Whether an object is such an empty, whatever it is called by now; one of an older file is known by its name."""
    return _MARKER_KEY in thing or thing.name.startswith(CENTER_NAME)


def add_center_marker(model: bpy.types.Object, context: bpy.types.Context) -> bpy.types.Object:
    """An empty at a weighed model's centre of mass, which follows the model; the one that is there is moved.

    Raises:
        SettingError: the model was not weighed.
        DamagedSplatsError: an attribute is missing, or of another type.
    """
    weight = kept_weight(model)
    if weight is None:
        raise SettingError("{model} was not weighed yet; press Weigh first.", model=model.name)
    size, marker = _CENTER_SIZE * _extent(model), center_marker(model)
    if marker is None:
        marker = bpy.data.objects.new(CENTER_NAME, None)
        marker[_MARKER_KEY] = True
        marker.empty_display_type = "ARROWS"
        marker.show_in_front = True
        marker.parent = model
        open_collection(context).objects.link(marker)
    _put(marker, weight)
    marker.empty_display_size = size
    return marker


def _put(marker: bpy.types.Object, weight: Weight) -> None:
    # A transform that was applied to the model's splats is in there.
    marker.matrix_parent_inverse.identity()
    marker.location = weight.properties.center_mm


def _is_as_weighed(model: bpy.types.Object) -> bool:
    """As far as a few of the splats tell, for panels ask each time that they are drawn; older files kept none."""
    kept, now = list(model.get(_STATE_KEY, ())), _state(model)
    if len(kept) == _OF_ALL:
        now = now[:_OF_ALL]
    return np.array_equal(kept, now, equal_nan=True)


def _state(model: bpy.types.Object) -> list[float]:
    applied, (count, *some) = transformed_to_splats(model), some_splats(model)
    return [count, *np.column_stack([applied.linear, applied.translation]).ravel().tolist(), *some]


def _extent(model: bpy.types.Object) -> float:
    """The longest side of a model in its own frame, mm; the model's display may show none of it."""
    means = read_density(model).means
    return float(np.ptp(means, axis=0).max()) if len(means) > 1 else 1.0
