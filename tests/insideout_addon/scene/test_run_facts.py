"""The unit of a run's lengths and its warnings."""

from __future__ import annotations

import json

import pytest

from insideout.core.capture.volumes import RELATIVE
from insideout.core.densities import Densities
from insideout.core.gaussians import GaussianSet, Modality
from insideout.core.ply import write_ply
from insideout.core.told import Told
from insideout.insideout_addon.scene.provenance import comment_lines
from insideout.insideout_addon.scene.run_facts import (
    ARBITRARY,
    MILLIMETRE,
    RunFacts,
    facts_to_export,
    read_run_facts,
)

# As training leaves it.
_PHOTOS = GaussianSet.create([[0.0, 0, 0]], 1.0, density=1e-9)
_XRAY = GaussianSet.create([[0.0, 0, 0]], 1.0, density=0.02, modality=Modality.XRAY)


@pytest.fixture
def run(tmp_path):
    """`run(similarity, report)`: a run folder whose align stage found that, with that report at its end."""

    def make(similarity=None, report=None):
        found = {"similarity": similarity} if similarity else {"skipped": "there is no X-ray data"}
        for name, content in {"align/report.json": found, "report.json": report}.items():
            (tmp_path / name).parent.mkdir(exist_ok=True)
            if content is not None:
                (tmp_path / name).write_text(json.dumps(content), "utf-8")
        return tmp_path

    return make


def test_photos_alone_have_no_millimetres(run):
    for name in ("rgb.ply", "fused.ply", "surface/rgb.ply", "fuse/fused.ply"):
        assert read_run_facts(run() / name, _PHOTOS).unit == ARBITRARY


def test_photos_brought_onto_xrays_have(run):
    folder = run(similarity={"scale": 2.0})
    assert read_run_facts(folder / "rgb.ply", _PHOTOS).unit == MILLIMETRE
    assert read_run_facts(folder / "align" / "rgb.ply", _PHOTOS).unit == MILLIMETRE
    assert read_run_facts(folder / "surface" / "rgb.ply", _PHOTOS).unit == ARBITRARY, "before they were brought there"


@pytest.mark.parametrize("name", ["rgb.ply", "crop.ply"])
def test_a_file_that_only_lies_in_a_run_folder_is_none_of_the_run_s(run, name):
    """An export, over one of the run's own files too, or a file of another program."""
    folder = run({"scale": 2.0}, {"stages": {}, "warnings": ["few photos"], "water_per_mm": 0.02})
    exported = {"unit": ARBITRARY, "exported": {"date": "2026"}}
    write_ply(_PHOTOS, folder / name, comment_lines(exported) if name == "rgb.ply" else ())
    assert read_run_facts(folder / name, _PHOTOS) == RunFacts(ARBITRARY)
    write_ply(_PHOTOS, folder / name, comment_lines({**exported, "unit": MILLIMETRE}))
    assert read_run_facts(folder / name, _PHOTOS) == RunFacts(MILLIMETRE)


def test_an_export_tells_warnings_in_both_languages_and_the_scan_s_water(run, tmp_path):
    warnings = f"volume.tif: {'long ' * 60}\nfotos/Püppchen 日本.png: 0.05 mm⁻¹, so densities are relative"
    told = [{"template": "{a}", "values": {"a": line}} for line in warnings.splitlines()]
    facts = facts_to_export(warnings, json.dumps(told), 0.0206)
    write_ply(_XRAY, tmp_path / "out.ply", comment_lines({"unit": MILLIMETRE, **facts, "exported": {"date": "2026"}}))
    found = read_run_facts(tmp_path / "out.ply", _XRAY)
    assert found == RunFacts(MILLIMETRE, tuple(warnings.splitlines()), tuple(told), water=0.0206)
    write_ply(_XRAY, tmp_path / "out.ply", comment_lines(facts_to_export("", "[]", None)))
    assert read_run_facts(tmp_path / "out.ply", _XRAY) == RunFacts(MILLIMETRE)


