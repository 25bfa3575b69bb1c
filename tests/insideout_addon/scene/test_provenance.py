"""Where a model is from: of its run, on the object, in the comments of a .ply."""

from __future__ import annotations

import json
import shutil

import bpy
import pytest

import insideout
from insideout.core.errors import MeshFileError
from insideout.core.gaussians import GaussianSet
from insideout.core.ply import read_comments, says_relative, write_ply
from insideout.insideout_addon.engine.curve_picture import CurvePoint
from insideout.insideout_addon.physics.whole import mesh_path
from insideout.insideout_addon.scene.ct_volume import has_volume
from insideout.insideout_addon.scene.exporting import export_splats
from insideout.insideout_addon.scene.importing import (
    WATER_KEY,
    densities_are_relative,
    import_splats,
    lengths_are_arbitrary,
    warnings_of,
)
from insideout.insideout_addon.scene.provenance import (
    PROVENANCE_KEY,
    comment_lines,
    curve_of,
    provenance_in_comments,
    provenance_of,
    read_provenance,
)
from insideout.insideout_addon.scene.provenance_text import effect_lines, provenance_lines

REPORT = {
    "preset": "draft",
    "seed": 3,
    "seconds": 76.5,
    "stages": {},
    "versions": {"insideout": "0.1.0", "torch": "2.13.0"},
    "heldout": {
        "photos": {"psnr": 27.51, "ssim": 0.9, "count": 5, "rgb": {"psnr": 1.0}},
        "projections": {"psnr": 42.2, "count": 7},
        "sections": {"psnr": None, "reference": "FDK of all projections"},
    },
    "curve": [
        {"stage": "surface", "part": "rgb", "iteration": 9, "seconds": 20.123456, "splats": 5, "photos": 27.123456},
        {"stage": "report", "part": "", "seconds": 76.512345, "photos": 27.51, "projections": 42.2},
    ],
}
# As a run writes them, see core/effects/choose.py.
EFFECTS = [
    {
        "name": "defocus",
        "half": "photos",
        "found": None,
        "strength": None,
        "unit": "",
        "threshold": None,
        "used": True,
        "chosen_by": "user",
        "reason": "There are no points of the object. It is used because you asked for it.",
        "seconds": 0.0,
    },
    {
        "name": "scatter",
        "half": "xray",
        "found": False,
        "strength": 0.312,
        "unit": "% of the peak",
        "used": False,
        "chosen_by": "auto",
        "reason": "The air beside the shadow is dark.",
        "seconds": 0.5,
    },
    {
        "name": "beam_hardening",
        "half": "xray",
        "found": None,
        "strength": None,
        "unit": "%",
        "used": False,
        "chosen_by": "auto",
        "reason": "The views are too narrow.",
        "seconds": 0.1,
    },
    {
        "name": "geometry",
        "half": "xray",
        "found": True,
        "strength": 1.3179,
        "unit": "px",
        "threshold": 0.25,
        "error": 0.01,
        "used": True,
        "chosen_by": "auto",
        "gain_db": 2.43,
        "times_as_long": 1.74,
        "reason": "The detector stands 1.32 px to the right.",
        "told": [{"template": "The detector stands {px:.2f} px to the right.", "values": {"px": 1.3179}}],
        "seconds": 3.0,
    },
    {
        "name": "exposure",
        "half": "photos",
        "found": None,
        "strength": None,
        "unit": "%",
        "threshold": 3.0,
        "used": False,
        "chosen_by": "auto",
        "reason": "The photos share no points.",
        "seconds": 0.3,
    },
]


@pytest.fixture
def run(tmp_path, random_set):
    """A finished run of a capture with a name of its own."""
    run = tmp_path / "my run"
    random_set.save(run / "fused.ply")
    random_set.save(run / "surface" / "xray.ply")
    capture = {"digest": "ab12", "path": "C:\\captures\\Püppchen"}
    files = {"report.json": REPORT, "capture.json": capture, "settings.json": {"preset": "draft", "stages": {"x": 1}}}
    for name, content in files.items():
        (run / name).write_text(json.dumps(content), "utf-8")
    (run / "log.jsonl").write_text('{"time": 1.0}\n{"time": 1795382185.65, "part": "done"}\n', "utf-8")
    return run


