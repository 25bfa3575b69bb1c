"""Where a model was put when it was imported, and where the user has moved it since."""

from __future__ import annotations

import math
from collections.abc import Generator

import bpy
import numpy as np
from bpy.app.translations import pgettext_n as n_
from mathutils import Matrix

from ...core.affine import Affine, Kept, affine_in_steps
from ...core.errors import InsideOutError, SettingError
from ...core.steps import part_of_work, run_through
from .display import scale_display
from .following import following_modifier
from .inside import inside_of, keep_inside, kept_inside, no_less_than_own
from .marked_splats import mark_splats, moved_since, points_are_turned_or_scaled
from .own_motion import moves_by_itself
from .run_facts import MILLIMETRE
from .splats import (
    DEPTH,
    UNIT_KEY,
    WATER_KEY,
    WATER_SET_KEY,
    move_cuts,
    read_splats,
    rewrite_splats,
    shown_model,
    shows_density,
    unchanged,
)
from .standing import place_in_world

# On each model, a matrix each, 16 numbers row by row: where it was placed, and what was applied to its splats.
_PLACED_KEY, _APPLIED_KEY = "insideout_placed", "insideout_applied"
# And by what its densities were multiplied with that, where line integrals were kept.
_DENSITY_KEY = "insideout_applied_density"
# Stretches that differ by less are the same.
_SAME_STRETCH = 1e-5
# Share of the work that is done when the splats are transformed, where depths have to be worked out anew.
_TRANSFORMED = 0.3
LEFT_BEHIND = n_(
    "Blender's own Apply has turned or scaled the points of {model}, but not the splats on them; undo it, then use "
    "Object > Apply > Transform to Splats."
)


def millimetre(scene: bpy.types.Scene) -> float:
    """Blender units in a millimetre; without a system of units a unit is one."""
    units = scene.unit_settings
    length = 1.0 if units.system == "NONE" else 0.001 / units.scale_length
    # The setting has single precision; a scale of 0.99999995 would only puzzle.
    return 1.0 if abs(length - 1.0) < 1e-5 else length


class SharedSplatsError(InsideOutError):
    """Splats of several objects cannot be changed for one of them."""


def remember_placement(model: bpy.types.Object) -> None:
    """Keeps where a model without parent or constraint stands: what it is turned and scaled by is the import's.

    Its splats are in the frame of its file still.
    """
    model[_PLACED_KEY] = [float(number) for row in model.matrix_basis for number in row]
    mark_splats(model)


def share_placement(part: bpy.types.Object, model: bpy.types.Object) -> None:
    """Lets a cloud of some of a model's splats, in the model's frame, count as imported with it."""
    if _PLACED_KEY in model:
        part[_PLACED_KEY] = list(model[_PLACED_KEY])
    _keep_applied(part, applied_to_splats(model))
    if _DENSITY_KEY in model:
        part[_DENSITY_KEY] = model[_DENSITY_KEY]


def moved_since_import(model: bpy.types.Object) -> Affine:
    """What the user has done to a model as an object, in the model's own frame and unit.

    The import scales to the scene's units and turns models of photos alone upright. That is no part of it, so a
    model that nobody has touched is not moved, and its lengths stay those of its file, whatever the scene's unit.
    Point clouds that were not imported count as placed with a unit of Blender as theirs.
    """
    return Affine.of_matrix(np.linalg.inv(_placed(model)) @ np.array(place_in_world(model), np.float64))


def is_scaled(model: bpy.types.Object) -> bool:
    """Whether a model has another size, as an object, than it was imported with: what is measured has that of before.

    One that is scaled to nothing has none, and one that is only mirrored has the same.
    """
    return bool(np.abs(np.linalg.svd(moved_since_import(model).linear)[1] - 1.0).max() > _SAME_STRETCH)


def splats_are_left_behind(model: bpy.types.Object) -> bool:
    """Whether Blender's own Apply has turned, mirrored or scaled a model's points: what was done to it as an object is
    lost then, and directions, shapes and densities of its splats are of before. A move alone leaves them right."""
    return points_are_turned_or_scaled(model, transformed_to_splats(model))


def apply_transform(model: bpy.types.Object, kept: Kept = Kept.MATERIAL) -> Affine:
    """Moves the splats instead of the object, which goes back to where the import placed it; nothing looks different.

    Centres, shapes and view-dependent colours all go with the object's transform. Blender's own Apply, and its Join of
    objects that stand apart, move centres alone. What follows the model stays where it is.

    Args:
        kept: what of the density stays if the object was scaled, as `edited_splats` has it.

    Returns:
        What was applied, in the model's own frame and unit.

    Raises:
        DamagedSplatsError: an attribute is missing, or of another type.
        SettingError: the object is scaled to nothing, a soft body, placed by constraints, keyframes or drivers of its
            own, or was turned or scaled by Blender's own Apply.
        SharedSplatsError: other objects show the same splats.
    """
    return run_through(apply_in_steps(model, kept))


