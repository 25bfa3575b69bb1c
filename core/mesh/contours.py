"""Contours of a section in millimetres."""

from __future__ import annotations

import numpy as np

from ..views import Plane
from ..volume import Volume


def contours(source: Volume | np.ndarray, plane: Plane, level: float, shortest_mm: float = 0.0) -> list[np.ndarray]:
    """Lines on a plane where a section passes a level, by marching squares.

    Args:
        source: a volume to cut, or the section itself, (height, width).
        plane: where the section lies.
        level: in the section's unit (mm⁻¹ for attenuation).
        shortest_mm: shorter lines are left out.

    Returns:
        Polylines (M, 3) in mm in the world frame, longest first; closed ones end where they begin. Material that
        runs out of the image is closed along its border.
    """
    from skimage.measure import find_contours

    image = source.section(plane) if isinstance(source, Volume) else np.asarray(source)
    if image.shape != (plane.height, plane.width):
        raise ValueError(f"the section is {image.shape}, the plane {(plane.height, plane.width)} pixels")
    # The frame mirrors the border's value at the level, which puts the closing line on the image's edge.
    framed = np.pad(image.astype(np.float64), 1, mode="edge")
    border = np.ones_like(framed, bool)
    border[1:-1, 1:-1] = False
    framed[border] = np.minimum(framed[border], 2 * level - framed[border])
    lines = []
    for line in find_contours(framed, level):
        rows, columns = line[:, 0] - 0.5, line[:, 1] - 0.5
        points = (
            np.asarray(plane.origin, np.float64)
            + columns[:, None] * np.asarray(plane.u, np.float64)
            + rows[:, None] * np.asarray(plane.v, np.float64)
        )
        lines.append((float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum()), points))
    lines.sort(key=lambda entry: -entry[0])
    return [points for length, points in lines if length >= shortest_mm and len(points) > 1]
