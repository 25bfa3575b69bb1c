"""What other code made of a comparison is made again, and all else stays."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from insideout import __version__
from insideout.core.capture.read import read_capture
from insideout.core.compare.ablation import ABLATION
from insideout.core.compare.code import CODE, code_of, first_by_other_code
from insideout.core.compare.compare import _Tables, compare, row_settings
from insideout.core.compare.methods import METHODS, Reconstructed
from insideout.core.compare.options import CompareSettings
from insideout.core.compare.sharing import CODE_FILE, Wanted, share
from insideout.core.compare.study import FIGURES, Made, Study
from insideout.core.errors import RunFolderError
from insideout.core.files import plain, write_json
from insideout.core.progress import Reporter
from insideout.core.run_folder import STAGES, RunFolder
from insideout.core.settings import Settings
from insideout.core.volume import Volume


def raised(monkeypatch, part):
    monkeypatch.setitem(CODE, part, CODE[part] + 1)


@pytest.fixture
def study(tiny_capture, tiny_settings, tmp_path):
    return Study(read_capture(tiny_capture), tmp_path / "matryoshka", tiny_settings, None, Reporter())


@pytest.mark.parametrize(
    ("part", "concerned"),
    [
        ("fdk", {"fdk", "naf", "additive", "r2_gaussian", "insideout", "ablation/xray_half"}),
        ("photos", {"3dgs", "mcmc", "gs2mesh", "insideout", "apart"}),
        ("xray", {"additive", "x_gaussian", "insideout", "ablation/affine"}),
        ("both", {"insideout", "apart", "ablation/none"}),
        ("sart", {"sart"}),
        ("naf", {"naf"}),
        ("gs2mesh", {"gs2mesh"}),
    ],
)
def test_which_rows_a_part_of_the_code_concerns(part, concerned):
    rows = {method.name: method for method in (*METHODS.values(), *ABLATION)}
    found = {name for name, method in rows.items() if part in method.code}
    assert concerned <= found
    usual = {"fdk", "sart", "naf", "gs2mesh", "3dgs", "additive"}
    assert found & usual == concerned & usual


def test_every_part_is_some_row_s():
    assert {part for method in METHODS.values() for part in method.code} == set(CODE)


@pytest.fixture
def voxels():
    """The row `fdk` with voxels that cost nothing, and how often they were made."""
    made = []

    def make(job):
        made.append(job)
        return Reconstructed(Volume.centered(np.ones((4, 4, 4), np.float32), np.ones(3)))

    return replace(METHODS["fdk"], volume=make), made


def test_voxels_of_other_code_are_made_again(study, voxels, monkeypatch):
    """The version of the program and the row's settings were the same, and its volume stayed in the tables."""
    method, made = voxels
    study.make(method)
    raised(monkeypatch, "photos")
    study.make(method)
    assert len(made) == 1
    raised(monkeypatch, "fdk")
    study.make(method)
    assert len(made) == 2


def test_voxels_from_before_there_were_numbers_have_the_first_ones(study, voxels, monkeypatch):
    method, made = voxels
    study.make(method)
    path = study.folder / "fdk" / "report.json"
    report = json.loads(path.read_text("utf-8"))
    del report["made_with"]["code"]
    write_json(path, report)
    study.make(method)
    assert len(made) == 1
    raised(monkeypatch, "fdk")
    study.make(method)
    assert len(made) == 2


@pytest.fixture
def finished(study):
    """A whole run of the InsideOut row's, without anything in it."""
    run = RunFolder(study.folder / "insideout")
    write_json(run.path / "capture.json", {"digest": study.capture.digest, "path": "x"})
    write_json(run.path / "settings.json", plain(study.settings))
    for stage in STAGES:
        write_json(run.stage(stage) / "report.json", {"settings": plain(study.settings.stages[stage])})
    landmarks = study.capture.landmarks
    write_json(run.stage("align") / "landmarks.json", plain({"photo": landmarks.photo, "xray": landmarks.xray}))
    write_json(run.path / "report.json", {"seconds": 1.0})
    return run


@pytest.mark.parametrize(
    ("part", "kept"),
    [("photos", []), ("xray", []), ("fdk", []), ("both", STAGES[:2]), ("report", STAGES), ("sart", None)],
)
@pytest.mark.parametrize("says", [True, False])
def test_of_a_run_the_stages_are_made_again_from_where_other_code_begins(
    study, finished, monkeypatch, part, kept, says
):
    if says:
        write_json(finished.path / CODE_FILE, {"code": METHODS["insideout"].code})
    monkeypatch.setattr("insideout.core.compare.study.reconstruct", lambda *_, **__: {"seconds": 2.0})
    raised(monkeypatch, part)
    made = study.make(METHODS["insideout"])
    assert made.seconds == (1.0 if kept is None else 2.0)
    assert [stage for stage in STAGES if finished.is_done(stage)] == list(STAGES if kept is None else kept)
    assert finished.read_json(finished.path / CODE_FILE) == {"code": METHODS["insideout"].code}


@pytest.mark.parametrize(
    ("part", "shared"), [("photos", []), ("both", ["initialize", "surface"]), ("report", STAGES), ("sart", STAGES)]
)
def test_stages_of_other_code_are_not_shared(study, finished, monkeypatch, tmp_path, part, shared):
    raised(monkeypatch, part)
    run, code = RunFolder(tmp_path / "matryoshka" / "another"), METHODS["insideout"].code
    wanted = Wanted(run, study.capture.digest, study.settings, STAGES, landmarks=study.capture.landmarks, code=code)
    share(wanted, study.folder)
    assert [stage for stage in STAGES if run.is_done(stage)] == list(shared)


