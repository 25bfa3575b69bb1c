"""With how many decimals a probe is told."""

from __future__ import annotations

import pytest

from insideout.core.gaussians import GaussianSet
from insideout.insideout_addon.measure.probe import probe
from insideout.insideout_addon.measure.probe_result import lines


@pytest.mark.parametrize(
    ("scales", "place", "distance", "sizes"),
    [
        ((0.31, 0.27, 3.2e-6), "1.00 2.00 3.25", "0.25 mm away", "0.31 0.27 0.000003"),
        ((0.0312, 0.0051, 0.0044), "1.000 2.000 3.250", "0.250 mm away", "0.031 0.0051 0.0044"),
    ],
)
def test_places_have_the_digits_of_a_splats_largest_size_and_each_size_its_own(blender, scales, place, distance, sizes):
    """Splats of photos are flat."""
    told = lines(probe(GaussianSet.create([[1, 2, 3]], [scales], density=0.1), (1.0, 2.0, 3.25)), in_mm=True)
    assert told[0] == f"At {place} mm"
    assert any(line.endswith(distance) for line in told)
    assert told[-1].endswith(f"sizes {sizes} mm")
