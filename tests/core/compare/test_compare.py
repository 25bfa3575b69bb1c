"""A comparison end to end on the tiny capture: its rows, what they share, how it goes on, and what it refuses."""

import json
import shutil
import time
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from insideout.core.capture.read import read_capture
from insideout.core.cli import app
from insideout.core.compare.compare import compare
from insideout.core.compare.methods import METHODS, Reconstructed
from insideout.core.compare.options import CompareSettings
from insideout.core.compare.pictures import CUT, load_cut
from insideout.core.compare.study import Study
from insideout.core.compare.truth import Truth
from insideout.core.errors import Cancelled, CaptureError, RunFolderError, SettingError
from insideout.core.files import plain
from insideout.core.gaussians import GaussianSet
from insideout.core.pipeline import reconstruct
from insideout.core.progress import Reporter
from insideout.core.run_folder import RunFolder
from insideout.core.sart import SartSettings
from insideout.core.volume import Volume


def test_every_row_has_its_figures(compared):
    _, _, content = compared
    rows, truth = (content["captures"]["matryoshka"][name] for name in ("methods", "truth"))
    assert set(rows) == {"3dgs", "fdk", "additive", "gs2mesh", "insideout"}
    assert 0 < truth["measured_sections"] <= truth["held_out_sections"]
    for name in ("fdk", "additive", "insideout"):
        # Air everywhere has some PSNR, too.
        assert truth["nothing"]["psnr"] + 3 < rows[name]["sections"]["psnr"] < 60, name
        assert rows[name]["sections"]["count"] == truth["measured_sections"], name
        assert 5 < rows[name]["volume"]["psnr"] < 60, name
        assert 5 < rows[name]["projections"]["psnr"] < 60, name
        # Walls and the gaps between them are half a voxel here, and the joint fit takes a few steps only.
        within = 2 if name == "insideout" else 1
        assert rows[name]["mesh"]["outer"]["to_truth"]["mean_voxels"] < within, name
    # The walls are half a voxel thick here: of models fitted for 40 steps a mesh shows the bright seam alone.
    assert rows["fdk"]["mesh"]["outer"]["from_truth"]["mean_voxels"] < 1
    assert {"paper", "occupancy"} <= set(rows["3dgs"]["sections"])
    assert rows["3dgs"]["projections"] is None
    assert rows["3dgs"]["sections"]["frame"] == "the true similarity"
    assert rows["insideout"]["chamfer"]["align"]["mm"] > 0
    alignment = content["captures"]["matryoshka"]["alignment"]
    # Photo splats and radiative ones have a distance from each other where the frames fit to the last digit, too.
    assert 0 < alignment["chamfer_at_truth"]["mm"] < alignment["chamfer"]["none"]["mm"]


def test_a_mesh_row_is_made_of_another_row_s_splats_and_measured_in_mm(compared):
    out, _, content = compared
    row = content["captures"]["matryoshka"]["methods"]["gs2mesh"]
    assert row["seconds"] > json.loads((out / "matryoshka/3dgs/report.json").read_text())["seconds"]
    assert row["mesh"]["frame"] == "the true similarity"
    assert row["mesh"]["outer"]["to_truth"]["mean_mm"] < 15


def test_the_ablation_has_its_rows_and_shares_what_they_have_in_common(compared):
    out, _, content = compared
    rows = content["captures"]["matryoshka"]["ablation"]
    assert set(rows) == {"ablation/none", "ablation/published_rates"}
    none, whole = (
        json.loads((out / "matryoshka" / name / "surface/report.json").read_text())
        for name in ("ablation/none", "insideout")
    )
    assert none == whole
    assert rows["ablation/published_rates"]["photos"] is None
    assert rows["ablation/published_rates"]["sections"]["psnr"] > 5
    assert "| matryoshka | ... X-ray half at R²-Gaussian's rates | – |" in (out / "tables.md").read_text("utf-8")


