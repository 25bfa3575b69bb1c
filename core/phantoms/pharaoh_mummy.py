"""What lies in the coffin: a body in three layers of linen, its skeleton, resin in the skull, an amulet of faience."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from . import shapes, solids
from .materials import Material
from .model import Part
from .solid_table import SolidTable, Wire, curve, inside_only, loft

_LINEN = Material("linen", "C6H10O5", 0.50)
_LOOSE = Material("loose linen", "C6H10O5", 0.18)
_SOAKED = Material("linen soaked in resin", (("C6H10O5", 0.6), ("C20H30O2", 0.4)), 0.95)
_TISSUE = Material("mummified tissue", (("C5H8NO2", 0.85), ("NaHCO3", 0.10), ("CaSO4", 0.05)), 0.85)
_PACKING = Material("sawdust and linen", "C6H10O5", 0.25)
_BONE = Material("bone", (("Ca10P6O26H2", 0.62), ("C5H8NO2", 0.38)), 1.75)
_RESIN = Material("conifer resin", "C20H30O2", 1.07)
_FAIENCE = Material("faience", (("SiO2", 0.90), ("CaO", 0.04), ("CuO", 0.06)), 2.30)

_OUTER_MM, _LOOSE_MM, _SOAKED_MM = 0.9, 0.6, 0.9
_SKIN_MM = _OUTER_MM + _LOOSE_MM + _SOAKED_MM
_BONE_DEPTH_MM = _SKIN_MM - 0.3
"""How far under the outermost linen all bones lie: where a limb is thin, they press into the innermost."""
_CENTER_Y = 4.6
# z, half width, reach to the front and to the back, mm, about y = _CENTER_Y.
_BODY = np.array(
    [
        [-52, 7.4, 6.0, 5.0],
        [-45, 6.8, 6.0, 5.6],
        [-33, 7.6, 6.6, 6.6],
        [-18, 9.8, 7.6, 7.4],
        [-4, 12.0, 8.2, 8.0],
        [6, 12.8, 8.6, 8.2],
        [17, 14.2, 8.8, 8.4],
        [23, 13.8, 8.2, 8.2],
        [28, 9.6, 6.6, 7.4],
        [31, 6.2, 5.6, 6.2],
        [37, 5.8, 5.4, 6.0],
    ],
    float,
)


@lru_cache(maxsize=1)
def wrapped() -> SolidTable:
    """The wrapped body."""
    trunk = loft(_BODY, 2.2, _CENTER_Y)
    upright = np.eye(3)

    def implicit(points: np.ndarray) -> np.ndarray:
        head = solids.ellipsoid(points, np.array([0.3, 4.4, 43.6]), upright, (7.8, 8.4, 9.6))
        feet = solids.ellipsoid(points, np.array([0.0, 1.8, -49.3]), upright, (7.0, 7.0, 4.3))
        elbows = solids.ellipsoid(solids.mirrored(points), np.array([10.4, 2.4, 5.0]), upright, (4.0, 5.0, 5.4))
        total = solids.joined([trunk(points), head, feet, elbows], 3.0)
        # The outermost bandage winds around: each turn overlaps the last.
        turns = points[:, 2] / 4.4 + np.arctan2(points[:, 0], points[:, 1] - _CENTER_Y) / (2 * np.pi)
        return total + 0.35 * (turns - np.floor(turns))

    return SolidTable.of(implicit, (-17, -11, -55), (17, 17, 56), 0.6)


def mummy_parts() -> tuple[Part, ...]:
    """Parts from the outermost linen inward."""
    body = wrapped().distance
    depth = _OUTER_MM + _LOOSE_MM
    return (
        Part("linen", body, _LINEN),
        Part("loose linen", shapes.shrunk(body, _OUTER_MM), _LOOSE),
        Part("soaked linen", shapes.shrunk(body, depth), _SOAKED),
        Part("body", shapes.shrunk(body, _SKIN_MM), _TISSUE),
        Part("trunk packing", inside_only(body, _packing, _SKIN_MM), _PACKING),
        Part("bones", inside_only(body, _bones, _BONE_DEPTH_MM), _BONE),
        Part("brain cavity", inside_only(body, _brain, _SKIN_MM), None),
        Part("resin", inside_only(body, _resin, _SKIN_MM), _RESIN),
        Part("amulet", inside_only(body, _amulet, 0.5), _FAIENCE),
    )


def _packing(points: np.ndarray) -> np.ndarray:
    belly = solids.ellipsoid(points, np.array([0.0, 3.0, 3.0]), np.eye(3), (6.2, 3.2, 7.0))
    chest = solids.ellipsoid(points, np.array([0.0, 3.4, 15.0]), np.eye(3), (6.6, 2.8, 7.0))
    return shapes.smooth_union(belly, chest, 2.0)


def _skull_case(points: np.ndarray) -> np.ndarray:
    return solids.ellipsoid(points, np.array([0.3, 5.2, 45.2]), np.eye(3), (5.0, 5.3, 5.2))


def _brain(points: np.ndarray) -> np.ndarray:
    return _skull_case(points) + 1.0


def _resin(points: np.ndarray) -> np.ndarray:
    """Poured in while the body lay on its back, a little tilted, and set there."""
    level = (7.0 - points[:, 1]) * 0.97 + (points[:, 2] - 45.0) * 0.2 + (points[:, 0] - 0.3) * 0.1
    return np.maximum(_brain(points), level)


def _skull(points: np.ndarray) -> np.ndarray:
    folded = solids.mirrored(points - np.array([0.3, 0, 0], np.float32))
    face = solids.ellipsoid(folded, np.array([0.0, 1.9, 41.2]), np.eye(3), (3.5, 3.0, 3.6))
    jaw = shapes.tube(folded, np.array([[4.0, 4.8, 41.5], [3.6, 3.6, 38.2], [1.6, 0.4, 37.6], [0.0, 0.1, 37.6]]), 0.7)
    cheek = shapes.tube(folded, np.array([[4.5, 4.6, 43.0], [3.9, 1.0, 42.2], [2.4, -0.2, 41.4]]), 0.55)
    solid = np.minimum(np.minimum(shapes.smooth_union(_skull_case(points), face, 1.0), jaw), cheek)
    orbit = shapes.sphere(folded, np.array([1.9, -0.4, 43.4]), 1.55)
    nose = solids.ellipsoid(folded, np.array([0.0, -0.9, 40.9]), np.eye(3), (0.8, 1.3, 1.2))
    throat = solids.ellipsoid(folded, np.array([0.0, 3.4, 38.6]), np.eye(3), (1.9, 2.2, 1.6))
    return np.maximum(solid, -np.minimum(np.minimum(orbit, nose), throat))


def _spine_y(z: np.ndarray | float) -> np.ndarray:
    """The spine's curve: back at the chest, forward at the loins and the neck."""
    return np.interp(z, [-2.0, 6.0, 18.0, 28.0, 37.0], [7.4, 6.4, 8.2, 6.8, 5.4])


