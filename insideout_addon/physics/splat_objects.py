"""Each piece's own splats as a point cloud that follows it."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from contextlib import suppress
from dataclasses import replace

import bpy
import numpy as np
from mathutils import Matrix

from ...core.gaussians import GaussianSet, Modality
from ..scene.cut_slots import HEIGHTS, NORMALS, SLOTS
from ..scene.display import display_modifier, show_splats
from ..scene.importing import TOLD_KEY, WARNINGS_KEY
from ..scene.node_tree import modifier_input, set_modifier_input
from ..scene.placement import share_placement
from ..scene.splats import SURROUNDINGS, UNIT_KEY, WATER_KEY, create_splats
from ..scene.standing import place_in_world
from .cells import Cell
from .pieces import Piece, owners
from .splat_cuts import CellSplats, splats_of_cell

# On the splats of a piece: the model. They outlive a piece that is deleted by hand.
PIECE_SPLATS_KEY = "insideout_piece_splats_of"
# What the import knew of a model's lengths and densities, which are those of its pieces, too.
_FACTS = (UNIT_KEY, WARNINGS_KEY, TOLD_KEY, WATER_KEY)
# Inputs of the display that the pieces' splats take over from the model's; sections are not among them.
_TAKEN = (
    *("Size", "Soft", "Soft in Viewport", "Minimum Opacity", "Minimum Density", "Detail"),
    *("Mixed", "Large From", "Near Cuts", "Camera"),
)


def share_in_steps(
    pieces: Sequence[Piece],
    cells: Sequence[Cell],
    cell_of_splat: np.ndarray,
    gaussians: GaussianSet,
    shown: np.ndarray,
) -> Generator[float, None, list[CellSplats]]:
    """Of each piece the splats seen in it: its own, and what reaches into it from across a wall.

    Yields the share that is done.

    Args:
        cell_of_splat: (N,) number of the cell that each centre is in.
        shown: (N,) bool; splats that are not are in one piece alone.
    """
    covariances = gaussians.covariances()
    owner = np.zeros(len(gaussians), np.int64)
    for index, piece in enumerate(pieces):
        owner[piece.splats] = index
    parts: list[list[CellSplats]] = [[] for _ in pieces]
    for number, cell in enumerate(cells):
        yield number / len(cells)
        seen = splats_of_cell(cell, number, cell_of_splat, gaussians, covariances)
        seen = _rows(seen, seen.own | shown[seen.index])
        into = owners(pieces, gaussians.means[seen.index], np.full(len(seen.index), number))
        into[seen.own] = owner[seen.index[seen.own]]
        for index in np.unique(into):
            parts[index].append(_rows(seen, into == index))
    return [_together(part) for part in parts]


def create_piece_splats(
    piece: bpy.types.Object,
    center_mm: np.ndarray,
    seen: CellSplats,
    model: bpy.types.Object,
    gaussians: GaussianSet,
    surroundings: np.ndarray,
    context: bpy.types.Context,
) -> bpy.types.Object:
    """A point cloud in the model's frame that is parented to a piece; splats from beyond a wall are clones, so that
    densities and masses count once.

    Args:
        center_mm: (3,) where the piece's origin is in the model's frame.
        surroundings: (N,) density around the model's splats.
    """
    part = gaussians.select(seen.index)
    part = replace(part, modality=np.where(seen.own, part.modality, np.uint8(Modality.CLONE)).astype(np.uint8))
    cloud = create_splats(part, f"{piece.name} Splats", context, surroundings=surroundings[seen.index])
    for slot, (normal, height) in enumerate(zip(NORMALS, HEIGHTS, strict=True)):
        if not seen.normals[:, slot].any():
            continue
        layer = cloud.data.attributes.new(normal, "FLOAT_VECTOR", "POINT")
        layer.data.foreach_set("vector", np.ascontiguousarray(seen.normals[:, slot], np.float32).ravel())
        layer = cloud.data.attributes.new(height, "FLOAT", "POINT")
        layer.data.foreach_set("value", np.ascontiguousarray(seen.heights[:, slot], np.float32))
    share_placement(cloud, model)
    for key in _FACTS:
        if key in model:
            cloud[key] = model[key]
    cloud[PIECE_SPLATS_KEY] = model
    cloud.parent = piece
    local = stretch_of(place_in_world(model)).to_4x4() @ Matrix.Translation(-np.asarray(center_mm))
    cloud.matrix_local = local
    # The shear, which an object has not of its own.
    cloud.matrix_parent_inverse = local @ cloud.matrix_basis.inverted_safe()
    _take_over_display(cloud, model)
    return cloud


def stretch_of(matrix: Matrix) -> Matrix:
    """(3, 3) what a model's place in the world (4, 4) does to a piece, which is turned as the model is: it is scaled,
    and sheared where a parent does that."""
    return matrix.to_quaternion().to_matrix().transposed() @ matrix.to_3x3()


def model_surroundings(model: bpy.types.Object) -> np.ndarray:
    """(N,) `surrounding_density` as the import kept it on a model."""
    values = np.empty(len(model.data.points), np.float32)
    model.data.attributes[SURROUNDINGS].data.foreach_get("value", values)
    return values


def _take_over_display(cloud: bpy.types.Object, model: bpy.types.Object) -> None:
    source = display_modifier(model)
    if source is None:
        return
    modifier = show_splats(cloud, bool(modifier_input(source, "Ellipsoids")))
    for name in _TAKEN:
        # A display of an older version may have other inputs.
        with suppress(KeyError):
            set_modifier_input(modifier, name, modifier_input(source, name))
    with suppress(KeyError):
        # All pieces together as many as the model.
        share = len(cloud.data.points) / max(len(model.data.points), 1)
        most = round(share * modifier_input(source, "Ellipsoids at Most"))
        set_modifier_input(modifier, "Ellipsoids at Most", max(most, 1))
    set_modifier_input(modifier, "Cut", any(name in cloud.data.attributes for name in HEIGHTS))


def _rows(seen: CellSplats, which: np.ndarray) -> CellSplats:
    return CellSplats(seen.index[which], seen.own[which], seen.normals[which], seen.heights[which])


def _together(parts: Sequence[CellSplats]) -> CellSplats:
    if not parts:
        # A piece of the mesh where the model has lost its splats.
        return CellSplats(np.zeros(0, np.int64), np.zeros(0, bool), np.zeros((0, SLOTS, 3)), np.zeros((0, SLOTS)))
    fields = ("index", "own", "normals", "heights")
    return CellSplats(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in fields})
