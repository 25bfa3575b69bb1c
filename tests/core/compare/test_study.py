"""Which runs a comparison keeps, and in which frame its photo rows are."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import trimesh

from insideout.core.capture.read import read_capture
from insideout.core.capture.registered import save_photos
from insideout.core.compare.methods import METHODS
from insideout.core.compare.sharing import Wanted, share
from insideout.core.compare.study import Made, Study, _save_mesh, kept_figures, mark, refuse_foreign
from insideout.core.compare.truth import find_truth
from insideout.core.errors import Cancelled, RunFolderError
from insideout.core.files import plain, write_json
from insideout.core.progress import Progress, Reporter
from insideout.core.resume import follow_landmarks
from insideout.core.run_folder import RunFolder


@pytest.fixture
def study(tiny_capture, tiny_settings, tmp_path):
    """Of a capture whose cameras have to be found; the InsideOut row finds those that it has."""
    capture = read_capture(tiny_capture)
    bare = replace(capture.photos, photos=[replace(photo, camera=None) for photo in capture.photos.photos])
    folder = tmp_path / "matryoshka"
    truth = find_truth(capture, folder, Reporter())
    made = []

    class Found(Study):
        def reference(self):
            if not made:
                RunFolder(self.folder / "insideout").stage("initialize")
                save_photos(self.folder / "insideout" / "initialize" / "photos.json", capture.photos)
                made.append(True)
            return None

    return Found(replace(capture, photos=bare), folder, tiny_settings, truth, Reporter())


@pytest.mark.parametrize("name", ["3dgs", "mcmc"])
def test_photo_rows_have_the_cameras_of_the_insideout_row_from_the_first_on(study, name):
    """Cameras found by each row for itself would be in another frame each."""
    first = study.seen_by(METHODS["3dgs"])
    assert first.photos.posed
    assert study.seen_by(METHODS[name]).digest == first.digest


def test_rows_of_photos_alone_go_on_after_the_insideout_row_has_found_cameras(study, monkeypatch):
    """Before it they had to find their own: with its cameras their folders were those of another capture."""
    photos = replace(study, capture=study.capture.photos_only(), truth=None)
    monkeypatch.setattr("insideout.core.compare.study.reconstruct", lambda *_, **__: {"seconds": 2.0})
    first = photos.make(METHODS["3dgs"])
    photos.reference()
    assert (photos.folder / "insideout" / "initialize" / "photos.json").exists()
    assert photos.make(METHODS["3dgs"]).folder == first.folder


def test_x_ray_rows_do_not_wait_for_cameras(study):
    study.seen_by(METHODS["fdk"])
    assert not (study.folder / "insideout").exists()


def test_a_row_made_with_cameras_that_were_found_anew_since_is_made_anew(study, tiny_settings, monkeypatch):
    seen = study.seen_by(METHODS["3dgs"])
    folder = study.folder / "3dgs"
    write_json(folder / "capture.json", {"digest": f"{study.capture.digest}, cameras of before", "path": "x"})
    write_json(folder / "report.json", {"seconds": 1.0})
    monkeypatch.setattr("insideout.core.compare.study.reconstruct", lambda *_, **__: {"seconds": 2.0})
    assert study.run(folder, seen, tiny_settings) == {"seconds": 2.0}
    assert RunFolder(folder).read_json(folder / "capture.json")["digest"] == seen.digest


@pytest.mark.parametrize("digest", ["of another capture", "its own", ""])
def test_a_run_of_the_user_s_where_a_row_would_go_is_refused_and_left_alone(study, tiny_settings, digest):
    seen, folder = study.seen_by(METHODS["3dgs"]), study.folder / "3dgs"
    write_json(
        folder / "capture.json", {"digest": study.capture.digest if digest == "its own" else digest, "path": "x"}
    )
    write_json(folder / "report.json", {"seconds": 1.0})
    with pytest.raises(RunFolderError, match="holds the run of another capture"):
        study.run(folder, seen, tiny_settings)
    assert (folder / "report.json").exists()


def test_a_row_that_was_aligned_by_other_landmarks_is_made_anew(study, tiny_settings, monkeypatch):
    """Landmarks are no part of a capture's digest: written after a comparison, they were not looked at."""
    run = RunFolder(study.folder / "insideout")
    run.claim(study.capture.digest, study.capture.path)
    follow_landmarks(run, study.capture.landmarks, ())
    write_json(run.path / "report.json", {"seconds": 1.0})
    monkeypatch.setattr("insideout.core.compare.study.reconstruct", lambda *_, **__: {"seconds": 2.0})
    assert study.run(run.path, study.capture, tiny_settings) == {"seconds": 1.0}
    moved = replace(study.capture.landmarks, photo=study.capture.landmarks.photo[::-1])
    assert study.run(run.path, replace(study.capture, landmarks=moved), tiny_settings) == {"seconds": 2.0}


