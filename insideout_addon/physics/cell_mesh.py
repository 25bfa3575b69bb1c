"""A convex cell as a mesh whose walls are fine enough for the colours of the inside."""

from __future__ import annotations

import numpy as np
from mathutils import Vector
from mathutils.geometry import delaunay_2d_cdt

from .cells import Cell
from .meshes import OUTSIDE, Surface

# Points of the grid keep this share of its spacing away from the wall's edges.
_FROM_EDGE = 0.4
_INSIDE = 1


def cell_surface(cell: Cell, spacing_mm: float, wall_numbers: dict[int, int]) -> Surface:
    """The closed surface of a cell: its walls as triangles of about `spacing_mm`, the box's faces as large ones.

    Args:
        wall_numbers: of each face of the cell with a wall, by its index, the number that its triangles carry.
    """
    vertices = list(cell.vertices)
    fine = [set(zip(loop, loop[1:] + loop[:1], strict=True)) for loop in cell.loops]
    on_wall = {frozenset(edge) for face in wall_numbers for edge in fine[face]}
    along: dict[tuple[int, int], list[int]] = {}
    for edge in {tuple(sorted(edge)) for edges in fine for edge in edges}:
        a, b = cell.vertices[edge[0]], cell.vertices[edge[1]]
        steps = max(1, round(float(np.linalg.norm(b - a)) / spacing_mm)) if frozenset(edge) in on_wall else 1
        between = [a + (b - a) * k / steps for k in range(1, steps)]
        along[edge] = list(range(len(vertices), len(vertices) + len(between)))
        vertices += between
    faces, walls = [], []
    for index, loop in enumerate(cell.loops):
        rim: list[int] = []
        for a, b in zip(loop, loop[1:] + loop[:1], strict=True):
            rim += [a, *(along[a, b] if a < b else along[b, a][::-1])]
        number = wall_numbers.get(index, OUTSIDE)
        triangles, inner = _divided(np.array([vertices[k] for k in rim]), spacing_mm if number != OUTSIDE else None)
        place = np.array([*rim, *range(len(vertices), len(vertices) + len(inner))])
        vertices += list(inner)
        faces.append(place[triangles])
        walls.append(np.full(len(triangles), number))
    triangles = np.concatenate(faces)
    return Surface(np.array(vertices), triangles, np.zeros((len(triangles), 3, 3)), np.concatenate(walls))


def _divided(rim: np.ndarray, spacing: float | None) -> tuple[np.ndarray, np.ndarray]:
    """Triangles (T, 3) of a convex polygon (R, 3), and the points (I, 3) within it that they use after its rim's."""
    middle = rim.mean(axis=0)
    first = rim[1] - rim[0]
    first = first / np.linalg.norm(first)
    # Newell's normal: right for rims with many points on a line.
    normal = np.cross(rim - middle, np.roll(rim, -1, axis=0) - middle).sum(axis=0)
    second = np.cross(normal / np.linalg.norm(normal), first)
    flat = np.stack([(rim - middle) @ first, (rim - middle) @ second], axis=1)
    inner = np.zeros((0, 2)) if spacing is None else _grid_within(flat, spacing)
    points = [Vector(point) for point in np.concatenate([flat, inner])]
    *_, triangles, origins, _, _ = delaunay_2d_cdt(points, [], [list(range(len(rim)))], _INSIDE, 0.0)
    # Points that fall together in single precision are one; none is new, as no edges cross.
    number = np.array([origin[0] for origin in origins])
    return number[np.array(triangles)], middle + inner @ np.stack([first, second])


def _grid_within(rim: np.ndarray, spacing: float) -> np.ndarray:
    """Points of a square grid in a convex polygon (R, 2), counter-clockwise, away from its edges."""
    low, high = rim.min(axis=0), rim.max(axis=0)
    axes = [np.arange(low[k] + spacing / 2, high[k], spacing) for k in range(2)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    inside = np.ones(len(points), bool)
    for a, b in zip(rim, np.roll(rim, -1, axis=0), strict=True):
        along = (b - a) / np.linalg.norm(b - a)
        inside &= (points - a) @ np.array([-along[1], along[0]]) > _FROM_EDGE * spacing
    return points[inside]
