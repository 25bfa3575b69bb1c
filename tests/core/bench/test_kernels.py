"""`insideout bench kernels`: what a row holds, and that the numbers in it can be trusted."""

import json
import re
import time
from types import SimpleNamespace

import numba
import numpy as np
import pytest
from numba import njit
from typer.testing import CliRunner

from insideout.core.bench import machine, scenes, tables, work
from insideout.core.bench.kernels import Grid, Step, _watched, available_threads, growth, measure, measure_case
from insideout.core.bench.peak import _CHAINS, _chains, lanes, measure_peak
from insideout.core.bench.scenes import MEAN_AXIS_PX, scene
from insideout.core.bench.stopwatch import Stopwatch
from insideout.core.cli import app
from insideout.core.errors import SettingError
from insideout.core.render.kernels.cpu.splat_raster import ATTRIBUTES, CENTER_X, CENTER_Y, DEEP, L1, L2, REACH
from insideout.core.render.kernels.cpu.vectors import aligned

SCHEMA = {
    "renderer", "kernel", "splats", "width", "height", "threads", "project_ms", "sort_ms", "forward_ms", "backward_ms",
    "step_ms", "cpu_ms", "pixel_splats", "pixel_splats_per_s", "peak_gflops", "peak_share", "date", "cpu", "cores",
    "versions",
}  # fmt: skip


@pytest.fixture(scope="module")
def rows():
    grid = Grid(splats=(200, 400), sides=(32, 64), threads=(1,), middle=(200, 64), repeats=2)
    return measure(grid)


def test_every_renderer_is_measured_at_every_size(rows):
    assert {(r["renderer"], r["splats"], r["width"]) for r in rows} == {
        (renderer, splats, side)
        for renderer in ("splat", "radiograph", "section")
        for splats in (200, 400)
        for side in (32, 64)
    }
    assert {row["threads"] for row in rows} == {1, available_threads()}


def test_a_row_has_all_figures_and_the_machine(rows):
    for row in rows:
        assert set(row) >= SCHEMA
        assert row["step_ms"] == pytest.approx(
            row["project_ms"] + row["sort_ms"] + row["forward_ms"] + row["backward_ms"], abs=1e-3
        )
        assert min(row["project_ms"], row["sort_ms"], row["forward_ms"], row["backward_ms"]) > 0
        # Two repeats beside other programs may measure a peak that is far too low; only the sign is certain.
        assert 0 < row["peak_share"] < np.inf
        assert row["height"] == row["width"]


def test_rows_are_json_and_a_failed_write_leaves_the_old_file(rows, tmp_path, monkeypatch):
    from insideout.core.bench import cli

    target = tmp_path / "rows.json"
    cli._save(target, rows)
    assert json.loads(target.read_text())[0]["renderer"] == "splat"
    before = target.read_bytes()
    with pytest.raises(TypeError):
        cli._save(target, [{**rows[0], "cpu": object()}])
    assert target.read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["rows.json"]


def test_growth_compares_neighbouring_sizes_with_the_rest_as_in_the_middle():
    base = {"renderer": "splat", "width": 400, "height": 400, "threads": 2}
    rows = [
        {**base, "splats": 50_000, "step_ms": 50.0},
        {**base, "splats": 10_000, "step_ms": 12.5},
        {**base, "splats": 50_000, "step_ms": 150.0, "width": 800, "height": 800},
        {**base, "splats": 50_000, "step_ms": 90.0, "threads": 1},
    ]
    found = {row["by"]: row for row in growth(rows, (50_000, 400))}
    assert (found["splats"]["low"], found["splats"]["high"], found["splats"]["times"]) == (10_000, 50_000, 4.0)
    assert (found["pixels"]["low"], found["pixels"]["high"], found["pixels"]["times"]) == (160_000, 640_000, 3.0)
    assert found["threads"]["times"] == pytest.approx(50 / 90)


@njit
def one_thread(rounds):
    return _chains(rounds, np.float32(0.999), np.float32(0.001))


def test_the_peak_is_that_of_vector_multiply_adds():
    if lanes() == 4:
        pytest.skip("a processor without AVX")
    register = {8: "ymm", 16: "zmm"}[lanes()]
    one_thread(1)
    code = one_thread.inspect_asm(one_thread.signatures[0])
    assert len(re.findall(rf"vfmadd\d+ps\s.*%{register}", code)) >= 12
    assert not re.search(r"vfmadd\d+ss", code)


def test_the_peak_is_plausible():
    """One core makes some 1e9 to 6e9 rounds a second of one or two units, in the thread's own time: what others take is
    not ours to know."""

    def own():
        begin = time.thread_time()
        one_thread(200_000)
        return 2 * _CHAINS * lanes() * 200_000 / (time.thread_time() - begin)

    one_thread(1)
    assert 2 * lanes() * 1e9 * 0.2 < max(own() for _ in range(9)) < 2 * lanes() * 6e9 * 2


def test_the_peak_is_what_all_threads_make_in_the_time_that_they_take(monkeypatch):
    clock = iter([1.0, 1.5])
    monkeypatch.setattr("insideout.core.bench.peak.time", SimpleNamespace(perf_counter=lambda: next(clock)))
    made = 2 * _CHAINS * lanes() * 1000 * numba.get_num_threads()
    assert measure_peak(1000) == pytest.approx(made / 0.5)