@pytest.mark.parametrize(("theirs", "shared"), [("the same", True), ("others", False)])
def test_no_alignment_by_other_landmarks_is_shared(theirs, shared, study, tiny_settings, tmp_path):
    given = study.capture.landmarks
    other, run = RunFolder(tmp_path / "other"), RunFolder(tmp_path / "run")
    write_json(other.path / "capture.json", {"digest": "of a capture", "path": "x"})
    write_json(other.path / "settings.json", plain(tiny_settings))
    for stage in ("initialize", "surface", "align"):
        write_json(other.stage(stage) / "report.json", {"settings": plain(tiny_settings.stages[stage])})
    marked = given if theirs == "the same" else replace(given, photo=given.photo[::-1])
    write_json(other.path / "align" / "landmarks.json", plain({"photo": marked.photo, "xray": marked.xray}))
    stages = ("initialize", "surface", "align")
    share(Wanted(run, "of a capture", tiny_settings, stages, landmarks=given), tmp_path)
    assert run.is_done("surface")
    assert run.is_done("align") is shared


def test_a_mesh_without_faces_is_read_again_as_one(tmp_path):
    _save_mesh(trimesh.Trimesh(), tmp_path / "mesh.ply")
    mesh = Made(METHODS["gs2mesh"], tmp_path, {"seconds": 0.0}).mesh()
    assert len(mesh.faces) == 0


def test_figures_measured_in_an_older_way_are_measured_anew(tmp_path, monkeypatch):
    path = tmp_path / "figures.json"
    assert kept_figures(path, {"of": 1}, lambda: {"psnr": 30.0}) == {"psnr": 30.0}
    assert kept_figures(path, {"of": 1}, lambda: {"psnr": 31.0}) == {"psnr": 30.0}
    monkeypatch.setattr("insideout.core.compare.study.FIGURES", 10_000)
    assert kept_figures(path, {"of": 1}, lambda: {"psnr": 31.0}) == {"psnr": 31.0}


def test_files_of_something_else_where_a_row_would_go_are_left_alone(study):
    notes = study.folder / "fdk" / "notes.txt"
    notes.parent.mkdir(parents=True)
    notes.write_text("precious")
    with pytest.raises(RunFolderError, match="fdk: holds files of something else"):
        study.make(METHODS["fdk"])
    assert notes.read_text() == "precious"


class TestFolderOfACapture:
    @pytest.fixture
    def folder(self, tmp_path):
        return tmp_path / "out" / "skull"

    def test_a_new_one_and_an_empty_one_are_taken(self, folder):
        refuse_foreign(folder)
        folder.mkdir(parents=True)
        (folder / ".lock").touch()
        refuse_foreign(folder)
        assert [file.name for file in folder.iterdir()] == [".lock"]

    @pytest.mark.parametrize("name", ["notes.txt", "fdk/notes.txt", "report.json", "surface/report.json"])
    def test_files_of_something_else_are_refused_and_left_alone(self, folder, name):
        (folder / name).parent.mkdir(parents=True)
        (folder / name).write_text("precious")
        with pytest.raises(RunFolderError, match="skull: holds files of something else; choose another --out"):
            refuse_foreign(folder)
        assert [file for file in folder.rglob("*") if file.is_file()] == [folder / name]

    @pytest.mark.parametrize(
        "name", ["fdk/started.json", "insideout/capture.json", "3dgs/figures.json", "reference 0123456789ab.npz"]
    )
    def test_a_comparison_that_was_begun_before_there_was_a_mark_goes_on(self, folder, name):
        write_json(folder / name, {})
        refuse_foreign(folder)
        assert [file for file in folder.rglob("*") if file.is_file()] == [folder / name]

    def test_one_that_is_marked_is_taken_whatever_is_in_it(self, folder):
        mark(folder)
        (folder / "notes.txt").write_text("of the user's, beside the rows")
        refuse_foreign(folder)
        assert (folder / "notes.txt").read_text() == "of the user's, beside the rows"


