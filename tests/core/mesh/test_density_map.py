"""Calibrations: two points, materials, water."""

from __future__ import annotations

import numpy as np
import pytest

from insideout.core.errors import SettingError
from insideout.core.mesh.density_map import curve_of_materials, curve_of_points, curve_of_water
from insideout.core.mesh.material_table import find_material


def test_two_points_with_air_are_a_proportion():
    curve = curve_of_points((0.05, 1.25), (0, 0))

    assert curve.factor == pytest.approx(25)
    np.testing.assert_allclose(curve(np.array([0, 0.02, 0.1])), [0, 0.5, 2.5])
    assert curve.edge_mm_inv == pytest.approx(0.025)


def test_air_that_is_not_0_in_the_scan_weighs_nothing():
    """As in grey values that are only scaled."""
    curve = curve_of_points((0.01, 0), (0.05, 1))

    assert curve.factor is None
    np.testing.assert_allclose(curve(np.array([0, 0.01, 0.03, 0.09])), [0, 0, 0.5, 2])
    assert curve.edge_mm_inv == pytest.approx(0.03)


def test_two_materials_leave_air_without_weight():
    curve = curve_of_points((0.04, 1.1), (0.02, 0.1))

    np.testing.assert_allclose(curve(np.array([0, 0.01, 0.02, 0.03, 0.06])), [0, 0.05, 0.1, 0.6, 2.1])
    assert curve.edge_mm_inv == pytest.approx(0.01)


@pytest.mark.parametrize(
    ("first", "second", "words"),
    [
        ((0.05, 1.0), (0.05, 2.0), "Both calibration points have 0.05 mm"),
        ((0.0, 0.0), (0.05, -1.0), "-1 g/cm³; give a density of 0 or more"),
        ((-0.01, 0.0), (0.05, 1.0), "-0.01 mm⁻¹; give an attenuation of 0 or more"),
        ((0.0, 0.0), (float("nan"), 1.0), "nan mm⁻¹"),
        ((0.02, 2.0), (0.05, 1.0), "density grows with attenuation"),
        ((0.0, 0.0), (0.05, 0.0), "density grows with attenuation"),
        ((0.0, 0.5), (0.05, 1.0), "0.5 g/cm³ at 0 mm⁻¹"),
    ],
)
def test_points_that_are_no_calibration(first, second, words):
    with pytest.raises(SettingError, match=words):
        curve_of_points(first, second)


def test_materials_are_met_in_the_order_of_their_attenuation():
    curve = curve_of_materials(["iron", "oak wood", "air"], 60)
    oak, iron = find_material("oak wood"), find_material("iron")

    assert curve.description == "oak wood, iron at 60 keV"
    found = curve(np.array([0, oak.attenuation(60), iron.attenuation(60)]))
    np.testing.assert_allclose(found, [0, oak.density_g_cm3, iron.density_g_cm3])
    assert curve.factor is None
    assert curve.edge_mm_inv == pytest.approx(0.5 * oak.attenuation(60))


def test_one_material_is_a_proportion():
    marble = find_material("marble")
    curve = curve_of_materials(["marble", "Marble"], 100)

    assert curve.factor == pytest.approx(marble.density_g_cm3 / marble.attenuation(100))


def test_materials_of_hounsfield_units_are_in_proportion_to_the_scan_s_water():
    """Whatever water has at that energy, the scan has it where its units were converted with it."""
    at_once = curve_of_materials(["water", "aluminium"], 35, water_mm_inv=0.0195)
    water, aluminium = find_material("water"), find_material("aluminium")

    found = at_once(np.array([0.0195, 0.0195 * aluminium.attenuation(35) / water.attenuation(35)]))
    np.testing.assert_allclose(found, [water.density_g_cm3, aluminium.density_g_cm3])
    assert at_once.edge_mm_inv == pytest.approx(0.5 * 0.0195)
    assert at_once.description == "water, aluminium at 35 keV, with water at 0.0195 mm⁻¹"
    with pytest.raises(SettingError, match="above 0"):
        curve_of_materials(["water"], 35, water_mm_inv=0.0)


def test_a_curve_that_turns_down_does_not_go_on_to_negative_densities():
    """Between 81 and 88 keV gold attenuates far more than lead, at 20 keV silver less than brass."""
    curve = curve_of_materials(["silver", "brass"], 20)

    assert curve(np.array([1e3])) == pytest.approx(find_material("brass").density_g_cm3)


def test_nothing_but_air_is_no_calibration():
    with pytest.raises(SettingError, match="choose at least one"):
        curve_of_materials(["air"], 60)


def test_materials_that_a_scan_cannot_tell_apart():
    glass, terracotta = find_material("glass"), find_material("terracotta")
    energies = np.linspace(20, 40, 2001)
    apart = [abs(glass.attenuation(energy) / terracotta.attenuation(energy) - 1) for energy in energies]

    with pytest.raises(SettingError, match="cannot tell them apart"):
        curve_of_materials(["glass", "terracotta"], float(energies[np.argmin(apart)]))


def test_water():
    assert curve_of_water(0.02).factor == pytest.approx(50)
    for wrong in (0.0, -0.1, float("inf")):
        with pytest.raises(SettingError, match="above 0"):
            curve_of_water(wrong)
