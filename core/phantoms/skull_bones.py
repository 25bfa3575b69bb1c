"""The skull's bones, teeth and metal as steps of a sculpture, in mm: face towards −y, z up, the atlas at z = −10."""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise

import numpy as np
from scipy.special import ellipeinc

from .sculpture import Piece, Step, add, box, carve, egg, limb, paired, rail, sculpt
from .sculpture import plate as flat_plate

_UPPER_WIDTHS = (3.5, 2.9, 3.2, 3.0, 3.0, 4.0, 3.9, 3.3)
_LOWER_WIDTHS = (2.4, 2.6, 3.0, 3.0, 3.1, 4.2, 4.1, 3.6)
_DEPTHS = (2.5, 2.5, 3.1, 3.5, 3.6, 4.2, 4.2, 3.9)
_LOST_TOOTH = 3
# Half width and depth in mm of the ellipses that the rows of teeth stand on.
_UPPER, _LOWER = (15.0, 21.0), (14.2, 19.9)
_ROD_X, _ROD_Y = 0.4, -2.0
# The burr hole's middle on the vault, and the plate's axes: along its arms and outward.
HOLE = np.array([-13.65, -14.63, 40.68], np.float32)
_PLATE_AXES = np.array([[0.7546, 0.1920, 0.6275], [-0.3026, 0.9500, 0.0732], [-0.5849, -0.2456, 0.7730]], np.float32)
_NOSTRIL = egg((2.7, -33, -4.8), (3.4, 22, 4.5), turn=(0, 14, 0), power=3)
_NOSE = egg((0, -35, -0.2), (3.2, 18, 5.8))
# Heights of the vertebrae's middles, atlas first, and how far each is turned about z in degrees.
_LEVELS = ((-11.0, 3.0), (-20.0, -2.0), (-29.0, 2.0), (-38.0, 5.0))


@lru_cache(maxsize=1)
def vault() -> tuple[Step, ...]:
    """Outside of the braincase."""
    return (
        add(egg((0, 3, 17), (27.5, 38, 20), (27.5, 34, 31.0))),
        add(egg((0, -15, 20), (20.5, 21.5, 18), (20.5, 20, 23)), 6),
        add(egg((0, 21, 10), (21, 18, 15)), 8),
        add(paired(egg((13, 9, 23), (15.5, 20, 18))), 6),
        carve(paired(egg((31.0, -20, 4), (11.0, 12.5, 20))), 5),
    )


