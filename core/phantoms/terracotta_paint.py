"""Earthen clay with what is left of its pigments, in sRGB."""

from __future__ import annotations

import numpy as np

from .texture import waves

Color = tuple[float, float, float]

CLAY, PALE, SOOT, DUST = (0.72, 0.47, 0.33), (0.82, 0.62, 0.47), (0.40, 0.29, 0.24), (0.80, 0.70, 0.56)
RED, GREEN, VIOLET = (0.60, 0.15, 0.11), (0.27, 0.47, 0.35), (0.46, 0.28, 0.50)
FLESH, BLACK, OCHRE, BLUE = (0.90, 0.71, 0.59), (0.17, 0.13, 0.12), (0.83, 0.60, 0.18), (0.20, 0.36, 0.58)
WHITE, DEPTHS = (0.93, 0.88, 0.80), (0.10, 0.06, 0.05)


def paint(
    points: np.ndarray,
    head_points: np.ndarray,
    groups: dict[str, np.ndarray],
    ridge: np.ndarray,
    lapel: np.ndarray,
    depth: np.ndarray,
) -> np.ndarray:
    """(N, 3) sRGB colours.

    Args:
        points: (N, 3) mm on the surface, the figure facing −y.
        head_points: (N, 3) the same in the head's own frame, before it was turned.
        groups: signed distances (N,) of "robe" and of what is modelled onto it, by name.
        ridge: (N,) mm by which the robe stands out from its plain shape; below zero in the folds.
        lapel: (N,) mm across to the edge of the robe's upper front.
        depth: (N,) mm below the outside, above zero within the vent and the hollow.
    """
    names = list(groups)
    nearest = np.argmin(np.stack([groups[name] for name in names]), axis=0)
    of = {name: nearest == index for index, name in enumerate(names)}
    rgb = _fired(points)
    # Worn off where hands touch, kept in the folds.
    kept = 0.75 * waves(points, 0.33, seed=5) + 0.5 * waves(points, 1.1, seed=6) + 0.35 * waves(points, 3.2, seed=7)
    ridge = np.where(of["robe"] & (points[:, 2] < 14), np.clip(ridge, -1.2, 1.2), 0)
    kept = kept - 0.5 * ridge
    _robe(rgb, of["robe"], points, lapel, kept)
    _sleeves(rgb, of["sleeves"], points, kept)
    for name, pigment, worn in (
        ("hands", FLESH, -0.5),
        ("neck", FLESH, -0.2),
        ("scarf", GREEN, -0.6),
        ("buckle", OCHRE, -1.0),
        ("shoes", BLACK, -0.5),
    ):
        _lay(rgb, of[name], pigment, kept - worn)
    _head(rgb, of["head"], head_points, kept)
    _hair(rgb, of["hair"], head_points, kept)
    dust = np.where(of["plinth"] | of["shoes"] | (points[:, 2] < -42), 0.5, 0.0) + -0.35 * ridge
    _lay(rgb, np.ones(len(rgb), bool), DUST, 0.5 * (dust + 0.3 * waves(points, 0.8, seed=9)), most=0.5)
    _lay(rgb, depth > 0.4, DEPTHS, 0.2 * depth, most=0.95)
    return np.clip(rgb * (1 + 0.03 * waves(points, 4.0, seed=10)[:, None]), 0, 1)


def _fired(points: np.ndarray) -> np.ndarray:
    """Bare clay: paler and darker clouds, and the soot of the kiln at his right."""
    rgb = np.tile(np.asarray(CLAY, np.float32), (len(points), 1))
    everywhere = np.ones(len(points), bool)
    _lay(rgb, everywhere, PALE, 0.25 * waves(points, 0.25, seed=1) + 0.15 * waves(points, 1.4, seed=2), most=0.7)
    smoked = 0.9 - np.linalg.norm((points - [-14, 6, -22]) / [16, 22, 26], axis=1)
    _lay(rgb, everywhere, SOOT, 0.5 * smoked + 0.12 * waves(points, 0.4, seed=3), most=0.75)
    specks = waves(points, 2.6, seed=4) > 1.9
    rgb[specks] *= 0.74
    return rgb


