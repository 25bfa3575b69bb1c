"""What is known of a model's densities is known of the splats of its pieces."""

from __future__ import annotations

import json

import bpy
import pytest

from insideout.core.capture.volumes import MU_WATER_PER_MM, RELATIVE
from insideout.insideout_addon.physics.breaking import BreakOptions, break_model
from insideout.insideout_addon.scene.importing import densities_are_relative, warnings_of
from insideout.insideout_addon.scene.weighing import water_per_mm

WATER = 0.03


@pytest.fixture
def piece_of(imported, hollow_ball, tmp_path):
    """`piece_of(**report)`: the splats of a piece, shown, of a run whose report says so."""

    def break_run(**report):
        (tmp_path / "run").mkdir()
        (tmp_path / "run" / "report.json").write_text(json.dumps({"stages": {}, **report}), "utf-8")
        model = imported(*hollow_ball)
        piece, *_ = break_model(model, bpy.context, BreakOptions(pieces=3, spacing_mm=4.0, show="SPLATS"))
        bpy.context.scene.insideout.model = piece.children[0]
        return piece.children[0]

    return break_run


def test_a_piece_has_the_water_of_the_models_scan(piece_of):
    piece = piece_of(water_per_mm=WATER)
    assert bpy.context.scene.insideout.water == pytest.approx(WATER)
    assert water_per_mm(piece, bpy.context.scene) == pytest.approx(WATER)


def test_a_piece_of_a_model_in_grey_values_is_in_grey_values(piece_of):
    piece = piece_of(warnings=[f"Densities are {RELATIVE}."])
    assert densities_are_relative(piece)
    assert water_per_mm(piece, bpy.context.scene) == MU_WATER_PER_MM
    assert warnings_of(piece) == [f"Densities are {RELATIVE}."]
