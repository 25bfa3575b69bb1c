"""Density to colour: a perceptually uniform map, dark for air and bright for dense. Numpy alone.

The table is every seventeenth colour of "inferno" (van der Walt and Smith 2015, CC0), straight lines between; it
differs from the full table by at most 0.024.
"""

from __future__ import annotations

import numpy as np

DENSITY_COLORS = np.array(
    [
        [0.0015, 0.0005, 0.0139],
        [0.0469, 0.0303, 0.1502],
        [0.1424, 0.0462, 0.3086],
        [0.2582, 0.0386, 0.4065],
        [0.3665, 0.0716, 0.4320],
        [0.4723, 0.1105, 0.4283],
        [0.5783, 0.1480, 0.4044],
        [0.6827, 0.1895, 0.3608],
        [0.7805, 0.2433, 0.2995],
        [0.8650, 0.3168, 0.2261],
        [0.9296, 0.4115, 0.1454],
        [0.9709, 0.5229, 0.0584],
        [0.9876, 0.6453, 0.0399],
        [0.9788, 0.7745, 0.1760],
        [0.9500, 0.9034, 0.3803],
        [0.9884, 0.9984, 0.6449],
    ]
)


def density_colors(density: np.ndarray, low: float | None = None, high: float | None = None) -> np.ndarray:
    """Colours (..., 3) in 0..1 of densities (...,).

    Args:
        density: mm⁻¹; not a number counts as `low`.
        low: shown darkest; 0 if None.
        high: shown brightest; the 99th percentile of what is above `low` if None.
    """
    density = np.asarray(density, np.float64)
    bottom = 0.0 if low is None else float(low)
    if high is None:
        above = density[density > bottom]
        high = float(np.percentile(above, 99)) if above.size else bottom + 1.0
    span = max(float(high) - bottom, 1e-300)
    place = np.nan_to_num(np.clip((density - bottom) / span, 0, 1)) * (len(DENSITY_COLORS) - 1)
    steps = np.arange(len(DENSITY_COLORS))
    return np.stack([np.interp(place, steps, DENSITY_COLORS[:, c]) for c in range(3)], axis=-1)
