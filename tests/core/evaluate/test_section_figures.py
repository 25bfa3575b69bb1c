import numpy as np
import pytest

from insideout.core.evaluate.heldout import section_figures


def test_light_material_beside_heavy_metal_is_an_object_too():
    """Plastic attenuates a twentieth of what the screws in it do, whose attenuation is full scale."""
    plastic, empty = np.zeros((40, 40), np.float32), np.zeros((40, 40), np.float32)
    plastic[10:30, 10:30] = 0.019
    found = section_figures([plastic + 0.001, empty], [plastic, empty], peak=0.4, air=0.009)
    assert found["count"] == 1
    assert found["psnr"] == pytest.approx(20 * np.log10(0.4 / 0.001), abs=0.01)
