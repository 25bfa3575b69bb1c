"""Capture: the folder with photos and X-rays."""

from __future__ import annotations

import json
from pathlib import PurePath

import bpy

from ..insideout_addon.engine.commands import absolute
from ..insideout_addon.told_text import displayable, told_text
from .job import draw_job
from .layout import SidebarPanel, wrapped

_ICONS = {"info": "CHECKMARK", "warning": "ERROR", "error": "CANCEL"}


class INSIDEOUT_PT_capture(SidebarPanel, bpy.types.Panel):
    bl_label = "Capture"
    bl_idname = "INSIDEOUT_PT_capture"
    bl_order = 1

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = self.layout, context.scene.insideout
        layout.prop(settings, "capture", text="")
        layout.operator("insideout.check", icon="VIEWZOOM")
        draw_job(layout, context, "capture")
        if not settings.capture:
            wrapped(
                layout,
                "Choose the folder of your photos and X-rays; a finished run is opened under Model",
                context,
                "INFO",
            )
        if not settings.checked or str(absolute(settings.checked)) != displayable(absolute(settings.capture)):
            return
        if not len(settings.findings):
            layout.label(text="No photos and no X-rays found", icon="ERROR")
        box, subject = layout, None
        for finding in settings.findings:
            if finding.subject != subject:
                subject, box = finding.subject, layout.box()
                box.label(text=_within(subject, settings.checked), translate=False)
            message, advice = _texts(finding.told, finding.message, finding.advice)
            wrapped(box, message, context, _ICONS.get(finding.level, "INFO"))
            if advice:
                wrapped(box, advice, context, "BLANK1")


def _texts(told: str, message: str, advice: str) -> tuple[str, str]:
    """A finding's texts in Blender's language; English as they are where the file has no more of them."""
    try:
        known = json.loads(told)
    except ValueError:
        return message, advice
    parts = known if isinstance(known, dict) else {}
    return told_text(parts.get("message"), message), told_text(parts.get("advice"), advice)


def _within(subject: str, capture: str) -> str:
    """A finding's file as seen from the capture folder, which a file browser ends with a slash."""
    path, folder = PurePath(subject), PurePath(capture)
    return str(path.relative_to(folder)) if folder in path.parents else path.name


CLASSES = (INSIDEOUT_PT_capture,)
