"""A Matryoshka: nested turned shells of different attenuation, painted outside.

It is not of revolution: sleeves, a loaf held in front, a bow under the chin and a plait at the back stand out in
relief, and the painting differs all around, so that shape alone decides how it is turned.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from scipy.spatial import ConvexHull

from . import shapes
from .materials import Material
from .matryoshka_paint import paint
from .model import Part, Phantom, SignedDistance

# Radius and z in mm of the outer doll's silhouette, rim of the flat bottom first, 100 mm high.
_SILHOUETTE = np.array(
    [
        [20.5, -50.0],
        [22.6, -48.2],
        [24.0, -43.0],
        [26.8, -33.0],
        [29.0, -21.0],
        [29.6, -9.0],
        [28.2, 2.0],
        [25.0, 11.0],
        [20.9, 18.0],
        [18.4, 23.0],
        [18.6, 28.0],
        [19.6, 34.0],
        [18.8, 40.5],
        [15.0, 46.0],
        [8.5, 49.2],
        [0.0, 50.0],
    ]
)
_BOTTOM = float(_SILHOUETTE[0, 1])
_WALL_MM, _THINNEST_MM = 2.4, 1.0
_PLAY_MM, _LEAN_MM = 0.9, 0.3
_WOODS = (
    Material("boxwood", "C6H10O5", 1.00),
    Material("birch wood", "C6H10O5", 0.62),
    Material("ebony", "C6H10O5", 1.10),
    Material("hornbeam wood", "C6H10O5", 0.78),
    Material("lignum vitae", "C6H10O5", 1.28),
)
_CORE = Material("PVC foam", "C2H3Cl", 0.60)
_GLUE = Material("glue with chalk", (("C5H8O2", 0.7), ("CaCO3", 0.3)), 1.30)
_ENERGY_KEV = 36.0
_SEAM_Z, _SEAM_HALF_HEIGHT = -16.0, 0.9


@lru_cache(maxsize=1)
def _profile() -> shapes.Profile:
    return shapes.Profile.through(_SILHOUETTE)


@lru_cache(maxsize=1)
def _plain_profile() -> shapes.Profile:
    """The dolls inside have no neck: each would be too narrow there for the next one's head."""
    corners = np.concatenate([_SILHOUETTE, _SILHOUETTE * [-1, 1]])
    hull = corners[ConvexHull(corners).vertices]
    hull = hull[hull[:, 0] >= 0]
    hull = hull[np.argsort(hull[:, 1])]
    radii = np.interp(_SILHOUETTE[:, 1], hull[:, 1], hull[:, 0])
    return shapes.Profile.through(np.column_stack([radii, _SILHOUETTE[:, 1]]))


def matryoshka(shells: int = 9) -> Phantom:
    """The phantom.

    Args:
        shells: nested shells, 1 to 9; a solid doll stands in the innermost.
    """
    parts: list[Part] = []
    scale, floor = 1.0, _BOTTOM
    for level in range(shells):
        shell = _standing(scale, floor, level)
        solid: SignedDistance = _dressed if level == 0 else shell
        wall = _wall(level, shells)
        cavity = shapes.shrunk(shell, wall)
        parts.append(Part(f"shell {level + 1}", solid, _WOODS[level % len(_WOODS)]))
        parts.append(Part(f"cavity {level + 1}", cavity, None))
        floor += wall
        play = _PLAY_MM * wall / _WALL_MM
        scale = _largest_fit(cavity, scale, floor, level + 1, play)
    parts.append(Part("little one", _standing(scale, floor, shells), _CORE))
    parts.append(Part("glue seam", _seam(_wall(0, shells)), _GLUE))
    return Phantom(
        name="matryoshka",
        parts=tuple(parts),
        surface=_dressed,
        color=_color,
        size_mm=(68.0, 77.0, 102.0),
        energy_kev=_ENERGY_KEV,
        landmarks=_landmarks(),
        of_revolution=True,
    )


def _wall(level: int, shells: int) -> float:
    """Wall thickness in mm: the inner ones are turned thinner, and all are thinner where many must fit."""
    return max(_THINNEST_MM, _WALL_MM * min(1.0, 5.0 / shells) * 0.88**level)


def _offset(scale: float, floor: float, level: int) -> tuple[float, float, float]:
    """Where a doll of this scale is moved to: on `floor`, a little off the axis, since nothing fits exactly."""
    turn = 2.4 * level
    lean = _LEAN_MM if level else 0.0
    return lean * float(np.cos(turn)), lean * float(np.sin(turn)), floor - scale * _BOTTOM


def _standing(scale: float, floor: float, level: int) -> SignedDistance:
    body = (_plain_profile() if level else _profile()).distance
    return shapes.moved(body, scale, _offset(scale, floor, level))


