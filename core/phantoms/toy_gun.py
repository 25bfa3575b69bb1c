"""A ray gun from a toy shop: two thin shells of coloured plastic, a clear barrel with rings, tiny metal inside.

The barrel points along +x. What is pressed or screwed differs from side to side: a big dial and a switch on the left
(+y), screw heads and a bolt of lightning on the right (−y).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.interpolate import PchipInterpolator

from . import shapes, solids
from .materials import Material
from .model import Part, Phantom, SignedDistance
from .solid_table import SolidTable, curve
from .toy_gun_inside import inner_parts
from .toy_gun_layout import (
    AXIS_Z,
    BARREL_X,
    CLEAR_RADIUS,
    CLEAR_WALL_MM,
    GAP_MM,
    MUZZLE,
    MUZZLE_RADIUS,
    RINGS,
    SCREWS,
    WALL_MM,
    well,
)
from .toy_gun_paint import paint

ABS = Material("ABS", "C15H17N", 1.05)
_CLEAR = Material("polystyrene", "C8H8", 1.05)
_RUBBER = Material("soft PVC", (("C2H3Cl", 0.6), ("C24H38O4", 0.4)), 1.22)
# Less would leave no photon behind the cell and the brass disc; more would leave no contrast of the plastic.
_ENERGY_KEV = 75.0

# x and radius of the body, mm, from the tail to where the barrel starts.
_BODY = np.array(
    [
        [-57.5, 7.6],
        [-55.5, 7.4],
        [-51.0, 5.6],
        [-47.5, 7.4],
        [-42.0, 11.2],
        [-34.0, 13.8],
        [-24.0, 14.9],
        [-12.0, 14.6],
        [-2.0, 13.2],
        [8.0, 11.0],
        [14.0, 9.6],
        [16.5, 10.6],
        [19.5, 10.6],
    ]
)
# z, middle x, half length along x, half thickness along y of the grip, mm, from its butt up.
_GRIP = np.array(
    [
        [-43.5, -36.4, 10.6, 7.6],
        [-39.0, -35.4, 10.4, 8.0],
        [-28.0, -32.4, 8.8, 8.0],
        [-14.0, -29.0, 8.6, 8.0],
        [-4.0, -26.6, 9.6, 8.4],
        [10.0, -24.0, 12.0, 9.0],
    ]
)
_FIN = [(-50.0, 44.0), (-42.5, 43.2), (-27.0, 34.5), (-5.0, 27.5), (-5.0, 22.0), (-44.0, 22.0)]


@lru_cache(maxsize=1)
def hull() -> SolidTable:
    """The hollow part of the shells: body and grip without what is laid on."""
    along = np.linspace(_BODY[0, 0], _BODY[-1, 0], 1000)
    radius = PchipInterpolator(_BODY[:, 0], _BODY[:, 1])(along)
    heights = np.linspace(_GRIP[0, 0], _GRIP[-1, 0], 1000)
    grip_shape = PchipInterpolator(_GRIP[:, 0], _GRIP[:, 1:])(heights)

    def body(points: np.ndarray) -> np.ndarray:
        side = np.hypot(points[:, 1], points[:, 2] - AXIS_Z) - np.interp(points[:, 0], along, radius)
        return np.maximum(side, np.maximum(along[0] - points[:, 0], points[:, 0] - along[-1]))

    def grip(points: np.ndarray) -> np.ndarray:
        z = points[:, 2]
        middle, long, thick = (np.interp(z, heights, grip_shape[:, k]) for k in range(3))
        u, v = np.abs(points[:, 0] - middle) / long, np.abs(points[:, 1]) / thick
        side = ((u**2.8 + v**2.8) ** (1 / 2.8) - 1) * thick
        return -shapes.smooth_union(-np.maximum(side, z - heights[-1]), z - heights[0], 3.0)

    def implicit(points: np.ndarray) -> np.ndarray:
        return shapes.smooth_union(body(points), grip(points), 4.0)

    return SolidTable.of(implicit, (-62, -20, -48), (24, 20, 36), 0.75)


def toy_gun() -> Phantom:
    """The phantom: shells, barrel, and what makes it rattle, flash and buzz."""
    cavity = shapes.shrunk(hull().distance, WALL_MM)
    parts = [
        Part("left shell", _half(1.0), ABS),
        Part("right shell", _half(-1.0), ABS),
        Part("barrel", _barrel, _CLEAR),
        Part("rings", _rings, ABS),
        Part("barrel's bore", _bore, None),
        Part("muzzle", _muzzle, ABS),
        Part("muzzle's cavity", lambda points: _muzzle(points) + WALL_MM, None),
        Part("cavity", cavity, None),
        Part("trigger", _trigger, _RUBBER),
        *inner_parts(cavity, ABS),
    ]
    return Phantom(
        name="toy_gun",
        parts=tuple(parts),
        surface=surface,
        color=_color,
        size_mm=(120.0, 36.0, 90.0),
        energy_kev=_ENERGY_KEV,
        landmarks=_landmarks(),
    )


def surface(points: np.ndarray) -> np.ndarray:
    """(N,) signed distance of everything that is seen."""
    skin = hull().distance(points)
    seen = [_shell(points, skin), *_fittings(points).values(), *_front(points).values()]
    return np.minimum.reduce(seen).astype(np.float32)


def relief(points: np.ndarray, skin: np.ndarray) -> dict[str, np.ndarray]:
    """Signed distances (N,) of all that is seen, by the name that it is painted under; `skin` is that of `hull`."""
    return {"shell": skin, **_laid_on(points, skin), **_fittings(points), **_front(points)}


def _shell(points: np.ndarray, skin: np.ndarray) -> np.ndarray:
    """Both shells as one solid: the hull, what is laid on it, the seam, and the wells of the screws' heads."""
    solid = np.where(skin > 0, np.maximum(skin - 2.2, 0.2 * skin), skin)
    near = np.flatnonzero(np.abs(skin) < 4.0)
    if len(near):
        close = points[near]
        laid = np.minimum.reduce([skin[near], *_laid_on(close, skin[near]).values()])
        solid[near] = np.maximum(laid, -np.maximum(-(skin[near] + 0.6), np.abs(close[:, 1]) - 0.3))
    return np.maximum(solid, -np.minimum.reduce([well(points, screw) for screw in SCREWS]))


