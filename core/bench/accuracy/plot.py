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

_SIZE, _FRAME, _LEGEND = (1240, 760), (90, 80, 900, 670), (930, 90)
_ENTRY = 34


def draw_front(content: dict[str, Any], path: Path, quality: str = "") -> None:
    """Writes the PNG.

    Args:
        content: of `accuracy.json`.
        quality: "sections", "photos" or "projections"; the first that all rows have if empty.
    """
    from .measure import drawn_quality

    quality = quality or drawn_quality(content["rows"])
    rows = [row for row in content["rows"] if row.get(quality) is not None]
    image = Image.new("RGB", _SIZE, "white")
    draw = ImageDraw.Draw(image)
    text(draw, (30, 20), f"{content['capture']}: held-out {quality}, PSNR by seconds of the whole run", 24)
    if not rows:
        text(draw, (120, 120), f"no row has {quality}", 22)
        save_png(image, path)
        return
    logs = [math.log10(row["seconds"]) for row in rows]
    across = limits(logs, 0.1)
    decibels = limits([row[quality] for row in rows], 1.0)
    axes = Axes(draw, _FRAME, across, decibels)
    axes.draw_grid(log_ticks(*across) or even_ticks(*across), even_ticks(*decibels))
    axes.draw_names("", "seconds", "dB")
    points = [(log, row[quality]) for log, row in zip(logs, rows, strict=True)]
    front = [axes.place(*points[place]) for place in pareto_front(points)]
    for (x0, y0), (x1, y1) in pairwise(front):
        # What is had for less than the next point's time is the point before.
        draw.line((x0, y0, x1, y0), INK, 2)
        draw.line((x1, y0, x1, y1), INK, 2)
    knobs = [knob for knob in dict.fromkeys(row["knob"] for row in rows) if knob != "preset"]
    for row, point in zip(rows, points, strict=True):
        if row["knob"] != "preset":
            mark(draw, axes.place(*point), knobs.index(row["knob"]), size=7)
    for row, point in zip(rows, points, strict=True):
        if row["knob"] == "preset":
            _draw_preset(axes, point, row["value"])
    _draw_legend(draw, knobs)
    save_png(image, path)


def _draw_preset(axes: Axes, point: tuple[float, float], name: str) -> None:
    x, y = axes.place(*point)
    axes.draw.polygon(((x, y - 13), (x + 13, y), (x, y + 13), (x - 13, y)), fill="white", outline=INK, width=3)
    text(axes.draw, (x + 18, y), name, 20, "lm")


def _draw_legend(draw: ImageDraw.ImageDraw, knobs: Sequence[str]) -> None:
    x, y = _LEGEND
    draw.polygon(((x, y - 10), (x + 10, y), (x, y + 10), (x - 10, y)), fill="white", outline=INK, width=3)
    text(draw, (x + 24, y), "presets", 18, "lm")
    for index, knob in enumerate(knobs, 1):
        mark(draw, (x, y + index * _ENTRY), index - 1, size=7)
        text(draw, (x + 24, y + index * _ENTRY), knob, 18, "lm")
    bottom = y + (len(knobs) + 1) * _ENTRY + 10
    draw.line((x - 10, bottom, x + 14, bottom), INK, 2)
    text(draw, (x + 24, bottom), "nothing measured is\nbetter in less time", 16, "lm")
