"""Blender's progress cursor while something takes long, and a way to end it."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager

import bpy
from bpy.app.translations import contexts
from bpy.app.translations import pgettext_iface as iface_
from bpy.app.translations import pgettext_n as n_
from bpy.app.translations import pgettext_rpt as rpt_
from bpy_extras.io_utils import ExportHelper, ImportHelper

from ..core.steps import run_through

# Blender draws, and looks for Esc, so often. Where it draws for longer an operator works for as long, up to so many
# seconds: else nearly all of the time would go into drawing.
_DRAW_S, _MOST_S = 0.05, 0.25
_UNDONE = n_("What this works on was undone or changed before its end; press the button again.")
_CHANGED = n_("What this needs is no longer there, or something else is in work; try again.")


@contextmanager
def waiting(context: bpy.types.Context) -> Iterator[Callable[[float], None]]:
    """A function to call with the share that is done, 0 to 1."""
    manager = context.window_manager
    manager.progress_begin(0.0, 1.0)
    try:
        yield manager.progress_update
    finally:
        manager.progress_end()


class InSteps:
    """An operator that works in steps: in a window Esc ends it, and nothing is changed then.

    Scripts, and Blender without a window, wait for it.
    """

    _steps: Generator[float, None, set[str]] | None = None

    @property
    def in_work(self) -> bool:
        """Whether some of its steps are done, and others are not, in a window."""
        return self._steps is not None

    def steps(self, context: bpy.types.Context) -> Generator[float, None, set[str]]:
        """Yields the share that is done, 0 to 1, and returns what the operator does."""
        raise NotImplementedError

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            with waiting(context) as tick:
                return run_through(self.steps(context), tick)
        except ReferenceError:
            return self._was_undone()

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        return self.execute(context) if bpy.app.background else self.begin(context)

    def begin(self, context: bpy.types.Context) -> set[str]:
        """From here on Blender calls `modal`."""
        manager = context.window_manager
        self._steps, self._left = self.steps(context), time.monotonic()
        self._timer = manager.event_timer_add(_DRAW_S, window=context.window)
        manager.progress_begin(0.0, 1.0)
        manager.modal_handler_add(self)
        # What is greyed out from now on.
        _redraw_sidebars(context)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Until it is done everything but Esc waits: what is worked on is not to change meanwhile."""
        if event.type == "ESC":
            self.cancel(context)
            return {"CANCELLED"}
        if event.type != "TIMER":
            return {"RUNNING_MODAL"}
        now, share = time.monotonic(), 0.0
        until = now + min(max(_DRAW_S, now - self._left), _MOST_S)
        try:
            while time.monotonic() < until:
                share = next(self._steps)
        except StopIteration as end:
            self.cancel(context)
            return end.value
        except ReferenceError:
            # Each break is one in which another window may undo something.
            self.cancel(context)
            return self._was_undone()
        except BaseException:
            self.cancel(context)
            raise
        context.window_manager.progress_update(share)
        text, name = iface_("{name}: {share}   Esc: Cancel"), iface_(self.bl_label, contexts.operator_default)
        # A label ends so where a dialog comes first.
        told = text.format(name=name.removesuffix("..."), share=f"{share:.0%}")
        context.workspace.status_text_set(told)
        self._left = time.monotonic()
        return {"RUNNING_MODAL"}

    def _was_undone(self) -> set[str]:
        self.report({"ERROR"}, rpt_(_UNDONE))
        return {"CANCELLED"}

    def cancel(self, context: bpy.types.Context) -> None:
        """Leaves nothing behind; Blender calls it too, where the window is closed, or a dialog before the work is."""
        steps, self._steps = self._steps, None
        if steps is None:
            return
        try:
            # Takes away what was made so far, which may fail.
            steps.close()
        finally:
            context.window_manager.event_timer_remove(self._timer)
            context.window_manager.progress_end()
            context.workspace.status_text_set(None)
            # Blender draws the sidebar anew where the mouse is, and it may be elsewhere by now.
            for area in context.window.screen.areas:
                area.tag_redraw()
            _redraw_sidebars(context)


def _redraw_sidebars(context: bpy.types.Context) -> None:
    """In all windows."""
    for area in [area for window in context.window_manager.windows for area in window.screen.areas]:
        for region in area.regions:
            if region.type == "UI":
                region.tag_redraw()


class AskedInSteps(InSteps):
    """An operator that works in steps after a dialog in which its settings are chosen.

    Its `bl_options` are without REGISTER: with it Blender's Adjust Last Operation would run it anew at every change of
    a setting, at once and to its end, with nothing drawn meanwhile and no Esc; it takes no operator that goes on.
    """

    _asked = False

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether it can be used now."""
        return True

    def ask(self, context: bpy.types.Context) -> set[str]:
        """Shows the dialog, after which Blender calls `execute`."""
        raise NotImplementedError

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        self._asked = not bpy.app.background
        return self.ask(context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        if not self._asked:
            return super().execute(context)
        # Blender asked this before the dialog, and much may happen while that is open.
        if not self.poll(context):
            self.report({"ERROR"}, rpt_(_CHANGED))
            return {"CANCELLED"}
        return self.begin(context)


class SavedInSteps(AskedInSteps, ExportHelper):
    """An operator that works in steps after a file browser in which its file and settings are chosen."""

    def ask(self, context: bpy.types.Context) -> set[str]:
        return ExportHelper.invoke(self, context, None)


class OpenedInSteps(AskedInSteps, ImportHelper):
    """An operator that works in steps after a file browser in which the file it reads is chosen."""

    def ask(self, context: bpy.types.Context) -> set[str]:
        return ImportHelper.invoke(self, context, None)