def test_more_rounds_take_more_time():
    """The compiler has not seen through the chains. In the thread's own time, whatever else is running."""

    def least(rounds):
        times = []
        for _ in range(9):
            begin = time.thread_time()
            one_thread(rounds)
            times.append(time.thread_time() - begin)
        return min(times)

    one_thread(1)
    assert 2 < least(4_000_000) / least(1_000_000) < 8


def circle(x, y, radius):
    """The table row of a round splat with a reach of three standard deviations, in pixels."""
    row = aligned(ATTRIBUTES).reshape(1, ATTRIBUTES)
    row[:] = 0
    row.view(np.float64)[0, [CENTER_X, CENTER_Y]] = x, y
    row[0, [L1, L2, DEEP]] = 3 / radius, 3 / radius, radius / 3
    row[0, REACH] = 3
    return row


class TestEvaluatedPixelsOfSplats:
    one = np.array([0, 1], np.int32), np.array([0], np.int32), np.array([1], np.int32)

    def test_are_the_rows_within_reach(self):
        """A splat in the middle of a tile, 6 pixels up and down: 12 rows of 16 columns."""
        assert work.splat_pixels(*self.one, circle(8.0, 8.0, 6.01), 1) == 12 * 16

    def test_are_only_rows_in_which_the_tile_is_reached(self):
        """10 pixels beside the tile's first column a circle of 10.8 is 2 · √(10.8² − 10²) = 8.2 pixels high."""
        assert work.splat_pixels(*self.one, circle(-9.5, 8.0, 10.8), 1) == 8 * 16

    def test_are_none_where_every_pixel_was_finished_before(self):
        assert work.splat_pixels(*self.one[:2], np.array([0], np.int32), circle(8.0, 8.0, 6.0), 1) == 0


@pytest.mark.parametrize("renderer", ["splat", "radiograph", "section"])
def test_more_pixels_are_evaluated_than_reached_but_not_all(renderer):
    case = scene(300, 64)
    watch = Stopwatch()
    with watch.watching(_watched(renderer)):
        Step(renderer, "cpu", case, "cpu").run(watch)
    found = work.evaluated_pixels(renderer, watch.calls)
    assert 300 < found < 300 * 64 * 64


def test_axes_average_one_and_a_half_pixels():
    case = scene(20_000, 400)
    pixel = 5.0 / case.camera.fx
    assert case.gaussians.scales.mean() / pixel == pytest.approx(MEAN_AXIS_PX, rel=0.01)


def test_the_same_seed_gives_the_same_scene():
    first, again, other = scene(50, 64, 1), scene(50, 64, 1), scene(50, 64, 2)
    np.testing.assert_array_equal(first.gaussians.means, again.gaussians.means)
    assert not np.array_equal(first.gaussians.means, other.gaussians.means)


def test_the_stopwatch_puts_the_functions_back():
    original = scenes.scene
    watch = Stopwatch()
    with pytest.raises(ValueError), watch.watching([(scenes, "scene", "making")]):  # noqa: PT011
        scenes.scene(-1, 8)
    assert scenes.scene is original
    assert watch.seconds["making"] > 0


def test_threads_are_set_back():
    import torch

    before = numba.get_num_threads(), torch.get_num_threads()
    row = measure_case("section", "cpu", scene(50, 16), 1, 1)
    assert row["threads"] == 1
    assert (numba.get_num_threads(), torch.get_num_threads()) == before


def test_the_reference_is_timed_without_the_figures_it_does_not_have():
    (row,) = measure(Grid(renderers=("splat",), kernel="reference", splats=(50,), sides=(16,), repeats=1))
    assert row["forward_ms"] > 0
    assert row["peak_share"] is None
    assert row["project_ms"] is None


@pytest.mark.parametrize(
    ("grid", "named"),
    [
        (Grid(renderers=("photo",)), "photo"),
        (Grid(kernel="gpu"), "gpu"),
        (Grid(splats=(0,)), "--splats"),
        (Grid(threads=(1000,)), "--threads"),
        (Grid(kernel="reference", splats=(1_000_000,)), "reference"),
    ],
)
def test_what_cannot_be_measured_is_named(grid, named):
    with pytest.raises(SettingError, match=named):
        measure(grid)


def test_the_command_prints_a_table_and_saves_the_rows(tmp_path):
    target = tmp_path / "bench.json"
    options = ["--quick", "--renderer", "section", "--splats", "1e2", "--sizes", "32", "--repeats", "1"]
    ran = CliRunner().invoke(app, ["bench", "kernels", *options, "--json", str(target), "--markdown"])
    assert ran.exit_code == 0, ran.output
    assert "| renderer | kernel | splats |" in ran.output
    assert machine.machine()["cpu"] in ran.output
    (row,) = json.loads(target.read_text())
    assert (row["renderer"], row["splats"], row["width"]) == ("section", 100, 32)


@pytest.mark.parametrize("text", ["many", "1.5", "1e4,x"])
def test_a_number_that_is_none_is_named(text):
    ran = CliRunner().invoke(app, ["bench", "kernels", "--splats", text])
    assert isinstance(ran.exception, SettingError)
    assert "--splats" in str(ran.exception)


def test_tables_leave_out_what_a_row_does_not_have():
    table = tables.Table("T", [tables.Column("a", tables.number("a", ".1f")), tables.Column("b", str)], [{"a": None}])
    assert table.cells() == [["", "{'a': None}"]]
    assert table.markdown().splitlines() == ["**T**", "", "| a | b |", "| --- | --- |", "|  | {'a': None} |"]
