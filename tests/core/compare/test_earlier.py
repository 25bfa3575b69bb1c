"""Which earlier figures stay in the tables, which stand beside them, and which are refused."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from insideout import __version__
from insideout.core.compare.compare import _Tables, row_settings
from insideout.core.compare.earlier import _is_by_other_code
from insideout.core.compare.methods import with_xray
from insideout.core.compare.options import CompareSettings
from insideout.core.compare.sharing import without_none
from insideout.core.compare.study import FIGURES
from insideout.core.errors import RunFolderError, SettingError
from insideout.core.files import write_json
from insideout.core.settings import Settings

TABLES = Path(__file__).parents[3] / "docs" / "tables"
STAMP = {"capture": "of the capture", "truth": "of the truth"}


@pytest.fixture
def chosen():
    return Settings.of("draft", seed=0, kernel="cpu")


@pytest.fixture(autouse=True)
def made_with(content, chosen):
    """The rows of `content` have the settings that they would be made with."""
    for one in content["captures"].values():
        for rows in (one["methods"], one["ablation"], *one["projections"].values()):
            for name, row in rows.items():
                row["settings"] = row_settings(chosen)[name]


@pytest.fixture
def earlier(content, chosen, tmp_path):
    """`earlier(coming, **how)`: a comparison beside an earlier one, or beside one that was made in another way."""

    def make(coming=None, **how):
        made = {"version": __version__, "figures": FIGURES}
        write_json(tmp_path / "earlier.json", {**content, **made, **how})
        return _Tables(tmp_path / "out", chosen, CompareSettings(also=(tmp_path / "earlier.json",)), coming)

    return make


@pytest.fixture
def written(earlier, content, tmp_path):
    """The folder of a comparison that holds both captures of `content`, with the rows of the skull beside it."""
    tables = earlier()
    out = tmp_path / "out"
    skull = tables.content["captures"]["skull"]
    skull["stamp"] = STAMP
    parts = [(out / "skull", skull["methods"]), (out / "skull", skull["ablation"])]
    parts.append((out / "skull" / "projections" / "25", skull["projections"]["25"]))
    for folder, rows in parts:
        for name in rows:
            write_json(folder / name / "figures.json", {})
    tables.write("skull", "a row")
    return out


def rows_of(capture):
    return {name: sorted(capture[name]) for name in ("methods", "ablation", "projections")}


def test_their_captures_stand_beside_the_new_ones_with_their_own_machine(earlier, skull, row, tmp_path):
    tables = earlier({"head": ["FDK"]})
    head = tables.of(tmp_path / "out" / "head", STAMP)
    head["methods"]["fdk"] = {**row("FDK", "xray", 22.0), "machine": None}
    head["truth"] = skull["truth"]
    tables.write("head", "FDK")
    text = (tmp_path / "out" / "tables.md").read_text("utf-8")
    assert "| InsideOut | 40.00 | **31.50** |" in text
    assert "| FDK | 40.00 | **22.00** |" in text
    assert "- skull: 2026-11-21, a processor" in text
    assert "- head: " in text


@pytest.fixture
def of_skull(content, skull):
    """Captures of an earlier comparison, of which the skull's digests are `STAMP`."""
    return {**content["captures"], "skull": {**skull, "stamp": STAMP}}


def test_a_capture_that_is_compared_again_keeps_the_rows_that_only_another_comparison_made(
    earlier, of_skull, row, tmp_path
):
    tables = earlier({"skull": ["FDK"]}, captures=of_skull)
    assert set(tables.content["captures"]) == {"a vase"}
    again = tables.of(tmp_path / "out" / "skull", STAMP)
    again["methods"]["fdk"] = row("FDK", "xray", 22.0)
    assert rows_of(again) == {**rows_of(of_skull["skull"]), "methods": sorted({*of_skull["skull"]["methods"], "fdk"})}
    assert again["methods"]["fdk"]["sections"]["psnr"] == 22.0
    assert again["alignment"] == of_skull["skull"]["alignment"]


@pytest.mark.parametrize("changed", ["capture", "truth"])
def test_rows_of_another_capture_of_that_name_are_not_taken(earlier, of_skull, changed, tmp_path):
    tables = earlier({"skull": ["FDK"]}, captures=of_skull)
    again = tables.of(tmp_path / "out" / "skull", {**STAMP, changed: "another"})
    assert rows_of(again) == {"methods": [], "ablation": [], "projections": []}


