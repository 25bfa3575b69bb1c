"""What was measured of a model before a transform was applied to its splats."""

from __future__ import annotations

import bpy
import numpy as np

from ...core.affine import Affine
from .probe_result import forget_probe
from .rulers import TEXT_KEY, remeasure
from .thickness_map import FIGURE_KEY, move_figures, remove_thickness_map

# Lengths that change by less are the same.
_SAME_LENGTH = 1e-5


def measure_again(model: bpy.types.Object, moved: Affine, context: bpy.types.Context) -> bool:
    """Brings lines and figures of a model up to date; returns whether its wall thickness is to be measured again.

    Lines stay where they are in space, with their new figures. A map of wall thickness stays if the model was only
    moved and turned, and goes if its walls are of another thickness now. The last probe was of another place.

    Args:
        moved: what was applied to the splats.
    """
    for ruler in [child for child in model.children if TEXT_KEY in child]:
        remeasure(ruler, context)
    for scene in bpy.data.scenes:
        forget_probe(scene, model)
    maps = [child for child in model.children if f"{FIGURE_KEY}least_mm" in child]
    if np.allclose(moved.polar()[1], 1.0, atol=_SAME_LENGTH):
        for drawn in maps:
            move_figures(drawn, moved)
        return False
    for drawn in maps:
        remove_thickness_map(drawn)
    return bool(maps)
