"""A run's curve in the sidebar: while it goes on, when it is done, and of a model that was imported."""

from __future__ import annotations

import json
import shutil

import bpy
import pytest

from insideout.insideout_addon.engine import curve_icons
from insideout.insideout_addon.engine.curve_picture import CurvePoint
from insideout.panels import CLASSES

CURVE = [
    {"stage": "surface", "part": "rgb", "iteration": 9, "seconds": 20.0, "splats": 5, "photos": 22.7},
    {"stage": "surface", "part": "xray", "iteration": 9, "seconds": 60.0, "splats": 5, "projections": 39.2},
    {"stage": "report", "part": "", "seconds": 124.0, "photos": 28.5, "projections": 42.2},
]
NOTHING_YET = ["–"] * 5 + ["", "Photos: –", "Projections: –", "–"]


@pytest.fixture
def draw(draw_panels):
    """`draw(name)`: the texts of one of the two panels; [] where it is not shown."""
    panels = {cls.bl_idname.removeprefix("INSIDEOUT_PT_"): cls for cls in CLASSES}
    return lambda name, width=300: draw_panels(width, [panels[f"{name}_curve"]])


@pytest.fixture
def run(tmp_path, random_set):
    run = tmp_path / "run"
    random_set.save(run / "fused.ply")
    (run / "report.json").write_text(json.dumps({"stages": {}, "curve": CURVE}), "utf-8")
    return run


def _state():
    return bpy.context.window_manager.insideout


def test_without_a_run_there_is_none(draw):
    assert draw("run") == draw("model") == []
    assert curve_icons._collections == []


def test_a_run_that_has_measured_nothing_yet_has_an_empty_one(draw):
    _state().stages.add().name = "initialize"
    assert [text for text in draw("run") if text] == [text for text in NOTHING_YET if text]


def test_decibels_stand_beside_it_and_what_was_reached_below(draw):
    _state().stages.add().name = "surface"
    _state().curve = json.dumps(CURVE)
    assert draw("run") == [
        "45 dB", "40 dB", "35 dB", "30 dB", "25 dB", "20 dB",
        "Photos: 28.5 dB", "Projections: 42.2 dB", "After 2 min 4 s",
    ]  # fmt: skip
    _state().curve = json.dumps(CURVE[:1])
    assert draw("run")[-3:] == ["Photos: 22.7 dB", "Projections: –", "After 20 s"]


def test_a_run_shows_its_points_as_they_are_measured(draw, make_engine, tmp_path, monkeypatch):
    """What the engine sends to Blender, and the sidebar after each message."""
    from insideout.insideout_addon.engine import job

    make_engine(
        "send('progress', stage='capture', fraction=0.5); time.sleep(0.2)\n"
        "point = {'iteration': 9, 'seconds': 20.0, 'splats': 5, 'photos': 22.7}\n"
        "send('progress', stage='surface', part='rgb', fraction=0.5, heldout=[point]); time.sleep(0.2)\n"
        f"send('done', report={{'curve': {CURVE!r}}})\n"
    )
    settings, drawn, handle = bpy.context.scene.insideout, [], job._handle
    settings.capture, settings.import_when_done = str(tmp_path), False

    def look(running, message):
        handle(running, message)
        drawn.append([text for text in draw("run") if text.startswith(("Photos", "Projections"))])

    monkeypatch.setattr(job, "_handle", look)
    assert bpy.ops.insideout.reconstruct() == {"FINISHED"}
    assert drawn[0] == ["Photos: –", "Projections: –"]
    assert drawn[-1] == ["Photos: 22.7 dB", "Projections: –"]
    _state().stages.add().name = "surface"
    assert draw("run")[-3:] == ["Photos: 28.5 dB", "Projections: 42.2 dB", "After 2 min 4 s"]


def test_it_does_not_come_and_go_while_times_are_estimated(draw, make_engine, tmp_path, monkeypatch):
    from insideout.insideout_addon.engine import job

    make_engine("send('progress', stage='capture', fraction=0.5); time.sleep(0.2); send('done')\n")
    drawn, handle = [], job._handle
    bpy.context.scene.insideout.capture = str(tmp_path)
    monkeypatch.setattr(job, "_handle", lambda *told: (handle(*told), drawn.append(draw("run"))))
    assert bpy.ops.insideout.forecast() == {"FINISHED"}
    assert drawn == [[], []]


def test_an_imported_model_shows_the_curve_of_its_run(draw, run):
    bpy.context.scene.insideout.run = str(run)
    bpy.ops.insideout.import_run()
    assert draw("model")[-3:] == ["Photos: 28.5 dB", "Projections: 42.2 dB", "After 2 min 4 s"]
    assert draw("run") == []
    assert curve_icons._shown["model"][0] == CurvePoint("surface", "rgb", 20.0, photos=22.7)
    shutil.rmtree(run)
    assert draw("model")[-3:] == ["Photos: 28.5 dB", "Projections: 42.2 dB", "After 2 min 4 s"]


def test_a_model_of_no_run_shows_none(draw, tmp_path, random_set):
    random_set.save(tmp_path / "other.ply")
    bpy.ops.insideout.import_run(filepath=str(tmp_path / "other.ply"))
    assert draw("model") == []


@pytest.mark.parametrize("width", [1, 120, 300, 2000])
def test_at_any_width_the_levels_are_as_high_as_the_picture(blender, width):
    from types import SimpleNamespace

    from insideout.panels.curve import draw_curve

    heights = {}

    class Layout:
        """Adds up what stands beside the picture."""

        scale_y, levels = 1.0, 0

        def split(self, factor):
            assert 0.0 < factor < 0.5
            return self

        def row(self, **_):
            return self

        def column(self, **_):
            column = Layout()
            heights.setdefault("levels", column)
            return column

        def label(self, **_):
            self.levels += 1

        def template_icon(self, icon_value, scale):
            heights["picture"] = scale

    context = SimpleNamespace(region=SimpleNamespace(width=width), preferences=bpy.context.preferences)
    draw_curve(Layout(), (CurvePoint("surface", "rgb", 10.0, photos=20.0),), "run", context)
    assert heights["levels"].levels * heights["levels"].scale_y == pytest.approx(heights["picture"])
    assert 5 <= heights["picture"] <= 14