def test_every_row_knows_the_machine_that_it_was_made_on(compared):
    out, _, content = compared
    one = content["captures"]["matryoshka"]
    parts = {"": one["methods"], "projections/8": one["projections"]["8"]}
    for folder, rows in {**parts, " ": one["ablation"]}.items():
        for name, row in rows.items():
            kept = json.loads((out / "matryoshka" / folder.strip() / name / "machine.json").read_text())
            assert row["machine"] == kept["machine"]
            assert {name: row["machine"][name] for name in ("cpu", "cores")} == {
                name: content["machine"][name] for name in ("cpu", "cores")
            }


def test_the_machine_is_kept_before_figures_are_measured(compared, tiny_capture, monkeypatch, tmp_path):
    """Measuring may be interrupted and taken up on another machine: the row's seconds are those of this one."""
    out, options, _ = compared
    shutil.copytree(out, tmp_path / "out")
    for name in ("machine.json", "figures.json"):
        (tmp_path / "out/matryoshka/fdk" / name).unlink()

    def stopped(*_, **__):
        raise Cancelled

    monkeypatch.setattr("insideout.core.compare.compare.row_figures", stopped)
    with pytest.raises(Cancelled):
        compare([tiny_capture], tmp_path / "out", options)
    assert (tmp_path / "out/matryoshka/fdk/machine.json").exists()


def test_a_comparison_of_some_methods_leaves_the_other_rows_in_the_tables(
    compared, tiny_capture, monkeypatch, tmp_path
):
    out, options, content = compared
    shutil.copytree(out, tmp_path / "out")

    def forbidden(*_, **__):
        raise AssertionError("made again")

    monkeypatch.setattr("insideout.core.compare.study.reconstruct", forbidden)
    again = compare([tiny_capture], tmp_path / "out", CompareSettings(("fdk",), options.settings, starts=0))
    assert again["captures"] == content["captures"]


def test_the_additive_row_gets_the_x_ray_seconds_of_insideout(compared):
    out, _, content = compared
    budget = content["captures"]["matryoshka"]["methods"]["additive"]["budget"]
    stages = json.loads((out / "matryoshka" / "insideout" / "report.json").read_text())["stages"]
    spent = stages["surface"]["xray"]["seconds"] + stages["internal"]["joint"]["xray_seconds"]
    assert budget["seconds"] == pytest.approx(spent)
    assert budget["iterations"] == budget["tries"][-1][0]
    # Each count is a run of its own, with its own time; one that is come back to may keep its run.
    assert len({seconds for _, seconds in budget["tries"]}) >= len({count for count, _ in budget["tries"]})
    surface = json.loads((out / "matryoshka" / "additive" / "surface" / "report.json").read_text())
    assert [surface["xray"]["iterations"], surface["xray"]["seconds"]] == budget["tries"][-1]


def test_a_half_taken_from_the_whole_run_is_what_a_run_of_that_half_makes(compared, tiny_capture, tmp_path):
    out, options, _ = compared
    alone = read_capture(tiny_capture).photos_only()
    reconstruct(alone, tmp_path / "run", settings=options.settings)
    for name in ("initialize/rgb.ply", "surface/rgb.ply"):
        shared, made = (GaussianSet.load(folder / name) for folder in (out / "matryoshka" / "3dgs", tmp_path / "run"))
        np.testing.assert_array_equal(shared.means, made.means)
        np.testing.assert_array_equal(shared.opacities, made.opacities)
    assert not (out / "matryoshka" / "3dgs" / "surface" / "xray.ply").exists()


def test_a_stage_that_was_left_out_is_made_when_it_is_wanted(compared, tiny_capture, tiny_settings, tmp_path):
    out, _, _ = compared
    run = RunFolder(tmp_path / "run")
    shutil.copytree(out / "matryoshka" / "additive", run.path)
    assert run.report("internal")["left_out"]
    assert run.report("align")["skipped"].startswith("there are no photos")
    report = json.loads((run.path / "report.json").read_text())
    stages = {stage: report["stages"][stage]["settings"] for stage in ("initialize", "surface", "fuse")}
    surface = tiny_settings.stages["surface"]
    settings = replace(
        tiny_settings,
        stages={
            **tiny_settings.stages,
            "surface": replace(
                surface,
                rgb=replace(
                    surface.rgb,
                    **{name: stages["surface"]["rgb"][name] for name in ("low_pass", "mip_filter", "degree")},
                ),
                xray=replace(surface.xray, iterations=stages["surface"]["xray"]["iterations"]),
            ),
            "internal": replace(
                tiny_settings.stages["internal"],
                display_iterations=3,
                joint=replace(tiny_settings.stages["internal"].joint, iterations=3),
            ),
        },
    )
    told = []
    reconstruct(
        read_capture(tiny_capture).xrays_only(),
        run.path,
        settings=settings,
        on_stage=lambda stage, state, _: told.append((stage, state)),
    )
    assert told[:3] == [("initialize", "kept"), ("surface", "kept"), ("align", "kept")]
    assert ("internal", "done") in told
    assert ("fuse", "done") in told