@lru_cache(maxsize=1)
def cranium() -> tuple[Step, ...]:
    """Base and face upon the vault."""
    base = (
        add(egg((0, -4, -1), (7, 13, 6)), 3),
        add(egg((0, -23, -4), (16, 13, 10), (16, 12, 9)), 3),
        add(paired(egg((16, 6, -1), (9, 6, 5))), 3),
        add(paired(egg((21, 8, -6), (3.4, 4.6, 8), turn=(-14, 0, 0))), 2.5),
        add(egg((0, 36, 4), (4, 2.6, 2.4)), 3),
        carve(paired(egg((23, -13, -14), (9, 9, 14))), 3),
        carve(egg((0, -1, -20), (11, 12, 14)), 3),
    )
    face = (
        add(paired(egg((9.5, -33.6, 15.2), (9, 3.2, 3.0), turn=(0, 8, -14))), 4),
        add(egg((0, -35.0, 15.0), (6, 2.8, 3.6)), 4),
        add(_arch_rail(14.6, 20.4, z=-11.6, half_height=4.8, half_width=2.0), 2.5),
        add(egg((0, -31, -6), (11, 6.6, 7)), 3),
        add(
            paired(
                limb(
                    [(18.3, -31.8, 14.8), (21.2, -29.2, 8.5), (21.4, -28.6, 2), (19.8, -29.2, -3)], (2.6, 2.2, 2.6, 3.4)
                )
            ),
            2,
        ),
        add(
            paired(
                limb(
                    [(19.8, -29.6, -2.4), (13, -33.6, -3.0), (7.5, -35.6, 0), (4.8, -36.8, 7), (3.8, -36.2, 13)],
                    (3.2, 2.6, 2.4, 2.2, 2.2),
                )
            ),
            2,
        ),
        add(paired(limb([(18.5, -28.4, -4), (14.5, -28.5, -9)], (3.6, 3.0))), 3),
        add(
            paired(
                limb(
                    [(20.5, -27, -4), (24.6, -20, -3.6), (26.2, -11, -2.4), (25.4, -4, -1.2), (22.5, 2, 0.2)],
                    (2.9, 2.0, 1.5, 1.7, 2.1),
                )
            ),
            1.5,
        ),
        add(limb([(0, -36.2, 12.5), (0, -38.4, 8.0), (0, -40.6, 3.8)], (2.8, 2.4, 2.6)), 2.0),
        *(
            add(paired(egg((x, y - 0.4, -14.0), (1.3, 2.6, 3.6), turn=(0, 0, turn))), 1.2)
            for x, y, turn in _arch(14.9, 20.9, _UPPER_WIDTHS)
        ),
    )
    holes = (
        carve(paired(_orbit(0.0)), 1.0),
        carve(paired(_NOSTRIL), 0.8),
        carve(_NOSE, 0.8),
        add(paired(limb([(1.2, -38.6, 9.0), (3.0, -38.8, 5.0), (5.2, -37.0, 0.6)], (1.3, 1.1, 1.0))), 1.2),
        carve(paired(limb([(13.2, -38, -5.6), (13.2, -33, -4.8)], 0.8)), 0.3),
        add(paired(box((17.6, -23.0, 6.2), (0.8, 6.6, 8.2), turn=(0, 0, 32), rounding=0.6)), 1.0),
        add(paired(box((4.0, -26.0, 6.4), (0.6, 9.0, 6.6), turn=(0, 0, 4), rounding=0.4)), 1.0),
        add(box((0.5, -20, -3.5), (0.5, 11.5, 5.5), turn=(0, 5, 0), rounding=0.3)),
        add(egg((0, -38.0, -8.6), (1.2, 2.2, 1.2)), 1.0),
        carve(egg((0, 9, -5), (5.6, 6.8, 9)), 0.8),
        carve(paired(limb([(30, 2.5, 0.5), (17, 1, 1)], 1.5)), 0.5),
        add(paired(egg((6.5, 4.5, -5.5), (2.4, 4.4, 2.4), turn=(0, 0, -20))), 1.5),
        add(paired(box((8.5, -13.5, -9), (0.9, 3.0, 6.5), turn=(12, 0, 10), rounding=0.6)), 1.0),
        add(paired(limb([(19, 2, -3), (18.5, 0, -11)], (1.5, 0.5))), 1.0),
    )
    return base + face + holes


def sockets(points: np.ndarray) -> np.ndarray:
    """(N,) signed distances of the room in the eyes' sockets and the nose."""
    return sculpt(points, (add(paired(_orbit(0.0))), add(paired(_NOSTRIL)), add(_NOSE)))


@lru_cache(maxsize=1)
def braincase() -> tuple[Step, ...]:
    """What stands up into the braincase, and its openings."""
    return (
        carve(egg((0, -5, 1), (7, 9, 6)), 2),
        carve(paired(limb([(22, 3, -1), (9, -4, 2)], (5.5, 3.0))), 2),
        carve(paired(_orbit(1.5)), 1),
        add(egg((0, 9, -5), (5.6, 6.8, 9))),
        add(limb([HOLE - 7 * _PLATE_AXES[2], HOLE + 7 * _PLATE_AXES[2]], 2.6)),
    )


@lru_cache(maxsize=1)
def sinuses() -> tuple[Step, ...]:
    """Air in the bone."""
    return (
        add(paired(egg((11.6, -25, -6.2), (4.0, 6.0, 4.4), turn=(0, 0, 14)))),
        add(paired(egg((3.6, -35.2, 15.6), (3.2, 0.9, 2.2)))),
        add(egg((0.8, -12.5, 1.8), (4.2, 3.4, 2.3))),
        add(egg((0, -26, 9.0), (2.6, 6.0, 2.6), power=3)),
    )


