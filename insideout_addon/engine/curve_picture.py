"""A run's curve as a picture for the sidebar: PSNR of views that were kept back, by seconds of the run. No bpy."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import count, pairwise
from typing import Any

import numpy as np

SIDE, MARK_SIDE = 360, 32
"""Pixels of the picture's sides, and of a mark's."""

# Okabe and Ito's, which people who confuse red and green can tell apart; as in the look by modality photos are yellow,
# X-rays blue. The ground is opaque: lines are as readable on a light theme as on a dark one.
COLORS = {"photos": (0.90, 0.62, 0.0), "projections": (0.34, 0.71, 0.91), "sections": (0.0, 0.62, 0.45)}
GROUND, GRID, BETWEEN_STAGES = (0.11, 0.12, 0.14), (0.24, 0.25, 0.27), (0.45, 0.46, 0.48)
_ENDS = 14.0
_LINE, _THIN, _RADIUS, _LAST_RADIUS = 4.5, 2.0, 5.0, 8.0
# Of a line between two parts, which measure other splats.
_FAINT = 0.45
_LEVELS_OF_NOTHING = [20.0, 25.0, 30.0, 35.0, 40.0]
_MOST_STEPS = 5


@dataclass(frozen=True)
class CurvePoint:
    """What was measured at one time.

    Attributes:
        stage, part: of the run; "report" for the finished model.
        seconds: of the run.
        photos, projections, sections: mean PSNR of those that were kept back, dB; None where there is none.
    """

    stage: str
    part: str
    seconds: float
    photos: float | None = None
    projections: float | None = None
    sections: float | None = None


def curve_points(content: Any) -> tuple[CurvePoint, ...]:
    """The points of a curve as `report.json` has it, in the order of their seconds.

    What is no point, or not finite, is passed over.
    """
    found = []
    for point in content if isinstance(content, list | tuple) else ():
        seconds = _finite(point.get("seconds")) if isinstance(point, dict) else None
        if seconds is None:
            continue
        known = {kind: _finite(point.get(kind)) for kind in COLORS}
        if any(value is not None for value in known.values()):
            found.append(CurvePoint(str(point.get("stage", "")), str(point.get("part", "")), seconds, **known))
    return tuple(sorted(found, key=lambda point: point.seconds))


def shown_kinds(points: Sequence[CurvePoint]) -> tuple[str, str]:
    """What the picture has a line for: photos, and projections or, where only these were kept back, sections."""
    alone = any(point.sections is not None for point in points) and all(point.projections is None for point in points)
    return "photos", "sections" if alone else "projections"


def newest(points: Sequence[CurvePoint], kind: str) -> float | None:
    """The last value of a kind, dB."""
    return next((value for point in reversed(points) if (value := getattr(point, kind)) is not None), None)


def levels(points: Sequence[CurvePoint]) -> list[float]:
    """Round dB with a line of the grid each, lowest first: three to six, with all points between the ends."""
    kinds = shown_kinds(points)
    values = [value for point in points for kind in kinds if (value := getattr(point, kind)) is not None]
    if not values:
        return list(_LEVELS_OF_NOTHING)
    for step in (float(digit * 10**power) for power in count() for digit in (1, 2, 5)):
        low, high = math.floor(min(values) / step), math.ceil(max(values) / step)
        if high - low <= _MOST_STEPS:
            # Equal values lie in the middle.
            low, high = (low - 1, high + 1) if high - low < 2 else (low, high)
            return [step * number for number in range(low, high + 1)]
    raise AssertionError("steps grow without end")


def draw_picture(points: Sequence[CurvePoint]) -> np.ndarray:
    """The picture (SIDE, SIDE, 4), sRGB 0 to 1, its lowest row first as Blender has them.

    Level i of n lies in the middle of the i-th of n equal strips, so that the strips' texts can stand beside it.
    """
    picture = np.empty((SIDE, SIDE, 4), np.float32)
    picture[...] = (*GROUND, 1.0)
    grid = levels(points)
    for level in grid:
        height = _up(level, grid)
        _stroke(picture, (0.0, height), (SIDE, height), GRID, _THIN)
    end = max((point.seconds for point in points), default=0.0)
    for before, after in pairwise(points):
        if before.stage != after.stage and after.stage != "report":
            across = _across(after.seconds, end)
            _stroke(picture, (across, 0.0), (across, SIDE), BETWEEN_STAGES, _THIN)
    for kind in shown_kinds(points):
        known = [point for point in points if getattr(point, kind) is not None]
        places = [(_across(point.seconds, end), _up(getattr(point, kind), grid)) for point in known]
        for (before, start), (after, stop) in pairwise(zip(known, places, strict=True)):
            same = (before.stage, before.part) == (after.stage, after.part)
            _stroke(picture, start, stop, COLORS[kind], _LINE if same else _THIN, 1.0 if same else _FAINT)
        for point, place in zip(known, places, strict=True):
            _mark(picture, place, kind, _LAST_RADIUS if point.stage == "report" else _RADIUS)
    return picture


def draw_mark(kind: str) -> np.ndarray:
    """A kind's mark (MARK_SIDE, MARK_SIDE, 4) on nothing; colours are premultiplied, as those of Blender's icons."""
    picture = np.zeros((MARK_SIDE, MARK_SIDE, 4), np.float32)
    _mark(picture, (MARK_SIDE / 2, MARK_SIDE / 2), kind, MARK_SIDE / 4)
    return picture


def _up(level: float, grid: Sequence[float]) -> float:
    strip = SIDE / len(grid)
    return strip * (0.5 + (level - grid[0]) / (grid[1] - grid[0]))


def _across(seconds: float, end: float) -> float:
    return _ENDS + (SIDE - 2 * _ENDS) * (seconds / end if end > 0 else 0.0)


def _stroke(
    picture: np.ndarray,
    start: tuple[float, float],
    stop: tuple[float, float],
    color: Sequence[float],
    width: float,
    strength: float = 1.0,
) -> None:
    """A straight line with round ends; places are (x, y) in pixels from the lower left corner."""
    (left, low), (right, high) = np.minimum(start, stop), np.maximum(start, stop)
    part, across, up = _around(picture, (left, low, right, high), width / 2)
    along = np.subtract(stop, start)
    share = ((across - start[0]) * along[0] + (up - start[1]) * along[1]) / max(float(along @ along), 1e-9)
    share = np.clip(share, 0.0, 1.0)
    away = np.hypot(across - start[0] - share * along[0], up - start[1] - share * along[1])
    _cover(part, width / 2 - away, color, strength)


def _mark(picture: np.ndarray, place: tuple[float, float], kind: str, radius: float) -> None:
    """A disc for photos, a diamond for what X-rays show: told apart without colours, too."""
    part, across, up = _around(picture, (*place, *place), 1.5 * radius)
    x, y = np.abs(across - place[0]), np.abs(up - place[1])
    inside = radius - np.hypot(x, y) if kind == "photos" else (1.25 * radius - x - y) / math.sqrt(2.0)
    _cover(part, inside, COLORS[kind], 1.0)


def _around(
    picture: np.ndarray, box: tuple[float, float, float, float], margin: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The pixels about a box, and where their centres are."""
    left, low, right, high = (int(value) for value in (*np.subtract(box[:2], margin + 1), *np.add(box[2:], margin + 2)))
    left, low = max(left, 0), max(low, 0)
    part = picture[low : max(high, low), left : max(right, left)]
    return part, left + np.arange(part.shape[1]) + 0.5, (low + np.arange(part.shape[0]) + 0.5)[:, None]


def _cover(part: np.ndarray, inside: np.ndarray, color: Sequence[float], strength: float) -> None:
    """Lays a colour over pixels; `inside` is how far their centres are within the edge, in pixels."""
    cover = strength * np.clip(inside + 0.5, 0.0, 1.0)[..., None]
    part += cover * (np.array((*color, 1.0), np.float32) - part)


def _finite(value: Any) -> float | None:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if number and math.isfinite(value) else None
