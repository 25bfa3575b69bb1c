"""Blender's own Apply on the plane or the box of a section: the cut stays where it was, as the object is put back.

A cut has its place from its object alone. Apply takes it from there, into the corners of the mesh or the size at which
an empty is drawn, so that the cut would jump, and a box lose its shape.
"""

from __future__ import annotations

from dataclasses import dataclass

import bpy
import numpy as np
from mathutils import Matrix

from .standing import place_in_world

# On each plane and box: `_Standing` when it was last looked at. With the object it goes through undo.
_KEPT_KEY = "insideout_standing"
# Parts of the farthest coordinate, or of a scale, that are rounding.
_ROUNDING = 1e-5


@dataclass(frozen=True, eq=False)
class _Standing:
    """How an object stands.

    Attributes:
        basis: (4, 4) float64 of its own, without its parent's.
        form: what Apply changes beside that: (3n,) corners of a plane's mesh, or (1,) the size of an empty.
    """

    basis: np.ndarray
    form: np.ndarray

    @property
    def numbers(self) -> list[float]:
        return [*self.basis.ravel().tolist(), *self.form.tolist()]

    @property
    def scales(self) -> np.ndarray:
        return np.linalg.norm(self.basis[:3, :3], axis=0)

    @property
    def places(self) -> np.ndarray:
        """(n, 3) the corners beside its parent."""
        return self.form.reshape(-1, 3) @ self.basis[:3, :3].T + self.basis[:3, 3]


def take_back_apply(section: bpy.types.PropertyGroup) -> None:
    """Puts the object of a section back if Apply, or another Origin, has changed it since the last call.

    Of a box the turn alone leaves no trace when it is applied.
    """
    thing = section.object
    if thing is None or not thing.is_editable or thing.mode != "OBJECT":
        return
    now = _standing(thing, section.shape)
    if now is None:
        return
    kept = np.array(thing.get(_KEPT_KEY, ()), np.float64)
    before = _Standing(kept[:16].reshape(4, 4), kept[16:]) if len(kept) == 16 + len(now.form) else None
    if before is not None and (_box_is_applied if section.shape == "BOX" else _plane_is_applied)(before, now):
        _put_back(thing, before, now)
    elif now.numbers != kept.tolist():
        thing[_KEPT_KEY] = now.numbers


def _standing(thing: bpy.types.Object, shape: str) -> _Standing | None:
    """None where the object is of another type than it was made with."""
    basis = np.array(thing.matrix_basis, np.float64)
    if shape == "BOX":
        return _Standing(basis, np.array([thing.empty_display_size])) if thing.type == "EMPTY" else None
    if thing.type != "MESH" or not thing.data.is_editable:
        return None
    corners = np.empty(3 * len(thing.data.vertices), np.float32)
    thing.data.vertices.foreach_get("co", corners)
    return _Standing(basis, corners.astype(np.float64))


def _plane_is_applied(before: _Standing, now: _Standing) -> bool:
    """Whether the corners are other ones, but still in their places."""
    if np.array_equal(before.form, now.form) or not len(now.form):
        return False
    return np.allclose(before.places, now.places, rtol=0.0, atol=_ROUNDING * np.abs(before.places).max())


def _box_is_applied(before: _Standing, now: _Standing) -> bool:
    """Whether the longest of the scales has become the empty's size: Blender forgets the other two."""
    larger = not np.isclose(now.form, before.form, rtol=_ROUNDING).all()
    applied = np.isclose(now.form, before.form * before.scales.max(), rtol=_ROUNDING).all()
    return bool(larger and applied and np.allclose(now.scales, 1.0, rtol=_ROUNDING))


def _put_back(thing: bpy.types.Object, before: _Standing, now: _Standing) -> None:
    if thing.type == "MESH":
        thing.data.vertices.foreach_set("co", before.form.astype(np.float32))
        thing.data.update()
    else:
        thing.empty_display_size = before.form[0]
    basis = Matrix(before.basis.tolist())
    # The place in the world at once, where Blender keeps it up only with its next update; then without rounding.
    thing.matrix_world = place_in_world(thing) @ Matrix(now.basis.tolist()).inverted_safe() @ basis
    thing.matrix_basis = basis