@lru_cache(maxsize=1)
def mandible() -> tuple[Step, ...]:
    """Lower jaw."""
    outline = [
        (-19.0, -28.0), (-13.0, -29.8), (-9.0, -29.4), (-6.4, -27.4), (-4.8, -23.5), (-2.2, -9), (-0.4, -3.2),
        (-3.4, -2.6), (-5.8, -7.6), (-9.3, -8.2), (-12.0, -1.8), (-14.3, -5.0), (-15.2, -16), (-18.0, -23.5),
    ]  # fmt: skip
    path = [
        (0, -34.6, -29.3),
        (5.5, -33.8, -29.2),
        (10.4, -30.4, -29.0),
        (14.2, -23.8, -28.2),
        (17.8, -14, -26.6),
        (18.6, -10, -26),
    ]
    return (
        add(paired(rail(path, 4.9, 2.2, 1.8))),
        add(egg((0, -35.2, -32.2), (8.5, 2.6, 3.6)), 4),
        add(paired(egg((6.0, -34.6, -33.6), (3.2, 2.2, 1.9))), 3),
        add(paired(flat_plate(outline, lambda p: 20.0 + 0.11 * (p[:, 2] + 14), 1.5, 1.3)), 2),
        add(paired(egg((21.5, -2.0, -3.4), (3.2, 1.7, 1.7))), 1.5),
        carve(paired(limb([(11.2, -34.5, -29.5), (9.4, -29, -29)], 0.7)), 0.3),
        *(
            add(paired(egg((x, y, -26.4), (1.1, 2.3, 3.2), turn=(0, 0, turn))), 1.2)
            for x, y, turn in _arch(*_LOWER, _LOWER_WIDTHS)[:6]
        ),
    )


@lru_cache(maxsize=1)
def mandible_marrow() -> tuple[Step, ...]:
    """The core of the lower jaw's body."""
    path = [(-17.2, -15, -27.6), (-14.2, -23.8, -29.2), (-10.5, -30.2, -30), (-5.5, -33.7, -30.3), (0, -34.4, -30.6)]
    both = path + [(-x, y, z) for x, y, z in path[-2::-1]]
    return (add(rail(both, 2.6, 0.9, 0.6)),)


@lru_cache(maxsize=1)
def teeth() -> tuple[Step, ...]:
    """Crowns and roots; the rows part at z = −20.6 in front, a little higher at the back, 0.4 mm apart."""
    steps = []
    for arch, widths, neck, tip in ((_UPPER, _UPPER_WIDTHS, -16.2, -20.4), (_LOWER, _LOWER_WIDTHS, -24.2, -20.8)):
        for index, (x, y, turn) in enumerate(_arch(*arch, widths)):
            lone = arch is _UPPER and index == _LOST_TOOTH
            for piece in _tooth((-x if lone else x, y), turn, widths[index], _DEPTHS[index], neck, tip + 0.12 * index):
                steps.append(add(piece if lone else paired(piece), 0.1))
    return tuple(steps)


@lru_cache(maxsize=1)
def vertebrae() -> tuple[Step, ...]:
    """The column; every level is turned a little, and its spine leans to another side."""
    steps: list[Step] = []
    for level, (z, turn) in enumerate(_LEVELS):
        lean = 1.5 * np.sin(np.radians(turn) * 12)
        arch = [(5.2, 1.5, z), (6.2, 6.5, z), (3.6, 11.0, z - 0.5), (0, 12.2, z - 0.8)]
        width = 14.5 if level == 0 else 10.5
        body = egg((0, -2, z), (7.2, 5.4, 4.0 if level else 2.8), power=4)
        spine = [
            (0, 11, z - 0.5),
            (0.6 * lean, 15, z - 2),
            (lean, (13.5, 20, 18, 19.5)[level], z - (1, 3.0, 3.4, 4)[level]),
        ]
        wing = [(5, 2.0, z), (width, 2.5 + 0.4 * level, z - 0.8)]
        steps += [
            add(body, 0.8),
            add(paired(limb(arch, (2.2, 2.3, 2.0, 2.0))), 1.0),
            add(limb(spine, (2.3, 1.7, 2.1)), 1.2),
            add(paired(limb(wing, (2.5, 1.6 if level else 2.2))), 1.2),
            add(paired(egg((7, 4.5, z), (2.6, 3.0, 4.0))), 1.0),
            carve(paired(limb([(8.0, 0.5, z - 5), (8.0, 0.5, z + 5)], 1.0)), 0.4),
        ]
    steps.append(carve(limb([(0, 7.0, -48), (0, 7.2, -4)], 3.6), 0.6))
    return tuple(steps)


@lru_cache(maxsize=1)
def vertebral_marrow() -> tuple[Step, ...]:
    """The cores of the bodies."""
    return tuple(add(egg((0, -2, z), (5.9, 4.2, 2.7), power=4)) for z, _ in _LEVELS[1:])


@lru_cache(maxsize=1)
def discs() -> tuple[Step, ...]:
    """Between the bodies, and below the skull base."""
    heights = [0.5 * (above[0] + below[0]) for above, below in pairwise(_LEVELS)]
    return tuple(add(egg((0, -2, z), (6.4, 4.8, 2.0), power=4)) for z in [-6.8, *heights])


