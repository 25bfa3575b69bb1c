"""Triangles between numpy and Blender: corners carry the colour, faces the wall that they lie on."""

from __future__ import annotations

from dataclasses import dataclass, replace

import bpy
import numpy as np

COLOR = "Color"
WALL = "insideout_wall"
OUTSIDE = -1


@dataclass(frozen=True, eq=False)
class Surface:
    """V vertices and F triangles.

    Attributes:
        vertices: (V, 3) float64, mm in the model's frame.
        faces: (F, 3) int64, counter-clockwise from outside.
        colors: (F, 3, 3) sRGB in 0..1 of each triangle's corners.
        wall: (F,) int64 number of the wall that a broken face lies on, OUTSIDE for the model's own surfaces.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray
    wall: np.ndarray

    def select(self, which: np.ndarray) -> Surface:
        """The triangles that a mask picks, with their vertices alone."""
        used, faces = np.unique(self.faces[which], return_inverse=True)
        return Surface(self.vertices[used], faces.reshape(-1, 3), self.colors[which], self.wall[which])

    def placed(self, origin: np.ndarray, linear: np.ndarray) -> Surface:
        """Seen from an origin (3,), and stretched from there by a map (3, 3); outside stays outside in a mirror."""
        vertices = (self.vertices - origin) @ linear.T
        if np.linalg.det(linear) > 0:
            return replace(self, vertices=vertices)
        return replace(self, vertices=vertices, faces=self.faces[:, ::-1], colors=self.colors[:, ::-1])


def new_mesh(name: str, surface: Surface, materials: tuple[bpy.types.Material, ...] = ()) -> bpy.types.Mesh:
    """A mesh of a surface: outside smooth with the first material, broken faces flat with the second."""
    mesh = bpy.data.meshes.new(name)
    count = len(surface.faces)
    mesh.vertices.add(len(surface.vertices))
    mesh.vertices.foreach_set("co", surface.vertices.astype(np.float32).ravel())
    mesh.loops.add(3 * count)
    mesh.loops.foreach_set("vertex_index", surface.faces.astype(np.int32).ravel())
    mesh.polygons.add(count)
    mesh.polygons.foreach_set("loop_start", np.arange(0, 3 * count, 3, dtype=np.int32))
    for material in materials:
        mesh.materials.append(material)
    broken = surface.wall != OUTSIDE
    mesh.polygons.foreach_set("use_smooth", ~broken)
    mesh.update(calc_edges=True)
    if materials:
        mesh.polygons.foreach_set("material_index", broken.astype(np.int32))
    mesh.attributes.new(WALL, "INT", "FACE").data.foreach_set("value", surface.wall.astype(np.int32))
    colors = np.ones((3 * count, 4), np.float32)
    colors[:, :3] = surface.colors.reshape(-1, 3)
    mesh.attributes.new(COLOR, "BYTE_COLOR", "CORNER").data.foreach_set("color_srgb", colors.ravel())
    mesh.color_attributes.active_color_name = COLOR
    return mesh


def read_mesh(mesh: bpy.types.Mesh) -> Surface:
    """The triangles of a mesh that has the attributes of `new_mesh`; polygons are divided."""
    vertices = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", vertices)
    mesh.calc_loop_triangles()
    count = len(mesh.loop_triangles)
    loops, polygons = np.empty(3 * count, np.int32), np.empty(count, np.int32)
    mesh.loop_triangles.foreach_get("loops", loops)
    mesh.loop_triangles.foreach_get("polygon_index", polygons)
    corners = np.empty(len(mesh.loops), np.int32)
    mesh.loops.foreach_get("vertex_index", corners)
    colors = np.empty(4 * len(mesh.loops), np.float32)
    mesh.attributes[COLOR].data.foreach_get("color_srgb", colors)
    wall = np.empty(len(mesh.polygons), np.int32)
    mesh.attributes[WALL].data.foreach_get("value", wall)
    surface = Surface(
        vertices.reshape(-1, 3).astype(np.float64),
        corners[loops].reshape(-1, 3).astype(np.int64),
        colors.reshape(-1, 4)[loops, :3].reshape(-1, 3, 3).astype(np.float64),
        wall[polygons].astype(np.int64),
    )
    return _divided_otherwise(surface, mesh, polygons, colors.reshape(-1, 4)[:, :3])


def _divided_otherwise(surface: Surface, mesh: bpy.types.Mesh, polygons: np.ndarray, colors: np.ndarray) -> Surface:
    """Polygons that were divided along an edge which is there already are divided from their middle instead.

    Such an edge would have four triangles, and the surface would not be closed any more.
    """
    start, end = surface.faces, surface.faces[:, [1, 2, 0]]
    _, number, uses = np.unique(start * len(surface.vertices) + end, return_inverse=True, return_counts=True)
    wrong = np.unique(polygons[(uses[number].reshape(-1, 3) > 1).any(axis=1)])
    wrong = [int(index) for index in wrong if mesh.polygons[index].loop_total > 3]
    if not wrong:
        return surface
    kept = ~np.isin(polygons, wrong)
    vertices, faces, hues, walls = (
        [surface.vertices],
        [surface.faces[kept]],
        [surface.colors[kept]],
        [surface.wall[kept]],
    )
    for added, index in enumerate(wrong):
        polygon = mesh.polygons[index]
        rim, own = np.array(polygon.vertices, np.int64), colors[list(polygon.loop_indices)].astype(np.float64)
        vertices.append(surface.vertices[rim].mean(axis=0, keepdims=True))
        middle = np.full(len(rim), len(surface.vertices) + added)
        faces.append(np.stack([rim, np.roll(rim, -1), middle], axis=1))
        hues.append(np.stack([own, np.roll(own, -1, axis=0), np.broadcast_to(own.mean(axis=0), own.shape)], axis=1))
        walls.append(np.full(len(rim), surface.wall[np.argmax(polygons == index)]))
    return Surface(np.concatenate(vertices), np.concatenate(faces), np.concatenate(hues), np.concatenate(walls))
