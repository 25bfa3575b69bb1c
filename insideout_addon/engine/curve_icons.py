"""Pictures of runs' curves as Blender's icons, which panels show; they belong to no file."""

from __future__ import annotations

from collections.abc import Sequence

import bpy
import bpy.utils.previews
import numpy as np

from .curve_picture import CurvePoint, draw_mark, draw_picture

# Made when a panel first asks, with what each shows now.
_collections: list[bpy.utils.previews.ImagePreviewCollection] = []
_shown: dict[str, tuple[CurvePoint, ...]] = {}


def curve_icon(place: str, points: Sequence[CurvePoint]) -> int:
    """The picture of a curve, drawn anew (a few milliseconds) only where it is another than at the last call.

    Args:
        place: which of the pictures; those of two panels can be seen at once.

    Returns:
        The icon's number; 0 in background mode, where Blender has no icons.
    """
    picture = _preview(place)
    if _shown.get(place) != tuple(points):
        _shown[place] = tuple(points)
        _fill(picture, "image", draw_picture(points))
    return picture.icon_id


def mark_icon(kind: str) -> int:
    """The mark that a kind's points have in the pictures."""
    name = f"mark of {kind}"
    known = bool(_collections) and name in _collections[0]
    mark = _preview(name)
    if not known:
        _fill(mark, "icon", draw_mark(kind))
    return mark.icon_id


def detach() -> None:
    """Takes all pictures away again."""
    _shown.clear()
    while _collections:
        bpy.utils.previews.remove(_collections.pop())


def _preview(name: str) -> bpy.types.ImagePreview:
    if not _collections:
        _collections.append(bpy.utils.previews.new())
    pictures = _collections[0]
    return pictures[name] if name in pictures else pictures.new(name)


def _fill(preview: bpy.types.ImagePreview, which: str, pixels: np.ndarray) -> None:
    setattr(preview, f"{which}_size", (pixels.shape[1], pixels.shape[0]))
    getattr(preview, f"{which}_pixels_float").foreach_set(np.ascontiguousarray(pixels, np.float32).ravel())
