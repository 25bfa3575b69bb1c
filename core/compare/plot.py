"""Accuracy against seconds by method, drawn with Pillow: a plot must not need a package that only tests have."""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import Any

from PIL import Image, ImageDraw, ImageFont

from ..files import atomic_write
from .methods import METHODS
from .tables import section_rows

_SIZE = (1400, 900)
_LEFT, _TOP, _RIGHT, _BOTTOM = 110, 70, 980, 790
_INK, _FAINT = (40, 40, 40), (225, 225, 225)
# Okabe and Ito's colours, which people who confuse red and green can tell apart.
_COLORS = ("#d55e00", "#0072b2", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#787878", "#000000")
_MARKS = ("circle", "square", "diamond", "triangle")

Point = tuple[str, str, float, float]
"""Capture, label, seconds, section PSNR in dB."""


def draw_plot(content: dict[str, Any], path: Path) -> None:
    """Writes the PNG; rows without sections are not on it.

    Args:
        content: of `tables.json`.
    """
    points = plot_points(content)
    image = Image.new("RGB", _SIZE, "white")
    draw = ImageDraw.Draw(image)
    draw.text(
        (_LEFT, 20), "Held-out sections: PSNR (dB, higher is nearer to the truth) by seconds of work", _INK, _font(30)
    )
    if points:
        _draw_axes(draw, points)
        _draw_points(draw, points)
    else:
        draw.text((_LEFT, _TOP + 30), "no row has sections yet", _INK, _font(22))
    buffer = io.BytesIO()
    image.save(buffer, "PNG")
    with atomic_write(path) as stream:
        stream.write(buffer.getvalue())


def plot_points(content: dict[str, Any]) -> list[Point]:
    """What is on the plot, in the tables' order."""
    order = list(METHODS)
    found = []
    for capture, one in content["captures"].items():
        for method in sorted(one["methods"], key=lambda name: order.index(name) if name in order else len(order)):
            row = one["methods"][method]
            for label, figures in section_rows(method, row):
                if figures.get("psnr") is not None and row["seconds"] > 0:
                    found.append((capture, label, float(row["seconds"]), float(figures["psnr"])))
    return found


def _limits(points: list[Point]) -> tuple[float, float, float, float]:
    """Logarithms of the seconds and dB of the frame."""
    seconds, values = [math.log10(p[2]) for p in points], [p[3] for p in points]
    return (
        math.floor(min(seconds) * 2) / 2 - 0.1,
        math.ceil(max(seconds) * 2) / 2 + 0.1,
        math.floor(min(values) / 5) * 5,
        math.ceil(max(values) / 5 + 1e-9) * 5,
    )


def _place(point: tuple[float, float], limits: tuple[float, float, float, float]) -> tuple[float, float]:
    left, right, low, high = limits
    x = _LEFT + (point[0] - left) / max(right - left, 1e-9) * (_RIGHT - _LEFT)
    return x, _BOTTOM - (point[1] - low) / max(high - low, 1e-9) * (_BOTTOM - _TOP)


def _draw_axes(draw: ImageDraw.ImageDraw, points: list[Point]) -> None:
    limits = _limits(points)
    left, right, low, high = limits
    for value in range(round(low), round(high) + 1, 5):
        _, y = _place((left, value), limits)
        draw.line((_LEFT, y, _RIGHT, y), _FAINT, 2)
        draw.text((_LEFT - 12, y), str(value), _INK, _font(20), anchor="rm")
    for power in range(math.ceil(left), math.floor(right) + 1):
        for factor in (1, 3):
            place = power + math.log10(factor)
            if place <= right:
                x, _ = _place((place, low), limits)
                draw.line((x, _TOP, x, _BOTTOM), _FAINT, 2)
                draw.text((x, _BOTTOM + 10), f"{factor * 10**power:g}", _INK, _font(20), anchor="mt")
    draw.rectangle((_LEFT, _TOP, _RIGHT, _BOTTOM), outline=_INK, width=2)
    draw.text(((_LEFT + _RIGHT) / 2, _BOTTOM + 50), "seconds", _INK, _font(22), anchor="mt")
    draw.text((_LEFT - 12, _TOP - 14), "dB", _INK, _font(20), anchor="rb")


def _draw_points(draw: ImageDraw.ImageDraw, points: list[Point]) -> None:
    limits = _limits(points)
    labels = list(dict.fromkeys(point[1] for point in points))
    captures = list(dict.fromkeys(point[0] for point in points))
    for capture, label, seconds, value in points:
        place = _place((math.log10(seconds), value), limits)
        _mark(draw, place, labels.index(label), captures.index(capture))
    x, y = _RIGHT + 30, _TOP + 10
    for index, label in enumerate(labels):
        _mark(draw, (x, y), index, 0)
        draw.text((x + 20, y), label, _INK, _font(18), anchor="lm")
        y += 30
    if len(captures) > 1:
        y += 20
        for index, capture in enumerate(captures):
            draw.text((x, y), f"{_MARKS[index % len(_MARKS)]}: {capture}", _INK, _font(18), anchor="lm")
            y += 28


def _mark(draw: ImageDraw.ImageDraw, place: tuple[float, float], label: int, capture: int) -> None:
    (x, y), size = place, 9
    color, kind = _COLORS[label % len(_COLORS)], _MARKS[capture % len(_MARKS)]
    # The second round of colours is drawn hollow.
    fill = color if label < len(_COLORS) else None
    if kind == "circle":
        draw.ellipse((x - size, y - size, x + size, y + size), fill, color, 3)
    elif kind == "square":
        draw.rectangle((x - size, y - size, x + size, y + size), fill, color, 3)
    elif kind == "diamond":
        draw.polygon([(x, y - size - 2), (x + size + 2, y), (x, y + size + 2), (x - size - 2, y)], fill, color, 3)
    else:
        draw.polygon([(x, y - size - 2), (x + size, y + size), (x - size, y + size)], fill, color, 3)


def _font(size: int) -> Any:
    return ImageFont.load_default(size)
