"""Breaks a model into rigid bodies, and makes it whole again."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import bpy
import numpy as np
from bpy.app.translations import pgettext_rpt as rpt_
from mathutils import Vector

from ...core.errors import MeshFileError, SettingError
from ...core.gaussians import GaussianSet, Modality
from ...core.mesh.glb_reader import TriangleMesh
from ...core.steps import part_of_work, run_through
from ..error_text import error_text
from ..measure.marks import marks_on
from ..scene.display import display_modifier
from ..scene.hidden_for_now import hide_for_now, show_as_before
from ..scene.linking import open_collection
from ..scene.node_tree import modifier_input
from ..scene.section import shown_planes
from ..scene.section_picture import hide_with_model
from ..scene.splats import read_splats, require_own
from ..scene.standing import place_in_world
from ..scene.weighing import MASS_KEY
from .appearance import piece_materials, remove_unused_materials
from .cells import Cell, Wall, cells_between, choose_seeds, nearest_cell, voronoi_cells
from .hulls import hulls_are_apart
from .inside_color import color_in_steps
from .intersect import NO_MANIFOLD, has_manifold
from .masses import G_CM3_PER_MM_INV
from .meshes import OUTSIDE, Surface, new_mesh
from .pieces import Piece, cut_in_steps, fill_in_steps
from .soft import release_soft, remove_unused_groups
from .splat_objects import PIECE_SPLATS_KEY, create_piece_splats, model_surroundings, share_in_steps, stretch_of
from .whole import masses_in_steps, mesh_path, read_model_mesh, release_whole, require_size, require_whole
from .world import (
    BODY_KEY,
    PIECE_KEY,
    add_floor,
    bodies_of,
    free_copies,
    give_gravity_back,
    leave_floor,
    let_pass,
    make_body,
    release,
)

VOLUME_KEY = "insideout_volume_mm3"
_GREY = 0.75
# Of the model's size: how far its box goes beyond it, how fine broken faces are.
_AROUND, _FINE = 0.02, 80
# Between hulls that do not touch, share of the model's size.
_GAP = 1e-3
# Shares of the work that are done when masses are known, cells cut, pieces filled, coloured, and made.
_WEIGHED, _CUT, _FILLED, _COLORED, _SHARED, _MADE = 0.05, 0.6, 0.65, 0.7, 0.75, 0.95


@dataclass(frozen=True)
class BreakOptions:
    """How to break.

    Attributes:
        pieces: cells around seeds; each may hold several solids.
        seed: of the random places; the same gives the same pieces.
        impact_mm: (3,) in the model's frame, where pieces are smaller; None for nowhere.
        along_planes: break along the scene's section planes instead.
        g_cm3_per_mm_inv: g/cm³ per mm⁻¹; what the model was weighed to be goes before.
        spacing_mm: between vertices on broken faces; 0 for an 80th of the model's size.
        window: mm⁻¹, shown darkest and brightest on broken faces; None for automatic.
        show: "MESH" or "SPLATS".
        floor: add one, `drop_mm` below the model, if the scene has none.
        mesh: another .glb than the run's.
    """

    pieces: int = 12
    seed: int = 0
    impact_mm: tuple[float, float, float] | None = None
    along_planes: bool = False
    g_cm3_per_mm_inv: float = G_CM3_PER_MM_INV
    spacing_mm: float = 0.0
    window: tuple[float, float] | None = None
    show: str = "MESH"
    floor: bool = True
    drop_mm: float = 50.0
    mesh: Path | None = None


def break_model(
    model: bpy.types.Object,
    context: bpy.types.Context,
    options: BreakOptions,
    tick: Callable[[float], None] | None = None,
) -> list[bpy.types.Object]:
    """Closed pieces in a collection of their own, each an active rigid body with its mass; the model is hidden.

    Args:
        tick: called with the share that is done; may raise to stop, and nothing is changed then.

    Raises:
        MeshFileError: the model has no mesh, or none that is closed.
        SettingError: the options do not fit the model, which is of another file, is broken already, or has no size.
    """
    return run_through(break_in_steps(model, context, options), tick)


def break_in_steps(
    model: bpy.types.Object, context: bpy.types.Context, options: BreakOptions
) -> Generator[float, None, list[bpy.types.Object]]:
    """As `break_model`, with breaks that tell the share that is done; closed before its end it changes nothing."""
    scene = context.scene
    require_own(model)
    require_whole(model, scene)
    require_size(model)
    whole, gaussians = _surface(read_model_mesh(model, options.mesh)), read_splats(model)
    low, high = whole.vertices.min(axis=0), whole.vertices.max(axis=0)
    size = float((high - low).max())
    cells = _cells(model, scene, gaussians, np.stack([low - _AROUND * size, high + _AROUND * size]), options)
    yield 0.0
    pieces = yield from _pieces(model, whole, cells, gaussians, options)
    with _whole_if_it_fails(model, context):
        things = yield from _create(pieces, cells, gaussians, model, context, options.show)
        for thing, piece in zip(things, pieces, strict=True):
            make_body(thing, model, scene, piece.mass_g)
        for first, second in _in_each_other(pieces, _GAP * size):
            let_pass(things[first], things[second], model, scene)
        _hide(model)
        context.view_layer.update()
        if options.floor:
            add_floor(model, scene, _box(things), options.drop_mm)
    for other in context.view_layer.objects:
        other.select_set(False)
    context.view_layer.objects.active = things[0]
    return things


def hindrance(model: bpy.types.Object) -> str:
    """Why a model will hardly break in this Blender, in a sentence; "" if nothing is known to be in the way.

    For those who want to know before they begin with other work.
    """
    try:
        mesh_path(model)
    except MeshFileError as error:
        return error_text(error)
    return "" if has_manifold() else rpt_(NO_MANIFOLD)


def pieces_of(scene: bpy.types.Scene, model: bpy.types.Object) -> list[bpy.types.Object]:
    """A model's pieces in a scene, in order; [] where it is whole."""
    pieces = (thing for thing in bodies_of(scene, model) if PIECE_KEY in thing)
    return sorted(pieces, key=lambda thing: thing[PIECE_KEY])


