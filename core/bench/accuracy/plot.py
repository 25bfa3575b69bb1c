"""Seconds against accuracy, knob by knob, with the front that nothing beats and the presets on it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from PIL import Image, ImageDraw

from ...plotting import INK, Axes, even_ticks, limits, log_ticks, mark, save_png, text
from .knobs import pareto_front

_HEIGHT, _TOP, _BOTTOM, _LEFT, _PANEL, _APART, _LEGEND = 800, 100, 660, 90, 560, 100, 270
_ENTRY = 34
# What changes a figure by less has nothing to do with it; so much more than the point before has its name in the plot.
_LEAST_DB, _NAMED_DB = 0.005, 0.25
# Above and below the points, and beside presets in px, for names.
_ROOM_DB, _NAME = 0.6, 60
# Of a setting's name, in px.
_WIDE = 90
# Marks so near to the middle of a preset across, and so far above it, are in the way of its name.
_NAME_WIDE, _NAME_FROM, _NAME_TO = 50, 10, 45
# The logarithm of seconds before the first and after the last point, for their marks.
_ROOM_LOG = 0.06

Row = dict[str, Any]


def draw_front(content: dict[str, Any], path: Path) -> None:
    """Writes the PNG: a panel for sections, else projections, and one for photos.

    Args:
        content: of `accuracy.json`.
    """
    rows: list[Row] = content["rows"]
    qualities = _drawn(rows)
    knobs = [knob for knob in dict.fromkeys(row["knob"] for row in rows) if knob != "preset"]
    panels = max(len(qualities), 1)
    size = _LEFT + panels * _PANEL + (panels - 1) * _APART + _LEGEND, _HEIGHT
    image = Image.new("RGB", size, "white")
    draw = ImageDraw.Draw(image)
    text(draw, (30, 14), f"{content['capture']}: PSNR of what was kept back, by seconds of the whole run", 24)
    text(draw, (30, _HEIGHT - 34), _machine(content["machine"]), 18)
    if not qualities:
        text(draw, (120, 120), "nothing was kept back", 22)
    for place, quality in enumerate(qualities):
        left = _LEFT + place * (_PANEL + _APART)
        _draw_panel(draw, (left, _TOP, left + _PANEL, _BOTTOM), rows, quality, knobs)
    _draw_legend(draw, (size[0] - _LEGEND + 40, _TOP + 20), knobs)
    save_png(image, path)


def _drawn(rows: Sequence[Row]) -> list[str]:
    """What is drawn of what all rows have."""
    there = [name for name in ("sections", "projections", "photos") if _all_have(rows, name)]
    return [*[name for name in there if name != "photos"][:1], *[name for name in there if name == "photos"]]


def _all_have(rows: Sequence[Row], name: str) -> bool:
    return bool(rows) and all(row.get(name) is not None for row in rows)


def _machine(facts: dict[str, Any]) -> str:
    cores = "one core" if facts["cores"] == 1 else f"{facts['cores']} cores"
    return f"{facts['cpu']}, {cores}, {facts['date'][:4]}. Settings that change nothing in a panel are left out of it."


def _draw_panel(
    draw: ImageDraw.ImageDraw,
    frame: tuple[float, float, float, float],
    rows: Sequence[Row],
    quality: str,
    knobs: Sequence[str],
) -> None:
    usual = rows[0][quality]
    shown = [row for row in rows if row["knob"] == "preset" or abs(row[quality] - usual) > _LEAST_DB]
    points = [(math.log10(row["seconds"]), float(row[quality])) for row in shown]
    logs = [log for log, _ in points]
    across = limits([min(logs) - _ROOM_LOG, max(logs) + _ROOM_LOG], 0.1)
    found = [decibel for _, decibel in points]
    decibels = limits([min(found) - _ROOM_DB, max(found) + _ROOM_DB], 1.0)
    axes = Axes(draw, frame, across, decibels)
    axes.draw_grid(log_ticks(*across) or even_ticks(*across), even_ticks(*decibels))
    axes.draw_names(quality, "seconds", "dB")
    front = pareto_front(points)
    corners = [axes.place(*points[place]) for place in front]
    for (x0, y0), (x1, y1) in pairwise(corners):
        # What is had for less than the next point's time is the point before.
        draw.line((x0, y0, x1, y0), INK, 2)
        draw.line((x1, y0, x1, y1), INK, 2)
    for row, point in zip(shown, points, strict=True):
        if row["knob"] != "preset":
            mark(draw, axes.place(*point), knobs.index(row["knob"]), size=7)
    others = [axes.place(*point) for row, point in zip(shown, points, strict=True) if row["knob"] != "preset"]
    for row, point in zip(shown, points, strict=True):
        if row["knob"] == "preset":
            _draw_preset(axes, point, row["value"], others)
    presets = [axes.place(*point) for row, point in zip(shown, points, strict=True) if row["knob"] == "preset"]
    best = -math.inf
    for place in front:
        x, y = axes.place(*points[place])
        free = not any(abs(right - x) < _NAME and abs(height - y) < 20 for right, height in presets)
        if free and points[place][1] >= best + _NAMED_DB:
            # Pillow's own font has no sign for times.
            name = shown[place]["value"].replace("×", "x ")
            taken = any(-_NAME < right - x < _NAME + _WIDE and 0 < height - y < _NAME for right, height in presets)
            taken = taken or x + _WIDE > frame[2]
            corner, anchor = ((x - 9, y - 7), "rb") if taken else ((x + 9, y + 7), "lt")
            text(draw, corner, name, 14, anchor)
        best = points[place][1]


def _draw_preset(axes: Axes, point: tuple[float, float], name: str, others: Sequence[tuple[float, float]]) -> None:
    """With its name above it, where nothing measured is better in less time, or to its left if a mark is there.

    Args:
        others: pixels of the marks.
    """
    x, y = axes.place(*point)
    axes.draw.polygon(((x, y - 13), (x + 13, y), (x, y + 13), (x - 13, y)), fill="white", outline=INK, width=3)
    taken = any(abs(right - x) < _NAME_WIDE and _NAME_FROM < y - height < _NAME_TO for right, height in others)
    place, anchor = ((x - 19, y), "rm") if taken else ((x, y - 17), "mb")
    text(axes.draw, place, name, 20, anchor)


def _draw_legend(draw: ImageDraw.ImageDraw, place: tuple[float, float], knobs: Sequence[str]) -> None:
    x, y = place
    draw.polygon(((x, y - 10), (x + 10, y), (x, y + 10), (x - 10, y)), fill="white", outline=INK, width=3)
    text(draw, (x + 24, y), "presets", 18, "lm")
    for index, knob in enumerate(knobs, 1):
        mark(draw, (x, y + index * _ENTRY), index - 1, size=7)
        text(draw, (x + 24, y + index * _ENTRY), knob, 18, "lm")
    bottom = y + (len(knobs) + 1) * _ENTRY + 10
    draw.line((x - 10, bottom, x + 14, bottom), INK, 2)
    text(draw, (x + 24, bottom), "nothing measured is\nbetter in less time", 16, "lm")
