"""`insideout bench cut`: the section that follows a plane, at rest and while it moves."""

import json

import pytest
from typer.testing import CliRunner

from insideout.core.bench.cut import measure_cuts
from insideout.core.cli import app
from insideout.core.errors import SettingError


def test_the_moving_section_differs_by_the_faint_rims_alone():
    row = measure_cuts(3000, 96, positions=3)
    assert 0 < row["rms_difference"] < 0.01
    assert row["rms_difference"] < row["largest_difference"] < 0.05


def test_a_row_says_how_often_the_section_can_be_drawn():
    row = measure_cuts(500, 40, positions=2)
    assert (row["splats"], row["width"], row["height"]) == (500, 40, 40)
    assert row["updates"] == pytest.approx(1e3 / row["moving_ms"])
    assert min(row["prepare_ms"], row["exact_ms"]) > 0


def test_the_command_prints_and_saves_a_row_for_each_number_of_splats(tmp_path):
    path = tmp_path / "rows.json"
    done = CliRunner().invoke(
        app, ["bench", "cut", "--splats", "100,200", "--size", "30", "--positions", "2", "--json", str(path)]
    )
    assert done.exit_code == 0, done.output
    assert [row["splats"] for row in json.loads(path.read_text())] == [100, 200]


def test_no_places_are_refused():
    done = CliRunner().invoke(app, ["bench", "cut", "--splats", "100", "--positions", "0"])
    assert isinstance(done.exception, SettingError)
