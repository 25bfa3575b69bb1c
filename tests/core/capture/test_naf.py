"""NAF pickles are read without running what a pickle may carry."""

from __future__ import annotations

import os
import pickle
import sys

import numpy as np
import pytest
from numpy.core import numeric

from insideout.core.capture.projections import read_projections
from insideout.core.errors import CaptureError


@pytest.fixture
def content(scan, radiograph):
    angles = np.arange(16) * 2 * np.pi / 16
    images = np.stack([radiograph(d) for d in scan.detectors(angles)])
    return {
        "DSD": 90.0,
        "DSO": 60.0,
        "nDetector": np.array([32, 28]),
        "dDetector": np.array([1.6, 1.6]),
        "nVoxel": np.array([16, 16, 16]),
        "dVoxel": np.array([2.0, 2.0, 1.5]),
        "offOrigin": np.zeros(3),
        "offDetector": np.zeros(2),
        "mode": "cone",
        "train": {"projections": images[:12], "angles": angles[:12]},
        "val": {"projections": images[12:], "angles": angles[12:]},
    }


@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
def test_projections_and_geometry(tmp_path, content, radiograph, protocol):
    path = tmp_path / "chest.pickle"
    path.write_bytes(pickle.dumps(content, protocol))
    result = read_projections(path).projections
    assert result.held_out.tolist() == [False] * 12 + [True] * 4
    assert np.allclose(result.box_mm, [[-16, -16, -12], [16, 16, 12]])
    assert np.allclose(result.images[5], radiograph(result.detectors[5]), atol=1e-5)


def test_a_pickle_of_numpy_2_is_read_by_numpy_1(tmp_path, content, monkeypatch):
    """Its modules have other names, under which numpy 1 knows some alone."""
    path = tmp_path / "chest.pickle"
    with monkeypatch.context() as as_written:
        as_written.setitem(sys.modules, "numpy._core.numeric", numeric)
        as_written.setattr(numeric._frombuffer, "__module__", "numpy._core.numeric")
        path.write_bytes(pickle.dumps(content, 5))
    assert b"numpy._core.numeric" in path.read_bytes()
    assert len(read_projections(path).projections.images) == 16


class Harm:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


def test_code_in_a_pickle_does_not_run(tmp_path, content):
    path = tmp_path / "bad.pickle"
    path.write_bytes(pickle.dumps({**content, "extra": Harm(tmp_path / "harm")}))
    with pytest.raises(CaptureError, match="cannot be read as a pickle of numbers"):
        read_projections(path)
    assert not (tmp_path / "harm").exists()


def test_builtins_that_run_code_are_refused(tmp_path):
    path = tmp_path / "bad.pickle"
    path.write_bytes(b"cbuiltins\neval\n(S'1+1'\ntR.")
    with pytest.raises(CaptureError, match=r"builtins\.eval"):
        read_projections(path)


def test_a_truncated_pickle_is_named(tmp_path, content):
    path = tmp_path / "half.pickle"
    path.write_bytes(pickle.dumps(content)[:500])
    with pytest.raises(CaptureError, match=r"half.pickle: cannot be read"):
        read_projections(path)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda c: c.pop("train"), "no 'train'"),
        (lambda c: c.pop("DSO"), "lacks 'DSO'"),
        (lambda c: c.update(nDetector=[28, 32]), "'nDetector'"),
        (lambda c: c["train"].update(angles=np.zeros(3)), "12 projections but 3 finite angles"),
        (lambda c: c["val"].update(projections=c["val"]["projections"][:, :-1]), "projection 12: is 32 x 27 but"),
        (lambda c: c["train"].update(projections=np.zeros((0, 28, 32))), "no projections in 'train'"),
    ],
)
def test_wrong_content_is_explained(tmp_path, content, change, says):
    change(content)
    path = tmp_path / "chest.pickle"
    path.write_bytes(pickle.dumps(content))
    with pytest.raises(CaptureError, match=says):
        read_projections(path)


def test_line_integrals_that_look_like_readings_can_be_said_to_be_that(tmp_path, content):
    """Of a hollow thing that is wider than the detector: no air is beside it, and its middle is the brightest."""
    path = tmp_path / "wide.pickle"
    for part in (content["train"], content["val"]):
        part["projections"] = np.float32(5 * part["projections"].max()) - part["projections"]
    path.write_bytes(pickle.dumps(content))
    doubt = read_projections(path)
    assert any("'values': 'line_integral' beside 'train'" in finding.advice for finding in doubt.findings)
    path.write_bytes(pickle.dumps({**content, "values": "line_integral"}))
    assert np.array_equal(read_projections(path).projections.images[:12], content["train"]["projections"])