def test_own_rows_go_before_those_of_another_comparison(written, earlier, of_skull, row):
    made = {**of_skull["skull"], "methods": {"insideout": row("InsideOut", "both", 1.0)}}
    again = earlier({"skull": []}, captures={"skull": made}).of(written / "skull", STAMP)
    assert rows_of(again) == rows_of(of_skull["skull"])
    assert again["methods"]["insideout"] == of_skull["skull"]["methods"]["insideout"]


@pytest.mark.parametrize("how", [{"preset": "paper"}, {"seed": 1}, {"same_time": False}, {"figures": 0}])
def test_what_was_made_in_another_way_is_refused(earlier, how):
    with pytest.raises(SettingError, match="compare like with like"):
        earlier(**how)


def test_rows_that_would_be_made_otherwise_now_are_left_out(earlier, content, skull):
    """As after a change of the joint refinement: rivals' rows stay."""
    skull["methods"]["insideout"]["settings"] = "of another version"
    skull["projections"]["25"]["fdk"]["settings"] = "of another version"
    found = earlier().content["captures"]["skull"]
    assert rows_of(found) == {"methods": ["3dgs", "r2_gaussian"], "ablation": ["ablation/none"], "projections": []}
    assert "alignment" not in found, "it is the InsideOut row's"


def test_what_was_measured_in_the_frame_of_such_a_row_is_left_out_too(earlier, skull):
    skull["methods"]["insideout"]["settings"] = "of another version"
    skull["methods"]["3dgs"]["sections"]["frame"] = "the similarity that the run found"
    assert sorted(earlier().content["captures"]["skull"]["methods"]) == ["r2_gaussian"]


def test_a_mesh_of_a_row_s_splats_changes_with_that_row(chosen):
    surface = chosen.stages["surface"]
    longer = replace(surface, rgb=replace(surface.rgb, iterations=surface.rgb.iterations + 1))
    now = row_settings(replace(chosen, stages={**chosen.stages, "surface": longer}))
    assert now["gs2mesh"] != row_settings(chosen)["gs2mesh"]


def test_a_comparison_of_which_nothing_would_be_made_so_now_is_refused(earlier, content):
    for one in content["captures"].values():
        for row in (*one["methods"].values(), *one["ablation"].values(), *one["projections"].get("25", {}).values()):
            del row["settings"]
    with pytest.raises(SettingError, match=r"another version of the program, whose preset draft"):
        earlier()


def test_own_rows_that_would_be_made_otherwise_now_are_not_given_up(written, chosen):
    kept = json.loads((written / "tables.json").read_text("utf-8"))
    kept["captures"]["skull"]["methods"]["3dgs"]["settings"] = "of another version"
    write_json(written / "tables.json", kept)
    with pytest.raises(RunFolderError, match=r"another version of the program.* choose another --out"):
        _Tables(written, chosen, CompareSettings(), {"skull": []})


def test_what_a_row_does_without_does_not_change_its_settings(chosen):
    internal = replace(chosen.stages["internal"], joint=replace(chosen.stages["internal"].joint, iterations=7))
    now = row_settings(replace(chosen, stages={**chosen.stages, "internal": internal}))
    changed = {name for name, digest in row_settings(chosen).items() if digest != now[name]}
    assert {"insideout", "ablation/without_outlines", "ablation/without_frame"} <= changed
    assert not changed & {
        "3dgs",
        "mcmc",
        "naf",
        "sart",
        "fdk",
        "x_gaussian",
        "r2_gaussian",
        "additive",
        "gs2mesh",
        "apart",
    }
    assert not changed & {"ablation/none", "ablation/align", "ablation/xray_half", "ablation/sections_kept"}


def test_what_is_off_and_the_half_that_a_row_does_not_see_change_no_row_s_settings(chosen):
    """As where a setting is new and off in a method, or smoothness changes and rows of photos do not."""
    xray = chosen.stages["surface"].xray
    smoother = with_xray(chosen, smooth_edge=0.2)
    changed = {name for name, digest in row_settings(chosen).items() if digest != row_settings(smoother)[name]}
    assert {"insideout", "additive", "ablation/xray_half"} <= changed
    assert not changed & {"3dgs", "mcmc", "gs2mesh", "r2_gaussian", "naf", "fdk"}
    assert xray.smooth_trial is None
    assert without_none({"a": {"b": None, "c": [1, {"d": None}]}}) == {"a": {"c": [1, {}]}}


def test_a_file_of_something_else_is_refused(earlier):
    with pytest.raises(SettingError, match=r"no tables\.json"):
        earlier(captures=None)


def test_a_capture_that_this_folder_has_rows_of_is_not_replaced_by_another_comparison_s(earlier, tmp_path):
    (tmp_path / "out" / "skull").mkdir(parents=True)
    with pytest.raises(SettingError, match=r"holds the capture 'skull', of which .*out has rows of its own"):
        earlier()


