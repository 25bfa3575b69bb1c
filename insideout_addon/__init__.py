"""The add-on inside Blender: registration, properties, the engine process, and scene building."""

from __future__ import annotations


def register() -> None:
    """Enables the add-on."""
    from . import registration

    registration.register()


def unregister() -> None:
    """Disables the add-on."""
    from . import registration

    registration.unregister()
