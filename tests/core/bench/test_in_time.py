"""`insideout bench budget`: a preset's run beside one that has the time that it took."""

import json
import shutil
from dataclasses import replace

import pytest

from insideout.core.bench import in_time
from insideout.core.bench.in_time import measure_budgets
from insideout.core.bench.tables import budgets_table
from insideout.core.errors import RunFolderError, SettingError
from insideout.core.pipeline import reconstruct
from insideout.core.run_folder import RunFolder


@pytest.fixture(scope="module")
def measured(tiny_capture, tiny_settings, tmp_path_factory):
    """Of a preset that seems to take a quarter of an hour: what a handful of steps takes is too short a budget."""

    def long(*given, settings=None, **options):
        report = reconstruct(*given, settings=settings, **options)
        return report if settings.time_budget_s else {**report, "seconds_in_all": 900.0}

    out = tmp_path_factory.mktemp("in time")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(in_time, "reconstruct", long)
        return out, measure_budgets([tiny_capture], [tiny_settings], out, timed=tiny_settings)


def test_what_the_preset_took_is_the_budget(measured):
    out, (row,) = measured
    timed = json.loads((out / f"{row['capture']}-draft-s-time" / "report.json").read_text())
    assert row["budget_s"] == timed["time_budget_s"] == 900.0
    assert row["seconds"] == pytest.approx(timed["seconds_in_all"])
    assert row["late"] == pytest.approx(row["seconds"] / 900.0 - 1)


def test_what_both_reach_stands_beside_each_other(measured):
    """The preset's first, then that of the run with its time, whose four times the steps projections show better."""
    out, (row,) = measured
    folders = [out / f"{row['capture']}-draft", out / f"{row['capture']}-draft-s-time"]
    reports = [json.loads((folder / "report.json").read_text()) for folder in folders]
    for kind in ("photos", "projections"):
        assert row[kind] == [report["heldout"][kind]["psnr"] for report in reports]
    assert row["projections"][1] > row["projections"][0]


def test_measured_again_it_tells_the_same(measured, tiny_capture, tiny_settings):
    """Though a finished run that is asked for again counts its seconds anew."""
    out, rows = measured
    assert measure_budgets([tiny_capture], [tiny_settings], out, timed=tiny_settings) == rows


def test_what_other_settings_took_is_not_told_again(measured, tiny_capture, tiny_settings):
    with pytest.raises(RunFolderError, match="choose another --out"):
        measure_budgets([tiny_capture], [tiny_settings], measured[0], timed=replace(tiny_settings, seed=1))


def test_captures_with_dots_in_their_names_keep_notes_of_their_own(tiny_capture, tiny_settings, tmp_path, monkeypatch):
    """Two scans of one object, by the size of their voxels."""
    captures, made = [tmp_path / name for name in ("scan-1.5mm", "scan-1.7mm")], []
    for capture in captures:
        shutil.copytree(tiny_capture, capture)

    def reconstruct(capture, folder, **_):
        RunFolder(folder).claim(capture.digest, capture.path)
        made.append(folder.name)
        return {"seconds_in_all": 100.0 * len(made), "heldout": {}}

    monkeypatch.setattr(in_time, "reconstruct", reconstruct)
    monkeypatch.setattr(in_time, "compile_kernels", lambda *_: None)
    rows = measure_budgets(captures, [tiny_settings], tmp_path / "out")
    assert made == [f"{capture.name}-draft{which}" for capture in captures for which in ("", "-s-time")]
    notes = {path.name for path in (tmp_path / "out").glob("*.json")}
    assert notes == {f"{capture.name}-draft.json" for capture in captures}
    assert [(row["budget_s"], row["seconds"]) for row in rows] == [(100.0, 200.0), (300.0, 400.0)]
    assert measure_budgets(captures, [tiny_settings], tmp_path / "out") == rows
    assert len(made) == 4, "nothing is made again"


def test_no_budget_holds_the_time_of_compiling_kernels(tiny_capture, tiny_settings, tmp_path, monkeypatch):
    """The preset's run would wait for them, and the one in its time would not."""
    made = []
    monkeypatch.setattr(in_time, "compile_kernels", lambda capture, *_: made.append(capture.path))

    def reconstruct(capture, folder, **how):
        RunFolder(folder).claim(capture.digest, capture.path)
        made.append(how)
        return {"seconds_in_all": 100.0, "heldout": {}}

    monkeypatch.setattr(in_time, "reconstruct", reconstruct)
    measure_budgets([tiny_capture], [tiny_settings], tmp_path / "out")
    assert made[0] == tiny_capture.resolve()
    assert [how.get("time_budget_s") for how in made[1:]] == [None, 100.0]
    # Broken off between the two, the second is made by a process that has loaded none yet.
    (noted,) = (tmp_path / "out").glob("*.json")
    kept = json.loads(noted.read_text())
    noted.write_text(json.dumps({**kept, "ended": kept["ended"][:1]}))
    measure_budgets([tiny_capture], [tiny_settings], tmp_path / "out")
    assert made[3] == tiny_capture.resolve()
    assert len(made) == 5


def test_two_captures_of_one_name_are_refused(tiny_capture, tiny_settings, tmp_path):
    twin = tmp_path / "other" / tiny_capture.name
    with pytest.raises(SettingError, match=f"two of the captures are called '{tiny_capture.name}'"):
        measure_budgets([tiny_capture, twin], [tiny_settings], tmp_path / "out")


def test_the_table_counts_those_that_are_late(measured):
    row = {**measured[1][0], "budget_s": 100.0, "seconds": 108.0, "late": 0.08, "photos": [30.0, 30.2]}
    other = {**row, "seconds": 111.0, "late": 0.11, "projections": [None, None]}
    table = budgets_table([row, other])
    assert table.title == "1 of 2 runs ended more than 10% after their budget"
    assert table.cells()[0][2:6] == ["100", "108", "+8%", "30.0, 30.2"]
    assert table.cells()[1][6] == "–, –"
