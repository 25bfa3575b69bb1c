"""A page of pictures, lines and lettering in millimetres, to be written as an image or as PDF. Numpy alone, no bpy.

Positions are from the page's top-left corner, to the right and down.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ...core.steps import part_of_work
from ..scene.png import write_png_in_steps

Color = tuple[float, float, float]
INK: Color = (0.12, 0.12, 0.12)
FAINT: Color = (0.62, 0.62, 0.62)
MM_PER_INCH = 25.4
# Each row of pixels is looked at along this many lines; across them coverage is exact.
_LINES_PER_ROW = 5
# Share of saving an image that is done when it is drawn.
_DRAWN = 0.3


@dataclass(frozen=True, eq=False)
class Outline:
    """A line of lettering of size 1, the baseline at y = 0, down positive.

    Attributes:
        loops: closed polygons (n, 2); holes run the other way round.
        width: from the first letter's left to the last one's right.
    """

    loops: Sequence[np.ndarray]
    width: float


@dataclass(frozen=True, eq=False)
class Picture:
    """Pixels (h, w, 3) uint8 in a box."""

    left: float
    top: float
    width: float
    height: float
    pixels: np.ndarray


@dataclass(frozen=True, eq=False)
class Shape:
    """Polygons filled with one colour, 0..1; of lettering also the text, its place on the baseline, size and width."""

    loops: Sequence[np.ndarray]
    color: Color
    text: str = ""
    place: tuple[float, float] = (0.0, 0.0)
    size: float = 0.0
    width: float = 0.0


@dataclass(eq=False)
class Page:
    """What is drawn so far.

    Attributes:
        width, height: mm.
        letter: makes the outlines of a text.
        title: for the file's properties.
    """

    width: float
    height: float
    letter: Callable[[str], Outline]
    title: str = ""
    parts: list[Picture | Shape] = field(default_factory=list)

    def picture(self, left: float, top: float, width: float, height: float, pixels: np.ndarray) -> None:
        """An image (h, w, 3) uint8 that fills a box."""
        self.parts.append(Picture(left, top, width, height, pixels))

    def rectangle(self, left: float, top: float, width: float, height: float, color: Color = INK) -> None:
        """A filled rectangle."""
        right, bottom = left + width, top + height
        self.polygon([(left, top), (right, top), (right, bottom), (left, bottom)], color)

    def frame(self, left: float, top: float, width: float, height: float, stroke: float, color: Color = INK) -> None:
        """The outline of a rectangle, drawn outside of it."""
        self.rectangle(left - stroke, top - stroke, width + 2 * stroke, stroke, color)
        self.rectangle(left - stroke, top + height, width + 2 * stroke, stroke, color)
        self.rectangle(left - stroke, top, stroke, height, color)
        self.rectangle(left + width, top, stroke, height, color)

    def polygon(self, points: Sequence[tuple[float, float]] | np.ndarray, color: Color = INK) -> None:
        """A filled polygon (n, 2)."""
        self.parts.append(Shape([np.asarray(points, np.float64)], color))

    def text(self, x: float, y: float, text: str, size: float, align: float = 0.0, color: Color = INK) -> float:
        """Lettering on the baseline y, and its width, mm.

        Args:
            x: where it begins (`align` 0), has its middle (0.5) or ends (1).
            size: of the font, mm; capitals are about 0.7 of it.
        """
        outline = self.letter(text)
        left, width = x - align * outline.width * size, outline.width * size
        loops = [loop * size + (left, y) for loop in outline.loops]
        self.parts.append(Shape(loops, color, text, (left, y), size, width))
        return width


def rasterize_in_steps(page: Page, dots_per_inch: float) -> Generator[float, None, np.ndarray]:
    """(height, width, 3) uint8: the page on white, edges smooth. Yields the share that is done."""
    scale = dots_per_inch / MM_PER_INCH
    height, width = round(page.height * scale), round(page.width * scale)
    canvas = np.full((height, width, 3), 255, np.uint8)
    for number, part in enumerate(page.parts, 1):
        if isinstance(part, Picture):
            _paste(canvas, part, scale)
        else:
            _fill(canvas, [loop * scale for loop in part.loops], part.color)
        yield number / len(page.parts)
    return canvas


def save_png_in_steps(path: Path, page: Page, dots_per_inch: float) -> Generator[float, None, None]:
    """Writes the page as a PNG of real size; breaks and errors as those of `write_png_in_steps`."""
    side = MM_PER_INCH / dots_per_inch
    pixels = yield from part_of_work(rasterize_in_steps(page, dots_per_inch), 0.0, _DRAWN)
    texts = {"Software": "InsideOut", "Title": page.title}
    yield from part_of_work(write_png_in_steps(path, pixels, (side, side), texts), _DRAWN, 1.0)


def _paste(canvas: np.ndarray, part: Picture, scale: float) -> None:
    """Without smoothing: pictures come with about as many pixels as their place has."""
    left, top = round(part.left * scale), round(part.top * scale)
    rows, columns = max(round(part.height * scale), 1), max(round(part.width * scale), 1)
    inside = canvas[max(top, 0) : top + rows, max(left, 0) : left + columns]
    row = (np.arange(inside.shape[0]) + max(-top, 0) + 0.5) * part.pixels.shape[0] / rows
    column = (np.arange(inside.shape[1]) + max(-left, 0) + 0.5) * part.pixels.shape[1] / columns
    inside[:] = part.pixels[row.astype(np.int64)[:, None], column.astype(np.int64)]


def _fill(canvas: np.ndarray, loops: Sequence[np.ndarray], color: Color) -> None:
    if not loops:
        return
    points = np.concatenate(list(loops))
    low = np.clip(np.floor(points.min(axis=0)).astype(np.int64), 0, canvas.shape[1::-1])
    high = np.clip(np.ceil(points.max(axis=0)).astype(np.int64), 0, canvas.shape[1::-1])
    if (high <= low).any():
        return
    covered = coverage([loop - low for loop in loops], *(int(side) for side in high - low))
    inside = canvas[low[1] : high[1], low[0] : high[0]]
    ink = 255.0 * np.array(color)
    inside[:] = np.rint(inside + covered[:, :, None] * (ink - inside)).astype(np.uint8)


def coverage(loops: Sequence[np.ndarray], width: int, height: int) -> np.ndarray:
    """(height, width) share of each pixel that polygons (n, 2) in pixels cover, holes running the other way round."""
    edges = np.concatenate([np.concatenate([loop, np.roll(loop, -1, axis=0)], axis=1) for loop in loops])
    x0, y0, x1, y1 = edges.T[:, :, None]
    lines = (np.arange(height * _LINES_PER_ROW) + 0.5) / _LINES_PER_ROW
    crossing = (y0 <= lines) != (y1 <= lines)
    edge, line = np.nonzero(crossing)
    share = (lines[line] - y0[edge, 0]) / (y1 - y0)[edge, 0]
    x = np.clip(x0[edge, 0] + share * (x1 - x0)[edge, 0], 0, width)
    sign = np.sign(y1 - y0)[edge, 0] / _LINES_PER_ROW
    # Everything right of a crossing gains or loses a line; the pixel that is crossed a part of it.
    change = np.zeros((height, width + 2))
    column = x.astype(np.int64)
    np.add.at(change, (line // _LINES_PER_ROW, column), sign * (column + 1 - x))
    np.add.at(change, (line // _LINES_PER_ROW, column + 1), sign * (x - column))
    return np.clip(np.abs(np.cumsum(change, axis=1)[:, :width]), 0, 1)
