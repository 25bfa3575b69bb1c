"""One pass of Adam, whose numbers are never too small for full precision."""

import numpy as np
import pytest

from insideout.core.train.adam import adam_step

SMALLEST = np.finfo(np.float32).tiny


class Moved:
    """Values of one group at 0, with limits far away."""

    def __init__(self, count=4, memory=0.99):
        self.values, self.gradients, self.first, self.second = (np.zeros(count, np.float32) for _ in range(4))
        self.memory, self.steps = memory, 0

    def step(self, gradient):
        self.gradients[:] = gradient
        self.steps += 1
        adam_step(
            self.values, self.gradients, self.first, self.second, np.array([len(self.values)]), np.array([1e-3]),
            np.array([[-1e9, 1e9]], np.float32), self.steps, 0.9, self.memory, 1e-15,
        )  # fmt: skip

    def has_small_numbers(self):
        return any(((abs(part) > 0) & (abs(part) < SMALLEST)).any() for part in (self.first, self.second))


@pytest.mark.parametrize("gradient", [1.0, -1e-6, 1e-12])
def test_moments_without_a_gradient_end_at_nothing(gradient):
    """A tenth less than the least number there is would be rounded to the same for ever."""
    moved = Moved(memory=0.9)
    moved.step(gradient)
    for _ in range(2000):
        moved.step(0.0)
        assert not moved.has_small_numbers()
    assert not moved.first.any()
    assert not moved.second.any()
    still = moved.values.copy()
    moved.step(0.0)
    assert np.array_equal(moved.values, still)


@pytest.mark.parametrize("exponent", range(-40, -14))
def test_no_gradient_makes_moments_too_small_for_full_precision(exponent):
    moved = Moved()
    for _ in range(3):
        moved.step(np.float32(10.0**exponent))
        assert not moved.has_small_numbers()


@pytest.mark.parametrize("gradient", [1e-12, 1e-3, 1e12])
def test_a_first_step_is_as_long_as_the_rate_however_small_its_gradient(gradient):
    moved = Moved()
    moved.step(gradient)
    assert moved.values == pytest.approx(-1e-3, rel=2e-3)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_a_number_is_not_taken_for_nothing(bad):
    moved = Moved()
    moved.first[0] = bad
    moved.step(0.0)
    assert not np.isfinite(moved.first[0])
    assert not moved.first[1:].any()
