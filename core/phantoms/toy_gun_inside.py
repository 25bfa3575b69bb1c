"""What lies in the toy gun: stiffening ribs and screw bosses, screws, a coil spring, a lever, a board that buzzes."""

from __future__ import annotations

from functools import lru_cache, partial

import numpy as np

from . import shapes, solids
from .materials import Material
from .model import Part, SignedDistance
from .solid_table import Wire, curve
from .toy_gun_layout import AXIS_Z, GAP_MM, SCREWS, Screw, axis_distance, well

_STEEL = Material("steel", "Fe", 7.80)
_BRASS = Material("brass", (("Cu", 0.63), ("Zn", 0.37)), 8.40)
_COPPER = Material("copper", "Cu", 8.96)
_ACETAL = Material("acetal", "CH2O", 1.41)
_BOARD = Material("glass fibre board", (("SiO2", 0.45), ("C21H24O4", 0.55)), 1.70)
_CHIP = Material("filled epoxy", (("SiO2", 0.75), ("C21H24O4", 0.25)), 1.85)
_PASTE = Material("lithium cell filling", (("MnO2", 0.75), ("C4H6O3", 0.25)), 2.20)
_LENS = Material("epoxy", "C21H24O4", 1.18)

_RIB_X = (-49.0, -30.5, -5.0, 10.5)
_RIB_Z = (-8.5, -24.5)
_BOARD_CENTER, _BOARD_HALF = (-36.0, 2.5, 15.5), (7.5, 0.7, 6.0)
_CELL_CENTER = (-36.6, 5.3, 16.0)
_DISC_CENTER = (-37.0, -4.0, 16.5)
_SPRING_X, _SPRING_TURNS, _SPRING_RADIUS, _WIRE_RADIUS = (-26.0, 7.0), 13, 4.2, 0.5


def inner_parts(cavity: SignedDistance, shell: Material) -> tuple[Part, ...]:
    """Parts in the order in which they take each other's place.

    Args:
        cavity: signed distance of the shells' hollow.
        shell: what ribs and bosses are made of, being one with the shells.
    """

    def clipped(solid: SignedDistance) -> SignedDistance:
        return lambda points: np.maximum(solid(points), cavity(points))

    return (
        Part("ribs", lambda points: _ribs(points, cavity(points)), shell),
        Part("bosses", clipped(_bosses), shell),
        Part("plunger", _plunger, _ACETAL),
        Part("spring", spring().distance, _STEEL),
        Part("lever", _lever, _ACETAL),
        Part("lever's pin", _pin, _STEEL),
        Part("board", lambda points: solids.box(points, _BOARD_CENTER, _BOARD_HALF), _BOARD),
        Part("chip", lambda points: solids.box(points, (-32.8, 1.3, 13.2), (2.6, 0.6, 2.0)), _CHIP),
        Part("cell", lambda points: solids.disc(points, _CELL_CENTER, 1, 5.0, 1.5, 0.3), _STEEL),
        Part("cell's filling", lambda points: solids.disc(points, _CELL_CENTER, 1, 4.5, 1.1), _PASTE),
        Part("sound disc", lambda points: solids.disc(points, _DISC_CENTER, 1, 5.5, 0.2), _BRASS),
        Part("lamp", _lamp, _LENS),
        Part("wires", _wires().distance, _COPPER),
        Part("screws", _screws, _STEEL),
    )


@lru_cache(maxsize=1)
def spring() -> Wire:
    """The coil spring around the plunger: a helix along x with its end turns closed."""
    turn = np.linspace(0, _SPRING_TURNS, 40 * _SPRING_TURNS + 1)
    low, high = _SPRING_X
    open_share = np.clip((turn - 1) / (_SPRING_TURNS - 2), 0, 1)
    tight = 1.1
    x = low + tight * np.clip(turn, 0, 1) + open_share * (high - low - 2 * tight)
    x += tight * np.clip(turn - _SPRING_TURNS + 1, 0, 1)
    angle = 2 * np.pi * turn
    path = [x, _SPRING_RADIUS * np.cos(angle), AXIS_Z + _SPRING_RADIUS * np.sin(angle)]
    return Wire([np.stack(path, axis=1)], _WIRE_RADIUS, 3.0)


