"""Contours in millimetres as SVG, CSV or a curve object."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import bpy
import numpy as np

from ...core.files import atomic_write, synced_in_steps
from ...core.steps import part_of_work, run_through
from .linking import open_collection
from .section_image import Contour

NAME = "InsideOut Contours"
# Points that are written between two steps: a hundredth of a second.
_AT_ONCE = 1 << 12
# Share of a saving that is done when all is put together; the rest is the disk's.
_PUT = 0.9


def save_svg(path: Path, contours: Sequence[Contour], width_mm: float, height_mm: float) -> None:
    """Writes closed and open lines as an SVG drawing of real size: one user unit is one millimetre."""
    run_through(save_svg_in_steps(path, contours, width_mm, height_mm))


def save_svg_in_steps(
    path: Path, contours: Sequence[Contour], width_mm: float, height_mm: float
) -> Generator[float, None, None]:
    """As `save_svg`, with breaks that tell the share that is done; closed before its end the file is as it was."""
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width_mm:.4f}mm" height="{height_mm:.4f}mm" '
        f'viewBox="0 0 {width_mm:.4f} {height_mm:.4f}">'
    ]
    for contour, share in _parted(contours):
        points = []
        for first in range(0, len(contour.section_mm), _AT_ONCE):
            yield _PUT * share(first)
            points += [f"{x:.4f},{y:.4f}" for x, y in contour.section_mm[first : first + _AT_ONCE]]
        lines.append(f'<path d="M{" L".join(points)}" fill="none" stroke="black" stroke-width="{width_mm / 500:.4f}"/>')
    yield from part_of_work(_write_in_steps(path, [*lines, "</svg>"]), _PUT, 1.0)


def save_csv(path: Path, contours: Sequence[Contour], thickness: Sequence[np.ndarray] | None = None) -> None:
    """Writes one row a point: contour, place on the section and in the model's frame, mm; area and length.

    Args:
        thickness: for each contour (n,) mm, written as a last column; empty where it is not a number.
    """
    run_through(save_csv_in_steps(path, contours, thickness))


def save_csv_in_steps(
    path: Path, contours: Sequence[Contour], thickness: Sequence[np.ndarray] | None = None
) -> Generator[float, None, None]:
    """As `save_csv`, with breaks that tell the share that is done; closed before its end the file is as it was."""
    head = "contour,section_x_mm,section_y_mm,x_mm,y_mm,z_mm,area_mm2,length_mm"
    lines = [head if thickness is None else f"{head},thickness_mm"]
    for index, (contour, share) in enumerate(_parted(contours)):
        last = [""] * len(contour.section_mm) if thickness is None else list(map(_column, thickness[index]))
        rows = list(zip(contour.section_mm, contour.model_mm, last, strict=True))
        size = f"{contour.area_mm2:.5f},{contour.length_mm:.5f}"
        for first in range(0, len(rows), _AT_ONCE):
            yield _PUT * share(first)
            lines += [
                f"{index},{a:.5f},{b:.5f},{x:.5f},{y:.5f},{z:.5f},{size}{more}"
                for (a, b), (x, y, z), more in rows[first : first + _AT_ONCE]
            ]
    yield from part_of_work(_write_in_steps(path, lines), _PUT, 1.0)


def _parted(contours: Sequence[Contour]) -> Iterator[tuple[Contour, Callable[[int], float]]]:
    """Each contour with what tells, from its point on, the share of all points that is done."""
    ends = np.cumsum([0, *(len(contour.section_mm) for contour in contours)])
    for contour, done in zip(contours, ends[:-1], strict=True):
        yield contour, lambda point, done=done: float(done + point) / max(int(ends[-1]), 1)


def _write_in_steps(path: Path, lines: Sequence[str]) -> Generator[float, None, None]:
    with atomic_write(Path(path), "w") as stream:
        stream.write("\n".join([*lines, ""]))
        yield from synced_in_steps(stream)


def _column(value: float) -> str:
    return f",{value:.5f}" if np.isfinite(value) else ","


def curve_in_steps(
    contours: Sequence[Contour], model_uid: int, context: bpy.types.Context
) -> Generator[float, None, bpy.types.Object]:
    """Makes a curve object that follows a model, one poly spline a contour; with breaks that tell the share done.

    Closed before its end it changes nothing.

    Args:
        model_uid: the model's `session_uid`; an undo in a break leaves no other reference to it.

    Raises:
        ReferenceError: an undo, or a purge, in a break has taken away the model or the curve.
    """
    curve = bpy.data.curves.new(NAME, "CURVE")
    try:
        curve.dimensions = "3D"
        for contour, share in _parted(contours):
            yield share(0)
            closed = contour.area_mm2 > 0
            points = contour.model_mm[: -1 if closed else None]
            spline = curve.splines.new("POLY")
            spline.points.add(len(points) - 1)
            spline.use_cyclic_u = closed
            spline.points.foreach_set("co", np.column_stack([points, np.ones(len(points))]).ravel())
        model = next((thing for thing in bpy.data.objects if thing.session_uid == model_uid), None)
        if model is None:
            raise ReferenceError("the model that the contours are of is gone")
    except BaseException:
        with suppress(ReferenceError):
            bpy.data.curves.remove(curve)
        raise
    drawn = bpy.data.objects.new(NAME, curve)
    open_collection(context).objects.link(drawn)
    drawn.parent = model
    return drawn
