"""How good a model became in how many seconds: held-out PSNR over the course of a run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from PIL import Image, ImageDraw

from ..plotting import COLORS, FAINT, Axes, even_ticks, limits, mark, save_png, text
from ..run_folder import STAGES

KINDS = ("photos", "projections", "sections")
CurvePoint = dict[str, Any]
"""`stage`, `part`, `iteration`, `seconds` of the run so far, `splats`, and PSNR in dB by what was kept back."""

_SIZE, _FRAME = (1000, 560), (90, 90, 960, 470)
_NAMES_BELOW = 525


def run_curve(stages: dict[str, dict[str, Any]], heldout: dict[str, Any], seconds: float) -> list[CurvePoint]:
    """The points of a run in the order of their seconds, the figures of the finished model last.

    Those on the way are of up to 16 held-out views of a kind and of what was trained then: in `surface` of photo and
    X-ray splats each by themselves. Lines of one kind therefore jump between stages.

    Args:
        stages: the stages' reports by name.
        heldout: of `report.json`.
        seconds: of the whole run.
    """
    found = []
    for stage in STAGES:
        found += stage_curve(stage, stages.get(stage, {}))
    known = _known({kind: heldout.get(kind, {}).get("psnr") for kind in KINDS})
    found.sort(key=lambda point: point["seconds"])
    end = max([seconds, *(point["seconds"] for point in found[-1:])])
    return found + ([{"stage": "report", "part": "", "seconds": end, **known}] if known else [])


def stage_curve(stage: str, report: dict[str, Any]) -> list[CurvePoint]:
    """The points that a stage's report has, part by part."""
    return [{"stage": stage, "part": part, **_known(point)} for part, made in _histories(report) for point in made]


def _known(point: CurvePoint) -> CurvePoint:
    """Without what could not be measured: the figure of an image that was not finite is null in a file."""
    return {name: value for name, value in point.items() if value is not None}


def _histories(report: dict[str, Any]) -> list[tuple[str, list[CurvePoint]]]:
    """The measured points of each optimisation of a stage, by its name in the stage's report; none of the pairs that
    runs of 0.1.0 and before have."""
    parts = ((name, part.get("heldout")) for name, part in report.items() if isinstance(part, dict))
    lists = ((name, points) for name, points in parts if isinstance(points, list))
    return [(name, [point for point in points if isinstance(point, dict)]) for name, points in lists]


def draw_curve(curve: Sequence[CurvePoint], path: Path) -> None:
    """Writes the PNG: dB by seconds, a line for each kind and optimisation, a larger mark for the finished model."""
    image = Image.new("RGB", _SIZE, "white")
    draw = ImageDraw.Draw(image)
    shown = [(point, kind) for point in curve for kind in KINDS if kind in point]
    end = max((point["seconds"] for point in curve), default=1.0)
    decibels = limits([point[kind] for point, kind in shown] or [0.0, 50.0], 5.0)
    axes = Axes(draw, _FRAME, (0.0, 1.03 * end), decibels)
    axes.draw_grid(even_ticks(*axes.x, most=8), even_ticks(*decibels))
    axes.draw_names("", "seconds", "dB")
    text(draw, (30, 18), "Views that were kept back from the run, PSNR by seconds", 22)
    _draw_stages(axes, curve)
    for number, kind in enumerate(KINDS):
        _draw_kind(axes, [point for point in curve if kind in point], kind, number)
    _draw_legend(draw, [kind for kind in KINDS if any(kind in point for point in curve)])
    save_png(image, path)


def _draw_kind(axes: Axes, points: Sequence[CurvePoint], kind: str, number: int) -> None:
    for index, point in enumerate(points):
        place = axes.place(point["seconds"], point[kind])
        before = points[index - 1] if index else None
        if before is not None and (before["stage"], before["part"]) == (point["stage"], point["part"]):
            axes.draw.line((*axes.place(before["seconds"], before[kind]), *place), COLORS[number], 3)
        mark(axes.draw, place, number, size=8 if point["stage"] == "report" else 4)


def _draw_stages(axes: Axes, curve: Sequence[CurvePoint]) -> None:
    """Each stage's name over its first point."""
    _, top, _, bottom = axes.frame
    for stage in STAGES:
        seconds = [point["seconds"] for point in curve if point["stage"] == stage]
        if seconds:
            across, _ = axes.place(min(seconds), axes.y[0])
            axes.draw.line((across, top - 6, across, bottom), FAINT, 1)
            text(axes.draw, (across, top - 10), stage, 16, "lb")


def _draw_legend(draw: ImageDraw.ImageDraw, kinds: Sequence[str]) -> None:
    across = float(_FRAME[0])
    for kind in kinds:
        mark(draw, (across + 8, _NAMES_BELOW), KINDS.index(kind), size=6)
        text(draw, (across + 24, _NAMES_BELOW), kind, 18, "lm")
        across += 160
    text(draw, (across, _NAMES_BELOW), "large: the finished model", 16, "lm")
