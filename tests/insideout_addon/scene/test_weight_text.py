"""How a weight is told."""

from __future__ import annotations

import numpy as np
import pytest

from insideout.core.mesh.cavities import Cavity
from insideout.core.mesh.density_map import curve_of_materials, curve_of_points, curve_of_water
from insideout.core.mesh.mass import MassProperties
from insideout.core.mesh.weight import Weight
from insideout.insideout_addon.scene.weight_text import moments_text, weight_text


def _told(mass_g, *volumes_mm3, calibration="water at 0.0195 mm⁻¹"):
    properties = MassProperties(mass_g, np.array([1.24, -0.31, -0.01]), np.eye(3))
    return weight_text(Weight(properties, tuple(Cavity(volume, np.zeros(3)) for volume in volumes_mm3), calibration))


def test_figures_in_words():
    assert _told(412.34, 3000.0, 100.0) == "412.3 g by water, center 1.2 / -0.3 / 0.0 mm, 2 cavities 3.1 cm³"
    assert _told(12345.6, 64.0) == "12.35 kg by water, center 1.2 / -0.3 / 0.0 mm, 1 cavity 64 mm³"
    assert _told(0.5, 99.6).endswith("1 cavity 100 mm³")
    assert _told(0.5) == "0.5 g by water, center 1.2 / -0.3 / 0.0 mm, no cavities"


@pytest.mark.parametrize(
    ("curve", "told"),
    [
        (curve_of_water(0.0195), "by water"),
        (curve_of_water(0.5, "rel"), "by water"),
        (curve_of_points((0.0, 0.0), (0.04, 2.5)), "by two points"),
        (curve_of_materials(["PMMA", "aluminium"], 60), "by materials"),
        (curve_of_materials(["water"], 60), "by water"),
        (curve_of_materials(["water", "aluminium"], 60), "by materials"),
    ],
)
def test_a_mass_is_told_with_its_calibration(curve, told):
    assert _told(7.0, calibration=curve.description).startswith(f"7 g {told}, center ")


def test_moments_of_what_a_hand_holds_have_no_powers_of_ten():
    assert moments_text([4.93e4, 1.21e5, 1.254e5]) == "493 / 1210 / 1254 g cm²"
    assert moments_text([0.5, 12.0, 3e9]) == "0.005 / 0.12 / 3e+07 g cm²"
