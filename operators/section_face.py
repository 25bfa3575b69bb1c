"""Turns the section plane to face along an axis of the model."""

from __future__ import annotations

import bpy

from ..insideout_addon.error_text import error_text
from ..insideout_addon.scene.section import NoSectionError, place_plane, shown_plane, shown_planes
from .needs import NeedsModel

# Towards the hidden side, from which a section is seen: as on section sheets.
_NORMALS = {"X": (1, 0, 0), "Y": (0, -1, 0), "Z": (0, 0, 1)}


def _normal(scene: bpy.types.Scene, axis: str) -> tuple[float, ...]:
    """Of the plane: where it is flipped it is seen from its other side."""
    plane = shown_plane(scene)
    flipped = any(section.flip for section in shown_planes(scene) if section.object == plane)
    return tuple(-part if flipped else part for part in _NORMALS[axis])


class INSIDEOUT_OT_section_face(NeedsModel, bpy.types.Operator):
    """Turn the plane about its middle to be at right angles to this axis of the model, seen as on section sheets"""

    bl_idname = "insideout.section_face"
    bl_label = "Face Axis"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    axis: bpy.props.EnumProperty(
        name="Axis",
        description="The axis of the model, in its own frame, that the plane is at right angles to",
        items=(
            ("X", "X", "At right angles to the model's x, seen from the right"),
            ("Y", "Y", "At right angles to the model's y, seen from the front"),
            ("Z", "Z", "At right angles to the model's z, seen from above"),
        ),
        default="Y",
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if shown_plane(context.scene) is None:
            cls.poll_message_set("Add a section plane first")
            return False
        return super().poll(context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            place_plane(context.scene, normal=_normal(context.scene, self.axis))
        except NoSectionError as error:
            self.report({"ERROR"}, error_text(error))
            return {"CANCELLED"}
        return {"FINISHED"}


CLASSES = (INSIDEOUT_OT_section_face,)