def test_a_run_tells_capture_settings_versions_and_figures(run, random_set):
    found = read_provenance(run / "fused.ply", random_set, "mm")
    assert found["run"] == {
        "name": "my run",
        "finished": "2026-11-22T21:16:25+00:00",
        "preset": "draft",
        "seed": 3,
        "seconds": 76.5,
    }
    assert found["capture"] == {"name": "Püppchen", "digest": "ab12"}
    assert found["settings"]["stages"] == {"x": 1}
    assert found["versions"]["torch"] == "2.13.0"
    assert found["heldout"]["photos"] == {"psnr": 27.51, "ssim": 0.9, "count": 5}
    assert found["file"]["name"] == "fused.ply"
    assert (found["file"]["splats"], found["file"]["sh_degree"], found["unit"]) == (200, 1, "mm")


def test_a_file_of_a_stage_belongs_to_the_run_above(run, random_set):
    assert read_provenance(run / "surface" / "xray.ply", random_set, "mm")["capture"]["digest"] == "ab12"


def test_a_file_that_only_lies_in_a_run_folder_is_none_of_the_run_s(run, random_set):
    """A copy that another program has changed, and an export over the run's own file."""
    random_set.save(run / "changed.ply")
    write_ply(random_set, run / "fused.ply", comment_lines({"capture": {"name": "vase"}, "exported": {"date": "2026"}}))
    assert not {"run", "capture", "heldout"} & set(read_provenance(run / "changed.ply", random_set, "mm"))
    found = read_provenance(run / "fused.ply", random_set, "mm")
    assert found["capture"] == {"name": "vase"}
    assert "heldout" not in found


@pytest.mark.parametrize("content", ["", "[]", "{", '{"stages": 3, "heldout": 5, "versions": [], "preset": null}'])
def test_reports_that_make_no_sense_do_not_stop_an_import(tmp_path, random_set, content):
    random_set.save(tmp_path / "fused.ply")
    for name in ("report.json", "capture.json", "settings.json", "log.jsonl"):
        (tmp_path / name).write_text(content, "utf-8")
    found = read_provenance(tmp_path / "fused.ply", random_set, "mm")
    assert found["file"]["splats"] == 200
    assert all(isinstance(line, str) for line in provenance_lines(found))


def test_it_is_kept_on_the_object_and_in_the_blend(blender, run, tmp_path):
    import_splats(run / "fused.ply", "model", bpy.context)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    model = bpy.data.objects["model"]
    found = provenance_of(model)
    assert isinstance(model[PROVENANCE_KEY], str), "any program that opens the .blend can read it"
    assert found["capture"]["name"] == "Püppchen"
    assert found["imported"]["blender"] == bpy.app.version_string
    assert found["imported"]["insideout"] == insideout.__version__
    assert found["imported"]["date"].startswith("20")


def test_the_curve_is_kept_though_the_run_has_gone(blender, run, tmp_path):
    import_splats(run / "fused.ply", "model", bpy.context)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    shutil.rmtree(run)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    assert curve_of(bpy.data.objects["model"]) == (
        CurvePoint("surface", "rgb", 20.1, photos=27.12),
        CurvePoint("report", "", 76.5, photos=27.51, projections=42.2),
    )


def test_a_header_has_no_room_for_the_curve(run, random_set):
    lines = comment_lines(read_provenance(run / "fused.ply", random_set, "mm"))
    assert any("preset" in line for line in lines)
    assert not any("curve" in line for line in lines)


@pytest.mark.parametrize("text", ["", "no json", "[1]", '{"curve": 3}', '{"curve": [3, {"seconds": null}]}'])
def test_a_model_that_knows_no_curve_has_no_points(blender, text):
    bpy.ops.mesh.primitive_cube_add()
    bpy.context.object[PROVENANCE_KEY] = text
    assert curve_of(bpy.context.object) == ()