def apply_in_steps(model: bpy.types.Object, kept: Kept = Kept.MATERIAL) -> Generator[float, None, Affine]:
    """As `apply_transform`, with breaks that tell the share that is done; closed before its end it changes nothing.

    Raises:
        ReferenceError: in a break the model was edited, moved or taken away; nothing is changed then, either.
    """
    users = model.data.users - model.data.use_fake_user
    if users > 1:
        raise SharedSplatsError(
            "{model}: {count} objects share its splats; make it a single user "
            "(Object > Relations > Make Single User > Object & Data) first.",
            model=model.name,
            count=users,
        )
    if following_modifier(model) is not None:
        raise SettingError(
            "{model} is a soft body, whose cage holds its splats; press Back to Whole first.", model=model.name
        )
    if moves_by_itself(model):
        raise SettingError(
            "{model} is moved by constraints, keyframes or drivers, which would move its splats once more; apply or "
            "clear those first.",
            model=model.name,
        )
    if splats_are_left_behind(model):
        raise SettingError(LEFT_BEHIND, model=model.name)
    moved, before, placed = moved_since_import(model), place_in_world(model), Matrix(_placed(model).tolist())
    so_far = applied_to_splats(model)
    # The modifier may peel by depth, by hand or by keyframes, where the scene's settings do not.
    inside, stretches = kept_inside(model), moved.polar()[1]
    size, denser = _size(moved), denser_by(moved, kept)
    known = inside is not None and np.ptp(stretches) < _SAME_STRETCH * stretches[0]
    anew = not known and DEPTH in model.data.attributes and shows_density(model)
    with unchanged(model, read_splats) as own:
        splats = yield from part_of_work(affine_in_steps(own, moved, kept), 0.0, _TRANSFORMED if anew else 1.0)
        if anew:
            inside = yield from part_of_work(inside_of(splats), _TRANSFORMED, 1.0)
        elif known:
            # Own densities were divided, which differs in the last digit.
            inside = float(stretches[0]) * inside[0], no_less_than_own(denser * inside[1], splats)
        if place_in_world(model) != before:
            raise ReferenceError("the model was moved meanwhile")
    move_cuts(model, moved.linear)
    rewrite_splats(model, splats)
    if anew or known:
        keep_inside(model, *inside)
    _keep_applied(model, Affine(moved.linear @ so_far.linear, moved.apply(so_far.translation)))
    _place(model, before, placed)
    for child in model.children:
        child.matrix_parent_inverse = placed.inverted_safe() @ before @ child.matrix_parent_inverse
    if kept is Kept.LINE_INTEGRALS:
        model[_DENSITY_KEY] = denser * densities_times(model)
        _make_water_denser(model, denser)
    scale_display(model, size, denser)
    return moved


def _place(model: bpy.types.Object, before: Matrix, placed: Matrix) -> None:
    """Puts a model that stands at `before` at `placed`, both in the world.

    Under a parent that is turned and stretched what an object has as its own would not do: it holds no shear.
    """
    if model.parent is None:
        model.matrix_world = placed
        return
    own = model.matrix_parent_inverse @ model.matrix_basis
    model.matrix_parent_inverse = (before @ own.inverted_safe()).inverted_safe()
    model.matrix_basis = placed


def denser_by(moved: Affine, kept: Kept) -> float:
    """By what densities are multiplied where splats are moved and stretched.

    Raises:
        SettingError: the map leaves no volume, or is not finite.
    """
    return 1.0 / _size(moved) if kept is Kept.LINE_INTEGRALS else 1.0


def _size(moved: Affine) -> float:
    return float(np.prod(moved.polar()[1])) ** (1 / 3)


def _make_water_denser(model: bpy.types.Object, denser: float) -> None:
    """Lets Hounsfield units stay what they are."""
    water = model.get(WATER_KEY)
    if water is None:
        return
    model[WATER_KEY] = denser * water
    for scene in bpy.data.scenes:
        if shown_model(scene) == model and math.isclose(scene.insideout.water, water, rel_tol=1e-5):
            scene.insideout.water = denser * water
            # No number of the user's, which would stay where another model is chosen.
            scene[WATER_SET_KEY] = denser * water


def densities_times(model: bpy.types.Object) -> float:
    """By what the densities of a model's file were multiplied by transforms that kept line integrals."""
    return float(model.get(_DENSITY_KEY, 1.0))


def applied_to_splats(model: bpy.types.Object) -> Affine:
    """From the frame of the file that a model was imported from to that of its splats now: all that was applied, by
    Blender's own Apply, too."""
    return moved_since(model, transformed_to_splats(model))


def transformed_to_splats(model: bpy.types.Object) -> Affine:
    """All that `apply_transform` has applied, for those who have no time to look where splats are."""
    return Affine.of_matrix(_matrix(model, _APPLIED_KEY))


def _keep_applied(model: bpy.types.Object, applied: Affine) -> None:
    matrix = np.eye(4)
    matrix[:3] = np.column_stack([applied.linear, applied.translation])
    model[_APPLIED_KEY] = matrix.ravel().tolist()


def _placed(model: bpy.types.Object) -> np.ndarray:
    """(4, 4) where the import has put a model.

    Appended to a scene in another unit one in mm is as many times too large or small as before, until the user makes
    it about as large as the import would have made it there: then that is what it is scaled from.
    """
    placed = _matrix(model, _PLACED_KEY)
    if model.get(UNIT_KEY) != MILLIMETRE or _PLACED_KEY not in model:
        return placed
    before, now = (_size_of(matrix) for matrix in (placed, np.array(place_in_world(model), np.float64)))
    if not (before > 0 and now > 0):
        return placed
    sizes = [before, *(millimetre(scene) for scene in model.users_scene)]
    nearest = min(sizes, key=lambda size: abs(math.log(now / size)))
    return placed if abs(nearest / before - 1) < _SAME_STRETCH else np.diag([*[nearest / before] * 3, 1.0]) @ placed


def _size_of(matrix: np.ndarray) -> float:
    return float(np.abs(np.linalg.det(matrix[:3, :3])) ** (1 / 3))


def _matrix(model: bpy.types.Object, key: str) -> np.ndarray:
    return np.array(model.get(key, np.eye(4).ravel()), np.float64).reshape(4, 4)