def _largest_fit(cavity: SignedDistance, below: float, floor: float, level: int, play: float) -> float:
    """The largest scale, under `below`, of a doll that stands in the cavity with `play` mm all around it."""
    outline = _plain_profile().outline
    around = np.linspace(0, 2 * np.pi, 12, endpoint=False)[:, None]
    ring = np.stack(
        np.broadcast_arrays(outline[:, 0] * np.cos(around), outline[:, 0] * np.sin(around), outline[:, 1]), -1
    ).reshape(-1, 3)
    low, high = 0.0, below
    for _ in range(24):
        scale = 0.5 * (low + high)
        points = (scale * ring + _offset(scale, floor, level)).astype(np.float32)
        standing = points[:, 2] > floor + play
        fits = bool(np.all(cavity(points[standing]) < -play))
        low, high = (scale, high) if fits else (low, scale)
    return low


def _seam(wall: float) -> SignedDistance:
    """The glued joint of the outer shell's two halves: a ring through its wall."""
    body = _profile().distance

    def distance(points: np.ndarray) -> np.ndarray:
        skin = body(points)
        band = np.abs(points[:, 2] - _SEAM_Z) - _SEAM_HALF_HEIGHT
        return np.maximum(np.maximum(skin, -(skin + wall)), band)

    return distance


def _on_body(azimuth_deg: Sequence[float] | float, z: Sequence[float] | float, lift: np.ndarray | float) -> np.ndarray:
    """(..., 3) points `lift` mm off the body; azimuth 0 is the front (−y), positive to the doll's left (+x)."""
    azimuth = np.radians(np.asarray(azimuth_deg, np.float64))
    radius = _profile().radius(np.asarray(z, np.float64)) + lift
    coordinates = np.broadcast_arrays(radius * np.sin(azimuth), -radius * np.cos(azimuth), z)
    return np.stack(coordinates, axis=-1)


def relief(points: np.ndarray) -> dict[str, np.ndarray]:
    """Signed distances (N,) of what stands out from the turned body, by name."""
    mirrored = points.copy()
    mirrored[:, 0] = np.abs(mirrored[:, 0])
    arm = shapes.tube(mirrored, _on_body([98, 92, 80, 64, 48], [7, 1.5, -2.5, -4, -3.5], -1.2), 4.3)
    hand = shapes.sphere(mirrored, _on_body(29.0, -3.0, 0.2), 4.2)
    upright = np.eye(3)
    loaf = shapes.ellipsoid(points, _on_body(0.0, -3.0, 1.0), upright, (11.0, 7.2, 6.4))
    knot = shapes.sphere(points, _on_body(0.0, 19.5, 0.8), 2.9)
    tilt = np.radians(-18.0)
    loop_axes = np.array([[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]], np.float32)
    loop = shapes.ellipsoid(mirrored, _on_body(20.4, 18.2, 0.7), loop_axes, (6.0, 3.0, 3.4))
    heights = np.arange(17.0, -20.5, -3.7)
    beads = [
        shapes.sphere(points, _on_body(180.0 + (3.2 if i % 2 else -3.2), z, 1.0), 3.9 - 0.12 * i)
        for i, z in enumerate(heights)
    ]
    ribbon = shapes.ellipsoid(points, _on_body(180.0, heights[-1] - 4.4, 0.4), upright, (6.0, 2.6, 2.6))
    return {
        "arm": arm,
        "hand": hand,
        "loaf": loaf,
        "bow": np.minimum(knot, loop),
        "plait": np.minimum.reduce(beads),
        "ribbon": ribbon,
    }


def _dressed(points: np.ndarray) -> np.ndarray:
    """The outer doll: the turned body with all reliefs."""
    total = _profile().distance(points)
    near = np.flatnonzero(np.abs(total) < 16.0)
    if len(near):
        close = total[near]
        for distance in relief(points[near]).values():
            close = shapes.smooth_union(close, distance.astype(np.float32), 1.2)
        total[near] = close
    return total


def _color(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    return paint(points, relief(points), _profile().distance(points), _profile().radius(points[:, 2]))


def _landmarks() -> np.ndarray:
    """Tip of the loaf, the bow's knot, the plait's ribbon, the crown, both elbows: on the surface, mm."""
    directions = [(0.0, -3.0), (0.0, 19.5), (180.0, -24.2), (86.0, 0.0), (-86.0, 0.0)]
    points = [[0.0, 0.0, 50.0]]
    for azimuth, z in directions:
        reach = _on_body(azimuth, z, np.linspace(12, -3, 3001))
        points.append(reach[np.argmax(_dressed(reach.astype(np.float32)) < 0)])
    return np.array(points)
