"""The few numbers of a splat that a pixel row of a radiograph needs; see `radiograph_geometry`."""

from __future__ import annotations

from typing import Any

import numpy as np

from ....compiled import njit

# Columns of the coefficient table, float64. With down = i − i₀, a row's first component of P z is 0 at the column
# offset SHIFT_DOWN · down + SHIFT, where that of R z is R_DOWN · down + R_AT; A_DOWN, A_AT are for a P₁₁ of 0. Of what
# comes within reach, the middle is MIDDLE · R z further right, and half the width's square is (HALF · R z)² + INVERSE ·
# (k²·rest − (P z)₂²). P is multiplied by `PER_ROOT`, so that exp(−½·) is 2^(−·).
SHIFT_DOWN, SHIFT, R_DOWN, R_AT, P22, P23, R22, R23, R33_SQUARED, P11, R11, INVERSE, HALF, MIDDLE, A_DOWN, A_AT = range(
    16
)
COLUMN0, ROW0, LEFT, RIGHT, TOP, BOTTOM, AMPLITUDE = range(16, 23)
COLUMNS = 24
PER_ROOT = float(1 / np.sqrt(2 * np.log(2)))
SQRT_2PI = float(np.sqrt(2 * np.pi))


@njit(error_model="numpy", _nrt=False, forceinline=True)
def coefficients(p: Any, r: Any, k2: Any) -> Any:
    """The table's first columns, up to A_AT, from P's five numbers and R's six; without a branch."""
    (p11, p12, p13, p22, p23), (r11, r12, r13, r22, r23, r33) = p, r
    slanted = p11 != 0.0
    per = -1.0 / p11 if slanted else 0.0
    shift_down, shift = p12 * per, p13 * per
    # num − k2·den along a row is square·t² − 2·k2·r₁₁·r·t + ..., t measured from the shift, so that a slanted needle's
    # large terms do not cancel. Where `square` is not positive all of a row counts as within reach.
    square = p11 * p11 - k2 * r11 * r11
    bounded = square > 0.0
    inverse = 1.0 / square if bounded else 0.0
    half = np.sqrt(k2) * p11 * inverse if bounded else np.inf
    return (
        shift_down,
        shift,
        r11 * shift_down + r12,
        r11 * shift + r13,
        PER_ROOT * p22,
        PER_ROOT * p23,
        r22,
        r23,
        r33 * r33,
        PER_ROOT * p11,
        r11,
        inverse * (1 / PER_ROOT**2),
        half,
        k2 * r11 * inverse,
        0.0 if slanted else PER_ROOT * p12,
        0.0 if slanted else PER_ROOT * p13,
    )
