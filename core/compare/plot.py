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
_MARK, _OWN_MARK = 9, 13
_GREY = "#808080"
# Above the best point, for its mark.
_ROOM_DB = 1.0
# Of the legend: a row's height, and that of the words under the rows with a margin.
_ENTRY, _WORDS = 30, 80


@dataclass(frozen=True)
class Point:
    """One row of one capture: `seconds` of work, section `psnr` in dB; `solid` for rows that saw X-rays, `own` for the
    InsideOut row."""

    capture: str
    label: str
    seconds: float
    psnr: float
    solid: bool
    own: bool = False


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
        shown, nothing = [point for point in points if point.capture == capture], _air(content["captures"][capture])
        axes = _panel(draw, column * _WIDE, _TITLE + row * _HIGH, spread, _decibels(shown, nothing))
        axes.draw_names(capture, "seconds", "dB")
        if nothing is not None:
            _draw_air(draw, axes, spread, nothing)
        # InsideOut's is the largest mark, and a ring of it stays round one that lies before it.
        for point in sorted(shown, key=lambda point: not point.own):
            place, radius = axes.place(math.log10(point.seconds), point.psnr), _OWN_MARK if point.own else _MARK
            mark(draw, place, labels.index(point.label), point.solid, radius)
    _draw_legend(draw, columns * _WIDE + 10, {point.label: point.solid for point in points}, labels)
    save_png(image, path)


def plot_points(content: dict[str, Any]) -> list[Point]:
    """What is on the plot, in the tables' order; of rows that are cut in two ways the better one."""
    order = list(METHODS)
    found = []
    for capture, one in content["captures"].items():
        for method in sorted(one["methods"], key=lambda name: order.index(name) if name in order else len(order)):
            row = one["methods"][method]
            known = [one["psnr"] for _, one in section_rows(method, row) if one.get("psnr") is not None]
            if known and row["seconds"] > 0:
                solid, own = row["modality"] != "photos", method == "insideout"
                found.append(Point(capture, row["label"], float(row["seconds"]), float(max(known)), solid, own))
    return found


def _seconds(points: Sequence[Point]) -> tuple[float, float]:
    """Limits of the logarithm of the seconds, the same for all panels."""
    logs = [math.log10(point.seconds) for point in points] or [0.0]
    return math.floor(min(logs) * 2) / 2 - 0.1, math.ceil(max(logs) * 2) / 2 + 0.1


def _air(capture: dict[str, Any]) -> float | None:
    """What an empty model has, dB."""
    return ((capture.get("truth") or {}).get("nothing") or {}).get("psnr")


def _draw_air(draw: ImageDraw.ImageDraw, axes: Axes, logs: tuple[float, float], psnr: float) -> None:
    start, end = axes.place(logs[0], psnr), axes.place(logs[1], psnr)
    draw.line([start, end], fill=_GREY, width=2)
    text(draw, (start[0] + 6, start[1] - 4), "nothing at all (air)", 14, "lb")


def _decibels(points: Sequence[Point], nothing: float | None) -> tuple[float, float]:
    values = [*(point.psnr for point in points), *([] if nothing is None else [nothing])]
    return math.floor(min(values) / 5) * 5, math.ceil((max(values) + _ROOM_DB) / 5) * 5


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
        # With what a row of before was made the tables tell; here that would run out of the picture.
        name, before, _ = label.partition(" [as it was")
        text(draw, (x + 32, y), f"{name}, before" if before else name, 18, "lm")
        y += _ENTRY
    if labels:
        text(draw, (x, y + 10), "filled: saw X-rays; hollow:\nphotos alone, at their better reading", 16)