def test_what_was_shown_beside_a_comparison_is_shown_again_by_the_same_call(earlier, tmp_path):
    earlier().write("skull", "a row")
    assert set(earlier().content["captures"]) == {"skull", "a vase"}


def test_captures_that_this_comparison_comes_to_again_stay_in_its_tables_until_then(written, chosen, content):
    again = _Tables(written, chosen, CompareSettings(), {"skull": [], "a vase": []})
    assert set(again.content["captures"]) == set(content["captures"])


def test_rows_that_are_not_asked_for_again_stay(written, chosen):
    """As after `compare X`, then `compare X --methods fdk` into the same folder."""
    skull = _Tables(written, chosen, CompareSettings(), {"skull": []}).of(written / "skull", STAMP)
    assert rows_of(skull) == {
        "methods": ["3dgs", "insideout", "r2_gaussian"],
        "ablation": ["ablation/none"],
        "projections": ["25"],
    }
    assert skull["alignment"]["starts"]["shape"]["found"] == 19


@pytest.mark.parametrize("changed", ["capture", "truth"])
def test_rows_of_another_capture_of_that_name_or_another_truth_do_not_stay(written, chosen, changed):
    tables = _Tables(written, chosen, CompareSettings(), {"skull": []})
    skull = tables.of(written / "skull", {**STAMP, changed: "of another"})
    assert rows_of(skull) == {"methods": [], "ablation": [], "projections": []}
    assert "alignment" not in skull


def test_a_row_whose_folder_is_gone_does_not_stay(written, chosen):
    (written / "skull" / "insideout" / "figures.json").unlink()
    skull = _Tables(written, chosen, CompareSettings(), {"skull": []}).of(written / "skull", STAMP)
    assert sorted(skull["methods"]) == ["3dgs", "r2_gaussian"]
    assert "alignment" not in skull


@pytest.mark.parametrize(("other", "message"), [
    (("standard", 0), "made with preset draft, not standard"), (("draft", 1), "made with seed 0, not 1"),
])  # fmt: skip
def test_another_comparison_in_its_folder_is_refused_so_that_no_row_is_given_up(written, other, message):
    with pytest.raises(RunFolderError, match=f"{message}; choose another --out"):
        _Tables(written, Settings.of(*other), CompareSettings(), {"skull": [], "a vase": []})
    # Nothing was finished: nothing is lost.
    kept = json.loads((written / "tables.json").read_text("utf-8"))
    write_json(written / "tables.json", {**kept, "captures": {}})
    assert _Tables(written, Settings.of(*other), CompareSettings()).content["captures"] == {}


def test_files_of_something_else_are_not_written_over(chosen, tmp_path):
    (tmp_path / "tables.md").write_text("a carpenter's", "utf-8")
    with pytest.raises(RunFolderError, match=r"tables\.md: is not of a comparison"):
        _Tables(tmp_path, chosen, CompareSettings())


def test_figures_that_were_measured_in_another_way_are_not_shown_again(written, chosen):
    kept = json.loads((written / "tables.json").read_text("utf-8"))
    write_json(written / "tables.json", {**kept, "figures": 0})
    with pytest.raises(RunFolderError, match=r"another version of the program.* choose another --out"):
        _Tables(written, chosen, CompareSettings(), {"skull": []})
    assert _Tables(written, chosen, CompareSettings(), {"skull": [], "a vase": []}).content["captures"] == {}


def test_a_row_that_is_there_is_no_longer_to_come(chosen, tmp_path):
    tables = _Tables(tmp_path, chosen, CompareSettings(), {"skull": ["InsideOut", "FDK"]})
    tables.write("skull", "InsideOut")
    assert "**In progress.** Rows still to come: skull: FDK." in (tmp_path / "tables.md").read_text("utf-8")
    tables.write("skull", "FDK")
    assert "In progress" not in (tmp_path / "tables.md").read_text("utf-8")


@pytest.mark.parametrize("path", sorted(TABLES.glob("*.json")), ids=lambda path: path.stem)
def test_rows_of_the_tables_in_docs_would_be_made_so_today_or_say_that_they_would_not(path):
    content = json.loads(path.read_text("utf-8"))
    now = row_settings(Settings.of(content["preset"], content["seed"], content["kernel"]))
    for capture in content["captures"].values():
        for rows in (capture["methods"], capture["ablation"], *capture["projections"].values()):
            for name, row in rows.items():
                alike = row["settings"] == now[name] and not _is_by_other_code(name, row)
                assert alike or "[as it was" in row["label"], name