def test_lines_for_the_panel(run, random_set):
    assert provenance_lines(read_provenance(run / "fused.ply", random_set, "mm")) == [
        "Püppchen · draft · 2026-11-22 · InsideOut 0.1.0",
        "Tested on images that were kept back, more is better: photos 27.5 dB, projections 42.2 dB",
    ]
    assert provenance_lines({}) == []


def test_the_panel_shows_them(draw_panels, run):
    import_splats(run / "fused.ply", "model", bpy.context)
    drawn = " ".join(draw_panels())
    assert "Püppchen · draft · 2026-11-22" in drawn
    assert "Tested on images that were kept back, more is better: photos 27.5 dB" in drawn


@pytest.mark.parametrize("text", [None, "", "no json", "[1]", '{"run": 1, "heldout": {"photos": 2}}'])
def test_what_others_have_written_onto_an_object(blender, text):
    bpy.ops.object.empty_add()
    if text is not None:
        bpy.context.object[PROVENANCE_KEY] = text
    assert provenance_lines(provenance_of(bpy.context.object)) == []


class TestEffects:
    """What a run looked for, with what it found."""

    @pytest.fixture
    def run(self, run):
        (run / "report.json").write_text(json.dumps({**REPORT, "effects": EFFECTS}), "utf-8")
        return run

    def test_they_are_kept_by_name(self, run, random_set):
        effects = read_provenance(run / "fused.ply", random_set, "mm")["effects"]
        assert list(effects) == ["defocus", "scatter", "beam_hardening", "geometry", "exposure"]
        known = {key: value for key, value in EFFECTS[3].items() if key not in ("name", "seconds")}
        assert effects["geometry"] == known

    def test_a_run_that_was_not_asked_has_none(self, run, random_set):
        (run / "report.json").write_text(json.dumps({**REPORT, "effects": []}), "utf-8")
        found = read_provenance(run / "fused.ply", random_set, "mm")
        assert "effects" not in found
        assert effect_lines(found) == []

    def test_lines_for_the_panel(self, run, random_set):
        lines = effect_lines(read_provenance(run / "fused.ply", random_set, "mm"))
        assert [line.told for line in lines] == [
            "Defocus: not looked for, used",
            "Scatter: not needed, 0.31 % of the peak, not used",
            "Beam Hardening: cannot tell, not used",
            "Geometry: found, 1.3 px, used, worth +2.4 dB in a trial, steps 1.7 times as long",
            "Exposure: cannot tell, not used",
        ]
        assert [(line.found, line.used) for line in lines] == [
            (None, True),
            (False, False),
            (None, False),
            (True, True),
            (None, False),
        ]
        assert lines[3].reason == "The detector stands 1.32 px to the right."

    def test_the_panel_shows_them_with_the_run_s_figures(self, draw_panels, run):
        import_splats(run / "fused.ply", "model", bpy.context)
        bpy.context.scene.insideout.capture = str(run)
        texts = draw_panels(width=2000)
        told = [
            "Geometry: found, 1.3 px, used, worth +2.4 dB in a trial, steps 1.7 times as long",
            "The detector stands 1.32 px to the right.",
        ]
        assert [text for text in texts if text in told] == told
        assert texts.count("Effects") == 2, "a setting of the next run, and the findings of this one"
        narrow = draw_panels(width=250)
        assert told[1] not in narrow
        assert told[1] in " ".join(narrow), "its lines are wrapped"

    def test_they_go_out_and_come_back_with_a_ply(self, run, random_set, tmp_path):
        known = read_provenance(run / "fused.ply", random_set, "mm")
        write_ply(random_set, tmp_path / "out.ply", comment_lines(known))
        assert effect_lines(provenance_in_comments(tmp_path / "out.ply")) == effect_lines(known)

    @pytest.mark.parametrize("rows", [5, [1, {}], [{"name": 3}, {"name": "a.b"}], {"geometry": {}}])
    def test_rows_that_make_no_sense_are_left_out(self, run, random_set, rows):
        (run / "report.json").write_text(json.dumps({**REPORT, "effects": rows}), "utf-8")
        assert effect_lines(read_provenance(run / "fused.ply", random_set, "mm")) == []

    def test_an_effect_of_a_newer_version_is_told_by_its_name(self):
        (line,) = effect_lines({"effects": {"ghosts": {"found": True, "used": False, "strength": float("nan")}}})
        assert line.told == "ghosts: found, not used"


