"""How a running job reads: the words and the small curve of the loss that the sidebar shows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

from bpy.app.translations import pgettext_iface as iface_
from bpy.app.translations import pgettext_n as n_

from ...core.run_folder import STAGES

# Eighths of a line's height.
BLOCKS = "▁▂▃▄▅▆▇█"
PARTS = {
    "chamfer": n_("distances"),
    "display": n_("display"),
    "done": n_("done"),
    "effects": n_("effects"),
    "fdk": "FDK",
    "files": n_("files"),
    "fine": n_("fine"),
    "finish": n_("finish"),
    "fit": n_("fit"),
    "global": n_("global"),
    "held-out views": n_("held-out views"),
    "hull": n_("hull"),
    "joint": n_("joint"),
    "local_1": n_("local 1"),
    "local_2": n_("local 2"),
    "local_3": n_("local 3"),
    "outlines": n_("outlines"),
    "photos": n_("photos"),
    "points": n_("points"),
    "projections": n_("projections"),
    "residuals": n_("residuals"),
    "rgb": n_("photos"),
    "rings": n_("rings"),
    "sart": "SART",
    "sections": n_("sections"),
    "sfm": n_("cameras"),
    "speed": n_("speed"),
    "surfaces": n_("surfaces"),
    "transfer": n_("transfer"),
    "xray": n_("X-rays"),
}
"""How parts of the engine's stages are called."""

_REPORT = n_("Report")
CURVE_COLUMNS = 8
_MOST_VALUES = 400


def headline(state: Any) -> str:
    """What is worked on and how far it is: "Surface photos (2 of 5)  45 %".

    Args:
        state: the job as `window_manager.insideout` has it.
    """
    # A newer engine may have others.
    part = PARTS.get(state.part, state.part.replace("_", " "))
    words = (state.stage.capitalize(), part) if state.stage or part else (state.title,)
    what = " ".join(iface_(word) for word in words if word)
    if state.stage in STAGES:
        place = iface_("({number} of {count})").format(number=STAGES.index(state.stage) + 1, count=len(STAGES))
        what = f"{what} {place}"
    return f"{what}  {100 * state.fraction:.0f} %"


def stage_lines(state: Any, running: bool) -> list[tuple[str, str, str]]:
    """Name, status ("", "started", "done", "kept" or "skipped") and text of each stage, the report last.

    All of them at any time: when the number of lines changes, Blender slides the panels below into place, which draws
    the whole window many times over.
    """
    lines = []
    for name in (*STAGES, _REPORT.lower()):
        row = state.stages.get(name)
        status, text = row.state if row else "", iface_(name.capitalize())
        if status == "started" and running and state.stage == name:
            known = [time_left(state.seconds_left)] if state.seconds_left >= 0 else []
            known += [f"{state.heldout_psnr:.1f} dB"] if state.heldout_psnr else []
            text = "  ".join([text, ", ".join(known)]).rstrip()
        elif row and row.seconds:
            text = f"{text}  {duration(row.seconds)}"
        lines.append((name, status, text))
    return lines


def rows(state: Any) -> list[tuple[str, str]]:
    """Name and value of what is known about the running stage; the same rows always, a dash for what is not known."""
    values = {
        n_("Iteration"): _iterations(state) if state.iterations else "",
        n_("Splats"): f"{state.splats:,}" if state.splats else "",
        n_("Loss"): f"{state.loss:.3g}  {state.loss_curve}" if state.loss > 0 else "",
        n_("Kept Back"): f"{state.heldout_psnr:.1f} dB" if state.heldout_psnr else "",
    }
    return [(name, value.rstrip() or "–") for name, value in values.items()]


def _iterations(state: Any) -> str:
    return iface_("{number:,} of {count:,}").format(number=state.iteration, count=state.iterations)


def sparkline(values: Sequence[float], columns: int = CURVE_COLUMNS) -> str:
    """A curve as one line of block characters, the lowest value lowest; "" for fewer than two values.

    More values than `columns` are averaged in even groups.
    """
    finite = [value for value in values if math.isfinite(value)]
    if len(finite) < 2:
        return ""
    count = min(columns, len(finite))
    edges = [round(index * len(finite) / count) for index in range(count + 1)]
    means = [sum(finite[a:b]) / (b - a) for a, b in pairwise(edges)]
    low, span = min(means), max(means) - min(means)
    if span <= 0:
        return BLOCKS[0] * count
    return "".join(BLOCKS[round((mean - low) / span * (len(BLOCKS) - 1))] for mean in means)


class Curve:
    """The course of one number over a run, thinned out evenly so that a run of days costs as little as a minute's.

    Args:
        logarithmic: draw the values' logarithms, for losses.

    Attributes:
        newest: the last value added; 0 before the first.
    """

    def __init__(self, logarithmic: bool = False) -> None:
        self.newest = 0.0
        self._logarithmic = logarithmic
        self._values: list[float] = []
        self._seen, self._stride = 0, 1

    def add(self, value: float | None) -> None:
        """Adds a value; None and what is not finite are passed over."""
        if value is None or not math.isfinite(value):
            return
        self.newest = float(value)
        if self._seen % self._stride == 0:
            self._values.append(math.log(max(self.newest, 1e-12)) if self._logarithmic else self.newest)
        self._seen += 1
        if len(self._values) >= _MOST_VALUES:
            del self._values[1::2]
            self._stride *= 2

    def line(self) -> str:
        """The values so far as a sparkline."""
        return sparkline(self._values)


def time_left(seconds: float) -> str:
    """As "45 s left"."""
    return iface_("{time} left").format(time=duration(seconds))


def duration(seconds: float) -> str:
    """Seconds as "45 s", "3 min 20 s" or "2 h 5 min"."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"
