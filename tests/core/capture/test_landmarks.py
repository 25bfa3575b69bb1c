"""Points picked on the photos' model and in the X-ray frame."""

from __future__ import annotations

import json

import numpy as np
import pytest

from insideout.core.capture.landmarks import read_landmarks
from insideout.core.errors import CaptureError
from insideout.core.stages.align.global_fit import landmarks_problem

PHOTO = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
XRAY = [[5, 5, 5], [7, 5, 5], [5, 7, 5]]


def write(tmp_path, content):
    path = tmp_path / "landmarks.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


@pytest.mark.parametrize(
    "content",
    [
        {"photo": PHOTO, "xray": XRAY},
        [{"photo": p, "xray": x} for p, x in zip(PHOTO, XRAY, strict=True)],
        {"landmarks": [{"photo": p, "xray": x, "name": "tip"} for p, x in zip(PHOTO, XRAY, strict=True)]},
    ],
)
def test_lists_or_pairs(tmp_path, content):
    landmarks = read_landmarks(write(tmp_path, content))
    assert np.array_equal(landmarks.photo, PHOTO)
    assert np.array_equal(landmarks.xray, XRAY)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("{", "is not valid JSON at line 1"),
        ("7", "holds no points"),
        ({"photo": PHOTO}, "'xray' is missing"),
        ({"photo": PHOTO, "xray": 3}, "'xray' is missing or not a list"),
        ({"photo": PHOTO, "xray": [[1, 2], [3, 4], [5, 6]]}, "'xray' is not a list of finite"),
        ({"photo": PHOTO, "xray": [[1, 2, "a"]] * 3}, "'xray' is"),
        ({"photo": PHOTO, "xray": XRAY[:2]}, "3 photo points but 2 X-ray points"),
        ({"photo": PHOTO[:2], "xray": XRAY[:2]}, "has 2 points; pick at least three"),
        ({"photo": [], "xray": []}, "has 0 points"),
        ({"photo": [[0, 0, 0], [1, 0, 0], [2, 0, 0]], "xray": XRAY}, "the photo points lie on one line"),
        ({"photo": PHOTO, "xray": [[0, 0, 0], [50, 0.5, 0], [100, 0, 0]]}, "the xray points lie on one line"),
        ({"photo": [[1, 1, 1]] * 3, "xray": XRAY}, "the photo points lie on one line"),
    ],
)
def test_what_is_wrong_is_said(tmp_path, content, says):
    with pytest.raises(CaptureError, match=says) as caught:
        read_landmarks(write(tmp_path, content))
    assert "landmarks.json" in str(caught.value)


@pytest.mark.parametrize("width", [0.5, 1.0, 1.5, 2.5, 4.0, 20.0])
def test_what_is_read_is_what_align_uses(tmp_path, width):
    points = [[0, 0, 0], [50, width, 0], [100, 0, 0]]
    problem = landmarks_problem(np.array(PHOTO, float), np.array(points, float))
    try:
        read_landmarks(write(tmp_path, {"photo": PHOTO, "xray": points}))
    except CaptureError:
        assert problem is not None
    else:
        assert problem is None
