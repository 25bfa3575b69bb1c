"""Figures say as much of small things as of large ones."""

from __future__ import annotations

import math

import pytest

from insideout.core.digits import decimals, fixed, length_decimals


@pytest.mark.parametrize(
    ("size", "told"), [(0.034, "0.0340"), (0.5, "0.500"), (5.0, "5.00"), (123.456, "123.46"), (0.0, "0.00")]
)
def test_a_length_has_three_digits_and_two_decimals_at_least(size, told):
    assert fixed(size, length_decimals(size)) == told


@pytest.mark.parametrize(("size", "told"), [(99.6, "100"), (9.96, "10"), (5.23, "5.2"), (0.0344, "0.034")])
def test_what_is_rounded_up_counts_as_what_it_becomes(size, told):
    assert fixed(size, decimals(size, 2)) == told


@pytest.mark.parametrize("size", [math.nan, math.inf, 0.0])
def test_what_has_no_size_has_the_least(size):
    assert decimals(size, 3, 1) == 1


def test_there_is_no_minus_zero():
    assert fixed(-0.001, 2) == "0.00"