def test_a_row_of_fewer_projections_begins_with_the_iterations_that_more_took(study, monkeypatch):
    asked = []

    def search(seconds, first, *_):
        asked.append(first())
        return {"iterations": asked[-1], "seconds": seconds, "tries": []}

    monkeypatch.setattr("insideout.core.compare.study.iterations_in_time", search)
    runs = []

    class Thinned(Study):
        def reference(self):
            return SimpleNamespace(xray_seconds=5.0)

        def run(self, folder, capture, settings, *_, **__):
            runs.append(settings.stages["surface"].xray.iterations)
            return {"stages": {"surface": {"xray": {"seconds": 5.0}}}}

    fewer = Thinned(study.capture, study.folder / "projections/8", study.settings, None, Reporter(), fuller=study)
    method = METHODS["r2_gaussian"]
    usual = study.settings.stages["surface"].xray.iterations
    fewer.make(method)
    write_json(study.folder / "tries" / "r2_gaussian.json", {"asked": {}, "first": usual, "tries": [[usual + 5, 5.1]]})
    fewer.make(method)
    assert asked == [usual, usual + 5]
    assert runs[-1] == usual + 5


@pytest.mark.parametrize(("effects", "shared"), [("geometry", False), ("none", True)])
def test_runs_with_other_effects_share_no_stages(effects, shared, tiny_settings, tmp_path):
    other, run = RunFolder(tmp_path / "other"), RunFolder(tmp_path / "run")
    write_json(other.path / "capture.json", {"digest": "of a capture", "path": "x"})
    write_json(other.path / "settings.json", plain(tiny_settings))
    made = {"settings": plain(tiny_settings.stages["initialize"]), "seconds": 1.0}
    write_json(other.stage("initialize") / "report.json", made)
    share(Wanted(run, "of a capture", replace(tiny_settings, effects=effects), ("initialize",)), tmp_path)
    assert run.is_done("initialize") is shared


class Slow(Study):
    """Takes a tenth of a second of its own clock for each iteration, where InsideOut has two seconds in all."""

    def reference(self):
        return SimpleNamespace(xray_seconds=2.0)

    def run(self, folder, capture, settings, leave_out=(), title="", stages=(), half="", code=None):
        count = settings.stages["surface"].xray.iterations
        for iteration in range(1, count + 1):
            self.reporter.check()
            DAY.now += 0.1
            self.reporter.update(Progress(title, "surface xray", iteration / count, iteration, count))
        DAY.ended.append(count)
        return {"stages": {"surface": {"xray": {"seconds": 0.1 * count}}}}


DAY = SimpleNamespace(now=0.0, ended=[])


def slow(study, monkeypatch, reporter):
    DAY.now = 0.0
    monkeypatch.setattr("insideout.core.progress.time", SimpleNamespace(monotonic=lambda: DAY.now))
    monkeypatch.setattr("insideout.core.compare.study.work_clock", lambda: DAY.now)
    DAY.ended.clear()
    method = METHODS["r2_gaussian"]
    made = Slow(study.capture, study.folder, study.settings, None, reporter)
    return made._budget(method, method.for_iterations, study.folder / method.name)


def test_a_try_that_takes_longer_than_it_may_is_ended_and_one_of_its_time_is_the_row(study, monkeypatch):
    """A try of all usual iterations, which a slow method would take minutes over, is not made to its end."""
    budget = slow(study, monkeypatch, Reporter())
    usual = study.settings.stages["surface"].xray.iterations
    assert budget["tries"][0] == [usual, pytest.approx(0.1 * usual)]
    assert 20 <= budget["iterations"] <= 24
    assert DAY.ended == [2, budget["iterations"]]


def test_a_user_who_cancels_a_try_ends_the_comparison(study, monkeypatch):
    with pytest.raises(Cancelled):
        slow(study, monkeypatch, Reporter(is_cancelled=lambda: DAY.now > 0.5))
    assert DAY.ended == [2]
