"""What takes long of a new section, worked out before the scene changes: splats, places, densities, the cut's nodes."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass

import bpy
import numpy as np

from ...core.render.section_numpy import SectionSplats, section_in_steps
from ...core.steps import part_of_work
from ...core.views import Plane
from .cutting import cut_group_in_steps
from .kept_splats import kept_splats
from .section import (
    Known,
    NoSectionError,
    box_in_steps,
    has_own_window,
    shown_sections,
    was_found_in,
    window_in_steps,
)
from .section_image import Window
from .splats import shows_density
from .standing import place_in_world

# Shares of the work that are done when the splats are known, then their box, the window, and the nodes.
_KNOWN, _BOXED, _WINDOWED, _BUILT = 0.15, 0.25, 0.4, 0.6

Views = Callable[[bpy.types.Object, np.ndarray, bpy.types.Scene], Sequence[Plane]]
"""The planes of a section's pictures in the model's frame (mm), of a model, the box in `Survey` and a scene."""


@dataclass(frozen=True, eq=False)
class Survey:
    """What a section is made from.

    Attributes:
        model_uid: `session_uid` of the model.
        box: (2, 3) of the model, turned as it is, about its origin.
        window: of its densities, where the scene has none yet.
        known: the densities of the section's pictures.
    """

    model_uid: int
    box: np.ndarray
    window: Window | None
    known: Known | None

    @property
    def model(self) -> bpy.types.Object:
        """The model.

        Raises:
            ReferenceError: it is gone.
        """
        return _found(self.model_uid)


def survey_in_steps(
    model: bpy.types.Object, context: bpy.types.Context, views: Views
) -> Generator[float, None, Survey]:
    """Surveys a model for a new section, with breaks that tell the share that is done, 0 to 1.

    Raises:
        DamagedSplatsError: an attribute is missing, or of another type.
        ReferenceError: an undo in a break has taken the model, or the nodes, away.
    """
    # A script may have edited it just now, and what is kept is not of that.
    context.view_layer.update()
    uid, turn, window, known = model.session_uid, place_in_world(model).to_quaternion(), None, None
    draws, unknown = shows_density(model), window_is_unknown(context.scene)
    # No break may come before this asks for the model.
    gaussians, splats = yield from part_of_work(kept_splats.read_in_steps(model), 0.0, _KNOWN)
    box = yield from part_of_work(box_in_steps(gaussians, turn), _KNOWN, _BOXED)
    # Photos alone have no density to find a window of, and would leave a made-up one to the next model.
    if unknown and draws:
        unturned = yield from part_of_work(box_in_steps(gaussians), _BOXED, _BOXED)
        window = yield from part_of_work(window_in_steps(splats, unturned), _BOXED, _WINDOWED)
    yield from part_of_work(cut_group_in_steps(), _WINDOWED, _BUILT)
    if draws:
        try:
            planes = views(_found(uid), box, context.scene)
        except NoSectionError:
            # As one scaled to nothing: the section cuts it, without a picture.
            planes = []
        known = yield from part_of_work(_densities(splats, planes), _BUILT, 1.0)
    return Survey(uid, box, window, known)


def window_is_unknown(scene: bpy.types.Scene) -> bool:
    """Before the first section, unless the user has set it; also where boxes of older files have no pictures."""
    settings = scene.insideout
    if shown_sections(scene):
        return not (settings.is_property_set("low") or settings.is_property_set("high"))
    return not has_own_window(settings)


def lacks_window(model: bpy.types.Object, scene: bpy.types.Scene) -> bool:
    """Whether a model is to be shown without a section, by a window that was not found in it."""
    return window_is_unknown(scene) and not was_found_in(model, scene)


def _densities(splats: SectionSplats, planes: Sequence[Plane]) -> Generator[float, None, Known]:
    values: list[tuple[Plane, np.ndarray]] = []
    for plane in planes:
        done = len(values) / len(planes)
        sampling = section_in_steps(splats, plane)
        values.append((plane, (yield from part_of_work(sampling, done, done + 1 / len(planes)))))
    return Known(splats, values)


def _found(uid: int) -> bpy.types.Object:
    """By its `session_uid`: an undo in a break leaves no references."""
    for thing in bpy.data.objects:
        if thing.session_uid == uid:
            return thing
    raise ReferenceError("the model of the section is gone")
