"""Models as they have become in the scene, back as splats and out as .ply."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from bpy.app.translations import pgettext_rpt as rpt_

from ...core.affine import Kept, affine_in_steps
from ...core.deform import deformed, turned_colors
from ...core.densities import Densities
from ...core.gaussians import GaussianSet
from ...core.ply import write_in_steps
from ...core.steps import part_of_work, run_through
from .display import display_modifier
from .following import Bending, bending_of, following_modifier
from .importing import TOLD_KEY, WARNINGS_KEY, densities_are_relative
from .node_tree import modifier_input, set_modifier_input
from .placement import LEFT_BEHIND, denser_by, moved_since_import, splats_are_left_behind
from .provenance import comment_lines, provenance_of, stamp
from .run_facts import facts_to_export
from .section_cut import cut_modifiers
from .splats import WATER_KEY, WHOLE_SCALE, DamagedSplatsError, in_scene, read_in_steps, read_splats, read_values

# Node groups of this add-on: they show a model and are no edit of it.
_OURS = "InsideOut"
# Shares of the editing that are done when the splats are read and bent, and of an export when they are edited.
_READ, _BENT, _EDITED = 0.3, 0.5, 0.5
# What leaves of a display what its cuts and its peeling leave, one point a splat: thresholds that the import chose
# are a matter of looks.
_ALL_THAT_IS_CUT_AWAY = {"Ellipsoids": False, "View-Dependent": True, "Minimum Opacity": 0.0, "Minimum Density": 0.0}
# Both sides of a plane where they were: 0 would hide one, and so little leaves each place what it is.
_NOT_APART = 1e-30
# Attributes that can hold what is no number, and the field of a GaussianSet that each becomes.
_FLOATS = (
    ("position", "means"),
    ("scale", "scales"),
    ("rotation", "quats"),
    ("radiance:base", "opacities"),
    ("radiance:base", "sh"),
    ("density", "density"),
)


@dataclass(frozen=True)
class Export:
    """What has been written.

    Attributes:
        splats: how many.
        warnings: what of the file is not as the user may think, a sentence each.
    """

    splats: int
    warnings: tuple[str, ...]


def model_to_export(context: bpy.types.Context) -> bpy.types.Object | None:
    """The active object if it is, or was, a model of splats, else the scene's shown one; damaged ones count, too."""
    active, shown = context.view_layer.objects.active, context.scene.insideout.model
    for candidate in (active, shown):
        if candidate is not None and candidate.type == "POINTCLOUD" and in_scene(candidate, context.scene):
            names = candidate.data.attributes.keys()
            if candidate == shown or {"scale", "rotation", "radiance:base"} & set(names):
                return candidate
    return None


def is_edited_by_modifiers(model: bpy.types.Object) -> bool:
    """Whether the user's modifiers change the splats: the view and an export have that, sections and weights do not."""
    ours = _ours(model)
    return any(modifier.show_viewport and modifier not in ours for modifier in model.modifiers)


def edited_splats(
    model: bpy.types.Object, context: bpy.types.Context, visible_only: bool = False, kept: Kept = Kept.MATERIAL
) -> GaussianSet:
    """A model's splats with all that was done to them: points deleted, modifiers, the object moved.

    In the frame and unit of the file that was imported, so that an untouched model comes out as it came in.

    Args:
        visible_only: leaves out hidden background, what is peeled off and what sections hide. A splat counts as on the
            side of its centre: both sides together are the model, and none is there twice. Sides that are pulled apart
            are both there, where they were.
        kept: what of the density stays if the object was scaled. The material by default: Blender's sections show
            densities in mm⁻¹ whatever the size of the object, and the file is to show the same. Line integrals are
            for a scale that corrects the size of what was X-rayed.

    Raises:
        DamagedSplatsError: an attribute is missing, of another type, or has no meaning; or no splat is left.
        SettingError: the object is scaled to nothing.
    """
    return run_through(edited_in_steps(model, context, visible_only, kept))


def edited_in_steps(
    model: bpy.types.Object, context: bpy.types.Context, visible_only: bool = False, kept: Kept = Kept.MATERIAL
) -> Generator[float, None, GaussianSet]:
    """As `edited_splats`, with breaks that tell the share that is done, 0 to 1; in none of them is there a copy.

    What Blender evaluates is a piece that cannot be divided.

    Raises:
        ReferenceError: in a break splats were edited, or an undo has taken them, or the model, away.
    """
    # A script may have moved it just now.
    context.view_layer.update()
    moved = moved_since_import(model)
    if visible_only or is_edited_by_modifiers(model):
        with _evaluated(model, context, visible_only) as shown:
            _require_some(shown.data, model)
            bending, scales = bending_of(model, shown.data), read_values(shown, WHOLE_SCALE)
            gaussians = read_splats(shown)
        yield _READ
    else:
        _require_some(model.data, model)
        # Before any break: the cage may be another one afterwards.
        bending, scales = bending_of(model), read_values(model, WHOLE_SCALE)
        gaussians = yield from part_of_work(read_in_steps(model), 0.0, _READ)
    # Splats with their own axes, where Blender draws them smaller beside a cut.
    gaussians = gaussians if scales is None else replace(gaussians, scales=scales)
    gaussians = yield from part_of_work(_bent(gaussians, bending, visible_only), _READ, _BENT)
    _check(gaussians, model.name)
    return (yield from part_of_work(affine_in_steps(gaussians, moved, kept), _BENT, 1.0))


