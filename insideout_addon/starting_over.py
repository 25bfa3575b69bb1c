"""Whether the next run starts over: in the scene where that was ticked, and in no other.

It is kept on the window manager. On the scene an undo would bring it back after the run that it was for, and the next
one would discard what that one has made.
"""

import bpy


def _starts_over(state: bpy.types.PropertyGroup) -> bool:
    return state.start_over_in == bpy.context.scene.session_uid


def _set_starts_over(state: bpy.types.PropertyGroup, value: bool) -> None:
    # A window manager has all scenes, and may stay when a file is opened: numbers of that file's scenes are new.
    state.start_over_in = bpy.context.scene.session_uid if value else 0


OF_ONE_SCENE = {"get": _starts_over, "set": _set_starts_over}