_VERTEBRA_MM = 2.2


def _spine(points: np.ndarray) -> np.ndarray:
    """Seventeen vertebrae with gaps between them: bodies, processes to the back and to the sides."""
    number = np.clip(np.round(points[:, 2] / _VERTEBRA_MM), 0, 16)
    nearest = np.full(len(points), np.inf, np.float32)
    for neighbour in (-1, 0, 1):
        index = np.clip(number + neighbour, 0, 16)
        height = index * _VERTEBRA_MM
        local = points - np.stack([np.zeros_like(height), _spine_y(height), height], axis=1).astype(np.float32)
        size = (2.5 - 0.07 * index).astype(np.float32)
        across = np.hypot(local[:, 0], local[:, 1]) - size
        drum = solids.plate(across, local[:, 2], 0.75, 0.2)
        behind = local - size[:, None] * np.array([0, 1, 0], np.float32)
        spike = solids.box(behind, (0.0, 0.2, -0.2), (0.45, 0.8, 0.55))
        beside = np.abs(local) - size[:, None] * np.array([1, 0.5, 0], np.float32)
        wings = solids.box(beside, (0.0, 0.0, 0.0), (0.9, 0.45, 0.5))
        nearest = np.minimum.reduce([nearest, drum, spike, wings])
    return nearest