def test_half_of_what_other_code_made_is_not_shared(study, finished, monkeypatch, tmp_path):
    marker = finished.stage("initialize") / "report.json"
    half = {"photos": {"seconds": 1.0}, "splats": {"rgb": 1}, "kernel": "cpu"}
    write_json(marker, {**finished.read_json(marker), **half})
    code, whole = code_of("photos"), study.capture.digest
    for part in ("fdk", "photos"):
        raised(monkeypatch, part)
        run = RunFolder(tmp_path / part)
        now = code if part == "fdk" else code_of("photos")
        share(Wanted(run, "of photos", study.settings, ["initialize"], "photos", whole, code=now), study.folder)
        assert run.is_done("initialize") is (part == "fdk")


def test_tries_of_other_code_are_not_gone_by(study, monkeypatch):
    """Their seconds are those of that code."""
    read = []

    def search(seconds, first, taken, kept, *_):
        read.append(kept.exists())
        return {"iterations": 7, "seconds": seconds, "tries": []}

    monkeypatch.setattr("insideout.core.compare.study.iterations_in_time", search)

    class Timed(Study):
        def reference(self):
            return Made(METHODS["insideout"], self.folder, {"stages": {"surface": {"xray": {"seconds": 5.0}}}})

        def run(self, *_, **__):
            return {"stages": {}}

    timed, method = Timed(study.capture, study.folder, study.settings, None, Reporter()), METHODS["r2_gaussian"]
    write_json(study.folder / "tries" / "r2_gaussian.json", {})
    timed.make(method)
    for part in ("photos", "report"):
        raised(monkeypatch, part)
    timed.make(method)
    raised(monkeypatch, "xray")
    timed.make(method)
    assert read == [True, True, False]


def test_a_comparison_makes_the_rows_again_that_are_concerned(compared, tiny_capture, monkeypatch, tmp_path):
    out, options, content = compared
    shutil.copytree(out, tmp_path / "out")

    def forbidden(*_, **__):
        raise AssertionError("made again")

    monkeypatch.setattr("insideout.core.compare.study.reconstruct", forbidden)
    raised(monkeypatch, "gs2mesh")
    again = compare([tiny_capture], tmp_path / "out", options)["captures"]["matryoshka"]
    before = content["captures"]["matryoshka"]
    assert again["methods"]["gs2mesh"]["code"] == {"photos": 1, "gs2mesh": 2}
    assert again["methods"]["gs2mesh"]["seconds"] != before["methods"]["gs2mesh"]["seconds"]
    for name in set(before["methods"]) - {"gs2mesh"}:
        assert again["methods"][name] == before["methods"][name]


class TestTables:
    @pytest.fixture
    def chosen(self):
        return Settings.of("draft", seed=0, kernel="cpu")

    @pytest.fixture
    def written(self, content, chosen, tmp_path):
        """The folder of a comparison of the skull, whose rows say by which code they were made."""
        rows = {method.name: method for method in (*METHODS.values(), *ABLATION)}
        skull = content["captures"]["skull"]
        for kept in (skull["methods"], skull["ablation"], *skull["projections"].values()):
            for name, row in kept.items():
                row |= {"settings": row_settings(chosen)[name], "code": rows[name].code}
        del content["captures"]["a vase"]
        write_json(tmp_path / "out" / "tables.json", {**content, "version": __version__, "figures": FIGURES})
        return tmp_path / "out"

    def test_own_rows_of_other_code_wait_for_their_turn_and_others_stay(self, written, chosen, monkeypatch):
        raised(monkeypatch, "both")
        skull = _Tables(written, chosen, CompareSettings(), {"skull": []}).content["captures"]["skull"]
        assert sorted(skull["methods"]) == ["3dgs", "r2_gaussian"]
        assert skull["ablation"] == {}
        assert sorted(skull["projections"]) == ["25"]
        assert "alignment" not in skull, "it is the InsideOut row's"

    def test_where_their_turn_does_not_come_they_are_not_given_up(self, written, chosen, monkeypatch):
        assert _Tables(written, chosen, CompareSettings(), {"head": []}).content["captures"]["skull"]["methods"]
        raised(monkeypatch, "both")
        with pytest.raises(RunFolderError, match=r"another version of the program.* choose another --out"):
            _Tables(written, chosen, CompareSettings(), {"head": []})

    def test_of_another_comparison_they_are_left_out(self, written, chosen, monkeypatch, tmp_path):
        raised(monkeypatch, "fdk")
        options = CompareSettings(also=(written / "tables.json",))
        skull = _Tables(tmp_path / "beside", chosen, options).content["captures"]["skull"]
        assert sorted(skull["methods"]) == ["3dgs"]
        assert skull["projections"] == {}


def test_a_part_that_is_new_had_the_number_one_before():
    assert first_by_other_code({"code": {}}, {"report": 1}) is None
    assert first_by_other_code({"code": {}}, {"report": 2}) == len(STAGES)
    assert first_by_other_code({}, {**METHODS["insideout"].code, "both": 2}) == STAGES.index("align")
