"""Axes, marks and lettering of plots, drawn with Pillow: a plot must not need a package that only tests have."""

from __future__ import annotations

import io
import math
from collections.abc import Iterable, Sequence
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

from .files import atomic_write

INK, FAINT = (40, 40, 40), (225, 225, 225)
COLORS = ("#d55e00", "#0072b2", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#787878")
"""Okabe and Ito's, which people who confuse red and green can tell apart."""
# Steps between ticks, times a power of ten.
_ROUND = (1, 2, 5, 10)
# Powers of ten that few ticks each are enough for.
_FAR = 1.5


class Axes:
    """The frame that values are drawn in.

    Args:
        frame: left, top, right, bottom in pixels.
        x, y: the values at its ends, lowest first.
    """

    def __init__(
        self,
        draw: ImageDraw.ImageDraw,
        frame: tuple[float, float, float, float],
        x: tuple[float, float],
        y: tuple[float, float],
    ) -> None:
        self.draw, self.frame, self.x, self.y = draw, frame, x, y

    def place(self, x: float, y: float) -> tuple[float, float]:
        """Where a point is in the picture."""
        left, top, right, bottom = self.frame
        across, up = ((value - low) / max(high - low, 1e-9) for value, (low, high) in ((x, self.x), (y, self.y)))
        return left + across * (right - left), bottom - up * (bottom - top)

    def draw_grid(self, xs: Iterable[tuple[float, str]], ys: Iterable[tuple[float, str]]) -> None:
        """The frame, a line and a text at each of these places along x and y."""
        left, top, right, bottom = self.frame
        for value, label in ys:
            _, height = self.place(self.x[0], value)
            self.draw.line((left, height, right, height), FAINT, 2)
            text(self.draw, (left - 12, height), label, 18, "rm")
        for value, label in xs:
            across, _ = self.place(value, self.y[0])
            self.draw.line((across, top, across, bottom), FAINT, 2)
            text(self.draw, (across, bottom + 10), label, 18, "mt")
        self.draw.rectangle(self.frame, outline=INK, width=2)

    def draw_names(self, title: str, x: str, y: str) -> None:
        """What is shown, and in which units."""
        left, top, right, bottom = self.frame
        text(self.draw, (left, top - 10), title, 22, "lb")
        text(self.draw, (left - 12, top - 14), y, 18, "rb")
        text(self.draw, (right, bottom + 38), x, 18, "rt")


def even_ticks(low: float, high: float, most: int = 6) -> list[tuple[float, str]]:
    """Up to about `most` round values between two, with their texts."""
    span = max(high - low, 1e-9) / most
    power = 10.0 ** math.floor(math.log10(span))
    step = next(factor * power for factor in _ROUND if factor * power >= span * (1 - 1e-9))
    return [(index * step, f"{index * step:g}") for index in range(math.ceil(low / step), math.floor(high / step) + 1)]


def log_ticks(low: float, high: float) -> list[tuple[float, str]]:
    """Logarithms of 1, 3, 10, 30 ... between two logarithms, with their texts; of 1, 2, 5, 10 ... over a short way."""
    factors = (1, 3) if high - low > _FAR else (1, 2, 5)
    places = (
        (power + math.log10(factor), f"{factor * 10**power:g}")
        for power in range(math.floor(low), math.floor(high) + 1)
        for factor in factors
    )
    return [(place, label) for place, label in places if low <= place <= high]


def limits(values: Sequence[float], step: float) -> tuple[float, float]:
    """Multiples of a step that leave room around values, never the same."""
    return math.floor(min(values) / step) * step, math.ceil(max(values) / step + 1e-9) * step


def mark(draw: ImageDraw.ImageDraw, place: tuple[float, float], number: int, solid: bool = True, size: int = 9) -> None:
    """A disc, beyond the first eight numbers a square, in the number's colour; hollow unless solid."""
    (x, y), color = place, COLORS[number % len(COLORS)]
    shape = draw.rectangle if number // len(COLORS) % 2 else draw.ellipse
    shape((x - size, y - size, x + size, y + size), color if solid else None, color, 3)


def text(draw: ImageDraw.ImageDraw, place: tuple[float, float], words: str, size: int, anchor: str = "la") -> None:
    """Words in Pillow's own font, which has no superscripts."""
    written = words.replace("²", "2")
    draw.text(place, written, INK, ImageFont.load_default(size), anchor=None if "\n" in written else anchor)


def save_png(image: Image.Image, path: Path) -> None:
    """Writes a picture, all of it or nothing."""
    buffer = io.BytesIO()
    image.save(buffer, "PNG")
    with atomic_write(path) as stream:
        stream.write(buffer.getvalue())