def make_whole(model: bpy.types.Object, scene: bpy.types.Scene) -> int:
    """Removes a model's pieces, body or cage, and floor, and shows it where it was, with what was hidden with it.

    A floor that another model may lie on stays, and so do duplicates that the user has made of pieces.

    Returns:
        How many objects went.
    """
    free_copies()
    leave_floor(model, scene)
    release_soft(model)
    things = bodies_of(scene, model)
    release([thing for thing in things if thing.rigid_body is not None], scene)
    clouds = (thing for thing in scene.objects if thing.get(PIECE_SPLATS_KEY) == model)
    parts = [*things, *(cloud for cloud in clouds if cloud.parent is None or BODY_KEY in cloud.parent)]
    for thing in things:
        release_whole(model, thing)
    # Where the user has removed the world of rigid bodies, what lets solids pass through each other is still there.
    for empty in [each for each in scene.objects if each.type == "EMPTY" and each.get(BODY_KEY) == model]:
        bpy.data.objects.remove(empty)
    data = {part.data for part in parts}
    animated = [*parts, *(part.data.shape_keys for part in parts if part.type == "MESH" and part.data.shape_keys)]
    actions = {each.animation_data.action for each in animated if each.animation_data is not None} - {None}
    for part in parts:
        bpy.data.objects.remove(part)
    for block in data:
        if block.users == 0:
            (bpy.data.meshes if isinstance(block, bpy.types.Mesh) else bpy.data.pointclouds).remove(block)
    for action in actions:
        if action.users == 0:
            bpy.data.actions.remove(action)
    for collection in [each for each in bpy.data.collections if each.get(BODY_KEY) == model]:
        if not collection.all_objects:
            bpy.data.collections.remove(collection)
    show_as_before([model, *marks_on(model)])
    for shown_in in model.users_scene:
        hide_with_model(shown_in)
    remove_unused_materials()
    remove_unused_groups()
    give_gravity_back(scene)
    return len(parts)