def _ribs(points: np.ndarray, hollow: np.ndarray) -> np.ndarray:
    """Thin webs across the shells, standing 3 mm off the wall, open in the middle for what moves."""
    x, y, z = points.T
    upper = np.maximum(np.min([np.abs(x - place) for place in _RIB_X], axis=0) - 0.6, 1.0 - z)
    lower = np.maximum(np.min([np.abs(z - place) for place in _RIB_Z], axis=0) - 0.6, z + 2.0)
    frame = np.maximum(hollow, -(hollow + 3.0))
    return np.maximum(np.maximum(frame, np.minimum(upper, lower)), 0.5 * GAP_MM - np.abs(y))


def _bosses(points: np.ndarray) -> np.ndarray:
    """Posts that the screws bite into, hollow above the heads; a gap parts those of the two shells."""
    posts = np.minimum.reduce([np.maximum(axis_distance(points, s) - 3.7, -well(points, s)) for s in SCREWS])
    return np.maximum(posts, 0.5 * GAP_MM - np.abs(points[:, 1]))


def _screws(points: np.ndarray) -> np.ndarray:
    nearest = [
        solids.boxed(
            points,
            (screw.x - 2.2, screw.head_y, screw.z - 2.2),
            (screw.x + 2.2, screw.end_y, screw.z + 2.2),
            partial(_screw, screw=screw),
        )["screw"]
        for screw in SCREWS
    ]
    return np.minimum.reduce(nearest)


def _screw(points: np.ndarray, screw: Screw) -> dict[str, np.ndarray]:
    """A shaft and a slotted head."""
    length = screw.end_y - screw.head_y
    shaft = solids.disc(points, (screw.x, 0.5 * (screw.head_y + screw.end_y), screw.z), 1, 1.0, 0.5 * length)
    head = solids.disc(points, (screw.x, screw.head_y + 0.7, screw.z), 1, 2.1, 0.7, 0.2)
    slot = solids.box(points, (screw.x, screw.head_y, screw.z), (3.0, 0.5, 0.3))
    return {"screw": np.minimum(shaft, np.maximum(head, -slot))}


def _plunger(points: np.ndarray) -> np.ndarray:
    low, high = _SPRING_X
    stem = solids.disc(points, (0.5 * (low + high) + 2.0, 0, AXIS_Z), 0, 2.2, 0.5 * (high - low) + 3.0)
    plate = solids.disc(points, (high + 1.0, 0, AXIS_Z), 0, 4.9, 0.9)
    return np.minimum(stem, plate)


def _lever(points: np.ndarray) -> np.ndarray:
    """Turns on its pin behind the trigger and pulls the plunger back."""
    arm = shapes.tube(points, np.array([[-8.5, 0.3, 3.6], [-11.5, 0.3, 4.8], [-19.0, 0.3, 2.4]]), 1.5)
    hook = shapes.tube(points, np.array([[-11.5, 0.3, 4.8], [-12.4, 0.3, 8.0]]), 1.3)
    return np.minimum(arm, hook)


def _pin(points: np.ndarray) -> np.ndarray:
    return solids.disc(points, (-11.5, 0.0, 4.8), 1, 0.7, 4.0)


def _lamp(points: np.ndarray) -> np.ndarray:
    """A light-emitting diode that shines into the barrel."""
    return solids.rod(points, (12.6, 0.6, AXIS_Z - 3.4), (14.4, 0.6, AXIS_Z - 3.4), 1.3, 1.3)


@lru_cache(maxsize=1)
def _wires() -> Wire:
    paths = [
        [[-30, 3.6, 11.0], [-24, 7.5, 7.0], [-10, 8.4, 6.5], [3, 6.8, 12.5], [9.8, 4.8, 11.4], [12.6, 1.0, 10.9]],
        [[-30, 3.6, 10.2], [-22, 6.4, 5.4], [-8, 7.4, 7.4], [3, 6.6, 14.8], [9.8, 5.0, 13.4], [12.6, 0.2, 10.4]],
        [[-33, 1.6, 20.5], [-30, -1.5, 22.5], [-33, -3.8, 21.0]],
        [[-39, 1.6, 10.5], [-36, -2.0, 7.5], [-37, -3.9, 11.5]],
        [[-31, 3.4, 9.8], [-26, 3.0, 1.0], [-27, 1.5, -6.0], [-21.5, 1.0, 0.5]],
    ]
    return Wire([curve(path) for path in paths], 0.32, 3.0)
