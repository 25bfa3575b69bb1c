"""A model's weight in words, in the language of Blender's interface."""

from __future__ import annotations

import math
from collections.abc import Sequence

import bpy
from bpy.app.translations import pgettext_iface as iface_
from bpy.app.translations import pgettext_n as n_

from ...core.capture.volumes import MU_WATER_PER_MM
from ...core.mesh.cavities import Cavity
from ...core.mesh.density_map import WATER_G_CM3, calibrated_by
from ...core.mesh.weight import Weight, center_text, mass_text, volume_text
from .importing import densities_are_relative
from .weighing import kept_curve

_CALIBRATIONS = {"water": n_("by water"), "two points": n_("by two points"), "materials": n_("by materials")}

GUESS = n_("A guess: densities are relative, and water's is not known here; weigh by Two Points")


def mass_is_a_guess(model: bpy.types.Object) -> bool:
    """Whether a model was weighed by what attenuates as water does in a usual scan, though its densities are relative:
    what water, or anything else, has in its own scan was not told."""
    curve = kept_curve(model) if densities_are_relative(model) else None
    factor = None if curve is None else curve.factor
    return factor is not None and math.isclose(factor, WATER_G_CM3 / MU_WATER_PER_MM, rel_tol=1e-5)


def weight_text(weight: Weight) -> str:
    """One line: "412.3 g by water, center 1.2 / -0.3 / 44.1 mm, 2 cavities 3.1 cm³"."""
    mass, center = mass_text(weight.properties.mass_g), center_text(weight.properties.center_mm)
    told = iface_("{mass} {calibration}, center {place}")
    parts = [told.format(mass=mass, calibration=calibration_text(weight.calibration), place=center)]
    if weight.cavities is not None:
        parts.append(cavities_text(weight.cavities))
    return ", ".join(parts)


def calibration_text(calibration: str) -> str:
    """By what a weight was told, in two or three words; the mass table has all of it.

    Args:
        calibration: as `Weight` has it.
    """
    return iface_(_CALIBRATIONS[calibrated_by(calibration)])


def cavities_text(cavities: Sequence[Cavity]) -> str:
    """How many there are and their volume together."""
    if not cavities:
        return iface_("no cavities")
    text = iface_("1 cavity {volume}") if len(cavities) == 1 else iface_("{count} cavities {volume}")
    return text.format(count=len(cavities), volume=volume_text(sum(cavity.volume_mm3 for cavity in cavities)))


def moments_text(moments: Sequence[float]) -> str:
    """Moments of inertia, given in g mm², with three digits: "493 / 1210 / 1250 g cm²"."""
    # In g mm² those of what a hand can hold have powers of ten.
    texts = (f"{0.01 * moment:.0f}" if 999.5 <= 0.01 * moment < 1e6 else f"{0.01 * moment:.3g}" for moment in moments)
    return " / ".join(texts) + " g cm²"
