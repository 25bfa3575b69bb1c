"""Operators that work in steps: a script waits, a window goes on drawing and Esc ends them."""

from __future__ import annotations

from types import SimpleNamespace

import bpy
import pytest

from insideout import operators
from insideout.operators import waiting
from insideout.operators.waiting import AskedInSteps, InSteps

_SIDEBARS = ["tag_redraw UI", "tag_redraw UI", "tag_redraw in another window"]
_ENDED = ["event_timer_remove", "progress_end", "status", "tag_redraw", "tag_redraw", *_SIDEBARS]


class _Work(InSteps):
    bl_label = "Work"

    def __init__(self, steps=5, fails=False):
        self.count, self.fails, self.made, self.closed = steps, fails, [], False

    def steps(self, context):
        try:
            for step in range(self.count):
                self.made.append(step)
                if self.fails and step == 2:
                    raise ZeroDivisionError
                yield step / self.count
        finally:
            self.closed = True
        return {"FINISHED"}


@pytest.fixture
def window(monkeypatch):
    """A window of which one sees what is called; each of Blender's moments is long enough for one step."""
    told = []

    def note(name):
        return lambda *values, **_: told.append((name, *values)) or name

    manager = SimpleNamespace(
        **{
            name: note(name)
            for name in (
                "progress_begin",
                "progress_update",
                "progress_end",
                "event_timer_add",
                "event_timer_remove",
                "modal_handler_add",
            )
        }
    )
    monkeypatch.setattr(waiting, "bpy", SimpleNamespace(app=SimpleNamespace(background=False)))
    monkeypatch.setattr(waiting, "time", SimpleNamespace(monotonic=iter(x * 0.03 for x in range(1000)).__next__))
    workspace = SimpleNamespace(status_text_set=note("status"))
    kinds = ("WINDOW", "UI")
    regions = [SimpleNamespace(type=kind, tag_redraw=note(f"tag_redraw {kind}")) for kind in kinds]
    areas = [SimpleNamespace(tag_redraw=note("tag_redraw"), regions=regions) for _ in range(2)]
    window = SimpleNamespace(screen=SimpleNamespace(areas=areas))
    other = SimpleNamespace(tag_redraw=note("tag_redraw in another window"), type="UI")
    manager.windows = [window, SimpleNamespace(screen=SimpleNamespace(areas=[SimpleNamespace(regions=[other])]))]
    return SimpleNamespace(window_manager=manager, workspace=workspace, window=window, told=told)


def _event(kind):
    return SimpleNamespace(type=kind)


def _names(window):
    return [name for name, *_ in window.told]


def test_a_script_waits_for_it(blender):
    work = _Work()
    assert work.execute(bpy.context) == {"FINISHED"}
    assert work.made == list(range(5))


def test_without_a_window_a_button_waits_too(blender):
    assert _Work().invoke(bpy.context, None) == {"FINISHED"}


def test_in_a_window_it_goes_on_step_by_step(window):
    work = _Work()
    assert work.invoke(window, None) == {"RUNNING_MODAL"}
    assert work.made == []
    assert _names(window)[-4:] == ["modal_handler_add", *_SIDEBARS]
    results = [work.modal(window, _event("TIMER")) for _ in range(6)]
    assert results == [*[{"RUNNING_MODAL"}] * 5, {"FINISHED"}]
    assert [values for name, *values in window.told if name == "progress_update"] == [[0.0], [0.2], [0.4], [0.6], [0.8]]
    assert ("status", "Work: 40%   Esc: Cancel") in window.told
    assert _names(window)[-8:] == _ENDED
    assert window.told[-6] == ("status", None)


@pytest.mark.parametrize(("drawn_s", "made"), [(0.0, 1), (0.15, 5), (4.0, 8)])
def test_where_blender_draws_long_it_works_as_long(window, monkeypatch, drawn_s, made):
    """But not so long that Esc would not be heard."""
    clock = [0.0]

    def monotonic():
        clock[0] += 0.03
        return clock[0]

    monkeypatch.setattr(waiting, "time", SimpleNamespace(monotonic=monotonic))
    work = _Work(100)
    work.invoke(window, None)
    clock[0] += drawn_s
    work.modal(window, _event("TIMER"))
    assert len(work.made) == made


def test_esc_ends_it(window):
    work = _Work()
    work.invoke(window, None)
    work.modal(window, _event("TIMER"))
    assert work.modal(window, _event("ESC")) == {"CANCELLED"}
    assert work.closed
    assert work.made == [0]
    assert {"event_timer_remove", "progress_end"} <= set(_names(window))


def test_everything_else_waits(window):
    work = _Work()
    work.invoke(window, None)
    assert work.modal(window, _event("LEFTMOUSE")) == {"RUNNING_MODAL"}
    assert work.made == []


def test_an_error_leaves_no_timer_behind(window):
    work = _Work(fails=True)
    work.invoke(window, None)
    work.modal(window, _event("TIMER"))
    work.modal(window, _event("TIMER"))
    with pytest.raises(ZeroDivisionError):
        work.modal(window, _event("TIMER"))
    assert {"event_timer_remove", "progress_end"} <= set(_names(window))


class _Stuck(_Work):
    def steps(self, context):
        try:
            yield from super().steps(context)
        finally:
            raise ReferenceError("the model is gone")


@pytest.mark.parametrize("end", [lambda work, window: work.modal(window, _event("ESC")), _Stuck.cancel])
def test_where_nothing_can_be_taken_back_no_timer_is_left_either(window, end):
    work = _Stuck()
    work.invoke(window, None)
    work.modal(window, _event("TIMER"))
    with pytest.raises(ReferenceError, match="the model is gone"):
        end(work, window)
    assert _names(window)[-8:] == _ENDED
    work.cancel(window)
    assert _names(window).count("event_timer_remove") == 1


