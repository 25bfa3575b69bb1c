"""How many decimals a figure is written with, so that it says as much of a small thing as of a large one."""

from __future__ import annotations

import math

# Cubes of a micrometre are 1e-9 mm³; of lengths less than a nanometre is told of none.
_MOST, _MOST_OF_LENGTHS = 9, 6


def decimals(size: float, digits: int, least: int = 0) -> int:
    """Decimals with which a figure of this size has so many digits that count.

    Args:
        size: of the figure, or of the step that is to be told apart.
        digits: that count, 1 or more.
        least: what larger figures have, too.
    """
    if not (math.isfinite(size) and size):
        return least
    exponent = int(f"{abs(size):.{digits - 1}e}".partition("e")[2])
    return min(max(digits - 1 - exponent, least), _MOST)


def fixed(value: float, places: int) -> str:
    """A figure with so many decimals."""
    # Rounded first, for there is no -0.00.
    return f"{round(float(value), places) + 0.0:.{places}f}"


def length_decimals(length: float, digits: int = 3) -> int:
    """Decimals of a length, and of those told with it, of which it is the least: two, and more of a small one."""
    return min(decimals(length, digits, 2), _MOST_OF_LENGTHS)
