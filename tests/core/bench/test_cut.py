"""`insideout bench cut`: the section that follows a plane, at rest and while it moves."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from insideout.core.bench.cut import measure_cuts
from insideout.core.cli import app
from insideout.core.errors import GaussianFileError, SettingError
from insideout.core.gaussians import GaussianSet


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


def test_a_model_of_one_s_own_has_a_row(tmp_path):
    path, model = tmp_path / "rows.json", tmp_path / "model.ply"
    cloud = np.random.default_rng(0).normal(size=(300, 3)) * (20, 10, 30)
    density = np.where(np.arange(300) < 200, 0.02, 0)
    GaussianSet.create(cloud, np.full((300, 3), 1.5), density=density).save(model)
    options = ["--splats", "100", "--size", "30", "--positions", "2", "--model", str(model), "--json", str(path)]
    done = CliRunner().invoke(app, ["bench", "cut", *options])
    assert done.exit_code == 0, done.output
    assert "model" in done.output
    row = json.loads(path.read_text())[1]
    assert (row["of"], row["splats"], row["width"]) == ("model", 200, 30)
    assert 0 < row["largest_difference"] < 0.05


def test_a_model_without_density_is_refused():
    with pytest.raises(GaussianFileError, match="photos has no splats"):
        measure_cuts(GaussianSet.create(np.zeros((4, 3)), np.ones((4, 3))), 20, positions=2, name="photos")


def test_no_places_are_refused():
    done = CliRunner().invoke(app, ["bench", "cut", "--splats", "100", "--positions", "0"])
    assert isinstance(done.exception, SettingError)