def _laid_on(points: np.ndarray, skin: np.ndarray) -> dict[str, np.ndarray]:
    """What follows the hull at some height: bands around the body, ribs on the grip, dial, bolt, switch."""
    x, y, z = points.T
    bands = np.minimum(np.abs(x + 40.0) - 1.3, np.abs(x - 5.5) - 1.3)
    ribs = np.abs((z - 0.25 * (x + 30.0) + 60.0) % 4.6 - 2.3) - 1.15
    middle = np.interp(z, _GRIP[:, 0], _GRIP[:, 1])
    face = solids.polygon(x - middle, z, [(-20, -37), (20, -37), (20, -8), (-20, -8)])
    reach = np.hypot(x + 19.0, z - AXIS_Z)
    bolt = solids.polygon(x, z, _BOLT)
    switch = solids.polygon(x, z, [(-6.0, 9.0), (1.5, 10.5), (1.5, 14.0), (-6.0, 12.5)])
    left, right = -y, y
    return {
        "band": np.maximum(skin - 0.9, np.maximum(bands, -1.0 - z)),
        "ribs": np.maximum(skin - 0.8, 0.9 * np.maximum(ribs, face)),
        "dial": np.maximum(skin - 1.0, np.maximum(reach - 7.6, left)),
        "knob": np.maximum(skin - 2.2, np.maximum(reach - 3.4, left)),
        "bolt": np.maximum(skin - 0.9, np.maximum(bolt, right)),
        "switch": np.maximum(skin - 1.8, np.maximum(switch, left)),
        "collar": np.maximum(skin - 0.8, np.abs(x - 17.6) - 1.2),
    }


_BOLT = [(-32, 17.5), (-17, 24.5), (-19, 18.2), (-6.5, 18.8), (-24, 8.0), (-20.5, 14.8)]


def _fittings(points: np.ndarray) -> dict[str, np.ndarray]:
    """Fin, sight and trigger guard, which the left shell carries."""
    return {
        **solids.boxed(points, (-51, -2, 21), (-4, 2, 45), lambda p: {"fin": _fin(p)}),
        **solids.boxed(points, (7, -2, 23), (12, 2, 33), lambda p: {"sight": _sight(p)}),
        **solids.boxed(points, (-24, -2, -19), (12, 2, 9), lambda p: {"guard": shapes.tube(p, _guard_path(), 1.8)}),
    }


