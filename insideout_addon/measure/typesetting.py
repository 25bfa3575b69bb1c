"""Lettering by Blender's own font, as outlines: it has all letters and units, and needs no window."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import bpy
import numpy as np

from .page import Outline

# Straight pieces in each curve of a letter: a thousandth of the size from the true outline.
_RESOLUTION = 4


@contextmanager
def typesetter() -> Iterator[Callable[[str], Outline]]:
    """What makes outlines of texts while the block lasts; nothing of it stays in the file."""
    curve = bpy.data.curves.new("InsideOut Lettering", "FONT")
    curve.resolution_u = _RESOLUTION
    writer = bpy.data.objects.new("InsideOut Lettering", curve)
    known: dict[str, Outline] = {}

    def letter(text: str) -> Outline:
        if text not in known:
            curve.body = text
            known[text] = _outline(writer)
        return known[text]

    try:
        yield letter
    finally:
        bpy.data.objects.remove(writer)
        bpy.data.curves.remove(curve)


def _outline(writer: bpy.types.Object) -> Outline:
    mesh = writer.to_mesh()
    try:
        points = np.empty(3 * len(mesh.vertices), np.float32)
        mesh.vertices.foreach_get("co", points)
        starts, ends = _rim(mesh)
    finally:
        writer.to_mesh_clear()
    places = points.reshape(-1, 3)[:, :2].astype(np.float64) * (1, -1)
    loops = [places[loop] for loop in _loops(starts, ends)]
    if not loops:
        return Outline([], 0.0)
    left = min(float(loop[:, 0].min()) for loop in loops)
    right = max(float(loop[:, 0].max()) for loop in loops)
    return Outline([loop - (left, 0) for loop in loops], right - left)


def _rim(mesh: bpy.types.Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Edges that only one face has, as that face goes round: first and second vertex of each."""
    corners = np.empty(len(mesh.loops), np.int32)
    mesh.loops.foreach_get("vertex_index", corners)
    first, count = (np.empty(len(mesh.polygons), np.int32) for _ in range(2))
    mesh.polygons.foreach_get("loop_start", first)
    mesh.polygons.foreach_get("loop_total", count)
    following = np.arange(1, len(corners) + 1)
    following[first + count - 1] = first
    starts, ends = corners.astype(np.int64), corners[following].astype(np.int64)
    there, back = starts * len(mesh.vertices) + ends, ends * len(mesh.vertices) + starts
    rim = ~np.isin(there, back)
    return starts[rim], ends[rim]


def _loops(starts: np.ndarray, ends: np.ndarray) -> list[list[int]]:
    following: dict[int, list[int]] = {}
    for start, end in zip(starts.tolist(), ends.tolist(), strict=True):
        following.setdefault(start, []).append(end)
    loops = []
    while following:
        place = first = next(iter(following))
        loop = []
        while place in following:
            loop.append(place)
            ways = following[place]
            place = ways.pop()
            if not ways:
                del following[loop[-1]]
            if place == first:
                break
        loops.append(loop)
    return loops
