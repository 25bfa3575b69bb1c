"""Where a model was put when it was imported, and where the user has moved it since."""

from __future__ import annotations

import bpy
import numpy as np
from mathutils import Matrix

from ...core.affine import Affine, Kept, affine_transformed
from ...core.errors import InsideOutError
from .splats import read_splats, rewrite_splats

# On each model: its matrix as it was placed, 16 numbers row by row.
_PLACED_KEY = "insideout_placed"


class SharedSplatsError(InsideOutError):
    """Splats of several objects cannot be changed for one of them."""


def remember_placement(model: bpy.types.Object) -> None:
    """Keeps where a model without parent or constraint stands: what it is turned and scaled by is the import's."""
    model[_PLACED_KEY] = [float(number) for row in model.matrix_basis for number in row]


def moved_since_import(model: bpy.types.Object) -> Affine:
    """What the user has done to a model as an object, in the model's own frame and unit.

    The import scales to the scene's units and turns models of photos alone upright. That is no part of it, so a
    model that nobody has touched is not moved, and its lengths stay those of its file, whatever the scene's unit.
    Point clouds that were not imported count as placed with a unit of Blender as theirs.
    """
    return Affine.of_matrix(np.linalg.inv(_placed(model)) @ np.array(model.matrix_world, np.float64))


def apply_transform(model: bpy.types.Object) -> None:
    """Moves the splats instead of the object, which goes back to where the import placed it; nothing looks different.

    Centres, shapes and view-dependent colours all go with the object's transform. Blender's own Apply, and its Join of
    objects that stand apart, move centres alone.

    Raises:
        DamagedSplatsError: an attribute is missing, or of another type.
        SettingError: the object is scaled to nothing.
        SharedSplatsError: other objects show the same splats.
    """
    if model.data.users > 1:
        raise SharedSplatsError(
            f"{model.name}: {model.data.users} objects share its splats; make it a single user "
            "(Object > Relations > Make Single User > Object & Data) first."
        )
    rewrite_splats(model, affine_transformed(read_splats(model), moved_since_import(model), Kept.MATERIAL))
    model.matrix_world = Matrix(_placed(model).tolist())


def _placed(model: bpy.types.Object) -> np.ndarray:
    return np.array(model.get(_PLACED_KEY, np.eye(4).ravel()), np.float64).reshape(4, 4)