@lru_cache(maxsize=1)
def _bars() -> tuple[Wire, ...]:
    """Ribs and limbs by thickness; each path is doubled to the other side unless it is given for both."""
    ribs = []
    for index, height in enumerate(np.arange(8.5, 26.6, 2.25)):
        turn = np.linspace(0.1, 0.9 if index > 1 else 0.7, 24) * np.pi
        wide = 8.6 - 0.018 * (height - 15.0) ** 2
        back = float(_spine_y(height + 1.0))
        y = back - 3.9 * (1 - np.cos(turn))
        ribs.append(np.stack([wide * np.sin(turn), y, height + 1.4 - 3.2 * turn / np.pi], axis=1))
    collar = curve([[0.8, 0.3, 24.5], [4.5, 1.0, 25.6], [9.0, 4.0, 25.0]])
    thin = [
        np.array([[5.6, 4.7, -27.0], [4.2, 4.6, -43.0]]),
        np.array([[11.2, 2.6, 4.8], [4.0, -0.9, 11.5], [-3.2, -1.2, 15.6]]),
        np.array([[11.0, 1.5, 4.0], [4.0, -1.5, 10.5], [-3.0, -1.8, 14.4]]),
        *(np.array([[1.5 + 0.7 * k, 3.2, -47.6], [1.3 + 0.85 * k, -1.6, -49.4]]) for k in range(4)),
    ]
    thick = [
        np.array([[10.0, 4.6, 22.4], [11.3, 2.6, 4.6]]),
        np.array([[4.0, 4.6, -27.2], [2.6, 4.8, -44.6]]),
        np.array([[2.6, 6.2, -48.0], [2.6, 3.4, -47.0]]),
    ]
    femur = [np.array([[5.2, 4.6, -4.5], [7.2, 5.0, -6.4], [4.8, 4.6, -25.0]])]
    return (
        Wire(_both(ribs), 0.55),
        Wire(_both([collar, *thin]), 0.6),
        Wire(_both(thick), 1.05),
        Wire(_both(femur), 1.35),
    )


def _both(paths: list[np.ndarray]) -> list[np.ndarray]:
    return [path * side for path in paths for side in (np.array([1, 1, 1]), np.array([-1, 1, 1]))]


def _bones(points: np.ndarray) -> np.ndarray:
    folded = solids.mirrored(points)
    tilt = np.radians(35.0)
    flared = np.array([[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]])
    wing = solids.ellipsoid(folded, np.array([5.0, 5.8, -1.2]), flared, (4.4, 2.9, 1.9))
    hollow = solids.ellipsoid(folded, np.array([2.6, 4.2, 1.4]), flared, (4.8, 3.6, 2.0))
    ring = shapes.tube(folded, np.array([[5.2, 5.0, -4.0], [3.6, 2.4, -6.4], [0.4, 0.9, -6.8]]), 0.9)
    sacrum = solids.rod(points, (0, 7.8, -1.4), (0, 8.6, -6.0), 2.2, 0.9)
    knees = solids.ellipsoid(folded, np.array([4.6, 4.6, -26.0]), np.eye(3), (2.0, 1.8, 1.5))
    hips = shapes.sphere(folded, np.array([5.2, 4.6, -4.5]), 1.7)
    shoulders = shapes.sphere(folded, np.array([9.7, 4.6, 22.6]), 1.6)
    blades = solids.ellipsoid(folded, np.array([6.4, 9.4, 19.0]), np.eye(3), (2.6, 0.6, 4.0))
    breastbone = solids.box(points, (0.0, 0.5, 19.0), (1.1, 0.55, 5.6), 0.3)
    solid = [np.maximum(wing, -hollow), ring, sacrum, knees, hips, shoulders, blades, breastbone]
    solid += [_skull(points), _spine(points)]
    solid += [bar.distance(points) for bar in _bars()]
    return np.maximum(np.minimum.reduce(solid), wrapped().distance(points) + np.float32(_BONE_DEPTH_MM))


def _amulet(points: np.ndarray) -> np.ndarray:
    """A scarab on the breast, on the left, between the wrappings and the skin."""
    center = np.array([2.2, -1.9, 19.5], np.float32)
    shell = solids.ellipsoid(points, center, np.eye(3), (2.6, 1.5, 3.5))
    head = solids.ellipsoid(points, center + np.array([0, 0, 3.6], np.float32), np.eye(3), (1.5, 1.1, 1.2))
    cut = solids.box(points, center + np.array([0, -1.7, -0.8], np.float32), (0.25, 0.7, 3.0))
    return np.maximum(np.minimum(shell, head), -cut)