class TestInComments:
    """An exported file says where it is from, and an import of it reads that again."""

    def test_facts_come_back_but_for_settings_and_curve(self, run, random_set, tmp_path):
        known = read_provenance(run / "fused.ply", random_set, "mm")
        write_ply(random_set, tmp_path / "out.ply", comment_lines(known))
        found = provenance_in_comments(tmp_path / "out.ply")
        assert found == {key: value for key, value in known.items() if key not in ("settings", "curve")}
        again = read_provenance(tmp_path / "out.ply", random_set, "mm")
        assert again["capture"] == known["capture"]
        assert again["file"]["name"] == "out.ply"

    def test_other_comments_say_nothing(self, random_set, tmp_path):
        odd = ["insideout", "insideout x", "insideout a = {", "insideout a = 1", "insideout a.b = 2", "made = 3"]
        write_ply(random_set, tmp_path / "a.ply", odd)
        assert provenance_in_comments(tmp_path / "a.ply") == {"a": 1}

    def test_millimetres_of_a_model_without_density(self, blender, tmp_path):
        photos = GaussianSet.create([[0.0, 0, 0], [9.0, 0, 0]], 1.0)
        write_ply(photos, tmp_path / "mm.ply", comment_lines({"unit": "mm"}))
        write_ply(photos, tmp_path / "none.ply")
        assert not lengths_are_arbitrary(import_splats(tmp_path / "mm.ply", "a", bpy.context))
        assert lengths_are_arbitrary(import_splats(tmp_path / "none.ply", "b", bpy.context))


class TestImportedAgain:
    """What an export of a run's model is known by, wherever it was saved."""

    @pytest.fixture
    def run(self, blender, tmp_path, random_set):
        """A run of grey values, with a volume and a mesh, and warnings that are longer than a comment."""
        run = tmp_path / "run"
        random_set.save(run / "fused.ply")
        for name in ("initialize/volume.npz", "mesh.glb"):
            (run / name).parent.mkdir(exist_ok=True)
            (run / name).write_bytes(b"any")
        warning = f"{'far/' * 40}volume.tif: has gray values without a unit, so densities are relative"
        told = [{"template": "{where}: has gray values", "values": {"where": "volume.tif"}}]
        report = {"stages": {}, "warnings": [warning], "warnings_told": told, "water_per_mm": 0.0206}
        (run / "report.json").write_text(json.dumps(report), "utf-8")
        return run

    @pytest.mark.parametrize("name", ["elsewhere.ply", "run/half.ply", "run/fused.ply"])
    def test_densities_stay_relative_and_water_what_it_was(self, run, tmp_path, name):
        model = import_splats(run / "fused.ply", "model", bpy.context)
        export_splats(model, tmp_path / name, bpy.context)
        again = import_splats(tmp_path / name, "again", bpy.context)
        assert densities_are_relative(again)
        assert says_relative(read_comments(tmp_path / name)), "for whoever reads its header"
        assert warnings_of(again) == warnings_of(model) == ["volume.tif: has gray values"]
        assert again[WATER_KEY] == model[WATER_KEY] == 0.0206

    @pytest.mark.parametrize("name", ["half.ply", "fused.ply", "surface/xray.ply"])
    def test_volume_and_mesh_of_the_run_whose_folder_it_lies_in_are_of_other_splats(self, run, name):
        model = import_splats(run / "fused.ply", "model", bpy.context)
        assert has_volume(model)
        assert mesh_path(model) == run / "mesh.glb"
        model.location.x += 5
        (run / "surface").mkdir()
        export_splats(model, run / name, bpy.context)
        again = import_splats(run / name, "again", bpy.context)
        assert not has_volume(again)
        with pytest.raises(MeshFileError, match="was not imported from a run"):
            mesh_path(again)
