"""The Matryoshka's painting: solid colours by position, in sRGB."""

from __future__ import annotations

import numpy as np

RED, DEEP_RED, PINK = (0.80, 0.09, 0.11), (0.52, 0.03, 0.09), (0.95, 0.52, 0.55)
TEAL, NAVY, GREEN = (0.05, 0.40, 0.44), (0.08, 0.14, 0.36), (0.13, 0.46, 0.17)
GOLD, CREAM, SKIN = (0.96, 0.74, 0.20), (0.98, 0.93, 0.80), (0.97, 0.79, 0.64)
HAIR, BROWN, BLACK = (0.56, 0.33, 0.12), (0.33, 0.17, 0.07), (0.07, 0.05, 0.06)
CRUST, ORANGE, WHITE = (0.77, 0.47, 0.18), (0.95, 0.45, 0.10), (0.99, 0.97, 0.93)


class Canvas:
    """Colours being painted over one another at N surface points.

    Attributes:
        rgb: (N, 3) sRGB in 0..1.
    """

    def __init__(self, count: int, base: tuple[float, float, float]) -> None:
        self.rgb = np.tile(np.asarray(base, np.float32), (count, 1))

    def fill(self, where: np.ndarray, color: tuple[float, float, float]) -> None:
        """Paints the points of the mask (N,)."""
        self.rgb[where] = color

    def glaze(self, amount: np.ndarray, color: tuple[float, float, float]) -> None:
        """Mixes a colour in by `amount` (N,) in 0..1."""
        self.rgb += np.clip(amount, 0, 1)[:, None] * (np.asarray(color, np.float32) - self.rgb)


