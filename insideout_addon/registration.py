"""Registers everything in the order Blender needs, and takes it away again without a trace."""

from __future__ import annotations

from types import ModuleType

import bpy

from . import deleted, preferences, properties, translations
from .engine import curve_icons
from .engine.job import abandon_job
from .physics import copies
from .scene import section_live, sources


def register() -> None:
    """Enables the add-on."""
    translations.attach()
    for cls in _classes():
        bpy.utils.register_class(cls)
    properties.attach()
    section_live.attach()
    sources.attach()
    copies.attach()
    deleted.attach()
    _menus().attach()


def unregister() -> None:
    """Disables the add-on; a running job is ended."""
    abandon_job()
    _menus().detach()
    deleted.detach()
    copies.detach()
    sources.detach()
    section_live.detach()
    properties.detach()
    curve_icons.detach()
    for cls in reversed(_classes()):
        bpy.utils.unregister_class(cls)
    translations.detach()


def _menus() -> ModuleType:
    from ..operators import menus

    return menus


def _classes() -> tuple[type, ...]:
    # Operators and panels stand on this package; only registering reaches up to them.
    from .. import operators, panels

    return (*properties.CLASSES, *preferences.CLASSES, *operators.CLASSES, *panels.CLASSES)
