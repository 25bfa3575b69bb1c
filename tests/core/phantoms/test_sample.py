"""The capture that ships with the repository."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from insideout.core.capture.check import check_capture
from insideout.core.capture.read import read_capture

SAMPLE = Path(__file__).resolve().parents[3] / "samples" / "matryoshka"


def test_it_is_small():
    assert sum(path.stat().st_size for path in SAMPLE.rglob("*") if path.is_file()) < 4_000_000


def test_nothing_is_wrong_with_it():
    assert [finding for finding in check_capture(SAMPLE) if finding.level != "info"] == []


def test_it_holds_photos_projections_and_landmarks():
    capture = read_capture(SAMPLE)

    assert capture.photos is not None
    assert capture.photos.posed
    assert capture.projections is not None
    assert capture.projections.images.max() == pytest.approx(1.65, abs=0.1)
    assert capture.landmarks is not None
    with np.load(SAMPLE / "truth.npz") as truth:
        found = truth["scale"] * capture.landmarks.photo @ truth["rotation"].T + truth["translation"]
    np.testing.assert_allclose(found, capture.landmarks.xray, atol=1e-6)
