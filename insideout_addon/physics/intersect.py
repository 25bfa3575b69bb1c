"""What two closed meshes have in common, by Blender's own exact booleans.

The solver is the library manifold, which Blender has had since 4.5. It wants oriented 2-manifolds, and some
distributions build Blender without it; then there is Blender's EXACT solver, which takes three times as long, and goes
wrong where surfaces cross, as those of a volume at times do.
"""

from __future__ import annotations

from functools import cache

import bpy
import numpy as np
from bpy.app.translations import pgettext_n as n_

from ...core.errors import MeshFileError
from ...core.mesh.solids import is_closed, volume_and_centroid
from .cell_mesh import cell_surface
from .cells import box_cell
from .meshes import Surface, new_mesh, read_mesh

NO_MANIFOLD = n_(
    "this Blender was built without the library manifold, and its other solver cannot break the model's mesh; use a "
    "Blender from blender.org."
)


class Intersection:
    """Intersects one mesh with others; use it in a `with` block, at whose end its meshes are gone.

    Each cut happens in a scene of its own, so that the user's is not evaluated again. It is there for that cut alone:
    between cuts Blender may draw its menu of scenes, or save the file.

    Args:
        surface: what all others are intersected with.
        solver: Blender's; chosen if None.
    """

    def __init__(self, surface: Surface, solver: str | None = None) -> None:
        self._surface = surface
        self._solver = solver or ("MANIFOLD" if is_closed(surface.faces) and has_manifold() else "EXACT")

    def __enter__(self) -> Intersection:
        self._whole, self._other = (
            bpy.data.objects.new("InsideOut Break", new_mesh("InsideOut Break", part))
            for part in (self._surface, self._surface.select(np.zeros(len(self._surface.faces), bool)))
        )
        modifier = self._whole.modifiers.new("Cell", "BOOLEAN")
        modifier.operation, modifier.object, modifier.solver = "INTERSECT", self._other, self._solver
        return self

    def __exit__(self, *_: object) -> None:
        data = [self._whole.data, self._other.data]
        for thing in (self._whole, self._other):
            bpy.data.objects.remove(thing)
        for mesh in data:
            bpy.data.meshes.remove(mesh)

    def with_(self, cell: Surface) -> Surface:
        """What lies in a closed cell; faces from the cell's walls carry their numbers.

        Raises:
            MeshFileError: the result is not closed, because the mesh is not.
        """
        old, self._other.data = self._other.data, new_mesh("InsideOut Break", cell)
        bpy.data.meshes.remove(old)
        scene = bpy.data.scenes.new("InsideOut Break")
        try:
            for thing in (self._whole, self._other):
                scene.collection.objects.link(thing)
            layer = scene.view_layers[0]
            layer.update()
            evaluated = self._whole.evaluated_get(layer.depsgraph)
            found = read_mesh(evaluated.to_mesh())
            evaluated.to_mesh_clear()
        finally:
            bpy.data.scenes.remove(scene)
        if len(found.faces) and not is_closed(found.faces):
            raise self.failed()
        return found

    def failed(self) -> MeshFileError:
        """That parts are not closed, or do not add up to the whole, and what to do."""
        if is_closed(self._surface.faces) and self._solver == "EXACT":
            return MeshFileError(NO_MANIFOLD)
        return MeshFileError(
            "the model's mesh has holes or surfaces that cross, so it cannot be broken into closed pieces; "
            "reconstruct it again, or repair the mesh."
        )


@cache
def has_manifold() -> bool:
    """Whether this Blender was built with manifold; without, its modifier leaves meshes as they are."""
    first, second = (cell_surface(box_cell(np.array([[low] * 3, [low + 2.0] * 3])), 1.0, {}) for low in (0.0, 1.0))
    with Intersection(first, "MANIFOLD") as trial:
        common = trial.with_(second)
    return abs(volume_and_centroid(common.vertices, common.faces)[0] - 1.0) < 1e-3
