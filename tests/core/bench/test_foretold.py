"""`insideout bench forecast`: what was foretold beside what the run took."""

import json
import shutil

import pytest

from insideout.core.bench.foretold import measure_forecasts
from insideout.core.bench.tables import foretold_table
from insideout.core.capture.read import read_capture
from insideout.core.errors import Cancelled, RunFolderError, SettingError
from insideout.core.forecast.budget import forecasts
from insideout.core.progress import Reporter
from insideout.core.run_folder import STAGES


@pytest.fixture(scope="module")
def measured(tiny_capture, tiny_settings, tmp_path_factory):
    out = tmp_path_factory.mktemp("foretold")
    return out, measure_forecasts([tiny_capture], [tiny_settings], out)


def test_a_row_has_what_was_foretold_and_what_the_run_took(measured, tiny_capture, tiny_settings):
    out, (row,) = measured
    report = json.loads((out / f"{row['capture']}-draft" / "report.json").read_text())
    assert row["seconds"] == pytest.approx(report["seconds_in_all"])
    assert row["off"] == pytest.approx(row["foretold_s"] / row["seconds"] - 1)
    assert row["cameras"] is False
    assert [*row["stages"]] == [*STAGES, "report"]
    foretold, taken = (sum(pair[column] for pair in row["stages"].values()) for column in (0, 1))
    assert (foretold, taken) == pytest.approx((row["foretold_s"], row["seconds"]))
    parts = forecasts(read_capture(tiny_capture), [tiny_settings], Reporter())[0].parts
    assert {part.split()[0] for part in parts} == {stage for stage, (foretold, _) in row["stages"].items() if foretold}


def test_measured_again_it_tells_the_same(measured, tiny_capture, tiny_settings):
    out, rows = measured
    assert measure_forecasts([tiny_capture], [tiny_settings], out) == rows


@pytest.mark.parametrize("of", ["capture", "machine"])
def test_what_another_capture_or_machine_took_is_not_told_again(measured, tiny_capture, tiny_settings, tmp_path, of):
    out, _ = measured
    shutil.copytree(out, tmp_path / "out")
    (kept,) = (tmp_path / "out").glob("*.json")
    content = json.loads(kept.read_text())
    assert of in content["made_with"]
    kept.write_text(json.dumps({**content, "made_with": {**content["made_with"], of: "another"}}))
    with pytest.raises(RunFolderError, match="choose another --out"):
        measure_forecasts([tiny_capture], [tiny_settings], tmp_path / "out")


def test_broken_off_it_goes_on_with_what_was_foretold_at_first(tiny_capture, tiny_settings, tmp_path):
    told = []

    def is_stopped():
        return any(progress.stage == "surface" for progress in told)

    with pytest.raises(Cancelled):
        measure_forecasts([tiny_capture], [tiny_settings], tmp_path, Reporter(told.append, is_stopped))
    (kept,) = tmp_path.glob("*.json")
    foretold = json.loads(kept.read_text())
    (row,) = measure_forecasts([tiny_capture], [tiny_settings], tmp_path)
    assert row["foretold_s"] == pytest.approx(sum(foretold["row"]["foretold"].values()))


def test_two_captures_of_one_name_are_refused(tiny_capture, tiny_settings, tmp_path):
    twin = tmp_path / "other" / tiny_capture.name
    with pytest.raises(SettingError, match=f"two of the captures are called '{tiny_capture.name}'"):
        measure_forecasts([tiny_capture, twin], [tiny_settings], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_runs_inside_the_capture_are_refused_before_anything_is_written(tiny_capture, tiny_settings):
    before = sorted(tiny_capture.rglob("*"))
    with pytest.raises(RunFolderError, match="lies inside the capture"):
        measure_forecasts([tiny_capture], [tiny_settings], tiny_capture / "runs")
    assert sorted(tiny_capture.rglob("*")) == before


def test_the_table_counts_those_within_three_tenths(measured):
    row = {**measured[1][0], "foretold_s": 129.0, "seconds": 100.0, "off": 0.29}
    other = {**row, "foretold_s": 60.0, "off": -0.4, "cameras": True}
    table = foretold_table([row, other])
    assert table.title == "1 of 2 runs took what was foretold within 30%"
    assert table.cells()[0][2:] == ["129", "100", "+29%", ""]
    assert table.cells()[1][4:] == ["-40%", "cameras had to be found"]
