"""Capture: the folder with photos and X-rays."""

from __future__ import annotations

import bpy

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
        if settings.checked != bpy.path.abspath(settings.capture):
            return
        box = layout.box()
        for finding in settings.findings:
            icon = _ICONS.get(finding.level, "INFO")
            wrapped(box, f"{finding.subject}: {finding.message}", context, icon)
            if finding.advice:
                wrapped(box, finding.advice, context, "BLANK1")
        if not len(settings.findings):
            box.label(text="Nothing found")


CLASSES = (INSIDEOUT_PT_capture,)