@lru_cache(maxsize=1)
def rod() -> tuple[Step, ...]:
    """A rod of 4 mm from below the nut up into the skull base, and the nut."""
    hexagon = [(3.9 * np.sin(a), 3.9 * np.cos(a)) for a in np.radians(np.arange(0, 360, 60) + 11)]
    nut = flat_plate(hexagon, lambda p: np.zeros(len(p), np.float32), 1.5, 0.3)

    def upright(points: np.ndarray) -> np.ndarray:
        local: np.ndarray = points - np.array([_ROD_X, _ROD_Y, -44.0], np.float32)
        return nut.distance(local[:, [2, 0, 1]])

    return (
        add(limb([(_ROD_X, _ROD_Y, -47.0), (_ROD_X, _ROD_Y, 0.6)], 2.0)),
        add(Piece(upright, np.array([_ROD_X, _ROD_Y, -44.0], np.float32), 5.0)),
    )


def plate(skin: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(N,) distance to a cross of two arms over the burr hole, bent to the vault, with a screw at each arm's end.

    Args:
        skin: (N,) signed distance of the vault at the points (N, 3).
    """
    offset = points - HOLE
    across, along = offset @ _PLATE_AXES[0], offset @ _PLATE_AXES[1]
    arms = np.minimum(
        np.hypot(np.maximum(np.abs(across) - 5.6, 0), along), np.hypot(np.maximum(np.abs(along) - 5.6, 0), across)
    )
    arms = np.maximum(np.minimum(arms - 1.1, np.hypot(across, along) - 2.2), offset @ -_PLATE_AXES[2] - 6.0)
    strip = np.maximum(np.abs(skin - 0.35) - 0.45, arms)
    return sculpt(points, _screws(), strip)


@lru_cache(maxsize=1)
def _screws() -> tuple[Step, ...]:
    steps = []
    for first, second in ((5.6, 0), (-5.6, 0), (0, 5.6), (0, -5.6)):
        spot = HOLE + first * _PLATE_AXES[0] + second * _PLATE_AXES[1]
        # The vault curves away from the tangent plane by about e² / 2R.
        head = spot - 5.6**2 / 56 * _PLATE_AXES[2]
        steps.append(add(limb([head, head - 2.4 * _PLATE_AXES[2]], (0.75, 0.45))))
        steps.append(add(limb([head + 0.3 * _PLATE_AXES[2], head + 0.8 * _PLATE_AXES[2]], 0.9)))
    return tuple(steps)


def _orbit(wall: float) -> Piece:
    """The eye's socket, larger all round by `wall` mm."""
    return egg((13.0, -37, 6.6), (7.6 + wall, 21 + wall, 7.0 + wall), turn=(4, 6, 13), power=2.6)


def _arch(a: float, b: float, widths: tuple[float, ...]) -> list[tuple[float, float, float]]:
    """x, y and turn in degrees of teeth side by side on an elliptic arch whose ends lie at y = −17.5."""
    angles = np.linspace(0, np.pi / 2, 400)
    lengths = a * ellipeinc(angles, 1 - (b / a) ** 2)
    middles = np.cumsum(widths) - 0.5 * np.asarray(widths)
    found = np.interp(middles * min(1.0, lengths[-1] / sum(widths)), lengths, angles)
    turns = np.degrees(np.arctan2(b * np.sin(found), a * np.cos(found)))
    return [(a * np.sin(t), -17.5 - b * np.cos(t), turn) for t, turn in zip(found, turns, strict=True)]


def _arch_rail(a: float, b: float, z: float, half_height: float, half_width: float) -> Piece:
    angles = np.linspace(0, np.pi / 2, 9)
    path = [(a * np.sin(t), -17.5 - b * np.cos(t), z) for t in angles]
    return paired(rail(path, half_height, half_width, 1.2))


def _tooth(at: tuple[float, float], turn: float, width: float, depth: float, neck: float, tip: float) -> list[Piece]:
    """Crown and root; on an arch the crowns must be a little narrower inside than their share of it."""
    x, y = at
    turn = float(np.sign(x)) * turn
    half = (0.5 * width - 0.09 - 0.022 * depth, 0.5 * depth, 0.5 * abs(neck - tip) + 0.25)
    up = float(np.sign(neck - tip))
    crown = box((x, y, 0.5 * (neck + tip) + 0.25 * up), half, turn=(0, 0, turn), rounding=0.7)
    root = egg((x, y, neck + up), (0.36 * width, 0.36 * depth, 4.2), turn=(0, 0, turn))
    return [crown, root]