def test_the_command_prints_where_its_tables_are(tiny_capture, monkeypatch, tmp_path):
    asked = []
    monkeypatch.setattr("insideout.core.compare.compare.compare", lambda *given: asked.append(given))
    options = ["--methods", "fdk,3dgs,fdk", "--preset", "draft", "--starts", "0", "--no-ablation", "--projections", "8"]
    done = CliRunner().invoke(app, ["compare", str(tiny_capture), "--out", str(tmp_path / "out"), *options])
    assert done.exit_code == 0, done.output
    assert "tables.md" in done.output
    captures, out, settings, _ = asked[0]
    assert (captures, out) == ([tiny_capture], tmp_path / "out")
    assert (settings.methods, settings.projections, settings.ablation) == (("fdk", "3dgs"), (8,), False)


def test_tables_and_plot_are_left(compared):
    out, _, content = compared
    assert json.loads((out / "tables.json").read_text()) == plain(content)
    text = (out / "tables.md").read_text("utf-8")
    headings = ["1. Internal detail", "2. Alignment", "3. Meshes", "4. Ablation", "Fewer projections", "Time"]
    places = [text.index(f"## {heading}") for heading in ["In short", *headings, "How it was measured"]]
    assert places == sorted(places)
    assert "In progress" not in text
    assert "- Rows not run of matryoshka: 3DGS-MCMC, " in text
    assert "| nothing at all (air) |" in text
    assert "| 3DGS, as the paper does" in text
    assert "16.25" in text
    assert Image.open(out / "plot.png").size == (980, 510)
    sheet = np.asarray(Image.open(out / "matryoshka" / "sections.png").convert("RGB")).astype(int)
    # Nothing but differences from the truth has a colour: the truth, in the first of three columns, has none.
    colored = np.flatnonzero((np.ptp(sheet, axis=2) > 20).any(axis=0))
    assert sheet.shape[1] / 3 - 10 < colored.min() < colored.max() < sheet.shape[1]
    assert len(load_cut(out / "matryoshka" / "fdk" / CUT)) == 2


def test_the_start_is_moved_and_measured_against_the_truth(compared):
    _, _, content = compared
    alignment = content["captures"]["matryoshka"]["alignment"]
    assert set(alignment["starts"]) == {"shape", "landmarks"}
    # From wherever the photos' frame starts, landmarks lead to where the run itself came to.
    found = alignment["starts"]["landmarks"]["starts"][0]
    for name, nearly in (("scale_percent", 1.0), ("rotation_deg", 1.0), ("translation_mm", 1.0)):
        assert found[name] == pytest.approx(alignment["errors"][name], abs=nearly), name


def test_thinned_rows_see_fewer_projections(compared):
    out, _, content = compared
    rows = content["captures"]["matryoshka"]["projections"]["8"]
    assert set(rows) == {"fdk", "insideout"}
    assert rows["insideout"]["xray_seconds"] > 0
    assert rows["insideout"]["note"].startswith("Of projections alone")
    surface = json.loads((out / "matryoshka/projections/8/insideout/surface/report.json").read_text())
    assert surface["xray"]["projections"] == {"training": 8, "validation": 0, "held_out": 2}
    whole = content["captures"]["matryoshka"]["methods"]["fdk"]["projections"]["psnr"]
    assert rows["fdk"]["projections"]["psnr"] < whole


