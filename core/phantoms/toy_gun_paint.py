"""The toy gun's colours: dyed plastic, printed stars and stripes, in sRGB."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .matryoshka_paint import Canvas
from .toy_gun_layout import AXIS_Z, BARREL_X, SCREWS

RED, DARK_RED, ORANGE = (0.88, 0.13, 0.10), (0.55, 0.05, 0.07), (0.98, 0.52, 0.08)
YELLOW, CREAM, WHITE = (0.99, 0.83, 0.14), (0.98, 0.94, 0.80), (0.97, 0.97, 0.96)
BLUE, NAVY, CYAN = (0.10, 0.32, 0.78), (0.06, 0.11, 0.35), (0.25, 0.80, 0.88)
PALE_CYAN, TEAL, GREEN = (0.70, 0.94, 0.96), (0.05, 0.50, 0.58), (0.25, 0.75, 0.25)
PURPLE, SILVER, BLACK = (0.45, 0.18, 0.62), (0.72, 0.74, 0.77), (0.07, 0.07, 0.09)

_DIAL_X = -19.0

Color = tuple[float, float, float]
Painter = Callable[[Canvas, np.ndarray, np.ndarray, np.ndarray], None]
"""(canvas, where, points, normals) -> None"""


def paint(points: np.ndarray, normals: np.ndarray, solids: dict[str, np.ndarray]) -> np.ndarray:
    """(N, 3) sRGB colours.

    Args:
        points: (N, 3) mm, barrel towards +x, z up.
        normals: (N, 3) unit.
        solids: signed distances (N,) of all that is seen, by name; a point gets the colour of the nearest.
    """
    canvas = Canvas(len(points), RED)
    names = list(solids)
    nearest = np.argmin(np.stack([solids[name] for name in names]), axis=0)
    for index, name in enumerate(names):
        on_it = nearest == index
        if on_it.any():
            _PAINTERS[name.split()[0]](canvas, on_it, points, normals)
    x, y, z = points.T
    # Moulding marks and scuffs: plain areas would hold no detail to compare.
    scuffs = np.sin(0.5 * x + 0.7 * z) * np.sin(1.6 * z - 0.4 * x + y) + 0.6 * np.sin(2.9 * x - 1.7 * z + 0.8 * y)
    return np.clip(canvas.rgb * (1 + 0.02 * scuffs[:, None]), 0, 1)


def _shell(canvas: Canvas, on: np.ndarray, points: np.ndarray, normals: np.ndarray) -> None:
    x, y, z = points.T
    grip = on & (z < 0.16 * (x + 27.0) - 0.5) & (z < 1.5) & (x < -8)
    tail = on & (x < -47.5)
    turn = np.arctan2(y, z - AXIS_Z)
    canvas.fill(on & (x > 8.0), ORANGE)
    flames = 6.0 + 4.0 * np.abs(((turn * 7 / np.pi) % 2) - 1)
    canvas.fill(on & (x > -1.0 + flames - 4.0) & (z > 2.0), YELLOW)
    canvas.fill(on & (x > 3.0 + flames - 4.0) & (z > 2.0), ORANGE)
    canvas.fill(tail, YELLOW)
    canvas.fill(tail & (((turn * 5 / np.pi) % 2) < 1) & (x < -50.5), BLACK)
    canvas.fill(on & (np.abs(x + 47.0) < 0.8), NAVY)
    _stars(canvas, on & ~grip & (x < 0) & (x > -46), points)
    canvas.fill(grip, BLUE)
    canvas.fill(grip & (z < -39.0), YELLOW)
    canvas.fill(grip & (np.abs(z + 39.0) < 0.5), NAVY)
    canvas.fill(on & (normals[:, 0] < -0.9) & (x < -56.0) & (np.hypot(y, z - AXIS_Z) < 5.5), BLACK)
    canvas.fill(on & (np.abs(y) < 0.32), DARK_RED)
    canvas.fill(grip & (np.abs(y) < 0.32), NAVY)
    for screw in SCREWS:
        canvas.fill(on & (np.hypot(x - screw.x, z - screw.z) < 2.62) & (y < 0), SILVER)
        slot = (np.abs(z - screw.z) < 0.35) & (np.abs(x - screw.x) < 1.9)
        canvas.fill(on & slot & (y < 0), BLACK)


def _stars(canvas: Canvas, on: np.ndarray, points: np.ndarray) -> None:
    """Stars of five points on the sides, others on the left than on the right."""
    x, y, z = points.T
    left = ((-33.5, 9.5, 3.4), (-30.0, 21.5, 2.4), (-7.5, 21.0, 2.8), (-9.0, 5.5, 1.6), (-38.0, 16.5, 1.6))
    right = ((-36.0, 10.0, 3.0), (-34.0, 21.0, 2.0), (-8.5, 12.0, 2.2), (-29.0, 6.5, 1.6))
    for side, stars in ((1, left), (-1, right)):
        for center_x, center_z, size in stars:
            u, v = x - center_x, z - center_z
            angle = (np.arctan2(u, v) * 5 / (2 * np.pi) + 0.5) % 1.0 - 0.5
            outline = size * 0.42 / np.cos(np.abs(angle) * 2 * np.pi / 5 - 0.95) * 0.95
            canvas.fill(on & (side * y > 2) & (np.hypot(u, v) < outline), YELLOW if size > 2.1 else WHITE)


def _band(canvas: Canvas, on: np.ndarray, points: np.ndarray, normals: np.ndarray) -> None:
    turn = np.arctan2(points[:, 1], points[:, 2] - AXIS_Z)
    canvas.fill(on, YELLOW)
    canvas.fill(on & (np.abs((turn * 12 / np.pi) % 2 - 1) < 0.3), NAVY)


def _ribs(canvas: Canvas, on: np.ndarray, points: np.ndarray, normals: np.ndarray) -> None:
    canvas.fill(on, NAVY)


def _dial(canvas: Canvas, on: np.ndarray, points: np.ndarray, normals: np.ndarray) -> None:
    u, v = points[:, 0] - _DIAL_X, points[:, 2] - AXIS_Z
    reach, turn = np.hypot(u, v), np.arctan2(v, u)
    canvas.fill(on, WHITE)
    canvas.fill(on & (reach > 6.7), BLACK)
    ticks = np.abs((turn * 10 / np.pi) % 2 - 1) < 0.28
    canvas.fill(on & ticks & (reach > 4.6) & (reach < 6.2), NAVY)
    canvas.fill(on & (reach > 4.4) & (reach < 6.4) & (turn > 0.2) & (turn < 1.2), RED)
    canvas.fill(on & (reach > 4.4) & (reach < 6.4) & (turn > 1.3) & (turn < 2.4), GREEN)


def _knob(canvas: Canvas, on: np.ndarray, points: np.ndarray, normals: np.ndarray) -> None:
    u, v = points[:, 0] - _DIAL_X, points[:, 2] - AXIS_Z
    canvas.fill(on, SILVER)
    canvas.fill(on & (np.abs(0.6 * u - 0.8 * v) < 0.55) & (0.8 * u + 0.6 * v > -0.8), RED)


def _fin(canvas: Canvas, on: np.ndarray, points: np.ndarray, normals: np.ndarray) -> None:
    x, y, z = points.T
    canvas.fill(on, BLUE)
    stripe = z + 0.62 * x
    canvas.fill(on & (stripe > 10.5) & (stripe < 13.5), WHITE)
    canvas.fill(on & (stripe > 13.5) & (y > 0), YELLOW)
    canvas.fill(on & (np.hypot(x + 37.0, z - 33.5) < 2.9) & (y < 0), WHITE)
    canvas.fill(on & (np.hypot(x + 37.0, z - 33.5) < 1.9) & (y < 0), RED)


def _barrel(canvas: Canvas, on: np.ndarray, points: np.ndarray, normals: np.ndarray) -> None:
    """Looks clear: light along its upper edge, a coil that seems to shine through."""
    x, y, z = points.T
    turn = np.arctan2(y, z - AXIS_Z)
    canvas.fill(on, CYAN)
    canvas.glaze(np.where(on, 0.75 * np.exp(-(((np.abs(turn) - 0.7) / 0.28) ** 2)), 0), PALE_CYAN)
    canvas.glaze(np.where(on, 0.6 * np.clip(np.abs(turn) - 1.9, 0, 1), 0), TEAL)
    coil = np.abs(((x - BARREL_X[0]) / 3.0 + turn / (2 * np.pi)) % 1.0 - 0.5) < 0.13
    canvas.glaze(np.where(on & coil, 0.6, 0), (0.95, 0.35, 0.75))


def _ring(canvas: Canvas, on: np.ndarray, points: np.ndarray, normals: np.ndarray) -> None:
    turn = np.arctan2(points[:, 1], points[:, 2] - AXIS_Z)
    canvas.fill(on, YELLOW)
    canvas.fill(on & (np.abs(normals[:, 0]) < 0.5), ORANGE)
    canvas.fill(on & (np.abs(normals[:, 0]) < 0.5) & (((turn * 9 / np.pi) % 2) < 0.4), RED)


def _muzzle(canvas: Canvas, on: np.ndarray, points: np.ndarray, normals: np.ndarray) -> None:
    x = points[:, 0]
    canvas.fill(on, RED)
    canvas.fill(on & (np.abs(x - 53.0) < 0.7), CREAM)
    canvas.fill(on & (x > 57.4), YELLOW)


def _plain(color: Color) -> Painter:
    def painter(canvas: Canvas, on: np.ndarray, points: np.ndarray, normals: np.ndarray) -> None:
        canvas.fill(on, color)

    return painter


_PAINTERS: dict[str, Painter] = {
    "shell": _shell,
    "band": _band,
    "ribs": _ribs,
    "dial": _dial,
    "knob": _knob,
    "bolt": _plain(YELLOW),
    "switch": _plain(PURPLE),
    "collar": _plain(NAVY),
    "fin": _fin,
    "guard": _plain(ORANGE),
    "trigger": _plain(YELLOW),
    "barrel": _barrel,
    "ring": _ring,
    "muzzle": _muzzle,
    "sight": _plain(CREAM),
}
