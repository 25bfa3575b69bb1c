"""Blender 5.3 draws point clouds of splats by itself: what of that there is in this Blender.

Its splats have the attributes of ours (`splats`), so all that is missing is the type. Which is set on what is
imported; splats of a file from an older Blender stay as that shows them until they are shown anew (`showing.show_as`),
and get the type of Blender's own colours then.
Only what has to be geometry is ours then: ellipsoids closed at cuts, and those that the user asks for.
"""

from __future__ import annotations

import bpy

_TYPE = "GAUSSIAN_SPLAT"


def draws_splats() -> bool:
    """Whether this Blender knows point clouds of splats."""
    kind = bpy.types.PointCloud.bl_rna.properties.get("type")
    return kind is not None and _TYPE in kind.enum_items


def make_native(data: bpy.types.PointCloud) -> None:
    """Lets Blender draw a point cloud as splats, if it can."""
    if draws_splats():
        data.type = _TYPE
