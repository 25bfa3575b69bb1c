"""The clay figure's outside in mm, facing −y, z up, in groups: a robe as radii around an axis, the rest modelled on."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter, map_coordinates, maximum_filter

from .sculpture import Step, add, box, carve, egg, limb, paired, posed, sculpt, smooth_cut, turned

# Height, half width, half depth in mm of the robe without its folds.
_ROBE = np.array(
    [
        [-56.0, 19.5, 15.6],
        [-49.0, 19.0, 15.2],
        [-40.0, 17.2, 14.0],
        [-25.0, 14.6, 12.2],
        [-10.0, 12.9, 10.9],
        [2.0, 11.6, 9.6],
        [10.0, 12.8, 9.9],
        [18.0, 13.8, 9.8],
        [30.0, 13.4, 9.0],
    ]
)
_ROBE_TOP = 21.0
HEAD_TURN, HEAD_PIVOT = (3.0, -4.0, 16.0), (0.0, 0.0, 33.0)
VENT = limb([(1.0, 18, -14), (0.5, 3, -14)], 3.4)
_SHOULDERS = add(egg((0, 0.2, 19.5), (14.4, 9.4, 9.6), power=2.2), 3.0)


@dataclass(frozen=True, eq=False)
class Mantle:
    """A solid around the z axis by its radius over azimuth and height, between two heights.

    Attributes:
        radii: (heights, azimuths) mm; azimuth 0 is −y, growing towards +x; the last column repeats the first.
        rise: (heights, azimuths) |d radius / d height|, the most nearby, so that no step is too far.
        swing: (heights, azimuths) |d radius / d azimuth| in mm, the most nearby.
        narrowest: (heights,) mm, the least of the radii.
        low_z, step: mm, of the rows.
    """

    radii: np.ndarray
    rise: np.ndarray
    swing: np.ndarray
    narrowest: np.ndarray
    low_z: float
    step: float

    @classmethod
    def of(cls, radii: np.ndarray, low_z: float, step: float) -> Mantle:
        """From radii (heights, azimuths), which must not repeat the first azimuth."""
        along = np.abs(np.gradient(radii, step, axis=0))
        around = np.abs(np.roll(radii, -1, 1) - np.roll(radii, 1, 1)) * radii.shape[1] / (4 * np.pi)
        reach = (int(3 / step), radii.shape[1] // 24)
        edges = ("nearest", "wrap")
        most = [gaussian_filter(maximum_filter(one, reach, mode=edges), 4.0, mode=edges) for one in (along, around)]
        closed, rise, swing = (np.concatenate([one, one[:, :1]], 1).astype(np.float32) for one in (radii, *most))
        return cls(closed, rise, swing, radii.min(axis=1).astype(np.float32), low_z, step)

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Signed distances (N,) at points (N, 3), not yet cut at any height."""
        reach = np.hypot(points[:, 0], points[:, 1])
        turn = np.arctan2(points[:, 0], -points[:, 1]) / np.float32(2 * np.pi) % 1.0
        row = (points[:, 2] - self.low_z) / self.step
        where = np.stack([row, turn * (self.radii.shape[1] - 1)])
        radius, rise, swing = (
            map_coordinates(table, where, order=1, mode="nearest", output=np.float32)
            for table in (self.radii, self.rise, self.swing)
        )
        narrow = self.narrowest[np.clip(row + 0.5, 0, len(self.narrowest) - 1).astype(int)]
        steep = 1 + rise * rise
        by_slope = (reach - radius) / np.sqrt(steep + (swing / np.maximum(reach, 2.0)) ** 2)
        # Near the axis the azimuth says little; there the narrowest radius bounds the depth from both sides.
        return np.maximum(np.minimum(by_slope, (reach - narrow) / np.sqrt(steep)), -narrow)


_LOW_Z, _STEP, _AZIMUTHS = -56.0, 0.25, 540


def _grid() -> tuple[np.ndarray, np.ndarray]:
    heights = np.arange(_LOW_Z, 30.0, _STEP)[:, None]
    return heights, (np.arange(_AZIMUTHS) * 2 * np.pi / _AZIMUTHS)[None, :]


def _plain_radii() -> np.ndarray:
    heights, azimuth = _grid()
    wide, deep = (PchipInterpolator(_ROBE[:, 0], _ROBE[:, k])(heights) for k in (1, 2))
    return 1 / np.hypot(np.sin(azimuth) / wide, np.cos(azimuth) / deep)


