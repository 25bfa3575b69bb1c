"""`insideout bench agreement`: what a row says, when a bar is broken, and which scene broke it."""

import json
import re

import numpy as np
import pytest
from typer.testing import CliRunner

from insideout.core.bench import agreement, kernels
from insideout.core.bench.agreement import Row, compare, measure_agreement
from insideout.core.cli import app
from insideout.core.errors import Cancelled, SettingError
from insideout.core.progress import Reporter
from insideout.core.render import card
from insideout.core.render.agreement import scene_errors

SCHEMA = {
    "renderer", "parameter", "scenes", "largest", "median", "percentile95", "over_value_bar", "over_gradient_bar",
    "worst_scene", "bar", "over_bar", "kernel", "seed", "date", "cpu", "cores", "versions",
}  # fmt: skip


def bench(*options):
    return CliRunner().invoke(app, ["bench", "agreement", *map(str, options)])


@pytest.fixture
def one_bad_scene(monkeypatch):
    """Scene 7 of `section` errs by 2e-3 in the gradient by the quaternions."""

    def errors(renderer, scene, *_):
        bad = renderer == "section" and scene == 7
        return {"image": 5e-7, "quats": 2e-3 if bad else 1e-5}

    monkeypatch.setattr(agreement, "scene_errors", errors)


def test_a_row_is_about_the_errors_of_its_scenes():
    scenes = range(3, 8)
    by_scene = {scene: scene_errors("section", scene) for scene in scenes}
    for row in compare("section", scenes):
        errors = {scene: found[row.parameter] for scene, found in by_scene.items() if row.parameter in found}
        assert row.scenes == len(errors)
        assert row.largest == errors[row.worst_scene] == max(errors.values())
        assert row.median == np.median(list(errors.values()))


def test_every_renderer_is_compared_in_value_and_in_every_gradient():
    found = {(row.renderer, row.parameter) for row in measure_agreement(scenes=6)}
    shared = {"image", "means", "quats", "scales"}
    own = {
        "splat": {"opacities", "sh", "pose"},
        "radiograph": {"density", "pose"},
        "section": {"density", "opacities", "sh"},
    }
    assert found == {(renderer, name) for renderer, names in own.items() for name in names | shared}


def test_figures_of_known_errors():
    row = Row.of("splat", "means", {scene: 1e-6 * (scene + 1) for scene in range(100)} | {100: 5e-4, 101: 2e-3})
    assert (row.scenes, row.worst_scene, row.largest) == (102, 101, 2e-3)
    assert row.median == pytest.approx(51.5e-6)
    assert row.percentile95 == pytest.approx(97e-6)
    assert (row.over_value_bar, row.over_gradient_bar, row.over_bar) == (2, 1, 1)


@pytest.mark.parametrize(("parameter", "bar"), [("image", 1e-4), ("means", 1e-3)])
def test_images_have_the_lower_bar(parameter, bar):
    below, above = (Row.of("splat", parameter, {0: factor * bar}) for factor in (0.99, 1.01))
    assert (below.over_bar, below.complaint) == (0, "")
    assert above.over_bar == 1
    assert f"bar {bar:.0e}" in above.complaint


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_an_error_that_is_not_finite_is_the_largest(wrong):
    row = Row.of("splat", "sh", {0: 1e-6, 1: wrong, 2: 1e-6})
    assert (row.worst_scene, row.largest, row.over_bar) == (1, np.inf, 1)
    assert np.isfinite([row.median]).all()


def test_a_complaint_holds_the_call_that_gives_the_error_again():
    error = scene_errors("splat", 4)["means"]
    row = Row("splat", "means", 1, error, error, error, 1, 1, 4)
    call = re.search(r"core\.render\.agreement\.(scene_errors\(.*?\))", row.complaint).group(1)
    assert eval(call, {"scene_errors": scene_errors})["means"] == error


def test_it_tells_where_it_is_and_stops_when_asked():
    heard, asked = [], iter(range(100))
    reporter = Reporter(heard.append, is_cancelled=lambda: next(asked) >= 3)
    with pytest.raises(Cancelled):
        compare("section", range(10), reporter=reporter)
    assert next(asked) == 4, "asked once a scene"
    assert heard[0].part == "section"
    assert (heard[0].iteration, heard[0].iterations) == (1, 10)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"scenes": 0}, "--scenes"),
        ({"seed": -1}, "--seed"),
        ({"renderers": ("photo",)}, "photo"),
        ({"kernel": "gpu"}, "gpu"),
    ],
)
def test_what_cannot_be_compared_is_named(options, named):
    with pytest.raises(SettingError, match=named):
        measure_agreement(**options)


@pytest.mark.parametrize("measure", [lambda: measure_agreement(kernel="cuda"), lambda: kernels._device("cuda")])
def test_a_kernel_that_is_not_installed_is_named(measure, monkeypatch):
    monkeypatch.setattr(card, "find_spec", lambda name: None)
    with pytest.raises(SettingError, match="Warp is not installed"):
        measure()


def test_the_command_prints_a_table_and_saves_the_rows(tmp_path):
    target = tmp_path / "agreement.json"
    ran = bench("--scenes", 2, "--seed", 5, "--renderer", "radiograph", "--json", target, "--markdown")
    assert ran.exit_code == 0, ran.output
    assert "| renderer | parameter | scenes | median | 95 % | largest |" in ran.output
    rows = json.loads(target.read_text())
    assert all(set(row) >= SCHEMA for row in rows)
    assert {row["worst_scene"] for row in rows} <= {5, 6}
    assert rows[0]["largest"] == max(scene_errors("radiograph", scene)["image"] for scene in (5, 6))


def test_a_broken_bar_is_exit_code_1_and_the_scene_is_named(one_bad_scene, tmp_path):
    target = tmp_path / "agreement.json"
    ran = bench("--scenes", 10, "--json", target)
    assert ran.exit_code == 1
    (complaint,) = ran.stderr.splitlines()
    assert "section: the gradient by quats errs by 2.0e-03 in scene 7 (bar 1e-03, 1 of 10 scenes over it)" in complaint
    assert "scene_errors('section', 7)" in complaint
    assert [row["over_bar"] for row in json.loads(target.read_text())] == [0, 0, 0, 0, 0, 1]


def test_scenes_beside_the_bad_one_are_well(one_bad_scene):
    assert bench("--scenes", 7).exit_code == 0
    assert bench("--scenes", 7, "--seed", 8).exit_code == 0
