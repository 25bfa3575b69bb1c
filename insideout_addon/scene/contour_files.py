"""Contours in millimetres as SVG, CSV or a curve object."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import bpy
import numpy as np

from ...core.files import atomic_write
from .section_image import Contour

NAME = "InsideOut Contours"


def save_svg(path: Path, contours: Sequence[Contour], width_mm: float, height_mm: float) -> None:
    """Writes closed and open lines as an SVG drawing of real size: one user unit is one millimetre."""
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width_mm:.4f}mm" height="{height_mm:.4f}mm" '
        f'viewBox="0 0 {width_mm:.4f} {height_mm:.4f}">'
    ]
    for contour in contours:
        path_data = "M" + " L".join(f"{x:.4f},{y:.4f}" for x, y in contour.section_mm)
        lines.append(f'<path d="{path_data}" fill="none" stroke="black" stroke-width="{width_mm / 500:.4f}"/>')
    with atomic_write(Path(path), "w") as stream:
        stream.write("\n".join([*lines, "</svg>", ""]))


def save_csv(path: Path, contours: Sequence[Contour], thickness: Sequence[np.ndarray] | None = None) -> None:
    """Writes one row a point: contour, place on the section and in the model's frame, mm; area and length.

    Args:
        thickness: for each contour (n,) mm, written as a last column; empty where it is not a number.
    """
    with atomic_write(Path(path), "w") as stream:
        stream.write("contour,section_x_mm,section_y_mm,x_mm,y_mm,z_mm,area_mm2,length_mm")
        stream.write("\n" if thickness is None else ",thickness_mm\n")
        for index, contour in enumerate(contours):
            last = [""] * len(contour.section_mm) if thickness is None else map(_column, thickness[index])
            for (a, b), (x, y, z), more in zip(contour.section_mm, contour.model_mm, last, strict=True):
                stream.write(
                    f"{index},{a:.5f},{b:.5f},{x:.5f},{y:.5f},{z:.5f},"
                    f"{contour.area_mm2:.5f},{contour.length_mm:.5f}{more}\n"
                )


def _column(value: float) -> str:
    return f",{value:.5f}" if np.isfinite(value) else ","


def create_curve(contours: Sequence[Contour], model: bpy.types.Object, context: bpy.types.Context) -> bpy.types.Object:
    """A curve object that follows the model, one poly spline a contour."""
    curve = bpy.data.curves.new(NAME, "CURVE")
    curve.dimensions = "3D"
    for contour in contours:
        points = contour.model_mm
        closed = contour.area_mm2 > 0
        if closed:
            points = points[:-1]
        spline = curve.splines.new("POLY")
        spline.points.add(len(points) - 1)
        spline.use_cyclic_u = closed
        for target, (x, y, z) in zip(spline.points, points, strict=True):
            target.co = (x, y, z, 1.0)
    drawn = bpy.data.objects.new(NAME, curve)
    context.collection.objects.link(drawn)
    drawn.parent = model
    return drawn