def _folds() -> np.ndarray:
    """How far the robe's folds stand out, deepest at the hem."""
    heights, azimuth = _grid()
    hang = np.clip((-2.0 - heights) / 40.0, 0, 1) ** 0.8
    drift = azimuth + 0.05 * np.sin(0.09 * heights + 2 * azimuth)
    third = 0.5 * np.cos(17 * drift + 0.3 * np.sin(0.1 * heights))
    return hang * 1.35 * np.tanh(np.cos(11 * drift + 0.6) + 0.7 * np.cos(7 * drift + 2.1) + third)


@lru_cache(maxsize=1)
def robe() -> Mantle:
    """The robe with folds below the belt, creases above it, the belt, and the edge that crosses the chest."""
    heights, azimuth = _grid()
    radii = _plain_radii() + _folds()
    pulled = np.clip((heights - 3) / 10, 0, 1) * np.clip((24 - heights) / 8, 0, 1)
    radii = radii + 0.30 * pulled * np.sin(0.55 * heights + 3 * np.cos(azimuth + 0.8) + 2 * azimuth)
    across = radii * np.sin(azimuth)
    front = np.cos(azimuth) > 0
    edge = lapel(across, heights)
    radii = radii + np.where(front, 0.75 / (1 + np.exp(3.0 * edge)) * np.clip((across + 13) / 4, 0, 1), 0)
    trim = np.exp(-(((edge + 1.2) / 1.0) ** 4))
    radii = radii + np.where(front & (across > -12), 0.45 * trim, 0)
    radii = radii + 1.1 / (1 + np.exp(6 * (np.abs(heights - 2.0) - 1.9)))
    return Mantle.of(gaussian_filter(radii, 0.8, mode=("nearest", "wrap")), _LOW_Z, _STEP)