def export_splats(
    model: bpy.types.Object,
    path: Path,
    context: bpy.types.Context,
    visible_only: bool = False,
    kept: Kept = Kept.MATERIAL,
) -> Export:
    """Writes `edited_splats` as a .ply of 3D Gaussian splatting, the model's provenance in its header.

    Raises:
        DamagedSplatsError, SettingError: as `edited_splats`.
        DiskFullError, RunFolderError: as `core.files.atomic_write`.
    """
    return run_through(export_in_steps(model, path, context, visible_only, kept))


def export_in_steps(
    model: bpy.types.Object,
    path: Path,
    context: bpy.types.Context,
    visible_only: bool = False,
    kept: Kept = Kept.MATERIAL,
) -> Generator[float, None, Export]:
    """As `export_splats`, with breaks that tell the share that is done; closed before its end the file is as it was."""
    # Before any break: the model may be elsewhere afterwards.
    context.view_layer.update()
    denser = denser_by(moved_since_import(model), kept)
    # Who imports the file cannot find it out any more.
    left_behind = (rpt_(LEFT_BEHIND).format(model=model.name),) if splats_are_left_behind(model) else ()
    gaussians = yield from part_of_work(edited_in_steps(model, context, visible_only, kept), 0.0, _EDITED)
    provenance = provenance_of(model)
    water = model.get(WATER_KEY)
    if water is not None:
        water *= denser
    facts = facts_to_export(model.get(WARNINGS_KEY, ""), model.get(TOLD_KEY, ""), water)
    comments = comment_lines({**provenance, **facts, "exported": stamp()})
    writing = write_in_steps(gaussians, path, comments, Densities(densities_are_relative(model)))
    yield from part_of_work(writing, _EDITED, 1.0)
    return Export(len(gaussians), (*left_behind, *_warnings(gaussians, provenance.get("file") or {})))


@contextmanager
def _evaluated(model: bpy.types.Object, context: bpy.types.Context, visible_only: bool) -> Iterator[bpy.types.Object]:
    """The model after its modifiers but for those that only show it."""
    # The user's modifiers stay as they are: a copy, which shares the points, has its own.
    copy = model.copy()
    context.scene.collection.objects.link(copy)
    try:
        copy.hide_viewport = False
        for modifier in _ours(copy):
            if visible_only:
                _show_what_is_not_cut(modifier)
            else:
                copy.modifiers.remove(modifier)
        yield copy.evaluated_get(context.evaluated_depsgraph_get())
    finally:
        bpy.data.objects.remove(copy)


def _require_some(points: bpy.types.PointCloud, model: bpy.types.Object) -> None:
    """Raises DamagedSplatsError where there are none: what is empty has no attributes either."""
    if len(points.points) == 0:
        raise DamagedSplatsError("{model}: has no splats left; show some, or undo what removed them.", model=model.name)


def _bent(gaussians: GaussianSet, bending: Bending | None, by_nodes: bool) -> Generator[float, None, GaussianSet]:
    """Splats as the cage of a soft body bends them; nodes have done so already but for the colours' directions."""
    if bending is None:
        return gaussians
    return (yield from bending.in_steps(gaussians, _turned if by_nodes else deformed))


def _turned(gaussians: GaussianSet, centers: np.ndarray, gradients: np.ndarray) -> GaussianSet:
    return replace(gaussians, sh=turned_colors(gaussians.sh, gradients))


def _warnings(gaussians: GaussianSet, imported: dict[str, Any]) -> Iterator[str]:
    degree, count = imported.get("sh_degree", 0), imported.get("splats", len(gaussians))
    if degree > gaussians.sh_degree:
        told = rpt_(
            "Colors that change with the view (SH degree {degree}) were not imported and are not in the file; import "
            "with View-Dependent to keep them."
        )
        yield told.format(degree=degree)
    if len(gaussians) > count:
        told = rpt_(
            "{count:,} splats more than were imported; those of a model that was turned or scaled when it was joined "
            "have wrong shapes, unless Object > Apply > Transform to Splats came first."
        )
        yield told.format(count=len(gaussians) - count)


def _ours(model: bpy.types.Object) -> list[bpy.types.Modifier]:
    """What shows, cuts and bends the splats, whatever it was renamed to; not the user's own copies of that."""
    known = [display_modifier(model), following_modifier(model), *cut_modifiers(model)]
    named = [m for m in model.modifiers if m.type == "NODES" and m.node_group and m.node_group.name.startswith(_OURS)]
    return [modifier for modifier in model.modifiers if modifier in known or modifier in named]


def _show_what_is_not_cut(modifier: bpy.types.NodesModifier) -> None:
    modifier.show_viewport = True
    inputs = modifier.node_group.interface.items_tree.keys()
    for name, value in _ALL_THAT_IS_CUT_AWAY.items():
        if name in inputs:
            set_modifier_input(modifier, name, value)
    if "Apart" in inputs and modifier_input(modifier, "Apart") > 0:
        set_modifier_input(modifier, "Apart", _NOT_APART)


def _check(gaussians: GaussianSet, name: str) -> None:
    """Raises DamagedSplatsError for values that no splat can have."""
    for attribute, field in _FLOATS:
        values = getattr(gaussians, field)
        bad = int((~np.isfinite(values).reshape(len(gaussians), -1).all(axis=1)).sum())
        if bad:
            raise DamagedSplatsError(
                "{model}: the attribute '{attribute}' of {count:,} splats is no number; delete them, or undo what did "
                "it.",
                model=name,
                attribute=attribute,
                count=bad,
            )
    without = int((gaussians.scales <= 0).any(axis=1).sum())
    if without:
        raise DamagedSplatsError(
            "{model}: the attribute 'scale' of {count:,} points is 0, as of points that were joined but are no "
            "splats; delete them.",
            model=name,
            count=without,
        )
