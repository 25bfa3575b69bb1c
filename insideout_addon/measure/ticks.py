"""Round numbers for axes, bars and scales."""

from __future__ import annotations

import math


def round_step(at_least: float) -> float:
    """The next 1, 2 or 5 times a power of ten that is no smaller."""
    decade = 10.0 ** math.floor(math.log10(at_least))
    return next(factor * decade for factor in (1, 2, 5, 10) if factor * decade >= at_least * 0.999999)


def round_ticks(low: float, high: float, most: int = 8) -> list[tuple[float, str]]:
    """Round values from `low` to `high` in equal steps, at most `most` of these, each with its text."""
    step = round_step(max(high - low, 1e-12) / most)
    digits = max(0, -math.floor(math.log10(step) + 1e-9))
    first, last = math.ceil(low / step - 1e-6), math.floor(high / step + 1e-6)
    return [(index * step, f"{index * step:.{digits}f}") for index in range(first, last + 1)]
