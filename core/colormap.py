"""Density to colour: perceptually uniform maps, dark for air and bright for dense. Numpy alone.

The tables are every seventeenth colour of "inferno" and "viridis" (van der Walt and Smith 2015, CC0) and of "cividis"
(Nuñez, Anderton and Renslow 2018, CC0), straight lines between; they differ from the full tables by at most 0.038.
"Difference" is for signed values: RdBu of ColorBrewer 2 (Apache 2.0), the other way round.
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


COLOR_MAPS = {
    "inferno": DENSITY_COLORS,
    "viridis": np.array(
        [
            [0.2670, 0.0049, 0.3294],
            [0.2827, 0.1002, 0.4222],
            [0.2771, 0.1852, 0.4899],
            [0.2539, 0.2653, 0.5300],
            [0.2220, 0.3392, 0.5488],
            [0.1906, 0.4071, 0.5561],
            [0.1636, 0.4711, 0.5581],
            [0.1391, 0.5338, 0.5553],
            [0.1206, 0.5964, 0.5436],
            [0.1347, 0.6586, 0.5176],
            [0.2080, 0.7187, 0.4729],
            [0.3278, 0.7740, 0.4066],
            [0.4775, 0.8214, 0.3182],
            [0.6473, 0.8584, 0.2099],
            [0.8249, 0.8847, 0.1062],
            [0.9932, 0.9062, 0.1439],
        ]
    ),
    "cividis": np.array(
        [
            [0.0000, 0.1351, 0.3048],
            [0.0000, 0.1816, 0.4219],
            [0.1176, 0.2259, 0.4343],
            [0.2089, 0.2725, 0.4248],
            [0.2794, 0.3187, 0.4230],
            [0.3422, 0.3649, 0.4286],
            [0.4014, 0.4118, 0.4407],
            [0.4584, 0.4596, 0.4605],
            [0.5179, 0.5085, 0.4727],
            [0.5821, 0.5587, 0.4681],
            [0.6482, 0.6106, 0.4548],
            [0.7162, 0.6644, 0.4324],
            [0.7860, 0.7204, 0.3996],
            [0.8578, 0.7790, 0.3533],
            [0.9322, 0.8402, 0.2859],
            [0.9957, 0.9093, 0.2178],
        ]
    ),
    "grey": np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]),
    "difference": np.array(
        [
            [0.0196, 0.1882, 0.3804],
            [0.1294, 0.4000, 0.6745],
            [0.2627, 0.5765, 0.7647],
            [0.5725, 0.7725, 0.8706],
            [0.8196, 0.8980, 0.9412],
            [0.9686, 0.9686, 0.9686],
            [0.9922, 0.8588, 0.7804],
            [0.9569, 0.6471, 0.5098],
            [0.8392, 0.3765, 0.3020],
            [0.6980, 0.0941, 0.1686],
            [0.4039, 0.0000, 0.1216],
        ]
    ),
}
"""sRGB colours from the lowest to the highest value, evenly spaced."""


def density_colors(
    density: np.ndarray, low: float | None = None, high: float | None = None, colors: str = "inferno"
) -> np.ndarray:
    """Colours (..., 3) in 0..1 of densities (...,).

    Args:
        density: mm⁻¹; not a number counts as `low`.
        low: shown darkest; 0 if None.
        high: shown brightest; the 99th percentile of what is above `low` if None.
        colors: one of `COLOR_MAPS`.
    """
    table = COLOR_MAPS[colors]
    density = np.asarray(density, np.float64)
    bottom = 0.0 if low is None else float(low)
    if high is None:
        above = density[density > bottom]
        high = float(np.percentile(above, 99)) if above.size else bottom + 1.0
    span = max(float(high) - bottom, 1e-300)
    place = np.nan_to_num(np.clip((density - bottom) / span, 0, 1)) * (len(table) - 1)
    steps = np.arange(len(table))
    return np.stack([np.interp(place, steps, table[:, c]) for c in range(3)], axis=-1)
