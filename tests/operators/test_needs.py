"""Why a button is greyed out."""

from __future__ import annotations

from types import SimpleNamespace

import bpy
import pytest

from insideout import operators
from insideout.insideout_addon import in_work
from insideout.operators import needs
from insideout.operators.waiting import AskedInSteps, InSteps


@pytest.fixture
def busy(blender, tmp_path, random_set, monkeypatch):
    """`busy(operator)` runs in one of Blender's windows; a model is there, cut and shown."""
    random_set.save(tmp_path / "fused.ply")
    bpy.context.scene.insideout.pixels = 32
    bpy.ops.insideout.import_run(filepath=str(tmp_path / "fused.ply"))
    bpy.ops.insideout.section_add()
    return lambda running: monkeypatch.setattr(in_work, "modal_operators", lambda: [running])


class _Working(InSteps):
    _steps = iter(())


class _Asking(AskedInSteps):
    """Its file browser is open."""


def _offered():
    found = set()
    for cls in operators.CLASSES:
        group, name = cls.bl_idname.split(".")
        if getattr(getattr(bpy.ops, group), name).poll():
            found.add(cls)
    return found


def test_while_one_works_in_steps_no_other_is_offered_that_would_change_what_it_works_on(busy):
    before = _offered()
    in_steps = {cls for cls in before if issubclass(cls, InSteps)}
    assert len(in_steps) > 12
    busy(_Working())
    during = _offered()
    assert not during & in_steps
    _assert_only_the_engine_is_offered(during)


def test_nor_while_a_timer_imports_the_result_of_a_run(busy):
    def timer():
        return 1.0

    before = _offered()
    bpy.app.timers.register(timer, first_interval=1e6)
    in_work.note_import(timer, goes_on=True)
    during = _offered()
    assert during < before
    _assert_only_the_engine_is_offered(during)
    in_work.note_import(timer, goes_on=False)
    assert _offered() == before, "it waits"
    in_work.note_import(timer, goes_on=True)
    bpy.app.timers.unregister(timer)
    assert _offered() == before, "its timer is gone, as where another file is opened"


def _assert_only_the_engine_is_offered(during):
    assert {cls.bl_idname for cls in during} <= {
        *("insideout.engine_check", "insideout.engine_setup", "insideout.forecast"),
        *("insideout.check", "insideout.reconstruct", "insideout.cancel"),
    }


@pytest.mark.parametrize("running", [SimpleNamespace(bl_idname="VIEW3D_OT_rotate"), _Asking()])
def test_what_is_not_ours_or_has_not_begun_disturbs_nobody(busy, running):
    before = _offered()
    busy(running)
    assert _offered() == before


def test_what_needs_a_model_and_a_plane_is_not_offered_when_the_model_is_gone(busy):
    """Its file browser would be filled in for nothing."""
    through_a_plane = {cls for cls in operators.CLASSES if issubclass(cls, needs.NeedsPlane)}
    assert len(through_a_plane) >= 4
    assert through_a_plane <= _offered()
    bpy.data.objects.remove(bpy.context.scene.insideout.model)
    assert not through_a_plane & _offered()
    with pytest.raises(RuntimeError, match="Import a model first"):
        bpy.ops.insideout.section_save(filepath="section.png")


def test_which_run_is_asked_of_blenders_windows(blender):
    assert in_work.modal_operators() == []
    assert needs.nothing_in_work(bpy.types.INSIDEOUT_OT_section_add)
