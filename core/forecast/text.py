"""Forecasts in words; Blender's side reads times with it, so nothing here needs torch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .expected import FinishedRun
    from .forecast import Forecast


def forecast_lines(found: Sequence[Forecast], has: Sequence[str] = (), known: FinishedRun | None = None) -> list[str]:
    """A line for each forecast, with what takes most of it and what may be reached, then what has to be said of them.

    Args:
        has: what the capture keeps back, see `expected.QUALITIES`.
        known: a finished run of the same capture.
    """
    from .expected import expected, range_text, source_text

    lines, told = [], False
    for one in found:
        longest = sorted(one.parts, key=lambda part: -one.parts[part])[:3]
        most = ", ".join(f"{part} {duration(one.parts[part])}" for part in longest)
        reached = [f"{name} {range_text(span)}" for name, span in expected(one.settings.preset, has, known).items()]
        told = told or bool(reached)
        lines.append("; ".join([f"{one.settings.preset}: about {duration(one.seconds)} ({most})", *reached]))
    if told:
        lines.append(source_text(known))
    if any(one.cameras for one in found):
        lines.append("Cameras have to be found first, which may take longer or shorter than said here.")
    return lines


def duration(seconds: float) -> str:
    """Seconds as people say them, to about a tenth: "40 s", "3.5 min", "2 h 10 min"."""
    if seconds < 90:
        return f"{max(round(seconds / 5), 1) * 5} s"
    if seconds < 600:
        return f"{round(seconds / 30) / 2:g} min"
    minutes = round(seconds / 60) if seconds < 3600 else round(seconds / 600) * 10
    hours, rest = divmod(minutes, 60)
    return " ".join(filter(None, (f"{hours} h" if hours else "", f"{rest} min" if rest else "")))