def lapel(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """About the distance in mm, across, to the edge of the robe's upper front, which lies at its left."""
    return np.where(z > 2, x - 0.62 * (z - 12), x - 0.16 * (2 - z) + 5.6)


@lru_cache(maxsize=1)
def lining() -> Mantle:
    """The hollow's side: some 6 mm of clay at the front, 5 at the sides and 4 at the back, as hands press it."""
    heights, azimuth = _grid()
    pressed = 0.25 * np.sin(3 * azimuth + 0.15 * heights) + 0.2 * np.sin(0.31 * heights + azimuth)
    wall = 5.05 + 1.1 * np.cos(azimuth) + pressed
    return Mantle.of(_plain_radii() + 0.6 * _folds() - wall, _LOW_Z, _STEP)


@lru_cache(maxsize=1)
def plain() -> Mantle:
    """The robe without folds, belt and edges."""
    return Mantle.of(_plain_radii(), _LOW_Z, _STEP)


def head_frame(points: np.ndarray) -> np.ndarray:
    """Points (N, 3) where they were before the head was turned."""
    pivot = np.asarray(HEAD_PIVOT, np.float32)
    return (points - pivot) @ turned(HEAD_TURN).T + pivot


def dressed(points: np.ndarray) -> np.ndarray:
    """(N,) distances of the robe's trunk with its shoulders."""
    trunk = smooth_cut(robe().distance(points), np.maximum(points[:, 2] - _ROBE_TOP, -50.5 - points[:, 2]), 1.5)
    return sculpt(points, (_SHOULDERS,), trunk)


def outside(points: np.ndarray) -> np.ndarray:
    """(N,) distances of the figure as if it were solid."""
    return sculpt(points, _modelled(), dressed(points))


def hollow(points: np.ndarray) -> np.ndarray:
    """(N,) distances of the air inside: trunk, neck and head, and the vent through the back."""
    trunk = smooth_cut(lining().distance(points), np.maximum(points[:, 2] - 18.0, -50.0 - points[:, 2]), 4.0)
    return sculpt(points, _hollowed(), trunk)


@lru_cache(maxsize=1)
def _hollowed() -> tuple[Step, ...]:
    return (
        add(egg((0, 0.6, 16.0), (9.0, 4.6, 7.5)), 2.0),
        add(limb([(0, 0.5, 20), (0, 0, 38)], (2.4, 1.3)), 1.5),
        add(egg((-0.2, -0.3, 42.2), (3.3, 3.6, 4.6)), 1.5),
        add(VENT, 0.6),
    )


@lru_cache(maxsize=1)
def groups() -> dict[str, tuple[Step, ...]]:
    """What is modelled onto the robe, by name, in order."""
    return {
        "plinth": _plinth(),
        "shoes": _shoes(),
        "sleeves": _sleeves(),
        "hands": _hands(),
        "buckle": (add(box((-0.5, -11.6, 2.0), (2.6, 1.2, 1.8), turn=(4, 0, 3), rounding=0.6), 0.4),),
        "neck": (add(limb([(0, 0.4, 26), (0, -0.6, 36)], (5.0, 4.5)), 1.5),),
        "scarf": _scarf(),
        "head": tuple(_head_posed(_head())),
        "hair": tuple(_head_posed(_hair())),
    }


@lru_cache(maxsize=1)
def _modelled() -> tuple[Step, ...]:
    return tuple(step for steps in groups().values() for step in steps)


def _plinth() -> tuple[Step, ...]:
    return (
        add(box((0, -1.5, -51.5), (21, 18.5, 3.5), turn=(0, 0, 4), rounding=1.0), 0.8),
        carve(egg((21.5, -20, -48), (4.5, 5, 4)), 0.4),
        carve(egg((-20, 17, -49.0), (2.2, 4, 2.2)), 0.4),
    )


def _shoes() -> tuple[Step, ...]:
    return (
        add(paired(egg((7.4, -14.6, -46.4), (4.3, 6.2, 3.6), power=2.6)), 0.6),
        add(paired(limb([(4.6, -19.3, -45.6), (10.2, -19.0, -45.6)], 1.6)), 1.2),
    )


def _sleeves() -> tuple[Step, ...]:
    """His right arm hangs, his left is bent forward; both cuffs are wide."""
    rings = [
        add(egg((x, y, z), (5.3, 5.0, 1.3), turn=(20, dip, 0)), 1.2)
        for x, y, z, dip in ((-17.2, 1.4, 13, 14), (-18.6, 1.8, 7.0, 6))
    ]
    return (
        add(limb([(-12.5, 0.2, 22.0), (-18.3, 2.2, 8.5), (-18.2, -1.5, -3.5)], (5.4, 5.0, 5.6)), 2.0),
        *rings,
        carve(egg((-18.0, -3.6, -10.0), (3.9, 3.7, 3.4)), 0.6),
        add(limb([(12.5, 0.2, 22.0), (18.4, 3.0, 8.0)], (5.4, 5.2)), 2.0),
        add(limb([(18.4, 3.0, 8.0), (14.6, -11.0, 4.2)], (5.2, 5.4)), 1.5),
        add(limb([(18.2, -1.0, 3.0), (15.6, -8.5, -5.5), (15.0, -9.0, -9.0)], (4.0, 3.0, 2.0)), 3.0),
        carve(egg((13.8, -16.0, 4.0), (3.7, 3.0, 3.6)), 0.6),
    )


def _hands() -> tuple[Step, ...]:
    steps = [
        add(egg((-17.6, -3.6, -10.5), (2.4, 3.4, 4.4), turn=(-14, 0, 0))),
        add(limb([(-17.6, -2.6, -4), (-17.6, -3.4, -9)], 2.6), 1.0),
        add(limb([(-16.6, -6.0, -8.5), (-15.9, -7.2, -12.2)], (1.2, 0.9)), 0.6),
        add(limb([(14.4, -10, 4.4), (13.4, -16, 5.2)], (2.7, 2.6)), 0.8),
        add(egg((13.2, -17.6, 5.4), (2.9, 2.6, 3.5), turn=(0, 0, 10)), 1.0),
    ]
    for index in range(4):
        across = 1.55 * (index - 1.5)
        finger = [
            (-17.9, -3.6 + across, -13),
            (-17.7 + 0.1 * index, -4.2 + 1.1 * across, -17.4 + 0.5 * abs(index - 1.6)),
        ]
        steps.append(add(limb(finger, (1.15, 0.95)), 0.35))
        height = 5.2 - 1.1 * across
        curled = [(15.6, -18.2, height), (14.2, -20.6, height), (11.6, -20.4, height), (10.9, -18.4, height)]
        steps.append(add(limb(curled, (1.0, 0.95, 0.9, 0.8)), 0.3))
    steps.append(add(limb([(11.4, -17.2, 8.2), (13.2, -19.6, 9.2)], (1.1, 0.9)), 0.4))
    steps.append(carve(limb([(13.2, -18.6, 14), (13.0, -18.4, -4)], 1.1), 0.3))
    return tuple(steps)


def _scarf() -> tuple[Step, ...]:
    around = np.linspace(0, 2 * np.pi, 15)
    ring = [(6.6 * np.sin(a), 0.3 - 6.3 * np.cos(a), 28.0 - 1.6 * np.cos(a)) for a in around]
    upper = [(5.6 * np.sin(a + 0.3), 0.1 - 5.4 * np.cos(a + 0.3), 30.2 - 1.2 * np.cos(a)) for a in around]
    return (
        add(limb(ring, 2.1), 0.6),
        add(limb(upper, 1.5), 0.4),
        add(egg((1.2, -7.4, 26.0), (2.6, 1.9, 2.0)), 0.5),
    )


def _head_posed(steps: tuple[Step, ...]) -> Iterator[Step]:
    for step in steps:
        piece = posed(step.piece, HEAD_TURN, HEAD_PIVOT)
        yield carve(piece, step.blend) if step.carved else add(piece, step.blend)


def _head() -> tuple[Step, ...]:
    return (
        add(egg((0, -0.4, 42.3), (6.7, 7.4, 8.2)), 1.0),
        add(egg((0, -3.0, 37.6), (5.2, 4.8, 5.0)), 3.0),
        add(paired(egg((3.3, -5.6, 40.0), (2.3, 2.2, 2.0))), 1.6),
        add(paired(limb([(0.9, -7.7, 44.4), (3.0, -7.5, 45.0), (5.2, -5.8, 44.4)], 0.7)), 1.0),
        carve(paired(egg((2.8, -8.6, 42.9), (2.0, 1.9, 1.05), turn=(0, -5, 0))), 0.8),
        add(paired(egg((2.8, -6.2, 42.8), (1.65, 1.0, 0.85), turn=(0, -5, 14))), 0.2),
        add(limb([(0, -7.2, 44.6), (0, -8.6, 42), (0, -9.6, 40.4)], (0.7, 0.85, 1.15)), 0.9),
        add(paired(egg((1.25, -8.0, 40.1), (0.85, 1.1, 0.75))), 0.5),
        carve(paired(limb([(0, -8.6, 37.95), (2.2, -7.4, 38.05)], 0.32)), 0.2),
        add(paired(egg((0.8, -7.5, 38.6), (1.5, 0.95, 0.5), turn=(0, 8, 12))), 0.25),
        add(egg((0, -7.5, 37.3), (1.7, 0.95, 0.6)), 0.25),
        add(paired(limb([(0.5, -8.2, 39.2), (2.4, -7.8, 38.6), (4.1, -6.4, 37.3)], (0.55, 0.6, 0.3))), 0.2),
        add(egg((0, -6.6, 34.6), (1.3, 1.3, 1.9)), 0.4),
        add(paired(egg((6.6, 0.2, 41.2), (0.9, 1.9, 2.9), turn=(10, 0, -12))), 0.4),
        carve(paired(egg((7.4, -0.1, 41.4), (0.5, 1.0, 1.8), turn=(10, 0, -12))), 0.3),
    )


def _hair() -> tuple[Step, ...]:
    band = [
        (-2.4 + 2.7 * np.sin(a), 2.4 - 2.7 * np.cos(a), 50.2 + 0.7 * np.sin(a)) for a in np.linspace(0, 2 * np.pi, 11)
    ]
    return (
        add(egg((0, 1.3, 43.8), (7.1, 7.2, 7.9))),
        add(egg((0, 5.6, 40.5), (4.6, 3.2, 5.0)), 1.5),
        add(egg((-2.4, 2.4, 51.6), (3.2, 3.2, 3.0)), 0.4),
        add(egg((-3.4, 1.6, 53.0), (2.0, 2.0, 1.7)), 0.4),
        add(limb(band, 0.75), 0.2),
        add(paired(limb([(6.3, 1.0, 45), (5.0, 6.5, 44), (2.4, 8.4, 45), (0, 7.9, 48)], 0.8)), 0.4),
    )
