"""`insideout bench affine`: what the cheaper mode of the radiograph loses and saves."""

import json

import pytest
from typer.testing import CliRunner

from insideout.core.bench.affine import MODES, PLACES, SIGMAS, measure_errors, measure_times
from insideout.core.bench.scenes import scene
from insideout.core.cli import app
from insideout.core.errors import SettingError


def test_a_balls_error_grows_with_its_size_and_beside_the_axis():
    rows = {(row["sigma"], row["place"]): row["peak_error"] for row in measure_errors()}
    assert set(rows) == {(sigma, place) for sigma in SIGMAS for place in PLACES}
    for place in PLACES:
        errors = [rows[sigma, place] for sigma in SIGMAS]
        assert errors == sorted(errors)
    assert all(rows[sigma, 0.2] > rows[sigma, 0.0] for sigma in SIGMAS)
    # A known value: 0.2 at 5 units, σ² = 0.0016 of the squared distance.
    assert rows[0.04, 0.0] == pytest.approx(1.7e-3, rel=0.1)


def test_both_modes_are_timed_on_the_same_scene():
    rows = measure_times(scene(500, 40), repeats=1)
    assert [row["mode"] for row in rows] == list(MODES)
    for row in rows:
        assert (row["splats"], row["width"], row["height"]) == (500, 40, 40)
        assert row["step_ms"] == pytest.approx(row["forward_ms"] + row["backward_ms"], abs=1e-3)
        assert row["step_ms"] > 0
    assert rows[0]["image_error"] == 0
    assert 0 < rows[1]["image_error"] < 0.1


def test_the_command_prints_and_saves_both_tables(tmp_path):
    path = tmp_path / "rows.json"
    done = CliRunner().invoke(
        app, ["bench", "affine", "--splats", "300", "--size", "30", "--json", str(path), "--markdown"]
    )
    assert done.exit_code == 0, done.output
    assert "A step of the radiograph in both modes" in done.output
    assert "What the affine mode errs by" in done.output
    rows = json.loads(path.read_text())
    assert len(rows) == len(MODES) + len(SIGMAS) * len(PLACES)
    assert all(row["cores"] >= 1 for row in rows)


def test_a_scene_without_splats_is_refused():
    done = CliRunner().invoke(app, ["bench", "affine", "--splats", "0"])
    assert isinstance(done.exception, SettingError)