def _fin(points: np.ndarray) -> np.ndarray:
    return solids.plate(solids.polygon(points[:, 0], points[:, 2], _FIN), points[:, 1], 1.5, 0.9)


def _sight(points: np.ndarray) -> np.ndarray:
    post = solids.rod(points, (9.5, 0.0, 24.5), (9.5, 0.0, 29.6), 1.1, 1.1)
    return np.minimum(post, shapes.sphere(points, np.array([9.5, 0.0, 31.0]), 1.8))


@lru_cache(maxsize=1)
def _guard_path() -> np.ndarray:
    return curve([[9.0, 0, 6.5], [9.4, 0, -2.0], [5.0, 0, -11.0], [-6.0, 0, -15.6], [-22.0, 0, -16.5]], 15)


def _front(points: np.ndarray) -> dict[str, np.ndarray]:
    """What is no part of the shells: trigger, barrel, rings, muzzle."""
    found = {"trigger": _trigger(points), "barrel": _barrel(points), "muzzle": _muzzle(points)}
    found.update({f"ring {index}": _ring(points, x, radius) for index, (x, radius) in enumerate(RINGS)})
    return found


def _trigger(points: np.ndarray) -> np.ndarray:
    path = np.array([[-8.5, 0, 3.0], [-6.6, 0, -1.5], [-7.2, 0, -5.5], [-4.6, 0, -10.0]])
    return solids.boxed(points, (-12, -3, -13), (-2, 3, 6), lambda p: {"trigger": shapes.tube(p, path, 2.1)})["trigger"]


def _barrel(points: np.ndarray) -> np.ndarray:
    low, high = BARREL_X
    return solids.disc(points, (0.5 * (low + high), 0, AXIS_Z), 0, CLEAR_RADIUS, 0.5 * (high - low))


def _bore(points: np.ndarray) -> np.ndarray:
    low, high = BARREL_X
    half = 0.5 * (high - low) - 2.0
    return solids.disc(points, (0.5 * (low + high), 0, AXIS_Z), 0, CLEAR_RADIUS - CLEAR_WALL_MM, half)


def _ring(points: np.ndarray, x: float, radius: float) -> np.ndarray:
    return solids.disc(points, (x, 0.0, AXIS_Z), 0, radius, 1.4, 1.0)


def _rings(points: np.ndarray) -> np.ndarray:
    return np.minimum.reduce([_ring(points, x, radius) for x, radius in RINGS])


def _muzzle(points: np.ndarray) -> np.ndarray:
    return shapes.sphere(points, np.array(MUZZLE), MUZZLE_RADIUS)


def _half(side: float) -> SignedDistance:
    """One shell, solid; the cavity is taken out of it later. `side` is the sign of y where it lies."""

    def distance(points: np.ndarray) -> np.ndarray:
        shell = _shell(points, hull().distance(points))
        half = np.maximum(shell, 0.5 * GAP_MM - side * points[:, 1])
        return np.minimum.reduce([half, *_fittings(points).values()]) if side > 0 else half

    return distance


def _color(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    skin = hull().distance(points)
    return paint(points, normals, relief(points, skin))


def _landmarks() -> np.ndarray:
    """(8, 3) mm: muzzle, sight, fin's tip, trigger's tip, butt, tail, dial's knob, bolt's point."""
    rays = [
        ((70.0, 0.0, AXIS_Z), (-1, 0, 0)),
        ((9.5, 0.0, 50.0), (0, 0, -1)),
        ((-49.0, 0.0, 60.0), (0, 0, -1)),
        ((8.0, 0.0, -10.5), (-1, 0, 0)),
        ((-36.4, 0.8, -60.0), (0, 0, 1)),
        ((-70.0, 0.8, AXIS_Z), (1, 0, 0)),
        ((-19.0, 30.0, AXIS_Z), (0, -1, 0)),
        ((-24.0, -30.0, 8.7), (0, 1, 0)),
    ]
    found = []
    for start, direction in rays:
        line = np.asarray(start) + np.arange(0, 40, 0.005)[:, None] * np.asarray(direction, float)
        found.append(line[np.argmax(surface(line.astype(np.float32)) < 0)])
    return np.array(found)
