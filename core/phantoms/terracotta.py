"""A small clay figure, an officer of an old army: hollow, of uneven wall, with its flaws hidden inside.

Two cracks in the robe and one in the plinth, air bubbles, grains of heavy temper, and a repair in plaster under the
last coat of slip. The head is turned, one arm bent, and the plinth chipped: no turn brings the shape upon itself.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from . import terracotta_shape as shape
from .materials import Material
from .model import Part, Phantom
from .sculpture import Step, add, egg, sculpt
from .terracotta_paint import paint

CLAY = Material(
    "fired clay",
    (("SiO2", 0.63), ("Al2O3", 0.19), ("Fe2O3", 0.07), ("CaO", 0.05), ("K2O", 0.03), ("MgO", 0.03)),
    1.90,
)
_GRAIN = Material("iron-rich temper", (("SiO2", 0.45), ("Fe2O3", 0.55)), 3.60)
_PLASTER = Material("plaster", "CaSO6H4", 1.15)
_ENERGY_KEV = 75.0
_SKIN_MM = 1.2
_BUBBLES, _GRAINS = 12, 30


def terracotta() -> Phantom:
    """The phantom, looking towards −y."""
    parts = (
        Part("figure", shape.outside, CLAY),
        Part("hollow and vent", shape.hollow, None),
        Part("repair", repair, _PLASTER),
        Part("grains", grains, _GRAIN),
        Part("bubbles", bubbles, None),
        Part("crack in the robe", robe_crack, None),
        Part("crack between layers", layer_crack, None),
        Part("crack in the plinth", plinth_crack, None),
    )
    return Phantom(
        name="terracotta",
        parts=parts,
        surface=surface,
        color=_color,
        size_mm=(52.0, 46.0, 113.0),
        energy_kev=_ENERGY_KEV,
        landmarks=_landmarks(),
    )


def surface(points: np.ndarray) -> np.ndarray:
    """The clay as photos show it: its outside, and the hollow through the vent."""
    return np.maximum(shape.outside(points), -shape.hollow(points))


def within(points: np.ndarray) -> np.ndarray:
    """(N,) distance to what lies deeper than the skin, 1.2 mm, from outside and 0.6 mm from the hollow."""
    return np.maximum(shape.outside(points) + _SKIN_MM, 0.6 - shape.hollow(points))


def robe_crack(points: np.ndarray) -> np.ndarray:
    """From the hem upwards through the front wall at his left, 0.7 mm wide, wandering."""
    x, y, z = points.T
    sideways = 0.83 * x + 0.56 * y - 2.9 + 0.7 * np.sin(0.45 * z) + 0.3 * np.sin(1.1 * z + 0.6 * y)
    return _sheet(points, 0.85 * sideways, 0.35, egg((10.0, -9.5, -28), (9, 9, 15)).distance(points))


def layer_crack(points: np.ndarray) -> np.ndarray:
    """Between two layers of clay in the front wall at his right, 0.6 mm wide, along the wall."""
    depth = shape.lining().distance(points) - 2.6 + 0.25 * np.sin(0.8 * points[:, 2])
    return _sheet(points, depth, 0.30, egg((-9.5, -9.0, -24), (6.5, 6, 11), turn=(0, 20, 0)).distance(points))


def plinth_crack(points: np.ndarray) -> np.ndarray:
    """Across a corner of the plinth, 0.8 mm wide."""
    x, y, z = points.T
    across = 0.72 * x - 0.62 * y - 0.3 * z - 31.9 + 0.35 * np.sin(0.9 * (x + y))
    return _sheet(points, 0.9 * across, 0.40, egg((14, -10, -52), (12, 12, 6)).distance(points))


def _sheet(points: np.ndarray, height: np.ndarray, half_width: float, extent: np.ndarray) -> np.ndarray:
    """A thin gap where |height| < half_width, inside `extent`, and nowhere near a surface of the clay."""
    total = np.maximum(np.abs(height) - np.float32(half_width), extent)
    near = np.flatnonzero(extent < 2.0)
    total[near] = np.maximum(total[near], within(points[near]))
    return total


def repair(points: np.ndarray) -> np.ndarray:
    """A plug of plaster in the back of the robe at his left, under 0.7 mm of slip, flush with the hollow."""
    plug = egg((11.5, 10.5, -31), (6.0, 6.0, 5.0), turn=(0, 30, 0)).distance(points)
    near = np.flatnonzero(plug < 3.0)
    plug[near] = np.maximum.reduce([plug[near], shape.outside(points[near]) + 0.7, -shape.hollow(points[near])])
    return plug


def bubbles(points: np.ndarray) -> np.ndarray:
    """Round pores of 1 to 2.6 mm across."""
    return sculpt(points, _scattered(_BUBBLES, (0.7, 1.3), 11))


def grains(points: np.ndarray) -> np.ndarray:
    """Coarse grains of 0.8 to 2.2 mm across."""
    return sculpt(points, _scattered(_GRAINS, (0.55, 1.1), 7))


@lru_cache(maxsize=2)
def _scattered(count: int, radii: tuple[float, float], seed: int) -> tuple[Step, ...]:
    """Pebbles at random places where the clay is thick enough to hide them."""
    rng = np.random.default_rng(seed)
    half = np.array([22.0, 20.0, 55.0])
    steps: list[Step] = []
    while len(steps) < count:
        points = rng.uniform(-half, half, (4000, 3)).astype(np.float32)
        semi = rng.uniform(*radii, (4000, 1)) * rng.uniform(0.75, 1.0, (4000, 3))
        fits = np.flatnonzero(np.maximum(within(points), -repair(points)) < -semi.max(1) + 0.4)
        for index in fits[: max(1, count // 3)]:
            steps.append(add(egg(points[index], semi[index], turn=rng.uniform(0, 180, 3))))
    return tuple(steps[:count])


def _color(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    points = np.asarray(points, np.float32)
    found = {"robe": shape.dressed(points)}
    found |= {name: sculpt(points, steps) for name, steps in shape.groups().items()}
    ridge = shape.plain().distance(points)
    lapel = shape.lapel(points[:, 0], points[:, 2])
    return paint(points, shape.head_frame(points), found, ridge, lapel, -shape.outside(points))


def _landmarks() -> np.ndarray:
    """Nose, bun, both elbows, the fist, the buckle and a corner of the plinth: on the surface, mm."""
    starts = np.array(
        [[4, -40, 40.2], [-2.5, 2, 70], [-40, 2.2, 8], [40, 3, 8], [13, -40, 3.5], [-0.5, -40, 2], [-40, -36, -51]],
        float,
    )
    ends = np.array(
        [[0, 0, 40.2], [-2.5, 2, 40], [0, 2.2, 8], [0, 3, 8], [13, 0, 3.5], [-0.5, 0, 2], [0, 0, -51]], float
    )
    share = np.linspace(0, 1, 4001)[:, None]
    lines = [(start + share * (end - start)).astype(np.float32) for start, end in zip(starts, ends, strict=True)]
    return np.array([line[np.argmax(surface(line) < 0)] for line in lines], np.float64)