def paint(points: np.ndarray, relief: dict[str, np.ndarray], body: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """(N, 3) sRGB colours.

    Args:
        points: (N, 3) mm, z up, the doll looking towards −y.
        relief: signed distances (N,) of the parts in relief, by name.
        body: (N,) signed distance of the turned body.
        radius: (N,) the body's radius at each point's height.
    """
    azimuth = np.arctan2(points[:, 0], -points[:, 1])
    z = points[:, 2]
    canvas = Canvas(len(points), TEAL)
    _dress(canvas, azimuth, z, radius)
    _apron(canvas, azimuth, z, radius)
    _headscarf(canvas, azimuth, z, radius)
    _face(canvas, points)
    names = list(relief)
    nearest = np.argmin(np.stack([relief[name] for name in names]), axis=0)
    raised = np.stack([relief[name] for name in names]).min(axis=0) < body
    for index, name in enumerate(names):
        on_it = raised & (nearest == index)
        if on_it.any():
            _RELIEF_PAINTERS[name](canvas, on_it, points, azimuth)
    # Brush strokes: without a little texture the large plain areas would hold no detail to compare.
    strokes = np.sin(5 * azimuth + 1.7 * z) * np.sin(2.3 * z - 9 * azimuth) + 0.6 * np.sin(31 * azimuth - 0.9 * z)
    return np.clip(canvas.rgb * (1 + 0.035 * strokes[:, None]), 0, 1)


def _dress(canvas: Canvas, azimuth: np.ndarray, z: np.ndarray, radius: np.ndarray) -> None:
    canvas.fill(_dots(azimuth, z, columns=30, pitch=6.0, size=0.85, radius=radius), GOLD)
    for degrees, height, petal in ((92, -26, PINK), (128, -34, ORANGE), (-95, -25, WHITE), (-132, -33, PINK)):
        _flower(canvas, azimuth, z, radius, degrees, height, 7.0, petal)
    for degrees, height, petal in ((150, -17, WHITE), (-152, -19, GOLD), (68, -38, WHITE), (-70, -39, ORANGE)):
        _flower(canvas, azimuth, z, radius, degrees, height, 4.2, petal)
    wave = z + 44.0 - 1.3 * np.abs(((azimuth * 16 / np.pi) % 2) - 1) * 2
    canvas.fill(wave < 3.2, DEEP_RED)
    canvas.fill(np.abs(wave - 3.2) < 0.6, GOLD)
    canvas.fill(_dots(azimuth, z + 44.6, columns=36, pitch=100.0, size=0.9, radius=radius), GOLD)
    canvas.fill(z < -47.4, NAVY)
    canvas.fill(np.abs(z + 47.2) < 0.5, GOLD)
    canvas.fill(np.abs(z + 16.0) < 0.25, BROWN)
    canvas.fill(z < -49.8, (0.82, 0.66, 0.44))


def _apron(canvas: Canvas, azimuth: np.ndarray, z: np.ndarray, radius: np.ndarray) -> None:
    across = azimuth * radius / 19.5
    down = (z + 16.0) / np.where(z > -16, 22.0, 25.5)
    edge = np.hypot(across, down) + 0.018 * np.cos(22 * np.arctan2(down, across))
    front = np.abs(azimuth) < 1.4
    canvas.fill(front & (edge < 1.0), GOLD)
    canvas.fill(front & (edge < 0.94), CREAM)
    inside = Canvas(len(z), CREAM)
    inside.rgb = canvas.rgb.copy()
    _flower(inside, azimuth, z, radius, 0, -24, 9.0, RED)
    _flower(inside, azimuth, z, radius, 22, -17, 5.2, ORANGE)
    _flower(inside, azimuth, z, radius, -22, -18, 5.2, (0.35, 0.25, 0.70))
    _flower(inside, azimuth, z, radius, 19, -33, 4.4, PINK)
    _flower(inside, azimuth, z, radius, -17, -33.5, 4.4, GOLD)
    blossom = front & (edge < 0.9)
    canvas.rgb[blossom] = inside.rgb[blossom]


def _headscarf(canvas: Canvas, azimuth: np.ndarray, z: np.ndarray, radius: np.ndarray) -> None:
    """Over the head and the shoulders, a triangle down the back, a scalloped golden edge."""
    back = np.clip((np.abs(azimuth) - 0.62 * np.pi) / (0.38 * np.pi), 0, 1)
    edge = 13.0 - 17.0 * back - 1.2 * np.abs(np.sin(9 * azimuth)) + 3.0 * np.exp(-((azimuth / 0.35) ** 2))
    canvas.fill(z > edge - 1.4, GOLD)
    scarf = z > edge
    canvas.fill(scarf, RED)
    canvas.fill(scarf & (z < edge + 2.6) & (z > edge + 1.9), CREAM)
    canvas.fill(scarf & (z > edge + 3.2) & _dots(azimuth, z, 18, 7.0, 1.25, radius), WHITE)
    flowers = Canvas(len(z), RED)
    flowers.rgb = canvas.rgb.copy()
    for degrees, height, petal in (
        (90, 33, GOLD),
        (-90, 33, PINK),
        (135, 26, ORANGE),
        (-140, 27, WHITE),
        (180, 38, GOLD),
    ):
        _flower(flowers, azimuth, z, radius, degrees, height, 5.0, petal)
    canvas.rgb[scarf] = flowers.rgb[scarf]


def _face(canvas: Canvas, points: np.ndarray) -> None:
    x, z = points[:, 0], points[:, 2]
    front = points[:, 1] < 0
    oval = np.hypot(x / 12.2, (z - 33.6) / 10.8)
    canvas.fill(front & (oval < 1.09), GOLD)
    canvas.fill(front & (oval < 1.0), SKIN)
    face = front & (oval < 1.0)

    def blot(center_x: float, center_z: float, wide: float, high: float) -> np.ndarray:
        return face & (np.hypot((np.abs(x) - center_x) / wide, (z - center_z) / high) < 1)

    cheeks = np.exp(-(((np.abs(x) - 7.0) / 2.4) ** 2) - ((z - 30.2) / 2.2) ** 2)
    canvas.glaze(np.where(face, 0.75 * cheeks, 0), (0.93, 0.35, 0.33))
    parting = z - 39.2 - 4.6 * np.exp(-((x / 3.2) ** 2)) + 0.035 * x * x
    canvas.fill(face & (parting > 0), HAIR)
    canvas.fill(face & (parting > 0) & (np.sin(2.2 * np.abs(x) + 0.8 * z) > 0.55), BROWN)
    canvas.fill(blot(4.5, 35.0, 2.3, 1.75), BROWN)
    canvas.fill(blot(4.5, 34.8, 2.0, 1.4), WHITE)
    canvas.fill(blot(4.4, 34.8, 1.3, 1.35), (0.16, 0.36, 0.62))
    canvas.fill(blot(4.4, 34.8, 0.7, 0.75), BLACK)
    canvas.fill(face & (np.hypot(x - np.sign(x) * 4.4 + 0.4, z - 35.35) < 0.38), WHITE)
    brow = z - 37.6 + 0.12 * (np.abs(x) - 4.6) ** 2
    canvas.fill(face & (np.abs(brow) < 0.38) & (np.abs(np.abs(x) - 4.6) < 2.6), BROWN)
    canvas.fill(blot(0.75, 31.3, 0.42, 0.3), (0.80, 0.42, 0.34))
    lips = (np.abs(z - 28.2 - 0.28 * np.abs(x)) < 0.95 - 0.3 * np.abs(x)) & (np.abs(x) < 2.9)
    canvas.fill(face & lips, RED)


def _flower(
    canvas: Canvas,
    azimuth: np.ndarray,
    z: np.ndarray,
    radius: np.ndarray,
    degrees: float,
    height: float,
    size: float,
    petal: tuple[float, float, float],
) -> None:
    """A six-petalled flower of `size` mm with two leaves, laid on the surface."""
    turned = (azimuth - np.radians(degrees) + np.pi) % (2 * np.pi) - np.pi
    across, up = turned * radius, z - height
    for side in (-1, 1):
        along = side * across * 0.8 - up * 0.6
        beside = side * across * 0.6 + up * 0.8
        canvas.fill(np.hypot((along - 1.05 * size) / (0.5 * size), beside / (0.2 * size)) < 1, GREEN)
    reach = np.hypot(across, up)
    turn = np.arctan2(up, across)
    outline = size * (0.78 + 0.22 * np.cos(6 * turn))
    canvas.fill(reach < outline, petal)
    dark = tuple(0.62 * channel for channel in petal)
    canvas.fill((reach < 0.9 * outline) & (np.abs(np.sin(3 * turn)) < 0.14), dark)  # type: ignore[arg-type]
    canvas.fill(reach < 0.32 * size, GOLD if petal != GOLD else DEEP_RED)
    canvas.fill(reach < 0.14 * size, BROWN)


def _dots(
    azimuth: np.ndarray, z: np.ndarray, columns: int, pitch: float, size: float, radius: np.ndarray
) -> np.ndarray:
    """Staggered rows of dots of `size` mm, `pitch` mm apart in height."""
    row = np.round(z / pitch)
    phase = azimuth * columns / (2 * np.pi) + 0.5 * (row % 2)
    across = (phase - np.round(phase)) * 2 * np.pi / columns * radius
    return np.hypot(across, z - row * pitch) < size


def _paint_arm(canvas: Canvas, where: np.ndarray, points: np.ndarray, azimuth: np.ndarray) -> None:
    canvas.fill(where, WHITE)
    degrees = np.degrees(np.abs(azimuth))
    canvas.fill(where & (np.abs((degrees - 84) % 13 - 6.5) < 1.5), RED)
    canvas.fill(where & (degrees < 47), RED)
    canvas.fill(where & (np.abs(degrees - 43) < 1.6), GOLD)


def _paint_hand(canvas: Canvas, where: np.ndarray, points: np.ndarray, azimuth: np.ndarray) -> None:
    canvas.fill(where, SKIN)
    fingers = (np.degrees(np.abs(azimuth)) < 29) & (np.abs(np.sin(1.5 * (points[:, 2] + 3))) < 0.22)
    canvas.fill(where & fingers, (0.85, 0.58, 0.45))


def _paint_loaf(canvas: Canvas, where: np.ndarray, points: np.ndarray, azimuth: np.ndarray) -> None:
    canvas.fill(where, CRUST)
    x, z = points[:, 0], points[:, 2] + 3.0
    scored = np.abs((x + 0.5 * z + 20) % 5.0 - 2.5) < 0.6
    canvas.fill(where & scored & (np.hypot(x / 9, z / 5.2) < 1), (0.97, 0.85, 0.60))
    canvas.fill(where & (z < -4.4), (0.50, 0.27, 0.10))


def _paint_bow(canvas: Canvas, where: np.ndarray, points: np.ndarray, azimuth: np.ndarray) -> None:
    canvas.fill(where, RED)
    canvas.fill(where & (np.abs(np.sin(1.1 * points[:, 0])) < 0.3), DEEP_RED)
    canvas.fill(where & (np.abs(points[:, 0]) < 2.6), ORANGE)


def _paint_plait(canvas: Canvas, where: np.ndarray, points: np.ndarray, azimuth: np.ndarray) -> None:
    canvas.fill(where, HAIR)
    canvas.fill(where & (np.sin(2.4 * points[:, 0] + 1.3 * points[:, 2]) > 0.5), BROWN)


def _paint_ribbon(canvas: Canvas, where: np.ndarray, points: np.ndarray, azimuth: np.ndarray) -> None:
    canvas.fill(where, (0.20, 0.45, 0.85))
    canvas.fill(where & (np.abs(points[:, 0]) < 1.6), NAVY)


_RELIEF_PAINTERS = {
    "arm": _paint_arm,
    "hand": _paint_hand,
    "loaf": _paint_loaf,
    "bow": _paint_bow,
    "plait": _paint_plait,
    "ribbon": _paint_ribbon,
}