@pytest.mark.parametrize("name", ["copied.ply", "xray.ply", "surface/xray.ply"])
def test_a_copy_and_a_run_that_is_not_done_tell_what_densities_are_in(run, name):
    path = run() / name
    _XRAY.save(path, Densities(water_per_mm=0.0206))
    assert read_run_facts(path, _XRAY) == RunFacts(water=0.0206)
    _XRAY.save(path, Densities(relative=True))
    assert read_run_facts(path, _XRAY) == RunFacts(warnings=(RELATIVE,), told=(RELATIVE.to_json(),))


def test_that_densities_are_relative_is_told_once(run):
    warning = Told("volume.tif: {relative}", relative=RELATIVE)
    folder = run(report={"stages": {}, "warnings": [warning], "warnings_told": [warning.to_json()]})
    _XRAY.save(folder / "fused.ply", Densities(relative=True))
    assert read_run_facts(folder / "fused.ply", _XRAY).warnings == (warning,)


@pytest.mark.parametrize(
    "comments", [{"warnings": 3}, {"warnings": {"a": 1}}, {"warnings_told": {"0": "["}}, {"water_per_mm": "much"}]
)
def test_comments_that_make_no_sense_say_nothing(tmp_path, comments):
    write_ply(_XRAY, tmp_path / "out.ply", comment_lines({**comments, "exported": {}}))
    assert read_run_facts(tmp_path / "out.ply", _XRAY) == RunFacts(MILLIMETRE)


def test_density_has_millimetres_wherever_it_is_from(tmp_path):
    assert read_run_facts(tmp_path / "any.ply", _XRAY) == RunFacts(MILLIMETRE)
    assert read_run_facts(tmp_path / "any.ply", _PHOTOS) == RunFacts(ARBITRARY)


@pytest.mark.parametrize("photos", [None, [], {"photos": [{"camera": {}}]}, {"photos": []}, {"photos": 3}])
def test_up_is_unknown_without_cameras(run, photos):
    folder = run()
    (folder / "initialize").mkdir()
    (folder / "initialize" / "photos.json").write_text(json.dumps(photos), "utf-8")
    assert read_run_facts(folder / "fused.ply", _PHOTOS).up is None


def test_up_is_up_in_the_photos(run):
    folder = run()
    (folder / "initialize").mkdir()
    cameras = [{"world_to_camera": [[1, 0, 0, 0], [0, 0.6 * s, -0.8, 0], [0, 0.8, 0.6 * s, 4]]} for s in (1, -1)]
    photos = [*({"camera": camera} for camera in cameras), {"camera": None}]
    (folder / "initialize" / "photos.json").write_text(json.dumps({"photos": photos}), "utf-8")
    assert read_run_facts(folder / "fused.ply", _PHOTOS).up == pytest.approx((0, 0, 1))
    assert read_run_facts(folder / "fused.ply", _XRAY).up is None, "z is the scanner's axis"


def test_warnings_of_the_run(run):
    folder = run(report={"stages": {}, "warnings": ["xray: grey values without a unit"]})
    for name in ("fused.ply", "fuse/fused.ply"):
        assert read_run_facts(folder / name, _XRAY).warnings == ("xray: grey values without a unit",)


@pytest.mark.parametrize(("told", "known"), [(["a", "b"], ("a", "b")), (["a"], ()), (None, ()), (3, ())])
def test_what_warnings_are_translated_by_is_there_for_all_of_them_or_not_at_all(run, told, known):
    folder = run(report={"stages": {}, "warnings": ["one", "other"], "warnings_told": told})
    assert read_run_facts(folder / "fused.ply", _XRAY).told == known


@pytest.mark.parametrize(("told", "found"), [(0.0206, 0.0206), (None, None), (-1.0, None), ("0.02", None)])
def test_the_water_that_hounsfield_units_were_converted_with(run, told, found):
    folder = run(report={"stages": {}, "warnings": [], "water_per_mm": told})
    assert read_run_facts(folder / "fused.ply", _XRAY).water == found


@pytest.mark.parametrize("content", ["", "[1]", '{"stages": {}, "warnings": 3}', '{"warnings": ["of something else"]}'])
def test_another_report_says_nothing(tmp_path, content):
    (tmp_path / "report.json").write_text(content, "utf-8")
    assert read_run_facts(tmp_path / "fused.ply", _XRAY).warnings == ()
