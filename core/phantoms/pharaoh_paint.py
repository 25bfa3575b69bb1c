"""The coffin's painting: solid colours by position, in sRGB."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .glyphs import write
from .matryoshka_paint import Canvas

GOLD, PALE_GOLD, DARK_GOLD = (0.94, 0.71, 0.17), (0.98, 0.83, 0.42), (0.70, 0.46, 0.10)
LAPIS, NIGHT, TURQUOISE = (0.09, 0.22, 0.58), (0.05, 0.08, 0.25), (0.08, 0.56, 0.56)
CARNELIAN, OCHRE, CREAM = (0.72, 0.17, 0.10), (0.80, 0.47, 0.16), (0.96, 0.90, 0.74)
BLACK, WHITE, GREEN, WOOD = (0.06, 0.05, 0.06), (0.98, 0.97, 0.93), (0.16, 0.45, 0.22), (0.45, 0.28, 0.14)

_AXIS_Y = 3.0
_ARC_MM = 17.5
_FEATHER_MM = 4.2

Color = tuple[float, float, float]
Painter = Callable[[Canvas, np.ndarray, np.ndarray, np.ndarray], None]
"""(canvas, where, points, azimuth) -> None"""


def paint(points: np.ndarray, normals: np.ndarray, relief: dict[str, np.ndarray], skin: np.ndarray) -> np.ndarray:
    """(N, 3) sRGB colours.

    Args:
        points: (N, 3) mm, z up, the coffin looking towards −y.
        normals: (N, 3) unit.
        relief: signed distances (N,) of the parts in relief, by name.
        skin: (N,) signed distance of the coffin without relief.
    """
    x, y, z = points.T
    azimuth = np.arctan2(x, -(y - _AXIS_Y))
    canvas = Canvas(len(points), GOLD)
    _feathers(canvas, azimuth, z)
    _bands(canvas, azimuth, z)
    _back(canvas, points, azimuth)
    _foot(canvas, points, normals)
    _flesh(canvas, points)
    names = list(relief)
    stack = np.stack([relief[name] for name in names])
    nearest, raised = np.argmin(stack, axis=0), stack.min(axis=0) < skin - 0.05
    for index, name in enumerate(names):
        on_it = raised & (nearest == index)
        if on_it.any():
            _PAINTERS[name](canvas, on_it, points, azimuth)
    canvas.fill((np.abs(y - _AXIS_Y) < 0.45) & (skin < 0.3), WOOD)
    # Brush strokes and wear: without a little texture the large plain areas would hold no detail to compare.
    wear = np.sin(3 * azimuth + 0.9 * z) * np.sin(1.7 * z - 7 * azimuth)
    wear += 0.7 * np.sin(1.9 * x + 23 * azimuth - 0.8 * z)
    return np.clip(canvas.rgb * (1 + 0.035 * wear[:, None]), 0, 1)


def _feathers(canvas: Canvas, azimuth: np.ndarray, z: np.ndarray) -> None:
    """Overlapping feathers in rows, pointing to the feet, a row in each of three colours."""
    color = np.array([LAPIS, TURQUOISE, CARNELIAN], np.float32)
    for above in (0, 1):
        # A row's tips reach over the row below, so the upper row is painted last.
        row = np.floor(z / _FEATHER_MM) + above
        arc = azimuth * _ARC_MM / 4.6 + 0.5 * (row % 2)
        across, down = 2.0 * (arc - np.round(arc)), row + 1 - z / _FEATHER_MM
        tip = np.hypot(across, np.maximum(down - 0.55, 0) / 0.9)
        own = (tip < 1.0) & (down > 0)
        canvas.fill(own, GOLD)
        body = own & (tip < 0.8)
        canvas.rgb[body] = color[(row[body] % 3).astype(int)]
        canvas.fill(body & ((np.abs(across) < 0.09) | (tip < 0.22) & (down > 0.6)), PALE_GOLD)


def _bands(canvas: Canvas, azimuth: np.ndarray, z: np.ndarray) -> None:
    """Three bands of writing around the body and four columns of it between them."""
    for number, height in enumerate((-4.0, -21.0, -38.0)):
        u, v = (z - height) / 2.5, azimuth * _ARC_MM / 4.6 + 0.37 * number
        _written(canvas, np.abs(z - height) < 3.5, u, v, number + 3, CREAM if number % 2 else PALE_GOLD)
    for number, degrees in enumerate((62.0, 118.0, -62.0, -118.0)):
        across = (azimuth - np.radians(degrees)) * _ARC_MM
        column = (np.abs(across) < 3.0) & (z < -7.5) & (z > -45) & (np.abs(z + 21) > 3.5) & (np.abs(z + 38) > 3.5)
        _written(canvas, column, across / 2.1, z / 4.4, number + 20, CREAM)


def _written(canvas: Canvas, band: np.ndarray, u: np.ndarray, v: np.ndarray, seed: int, ground: Color) -> None:
    canvas.fill(band, LAPIS)
    canvas.fill(band & (np.abs(u) < 1.25), GOLD)
    canvas.fill(band & (np.abs(u) < 1.12), ground)
    canvas.fill(band & write(u, v, seed), NIGHT)


def _back(canvas: Canvas, points: np.ndarray, azimuth: np.ndarray) -> None:
    """A pillar with four bars, and a column of writing below it."""
    x, y, z = points.T
    back = y > _AXIS_Y + 4
    column = back & (np.abs(x) < 4.6) & (z < -8) & (z > -56)
    _written(canvas, column, -x / 3.4, z / 6.4, 9, PALE_GOLD)
    field = back & (np.abs(x) < 11) & (z > 0) & (z < 26)
    canvas.fill(field, NIGHT)
    canvas.fill(field & ((np.abs(np.abs(x) - 10.3) < 0.4) | (np.abs(z - 0.7) < 0.4)), GOLD)
    canvas.fill(field & (np.abs(x) < 2.0 + 1.2 * np.exp(-(((z - 1.5) / 2.0) ** 2))) & (z > 1.5), GOLD)
    canvas.fill(field & (np.abs(x) < 5.6) & (np.abs((z - 10.0) % 3.4 - 1.7) < 1.0) & (z > 9.8) & (z < 23.4), TURQUOISE)
    stars = np.hypot((np.abs(x) - 8.0 + 4.2 / 2) % 4.2 - 2.1, (z + 0.3) % 4.2 - 2.1)
    canvas.fill(field & (np.abs(x) > 6.2) & (np.abs(x) < 10) & (stars < 0.75), WHITE)
    wing = back & (np.abs(x) >= 11) & (z > 0) & (z < 24)
    ray = np.abs(x) + 0.7 * z
    canvas.fill(wing & (ray % 3.0 < 1.0), CARNELIAN)
    canvas.fill(wing & (ray % 3.0 > 2.0), LAPIS)


def _foot(canvas: Canvas, points: np.ndarray, normals: np.ndarray) -> None:
    x, y, z = points.T
    canvas.fill(z < -55.2, CARNELIAN)
    canvas.fill((z < -56.0) & (np.abs((x + 0.6 * y + 60) % 3.2 - 1.6) < 0.8), CREAM)
    canvas.fill(np.abs(z + 55.2) < 0.45, GOLD)
    canvas.fill((z < -59.3) & (normals[:, 2] < -0.7), WOOD)
    top = (normals[:, 2] > 0.35) & (y < -4) & (z < -42)
    canvas.fill(top, GOLD)
    toes = np.abs((np.abs(x) + 0.2) % 2.2 - 1.1) < 0.75
    canvas.fill(top & (y < -13) & (np.abs(x) > 0.9) & (np.abs(x) < 11.2) & toes, CREAM)


def _flesh(canvas: Canvas, points: np.ndarray) -> None:
    """The golden face, with its eyes lined in black; painted on what the headdress leaves free."""
    x, y, z = points.T
    face = (z > 30.5) & (y < 1.0)
    canvas.fill(face, PALE_GOLD)
    across = np.abs(x) - 3.8
    lid = np.hypot(across / 2.9, (z - 45.9 - 0.1 * across) / 1.55)
    canvas.fill(face & (lid < 1.0), BLACK)
    tail = (np.abs(z - 45.6 + 0.05 * across) < 0.42) & (across > 2.2) & (across < 5.4)
    canvas.fill(face & tail, BLACK)
    canvas.glaze(np.where(face, 0.35 * np.exp(-(((np.abs(x) - 5) / 2.2) ** 2) - ((z - 41) / 2.4) ** 2), 0), OCHRE)


def _cloth(canvas: Canvas, on: np.ndarray, points: np.ndarray, azimuth: np.ndarray) -> None:
    x, y, z = points.T
    canvas.fill(on, GOLD)
    # Stripes fan out from the brow over the head, lie level on lappets and flap.
    over = np.where(z > 33.0, np.hypot(x * 0.55, z - 33.0) + 0.35 * np.abs(y - 12.0) * (y > _AXIS_Y), 0.0)
    head = (z > 33.0) & ((over % 3.0) > 1.45)
    fall = (z <= 33.0) & (((z + 60) % 3.0) > 1.45)
    canvas.fill(on & (head | fall), LAPIS)
    hem = (z < 17.6) & (np.abs(x) > 6) & (y < _AXIS_Y)
    canvas.fill(on & hem, CARNELIAN)
    canvas.fill(on & (np.abs(z - 17.6) < 0.4) & (y < _AXIS_Y), PALE_GOLD)


def _collar(canvas: Canvas, on: np.ndarray, points: np.ndarray, azimuth: np.ndarray) -> None:
    x, _, z = points.T
    reach = np.hypot(0.85 * x, z - 30.0)
    turn = np.arctan2(x, 30.0 - z)
    for index, color in enumerate((TURQUOISE, CREAM, CARNELIAN, LAPIS, GOLD, TURQUOISE, CARNELIAN)):
        ring = on & (np.abs(reach - 3.6 - 1.9 * index) < 0.95)
        canvas.fill(ring, color)
        canvas.fill(ring & (np.abs((turn * (6 + 3 * index) + 60) % 2.0 - 1.0) < 0.22), PALE_GOLD)
    canvas.fill(on & (reach > 14.0), GOLD)
    drops = np.abs((turn * 14 + 60) % 2.0 - 1.0) < 0.62
    canvas.fill(on & (reach > 14.5) & drops, LAPIS)


def _fist(canvas: Canvas, on: np.ndarray, points: np.ndarray, side: float) -> None:
    """Fingers, closed around a stick."""
    x, _, z = points.T
    hand = on & (side * x > 3.4) & (z > 12.0)
    canvas.fill(hand, PALE_GOLD)
    canvas.fill(hand & (np.abs((z + 0.35 * side * x) % 1.5 - 0.75) < 0.16), DARK_GOLD)


def _lower_arm(canvas: Canvas, on: np.ndarray, points: np.ndarray, azimuth: np.ndarray) -> None:
    _arm(canvas, on, points, -1.0)


def _upper_arm(canvas: Canvas, on: np.ndarray, points: np.ndarray, azimuth: np.ndarray) -> None:
    _arm(canvas, on, points, 1.0)


def _arm(canvas: Canvas, on: np.ndarray, points: np.ndarray, hand_side: float) -> None:
    """A pleated sleeve, a bracelet of three colours, a hand; `hand_side` is the sign of x where the hand is."""
    along = 0.9 * hand_side * points[:, 0] + 0.42 * (points[:, 2] - 9.5)
    canvas.fill(on, CREAM)
    canvas.fill(on & (along % 1.8 < 0.5), (0.80, 0.72, 0.52))
    for low, high, color in ((-1.4, 0.2, LAPIS), (0.2, 1.0, GOLD), (1.0, 2.6, CARNELIAN), (2.6, 3.2, GOLD)):
        canvas.fill(on & (along > low) & (along < high), color)
    canvas.fill(on & (along > 3.2), PALE_GOLD)
    _fist(canvas, on, points, hand_side)


def _rings(first: Color, second: Color, pitch: float, slant: float = 0.0) -> Painter:
    def painter(canvas: Canvas, on: np.ndarray, points: np.ndarray, azimuth: np.ndarray) -> None:
        canvas.fill(on, first)
        canvas.fill(on & ((points[:, 2] + slant * points[:, 0] + 100.0) % pitch < 0.5 * pitch), second)

    return painter


def _plain(color: Color) -> Painter:
    def painter(canvas: Canvas, on: np.ndarray, points: np.ndarray, azimuth: np.ndarray) -> None:
        canvas.fill(on, color)

    return painter


def _eyes(canvas: Canvas, on: np.ndarray, points: np.ndarray, azimuth: np.ndarray) -> None:
    across, up = np.abs(points[:, 0]) - 3.75, points[:, 2] - 46.0
    canvas.fill(on, BLACK)
    canvas.fill(on & (np.hypot(across / 2.15, up / 0.85) < 1), WHITE)
    canvas.fill(on & (np.hypot(across, up) < 0.88), BLACK)


def _apron(canvas: Canvas, on: np.ndarray, points: np.ndarray, azimuth: np.ndarray) -> None:
    _written(canvas, on, points[:, 0] / 3.3, points[:, 2] / 6.2, 1, PALE_GOLD)


def _seal(canvas: Canvas, on: np.ndarray, points: np.ndarray, azimuth: np.ndarray) -> None:
    reach = np.hypot(points[:, 0] - 14.6, points[:, 2] + 2.0)
    canvas.fill(on, GOLD)
    canvas.fill(on & (reach < 2.6), TURQUOISE)
    canvas.fill(on & (reach < 1.3), CARNELIAN)


_PAINTERS: dict[str, Painter] = {
    "cloth": _cloth,
    "collar": _collar,
    "lower arm": _lower_arm,
    "upper arm": _upper_arm,
    "crook": _rings(PALE_GOLD, BLACK, 3.4, 0.4),
    "flail": _rings(PALE_GOLD, BLACK, 3.4, -0.4),
    "beads": _rings(CARNELIAN, TURQUOISE, 2.8),
    "eyes": _eyes,
    "brows": _plain(NIGHT),
    "nose": _plain(PALE_GOLD),
    "lips": _plain((0.80, 0.44, 0.22)),
    "chin": _plain(PALE_GOLD),
    "ears": _plain((0.93, 0.74, 0.32)),
    "beard": _rings(LAPIS, GOLD, 2.4),
    "band": _plain(GOLD),
    "serpent": _rings(CARNELIAN, GOLD, 1.6),
    "seal": _seal,
    "apron": _apron,
}