def _robe(rgb: np.ndarray, where: np.ndarray, points: np.ndarray, lapel: np.ndarray, kept: np.ndarray) -> None:
    x, y, z = points.T
    _lay(rgb, where, RED, kept - 0.4)
    _lay(rgb, where & (np.abs(z + 44.5) < 3.0), VIOLET, kept + 0.2)
    trim = where & (np.abs(lapel + 1.2) < 1.15) & (y < 0) & (x > -12)
    _lay(rgb, trim, BLUE, kept + 0.5)
    belt = where & (np.abs(z - 2.0) < 2.0)
    _lay(rgb, belt, BLACK, kept + 0.6)
    studs = np.abs((np.arctan2(x, -y) * 7.0) % 2.0 - 1.0) < 0.35
    _lay(rgb, belt & studs & (np.abs(z - 2.0) < 0.8), OCHRE, kept + 1.2)


def _sleeves(rgb: np.ndarray, where: np.ndarray, points: np.ndarray, kept: np.ndarray) -> None:
    x, y, z = points.T
    _lay(rgb, where, RED, kept - 0.4)
    cuff = where & np.where(x < 0, z < -2.6, y < -8.3)
    _lay(rgb, cuff, VIOLET, kept + 0.6)


def _head(rgb: np.ndarray, where: np.ndarray, points: np.ndarray, kept: np.ndarray) -> None:
    """Flesh, with eyes, brows, moustache and lips drawn."""
    x, y, z = points.T
    side, face = np.abs(x), where & (y < -2.0)
    _lay(rgb, where, FLESH, 0.5 * kept + 0.45, most=0.85)
    eye = face & (np.hypot((side - 2.8) / 1.75, (z - 42.8) / 0.85) < 1)
    _lay(rgb, eye, WHITE, np.ones(len(rgb)))
    _lay(rgb, eye & (np.hypot(side - 2.7, z - 42.85) < 0.75), BLACK, np.ones(len(rgb)))
    lid = face & (np.abs(np.hypot((side - 2.8) / 1.9, (z - 42.8) / 1.0) - 1) < 0.14)
    _lay(rgb, lid, BLACK, np.ones(len(rgb)), most=0.7)
    brow = face & (np.abs(z - 45.2 + 0.16 * (side - 2.6) ** 2) < 0.5) & (np.abs(side - 3.0) < 2.3)
    moustache = face & (np.abs(z - 39.25 + 0.115 * side**2) < 0.6) & (side > 0.3) & (side < 4.6)
    goatee = face & (np.hypot(x / 1.4, (z - 34.6) / 2.0) < 1)
    _lay(rgb, brow | moustache | goatee, BLACK, kept + 1.2)
    lips = face & (side < 2.4 - 1.5 * np.abs(z - 37.8))
    _lay(rgb, lips, RED, np.ones(len(rgb)), most=0.75)


def _hair(rgb: np.ndarray, where: np.ndarray, points: np.ndarray, kept: np.ndarray) -> None:
    """Black, combed towards the bun, a red band round it."""
    x, y, z = points.T
    _lay(rgb, where, BLACK, kept + 0.9, most=0.9)
    combed = np.sin(3.4 * np.hypot(x + 2.4, y - 2.4) * np.arctan2(y - 2.4, x + 2.4))
    _lay(rgb, where & (z < 49.5) & (combed > 0.6), SOOT, np.ones(len(rgb)), most=0.6)
    _lay(rgb, where & (np.abs(z - 50.1) < 0.8), RED, kept + 1.4)


def _lay(rgb: np.ndarray, where: np.ndarray, color: Color, amount: np.ndarray, most: float = 0.88) -> None:
    """Mixes a colour in where the mask (N,) holds, by twice `amount` (N,), at most by `most`."""
    share = np.where(where, np.clip(2.0 * amount, 0, most), 0).astype(np.float32)
    rgb += share[:, None] * (np.asarray(color, np.float32) - rgb)