def section_walls(scene: bpy.types.Scene, model: bpy.types.Object) -> list[Wall]:
    """The scene's section planes in a model's frame."""
    walls = []
    for section in shown_planes(scene):
        place = place_in_world(section.object)
        matrix = np.array(place_in_world(model).inverted_safe() @ place, np.float64)
        normal = np.cross(matrix[:3, 0], matrix[:3, 1])
        if np.linalg.norm(normal) > 0:
            normal /= np.linalg.norm(normal)
            walls.append(Wall(normal, float(normal @ matrix[:3, 3])))
    return walls


def _cells(
    model: bpy.types.Object, scene: bpy.types.Scene, gaussians: GaussianSet, box: np.ndarray, options: BreakOptions
) -> list[Cell]:
    if options.along_planes:
        walls = section_walls(scene, model)
        if not walls:
            raise SettingError("the scene has no section plane to break along; add one, or break into random pieces.")
        return cells_between(walls, box)
    impact = None if options.impact_mm is None else np.array(options.impact_mm, np.float64)
    within = ((gaussians.means > box[0]) & (gaussians.means < box[1])).all(axis=1)
    return voronoi_cells(choose_seeds(gaussians.select(within), options.pieces, options.seed, impact), box)


def _pieces(
    model: bpy.types.Object,
    whole: Surface,
    cells: Sequence[Cell],
    gaussians: GaussianSet,
    options: BreakOptions,
) -> Generator[float, None, list[Piece]]:
    """The pieces with their masses and colours."""
    steps = masses_in_steps(model, gaussians, options.g_cm3_per_mm_inv)
    masses = yield from part_of_work(steps, 0.0, _WEIGHED)
    spacing = options.spacing_mm or float(np.ptp(whole.vertices, axis=0).max()) / _FINE
    solids, walls = yield from part_of_work(cut_in_steps(whole, cells, spacing), _WEIGHED, _CUT)
    filling = fill_in_steps(solids, nearest_cell(gaussians.means, cells), gaussians, masses)
    pieces = yield from part_of_work(filling, _CUT, _FILLED)
    coloring = color_in_steps([piece.surface for piece in pieces], walls, gaussians, spacing, options.window)
    surfaces = yield from part_of_work(coloring, _FILLED, _COLORED)
    return [replace(piece, surface=surface) for piece, surface in zip(pieces, surfaces, strict=True)]


def _create(
    pieces: Sequence[Piece],
    cells: Sequence[Cell],
    gaussians: GaussianSet,
    model: bpy.types.Object,
    context: bpy.types.Context,
    show: str,
) -> Generator[float, None, list[bpy.types.Object]]:
    """An object for each piece, in a collection of their own, and its splats with it."""
    sharing = share_in_steps(pieces, cells, nearest_cell(gaussians.means, cells), gaussians, _shown(model, gaussians))
    shares = yield from part_of_work(sharing, _COLORED, _SHARED)
    surroundings = model_surroundings(model)
    collection = _own_collection(model, context)
    things = []
    for number, (piece, seen) in enumerate(zip(pieces, shares, strict=True), 1):
        # What else is made between the steps belongs elsewhere.
        with _into(collection, context):
            thing = _create_piece(piece, number, model, context)
            if len(seen.index):
                cloud = create_piece_splats(thing, piece.center_mm, seen, model, gaussians, surroundings, context)
                _show(thing, cloud, show)
        things.append(thing)
        yield _SHARED + number / len(pieces) * (_MADE - _SHARED)
    return things


def _surface(mesh: TriangleMesh) -> Surface:
    colors = np.full((len(mesh.faces), 3, 3), _GREY) if mesh.colors is None else mesh.colors[mesh.faces]
    return Surface(mesh.vertices, mesh.faces, colors, np.full(len(mesh.faces), OUTSIDE))


