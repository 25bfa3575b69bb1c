"""The beam: one energy gives the attenuation's own line integrals, a tube's spectrum hardens."""

from __future__ import annotations

import numpy as np
import pytest

from insideout.core.phantoms.materials import Material
from insideout.core.phantoms.spectrum import monochromatic, tube_spectrum

WATER, IRON = Material("water", "H2O", 1.0), Material("iron", "Fe", 7.87)


def test_one_energy_adds_up_attenuation_times_length():
    lengths = np.array([[0.0, 10.0, 30.0], [0.0, 1.0, 100.0]])

    found = monochromatic(60.0).line_integrals((WATER, IRON), lengths)

    np.testing.assert_allclose(found, WATER.attenuation(60) * lengths[0] + IRON.attenuation(60) * lengths[1])


def test_water_and_iron_are_those_of_the_tables():
    # NIST XCOM, total with coherent scatter: 0.2059 and 1.205 cm²/g at 60 keV.
    assert WATER.attenuation(60.0) == pytest.approx(0.02059, rel=0.01)
    assert IRON.attenuation(60.0) == pytest.approx(0.1 * 7.87 * 1.205, rel=0.01)


@pytest.mark.parametrize("energy", [36.0, 60.0, 100.0])
def test_a_tube_has_the_mean_energy_asked_for(energy):
    spectrum = tube_spectrum(energy)

    photons = spectrum.weights / spectrum.energies_kev
    assert np.average(spectrum.energies_kev, weights=photons) == pytest.approx(energy, abs=0.1)
    assert spectrum.weights.sum() == pytest.approx(1)
    assert spectrum.energies_kev.max() < 1.75 * energy


def test_the_more_iron_the_less_a_millimetre_takes_away():
    millimetres = np.array([0.05, 0.5, 2.0, 8.0, 200.0])

    mean = tube_spectrum(60.0).line_integrals((IRON,), millimetres[None]) / millimetres

    assert np.all(np.diff(mean) < 0)
    assert mean[0] > 1.1 * IRON.attenuation(60.0)
    assert mean[3] < 0.8 * IRON.attenuation(60.0)
    assert np.isfinite(mean).all()


def test_no_material_takes_nothing_away():
    assert not tube_spectrum(50.0).line_integrals((), np.zeros((0, 4))).any()
