"""Accuracy against seconds by method, drawn with Pillow: a plot must not need a package that only tests have."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import Image, ImageDraw, ImageFont

from ..files import atomic_write
from .cells import section_rows
from .methods import METHODS

_COLUMNS = 2
_TITLE, _LEGEND = 80, 340
# Of a panel: its size, and what its frame leaves free.
_WIDE, _HIGH = 640, 430
_LEFT, _TOP, _RIGHT, _BOTTOM = 90, 50, 30, 80
# Of the legend: a row's height, and that of the words under the rows with a margin.
_ENTRY, _WORDS = 30, 80
_INK, _FAINT = (40, 40, 40), (225, 225, 225)
# Okabe and Ito's colours, which people who confuse red and green can tell apart.
_COLORS = ("#d55e00", "#0072b2", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#787878")


@dataclass(frozen=True)
class Point:
    """One row of one capture: `seconds` of work, section `psnr` in dB; `solid` for rows that saw X-rays."""

    capture: str
    label: str
    seconds: float
    psnr: float
    solid: bool


def draw_plot(content: dict[str, Any], path: Path) -> None:
    """Writes the PNG, one panel for each capture; rows without sections are not on it.

    Args:
        content: of `tables.json`.
    """
    points = plot_points(content)
    captures = list(dict.fromkeys(point.capture for point in points))
    labels = list(dict.fromkeys(point.label for point in sorted(points, key=lambda point: not point.solid)))
    columns = min(max(len(captures), 1), _COLUMNS)
    panels = _TITLE + max(math.ceil(len(captures) / columns), 1) * _HIGH
    size = (columns * _WIDE + _LEGEND, max(panels, legend_height(len(labels))))
    image = Image.new("RGB", size, "white")
    draw = ImageDraw.Draw(image)
    _text(draw, (30, 24), "Held-out sections: PSNR (dB, higher is nearer to the truth) by seconds of work", 26)
    if not points:
        _text(draw, (30, _TITLE + 30), "no row has sections yet", 22)
    spread = _seconds(points)
    for index, capture in enumerate(captures):
        row, column = divmod(index, columns)
        shown = [point for point in points if point.capture == capture]
        panel = _Panel(draw, column * _WIDE, _TITLE + row * _HIGH, (*spread, *_decibels(shown)))
        panel.draw_axes(capture)
        for point in shown:
            _mark(draw, panel.place(math.log10(point.seconds), point.psnr), labels.index(point.label), point.solid)
    _draw_legend(draw, columns * _WIDE + 10, {point.label: point.solid for point in points}, labels)
    buffer = io.BytesIO()
    image.save(buffer, "PNG")
    with atomic_write(path) as stream:
        stream.write(buffer.getvalue())


def plot_points(content: dict[str, Any]) -> list[Point]:
    """What is on the plot, in the tables' order; of photo rows the sections as the paper cuts them."""
    order = list(METHODS)
    found = []
    for capture, one in content["captures"].items():
        for method in sorted(one["methods"], key=lambda name: order.index(name) if name in order else len(order)):
            row = one["methods"][method]
            cut, solid = section_rows(method, row), row["modality"] != "photos"
            figures = cut[-1 if solid else 0][1] if cut else {}
            if figures.get("psnr") is not None and row["seconds"] > 0:
                found.append(Point(capture, row["label"], float(row["seconds"]), float(figures["psnr"]), solid))
    return found


def _seconds(points: Sequence[Point]) -> tuple[float, float]:
    """Limits of the logarithm of the seconds, the same for all panels."""
    logs = [math.log10(point.seconds) for point in points] or [0.0]
    return math.floor(min(logs) * 2) / 2 - 0.1, math.ceil(max(logs) * 2) / 2 + 0.1


def _decibels(points: Sequence[Point]) -> tuple[float, float]:
    values = [point.psnr for point in points]
    return math.floor(min(values) / 5) * 5, math.ceil(max(values) / 5 + 1e-9) * 5


class _Panel:
    """The frame of one capture's points; `limits` are those of the seconds' logarithm and of the dB."""

    def __init__(self, draw: ImageDraw.ImageDraw, x: int, y: int, limits: tuple[float, float, float, float]) -> None:
        self._draw, self._limits = draw, limits
        self._frame = x + _LEFT, y + _TOP, x + _WIDE - _RIGHT, y + _HIGH - _BOTTOM

    def place(self, log_seconds: float, psnr: float) -> tuple[float, float]:
        """Where a point is in the picture."""
        left, right, low, high = self._limits
        x0, y0, x1, y1 = self._frame
        across = (log_seconds - left) / max(right - left, 1e-9)
        return x0 + across * (x1 - x0), y1 - (psnr - low) / max(high - low, 1e-9) * (y1 - y0)

    def draw_axes(self, title: str) -> None:
        """Frame, grid and their numbers."""
        left, right, low, high = self._limits
        x0, y0, x1, y1 = self._frame
        for value in range(round(low), round(high) + 1, 5):
            _, y = self.place(left, value)
            self._draw.line((x0, y, x1, y), _FAINT, 2)
            _text(self._draw, (x0 - 12, y), str(value), 18, "rm")
        for power in range(math.floor(left), math.floor(right) + 1):
            for factor in (1, 3):
                place = power + math.log10(factor)
                if left <= place <= right:
                    x, _ = self.place(place, low)
                    self._draw.line((x, y0, x, y1), _FAINT, 2)
                    _text(self._draw, (x, y1 + 10), f"{factor * 10**power:g}", 18, "mt")
        self._draw.rectangle(self._frame, outline=_INK, width=2)
        _text(self._draw, (x0, y0 - 10), title, 22, "lb")
        _text(self._draw, (x0 - 12, y0 - 14), "dB", 18, "rb")
        _text(self._draw, (x1, y1 + 38), "seconds", 18, "rt")


def legend_height(rows: int) -> int:
    """Pixels from the top of the picture to the end of a legend of that many rows."""
    return _TITLE + _TOP + rows * _ENTRY + _WORDS


def _draw_legend(draw: ImageDraw.ImageDraw, x: int, solid: dict[str, bool], labels: list[str]) -> None:
    y = _TITLE + _TOP
    for index, label in enumerate(labels):
        _mark(draw, (x + 10, y), index, solid[label])
        _text(draw, (x + 32, y), label, 18, "lm")
        y += _ENTRY
    if labels:
        _text(draw, (x, y + 10), "filled: saw X-rays; hollow:\nphotos alone", 16)


def _mark(draw: ImageDraw.ImageDraw, place: tuple[float, float], label: int, solid: bool) -> None:
    (x, y), size, color = place, 9, _COLORS[label % len(_COLORS)]
    shape = draw.rectangle if label // len(_COLORS) % 2 else draw.ellipse
    shape((x - size, y - size, x + size, y + size), color if solid else None, color, 3)


def _text(draw: ImageDraw.ImageDraw, place: tuple[float, float], text: str, size: int, anchor: str = "la") -> None:
    # Pillow's own font has no superscripts.
    written = text.replace("²", "2")
    draw.text(place, written, _INK, ImageFont.load_default(size), anchor=None if "\n" in written else anchor)