def _shown(model: bpy.types.Object, gaussians: GaussianSet) -> np.ndarray:
    """(N,) whether the model's display shows a splat."""
    modifier = display_modifier(model)
    least = 0.0 if modifier is None else modifier_input(modifier, "Minimum Density")
    return (gaussians.modality != Modality.XRAY) | (model_surroundings(model) >= least)


def _create_piece(piece: Piece, number: int, model: bpy.types.Object, context: bpy.types.Context) -> bpy.types.Object:
    """The piece's mesh in Blender units about its centre of mass, where it is in the model."""
    matrix = place_in_world(model)
    turn = matrix.to_quaternion()
    # With the shear that a parent gives: an object has none of its own.
    placed = piece.surface.placed(piece.center_mm, np.array(stretch_of(matrix), np.float64))
    name = f"{model.name} Piece {number:02d}"
    thing = bpy.data.objects.new(name, new_mesh(name, placed, piece_materials()))
    open_collection(context).objects.link(thing)
    thing.rotation_mode, thing.rotation_quaternion = "QUATERNION", turn
    thing.location = matrix @ Vector(piece.center_mm)
    thing[BODY_KEY] = model
    thing[PIECE_KEY], thing[MASS_KEY], thing[VOLUME_KEY] = number, piece.mass_g, piece.volume_mm3
    return thing


def _show(thing: bpy.types.Object, cloud: bpy.types.Object, show: str) -> None:
    if show == "MESH":
        cloud.hide_viewport = cloud.hide_render = True
    else:
        thing.display_type, thing.hide_render = "BOUNDS", True


def _in_each_other(pieces: Sequence[Piece], gap: float) -> list[tuple[int, int]]:
    """Pairs of pieces whose convex hulls overlap: solids of the same cell, as hulls of different cells never meet."""
    return [
        (first, second)
        for first, second in combinations(range(len(pieces)), 2)
        if set(pieces[first].cells) & set(pieces[second].cells)
        and not hulls_are_apart(pieces[first].surface.vertices, pieces[second].surface.vertices, gap)
    ]


def _box(things: Sequence[bpy.types.Object]) -> np.ndarray:
    corners = np.array([place_in_world(thing) @ Vector(corner) for thing in things for corner in thing.bound_box])
    return np.stack([corners.min(axis=0), corners.max(axis=0)])


def _hide(model: bpy.types.Object) -> None:
    """With what shows its inside, and what was measured of it: all that would stay in the air over the pieces."""
    hide_for_now([model, *marks_on(model)])
    for scene in model.users_scene:
        hide_with_model(scene)


@contextmanager
def _whole_if_it_fails(model: bpy.types.Object, context: bpy.types.Context) -> Iterator[None]:
    """Makes a model whole again, with what was selected, if not all of the block is done."""
    layer = context.view_layer
    # Not the objects: some may be deleted meanwhile, in another window.
    active = layer.objects.active.session_uid if layer.objects.active else None
    selected = {thing.session_uid for thing in layer.objects if thing.select_get()}
    try:
        yield
    except BaseException:
        make_whole(model, context.scene)
        layer.update()
        for thing in layer.objects:
            if thing.session_uid in selected:
                thing.select_set(True)
        layer.objects.active = next((thing for thing in layer.objects if thing.session_uid == active), None)
        raise


def _own_collection(model: bpy.types.Object, context: bpy.types.Context) -> bpy.types.Collection:
    """A new collection beside the model."""
    collection = bpy.data.collections.new(f"{model.name} Pieces")
    collection[BODY_KEY] = model
    context.scene.collection.children.link(collection)
    return collection


@contextmanager
def _into(collection: bpy.types.Collection, context: bpy.types.Context) -> Iterator[None]:
    """What is made in the block comes into a collection of the scene's."""
    layer = context.view_layer.layer_collection.children[collection.name]
    before = context.view_layer.active_layer_collection
    context.view_layer.active_layer_collection = layer
    try:
        yield
    finally:
        context.view_layer.active_layer_collection = before
