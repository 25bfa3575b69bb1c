"""Noise is repeatable, of variance one, as fine as asked for, and the same wherever a point is asked about."""

from __future__ import annotations

import numpy as np
import pytest

from insideout.core.phantoms.texture import waves

POINTS = np.random.default_rng(0).uniform(-50, 50, (20_000, 3)).astype(np.float32)


@pytest.mark.parametrize("wave_number", [0.3, 2.0])
def test_mean_zero_and_variance_one(wave_number):
    found = waves(POINTS, wave_number, seed=1)
    assert abs(found.mean()) < 0.1
    assert found.std() == pytest.approx(1.0, abs=0.1)


def test_seed_decides():
    np.testing.assert_array_equal(waves(POINTS, 1.0, seed=1), waves(POINTS, 1.0, seed=1))
    assert abs(np.corrcoef(waves(POINTS, 1.0, seed=1), waves(POINTS, 1.0, seed=2))[0, 1]) < 0.1


def test_finer_waves_change_faster():
    step = np.float32([0.1, 0, 0])
    slow, fast = (np.std(waves(POINTS + step, k, seed=1) - waves(POINTS, k, seed=1)) for k in (0.5, 2.0))
    assert fast == pytest.approx(4 * slow, rel=0.1)
