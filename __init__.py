"""InsideOut: one 3D Gaussian model of an object from photos and X-rays.

The folder is a Blender extension and the Python package `insideout` at once; without bpy only the engine in
`core` is used.
"""

__version__ = "0.1.0"


def register() -> None:
    """Called by Blender when the extension is enabled."""
    from . import insideout_addon

    insideout_addon.register()


def unregister() -> None:
    """Called by Blender when the extension is disabled."""
    from . import insideout_addon

    insideout_addon.unregister()