class _Undone(_Work):
    def __init__(self):
        super().__init__()
        self.told = []

    def report(self, kinds, text):
        self.told.append((kinds, text))

    def steps(self, context):
        yield from super().steps(context)
        raise ReferenceError("StructRNA of type Object has been removed")


_UNDONE = [({"ERROR"}, "What this works on was undone or changed before its end; press the button again.")]


def test_what_is_undone_in_a_break_is_told(window):
    work = _Undone()
    work.invoke(window, None)
    while (answer := work.modal(window, _event("TIMER"))) == {"RUNNING_MODAL"}:
        pass
    assert answer == {"CANCELLED"}
    assert work.told == _UNDONE
    assert _names(window)[-8:] == _ENDED
    assert not work.in_work


def test_so_it_is_where_nothing_is_drawn(window):
    work = _Undone()
    assert work.execute(window) == {"CANCELLED"}
    assert work.told == _UNDONE


class _Asked(AskedInSteps, _Work):
    bl_label = "Work..."

    def ask(self, context):
        self.asked = True
        return {"RUNNING_MODAL"}


def test_after_its_dialog_it_goes_on_step_by_step(window):
    work = _Asked()
    assert work.invoke(window, None) == {"RUNNING_MODAL"}
    assert work.asked
    assert window.told == []
    assert work.execute(window) == {"RUNNING_MODAL"}
    assert work.made == []
    assert _names(window)[:3] == ["event_timer_add", "progress_begin", "modal_handler_add"]
    results = [work.modal(window, _event("TIMER")) for _ in range(6)]
    assert results[-1] == {"FINISHED"}
    assert ("status", "Work: 40%   Esc: Cancel") in window.told


def test_sidebars_of_all_windows_are_drawn_anew_when_it_begins_and_ends(window):
    """What is greyed out meanwhile is so in all of them."""
    work = _Work()
    work.begin(window)
    assert _names(window).count("tag_redraw in another window") == 1
    work.cancel(window)
    assert _names(window).count("tag_redraw in another window") == 2


def test_what_it_needs_is_asked_again_after_the_dialog(window):
    """The model may be gone by then, or another operator at work."""
    work, told = _Asked(), []
    work.report = lambda kinds, text: told.append(text)
    work.invoke(window, None)
    work.poll = lambda context: False
    assert work.execute(window) == {"CANCELLED"}
    assert told == ["What this needs is no longer there, or something else is in work; try again."]
    assert (work.made, window.told) == ([], [])


def _all_asked():
    return [cls for cls in operators.CLASSES if issubclass(cls, AskedInSteps)]


def _options(cls):
    return getattr(cls, "bl_options", set())


@pytest.mark.parametrize("cls", _all_asked(), ids=lambda cls: cls.bl_idname)
def test_settings_are_not_changed_afterwards(blender, cls):
    """Adjust Last Operation, where Blender puts what registers, would run it again in one go, deaf to Esc."""
    assert "REGISTER" not in _options(cls)


def test_what_changes_the_scene_can_be_undone_all_the_same(blender):
    undone = {
        cls.bl_idname.removeprefix("insideout.") for cls in _all_asked() if "UNDO" in getattr(cls, "bl_options", ())
    }
    assert undone == {
        *("weigh", "break_model", "make_rigid", "make_soft", "bake_physics"),
        *("import_file", "relink", "apply_transform"),
    }


@pytest.mark.parametrize("name", ["weigh", "break_model", "make_rigid", "make_soft", "section_sheet"])
def test_settings_are_kept_as_presets(blender, name):
    """As the "+" of Blender's dialogs writes them: all that is chosen, but no file and nothing that is one model's, as
    its scan's water is."""
    cls = getattr(bpy.types, f"INSIDEOUT_OT_{name}")
    assert "PRESET" in cls.bl_options
    kept = bpy.types.WM_OT_operator_preset_add.preset_values.fget(SimpleNamespace(operator=f"INSIDEOUT_OT_{name}"))
    chosen = set(cls.__annotations__) - {"filepath", "filter_glob", "impact", "mesh", "water", "density_factor"}
    assert {value.removeprefix("op.") for value in kept} == chosen


def test_a_script_is_asked_nothing_and_waits(window):
    work = _Asked()
    assert work.execute(window) == {"FINISHED"}
    assert not hasattr(work, "asked")


def test_without_a_window_it_waits_after_the_dialog_too(blender):
    work = _Asked()
    work.invoke(bpy.context, None)
    assert work.execute(bpy.context) == {"FINISHED"}


def test_a_dialog_that_is_dismissed_leaves_nothing(window):
    """Blender calls `cancel` then."""
    work = _Asked()
    work.invoke(window, None)
    work.cancel(window)
    assert window.told == []


@pytest.mark.parametrize(
    ("name", "asks"),
    [
        *((name, True) for name in ("break_model", "make_rigid", "make_soft", "bake_physics")),
        *((name, True) for name in ("weigh", "section_sheet", "histogram_save")),
        *((name, False) for name in ("thickness", "look_prepare", "color_by")),
        *((name, True) for name in ("thickness_save", "section_save", "contours_save")),
        *((name, False) for name in ("contours_curve", "import_run", "scan_read")),
        *((name, True) for name in ("import_file", "export_file", "apply_transform")),
    ],
)
def test_what_takes_long_can_be_ended(blender, name, asks):
    cls = getattr(bpy.types, f"INSIDEOUT_OT_{name}")
    assert issubclass(cls, InSteps)
    assert issubclass(cls, AskedInSteps) == asks
    # Blender looks for these in the class.
    assert all(callable(getattr(cls, method)) for method in ("execute", "invoke", "modal", "cancel", "steps"))
