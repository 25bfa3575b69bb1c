"""The table of materials against the library that it was made with."""

from __future__ import annotations

import numpy as np
import pytest

from insideout.core.errors import SettingError
from insideout.core.mesh.material_table import ENERGIES_KEV, MATERIALS, find_material
from insideout.core.phantoms.materials import Material


@pytest.mark.parametrize("material", MATERIALS, ids=lambda material: material.name)
def test_attenuation_is_that_of_xraylib(material):
    pytest.importorskip("xraylib")
    exact = Material(material.name, material.formulas, material.density_g_cm3)
    energies = np.arange(20, 151)

    found = [material.attenuation(energy) for energy in energies]

    np.testing.assert_allclose(found, exact.attenuations(energies), rtol=0.005)


@pytest.mark.parametrize(("name", "edge"), [("silver", 25.514), ("bronze", 29.2001), ("gold", 80.7249)])
def test_an_edge_is_a_step_and_no_slope(name, edge):
    pytest.importorskip("xraylib")
    material = find_material(name)
    exact = Material(name, material.formulas, material.density_g_cm3)

    for energy in (edge - 0.05, edge + 0.05):
        assert material.attenuation(energy) == pytest.approx(exact.attenuation(energy), rel=0.005)
    assert material.attenuation(edge + 0.05) > 1.3 * material.attenuation(edge - 0.05)


def test_formulas_add_up():
    for material in MATERIALS:
        assert sum(share for _, share in material.formulas) == pytest.approx(1, abs=0.01), material.name


def test_names_are_found_as_people_and_scripts_write_them():
    assert find_material(" Cortical Bone").name == find_material("CORTICAL_BONE").name == "cortical bone"


def test_an_unknown_material_is_answered_with_those_there_are():
    with pytest.raises(SettingError, match=r"no material 'mithril'; choose among air, water, .*gold"):
        find_material("mithril")


@pytest.mark.parametrize("energy", [ENERGIES_KEV[0] - 0.1, ENERGIES_KEV[-1] + 1, float("nan")])
def test_an_energy_beyond_the_table_is_refused(energy):
    with pytest.raises(SettingError, match="give one of 20 to 150 keV"):
        find_material("iron").attenuation(energy)