def test_what_is_finished_is_not_made_again(compared, tiny_capture, monkeypatch):
    out, options, content = compared

    def forbidden(*_, **__):
        raise AssertionError("made again")

    monkeypatch.setattr("insideout.core.compare.study.reconstruct", forbidden)
    monkeypatch.setattr("insideout.core.compare.compare.row_figures", forbidden)
    monkeypatch.setattr("insideout.core.compare.starts.place", forbidden)
    again = compare([tiny_capture], out, options)
    assert again["captures"] == content["captures"]


def test_a_stopped_comparison_goes_on_and_one_with_other_settings_is_refused(tiny_capture, tiny_settings, tmp_path):
    def options(iterations):
        surface = tiny_settings.stages["surface"]
        surface = replace(surface, rgb=replace(surface.rgb, iterations=iterations))
        settings = replace(tiny_settings, stages={**tiny_settings.stages, "surface": surface})
        return CompareSettings(("3dgs",), settings, starts=0, ablation=False)

    fitting, asked = [], []

    def listen(progress):
        if progress.part == "surface rgb":
            fitting.append(True)

    def is_cancelled():
        # Asked at least once in each iteration.
        asked.extend(fitting[:1])
        return len(asked) > 30

    out = tmp_path / "out"
    with pytest.raises(Cancelled):
        compare([tiny_capture], out, options(50), Reporter(listen, is_cancelled))
    assert (out / "matryoshka" / "3dgs" / "surface" / "rgb.checkpoint.pt").exists()
    heard = []
    compare(
        [tiny_capture], out, options(50), Reporter(lambda progress: heard.append((progress.part, progress.iteration)))
    )
    assert not [part for part, _ in heard if "initialize sfm" in part]
    assert min(iteration for part, iteration in heard if part == "surface rgb" and iteration) > 5
    with pytest.raises(RunFolderError, match=r"another version of the program.* choose another --out"):
        compare([tiny_capture], out, options(30))
    kept = json.loads((out / "matryoshka/3dgs/surface/report.json").read_text())
    assert kept["rgb"]["iterations"] == 50


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"methods": ("nerf",)}, "--methods nerf: there is no such method; choose of 3dgs"),
        ({"projections": (40,)}, "--projections 40: .* 16 training projections"),
    ],
)
def test_what_cannot_be_done_is_refused_before_anything_runs(tiny_capture, tmp_path, change, message):
    with pytest.raises(SettingError, match=message):
        compare([tiny_capture], tmp_path / "out", CompareSettings(**change))
    assert not (tmp_path / "out").exists()


def test_two_captures_of_one_name_are_refused(tiny_capture, tmp_path):
    with pytest.raises(SettingError, match="two captures are called 'matryoshka'"):
        compare([tiny_capture, tiny_capture], tmp_path / "out", CompareSettings())


def test_an_out_inside_a_capture_is_refused(tiny_capture):
    with pytest.raises(RunFolderError, match="lies inside the capture"):
        compare([tiny_capture], tiny_capture / "out", CompareSettings())


def test_an_out_beside_a_capture_is_refused_where_its_folder_would_be_the_capture(tiny_capture):
    before = sorted(tiny_capture.rglob("*"))
    with pytest.raises(RunFolderError, match="lies inside the capture"):
        compare([tiny_capture], tiny_capture.parent, CompareSettings(("fdk",), starts=0))
    assert sorted(tiny_capture.rglob("*")) == before


def test_a_row_that_the_capture_cannot_have_is_named(tiny_capture, monkeypatch, tmp_path):
    def refuse(*_, **__):
        raise CaptureError("a projection is a mirror image.")

    monkeypatch.setattr("insideout.core.compare.study.reconstruct", refuse)
    with pytest.raises(CaptureError, match=r"matryoshka, row 'x_gaussian': .* mirror .*--methods without x_gaussian"):
        compare([tiny_capture], tmp_path / "out", CompareSettings(("x_gaussian",), same_time=False, starts=0))


