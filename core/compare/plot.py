"""Accuracy against seconds by method."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import Image, ImageDraw

from ..plotting import Axes, log_ticks, mark, save_png, text
from .cells import section_rows
from .methods import METHODS

_COLUMNS = 2
_TITLE, _LEGEND = 80, 340
# Of a panel: its size, and what its frame leaves free.
_WIDE, _HIGH = 640, 430
_LEFT, _TOP, _RIGHT, _BOTTOM = 90, 50, 30, 80
# Of the legend: a row's height, and that of the words under the rows with a margin.
_ENTRY, _WORDS = 30, 80


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
    text(draw, (30, 24), "Held-out sections: PSNR (dB, higher is nearer to the truth) by seconds of work", 26)
    if not points:
        text(draw, (30, _TITLE + 30), "no row has sections yet", 22)
    spread = _seconds(points)
    for index, capture in enumerate(captures):
        row, column = divmod(index, columns)
        shown = [point for point in points if point.capture == capture]
        axes = _panel(draw, column * _WIDE, _TITLE + row * _HIGH, spread, _decibels(shown))
        axes.draw_names(capture, "seconds", "dB")
        for point in shown:
            mark(draw, axes.place(math.log10(point.seconds), point.psnr), labels.index(point.label), point.solid)
    _draw_legend(draw, columns * _WIDE + 10, {point.label: point.solid for point in points}, labels)
    save_png(image, path)


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


def _panel(draw: ImageDraw.ImageDraw, x: int, y: int, logs: tuple[float, float], decibels: tuple[float, float]) -> Axes:
    """The frame of one capture's points, over the logarithm of the seconds."""
    axes = Axes(draw, (x + _LEFT, y + _TOP, x + _WIDE - _RIGHT, y + _HIGH - _BOTTOM), logs, decibels)
    heights = [(value, str(value)) for value in range(round(decibels[0]), round(decibels[1]) + 1, 5)]
    axes.draw_grid(log_ticks(*logs), heights)
    return axes


def legend_height(rows: int) -> int:
    """Pixels from the top of the picture to the end of a legend of that many rows."""
    return _TITLE + _TOP + rows * _ENTRY + _WORDS


def _draw_legend(draw: ImageDraw.ImageDraw, x: int, solid: dict[str, bool], labels: list[str]) -> None:
    y = _TITLE + _TOP
    for index, label in enumerate(labels):
        mark(draw, (x + 10, y), index, solid[label])
        text(draw, (x + 32, y), label, 18, "lm")
        y += _ENTRY
    if labels:
        text(draw, (x, y + 10), "filled: saw X-rays; hollow:\nphotos alone", 16)
