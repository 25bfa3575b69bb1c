"""Comparisons of captures that are a volume and nothing else, with rows that are not really made."""

import json

import numpy as np
import pytest

from insideout.core.capture.model import Capture
from insideout.core.compare.compare import compare
from insideout.core.compare.options import CompareSettings
from insideout.core.compare.score import volume_mesh
from insideout.core.compare.study import Made, Study
from insideout.core.errors import RunFolderError
from insideout.core.settings import Settings
from insideout.core.volume import Volume


@pytest.fixture
def ball():
    axis = np.arange(24) - 11.5
    radius = np.sqrt(axis[:, None, None] ** 2 + axis[None, :, None] ** 2 + axis[None, None, :] ** 2)
    return Volume.centered((0.05 * np.clip(8.5 - radius, 0, 1)).astype(np.float32), np.ones(3))


@pytest.fixture
def comparison(monkeypatch, tmp_path):
    """`comparison(volume)`: tables.json and tables.md of a comparison whose only row shows half the attenuation."""

    def make(study, method):
        (study.folder / method.name).mkdir(exist_ok=True)
        return Made(method, study.folder / method.name, {"seconds": 2.0, "stages": {}})

    def figures(study, made, judge, surfaces):
        half = Volume(0.5 * study.capture.volume.values, study.capture.volume.spacing_mm, judge.volume.origin_mm)
        missing = dict.fromkeys(("budget", "xray_seconds", "splats", "photos", "projections", "volume", "chamfer"))
        mesh = None if surfaces is None else volume_mesh(half, surfaces)
        found = {"modality": "both", "seconds": made.seconds, "sections": judge.density(half), "mesh": mesh}
        return {**missing, **found}

    monkeypatch.setattr(Study, "make", make)
    monkeypatch.setattr("insideout.core.compare.compare.row_figures", figures)

    def run(volume):
        capture = Capture(tmp_path / "scan", volume=volume, digest="of the scan")
        monkeypatch.setattr("insideout.core.compare.compare.read_capture", lambda *_: capture)
        options = CompareSettings(settings=Settings.of("draft"), starts=0, ablation=False)
        found = compare([capture.path], tmp_path / "out", options)
        assert found == json.loads((tmp_path / "out" / "tables.json").read_text("utf-8"))
        return found, (tmp_path / "out" / "tables.md").read_text("utf-8")

    return run


def test_rows_are_measured_against_what_they_were_given_and_the_reader_is_told(comparison, ball):
    content, text = comparison(ball)
    scan = content["captures"]["scan"]
    assert set(scan["methods"]) == {"insideout"}
    assert scan["possible"] == ["insideout"]
    truth = scan["truth"]
    assert (truth["given"], truth["exact"], truth["source"]) == (True, False, "the capture's volume")
    # Half the attenuation has half the error of none at all.
    gain = scan["methods"]["insideout"]["sections"]["psnr"] - truth["nothing"]["psnr"]
    assert gain == pytest.approx(20 * np.log10(2), abs=1e-3)
    assert "Rows that see X-rays were given this volume, held-out sections too" in text
    assert "| scan | the volume's own surface |" in text
    assert "- InsideOut: There are no projections to be fitted: radiative splats follow the volume's sections." in text
    assert content["coming"] == {"scan": []}


def test_a_volume_without_a_surface_does_not_end_the_comparison(comparison, ball):
    content, text = comparison(Volume(np.zeros_like(ball.values), ball.spacing_mm, ball.origin_mm))
    truth = content["captures"]["scan"]["truth"]
    assert truth["no_surface"]
    assert truth["measured_sections"] == 0
    assert "- scan: the capture's volume has no surface, so no mesh is measured." in text


def test_a_folder_of_something_else_under_the_capture_s_name_is_left_alone(comparison, ball, tmp_path):
    notes = tmp_path / "out" / "scan" / "notes.txt"
    notes.parent.mkdir(parents=True)
    notes.write_text("precious")
    with pytest.raises(RunFolderError, match="scan: holds files of something else"):
        comparison(ball)
    assert [file for file in (tmp_path / "out").rglob("*") if file.is_file()] == [notes]