def test_a_row_of_the_ablation_that_a_capture_cannot_have_is_named_as_such(
    compared, tiny_capture, monkeypatch, tmp_path
):
    out, options, _ = compared
    shutil.copytree(out, tmp_path / "out")

    def refuse(*_, **__):
        raise CaptureError("a projection is a mirror image.")

    monkeypatch.setattr("insideout.core.compare.study.reconstruct", refuse)
    with pytest.raises(CaptureError, match=r"row 'affine': .*--ablation-rows without affine"):
        compare([tiny_capture], tmp_path / "out", replace(options, ablation_rows=("affine",)))


def test_a_row_of_the_ablation_that_no_capture_can_have_is_refused(tiny_capture, tmp_path, monkeypatch):
    xrays = read_capture(tiny_capture).xrays_only()
    monkeypatch.setattr("insideout.core.compare.compare.read_capture", lambda *_: xrays)
    options = CompareSettings(("insideout",), ablation_rows=("align",))
    with pytest.raises(SettingError, match="--ablation-rows align: none of these captures can have this row"):
        compare([tiny_capture], tmp_path / "out", options)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("at_centers", [False, True])
def test_voxels_are_made_as_the_truth_has_them(tiny_capture, tiny_settings, tmp_path, at_centers):
    told = []

    def voxels(job):
        told.append(job.at_centers)
        return Reconstructed(Volume.centered(np.ones((4, 4, 4), np.float32), np.ones(3)))

    truth = Truth(Volume.centered(np.ones((4, 4, 4), np.float32), np.ones(3)), True, "", at_centers=at_centers)
    study = Study(read_capture(tiny_capture), tmp_path / "matryoshka", tiny_settings, truth, Reporter())
    study.make(replace(METHODS["sart"], volume=voxels))
    assert told == [at_centers]


def test_seconds_of_a_row_that_begins_anew_are_those_of_the_last_time(tiny_capture, tiny_settings, tmp_path):
    """Voxels have no checkpoint: what was lost with a cancelled reconstruction is no part of the next."""
    lost = []

    def voxels(job):
        if not lost:
            lost.append(True)
            time.sleep(3.0)
            raise Cancelled
        return Reconstructed(Volume.centered(np.ones((4, 4, 4), np.float32), np.ones(3)))

    study = Study(read_capture(tiny_capture), tmp_path / "matryoshka", tiny_settings, None, Reporter())
    method = replace(METHODS["sart"], volume=voxels)
    with pytest.raises(Cancelled):
        study.make(method)
    assert study.make(method).seconds < 3.0


def test_files_of_something_else_are_left_alone(tiny_capture, tmp_path):
    notes = tmp_path / "out" / "matryoshka" / "fdk" / "notes.txt"
    notes.parent.mkdir(parents=True)
    notes.write_text("precious")
    with pytest.raises(RunFolderError, match="matryoshka: holds files of something else"):
        compare([tiny_capture], tmp_path / "out", CompareSettings(("fdk",), starts=0))
    assert [file for file in (tmp_path / "out").rglob("*") if file.is_file()] == [notes]
    assert notes.read_text() == "precious"


def test_a_row_of_voxels_is_made_anew_where_its_own_settings_changed(tiny_capture, tiny_settings, tmp_path):
    made = []

    def voxels(job):
        made.append(job)
        return Reconstructed(Volume.centered(np.ones((4, 4, 4), np.float32), np.ones(3)))

    study = Study(read_capture(tiny_capture), tmp_path / "matryoshka", tiny_settings, None, Reporter())
    twice = replace(METHODS["sart"], volume=voxels, own=lambda: SartSettings(iterations=2))
    study.make(twice)
    study.make(twice)
    assert len(made) == 1
    study.make(replace(twice, own=SartSettings))
    assert len(made) == 2


def test_mcmc_gets_as_many_splats_as_3dgs_has(tiny_capture, tiny_settings, tmp_path):
    study = Study(read_capture(tiny_capture), tmp_path / "matryoshka", tiny_settings, None, Reporter())
    made, plain_row = (study.make(METHODS[name]) for name in ("mcmc", "3dgs"))
    strategy = made.report["stages"]["surface"]["settings"]["rgb"]["strategy"]
    assert strategy["most"] == plain_row.report["splats"]["final"] > 100
    assert made.report["splats"]["final"] <= max(strategy["most"], len(made.run.read_set("initialize", "rgb")))
