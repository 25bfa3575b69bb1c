"""landmarks.json: points that the user picked on the photos' model and in the X-ray frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .findings import CaptureProblem
from .model import Landmarks
from .values import read_json

# Width over length of the points; picked by hand they are a hundredth of the object off.
_LEAST_WIDTH = 0.02
_SHAPE = 'write {{"photo": [[x, y, z], ...], "xray": [[x, y, z], ...]}} with the same points in the same order'


def read_landmarks(path: Path) -> Landmarks:
    """Reads matching points, either as two lists or as a list of {"photo": [...], "xray": [...]} pairs.

    Raises:
        CaptureError: the file is broken, the lists differ in length, there are fewer than three points, or they
            lie on one line, which leaves the turn about it open.
    """
    content = read_json(path)
    if isinstance(content, dict) and isinstance(content.get("landmarks"), list):
        content = content["landmarks"]
    if isinstance(content, list) and all(isinstance(pair, dict) for pair in content):
        content = {side: [pair.get(side) for pair in content] for side in ("photo", "xray")}
    if not isinstance(content, dict):
        raise CaptureProblem(path, "holds no points", _SHAPE)
    photo, xray = (_points(path, content, side) for side in ("photo", "xray"))
    if len(photo) != len(xray):
        raise CaptureProblem(
            path, "has {photos} photo points but {xrays} X-ray points", _SHAPE, photos=len(photo), xrays=len(xray)
        )
    if len(photo) < 3:
        raise CaptureProblem(
            path,
            "has {count} points",
            "pick at least three that do not lie on a line, or remove the file",
            count=len(photo),
        )
    for side, points in (("photo", photo), ("xray", xray)):
        if on_a_line(points):
            raise CaptureProblem(path, "the {side} points lie on one line", "pick one more point beside it", side=side)
    return Landmarks(photo, xray)


def _points(path: Path, content: dict[str, Any], side: str) -> np.ndarray:
    if content.get(side) == []:
        return np.zeros((0, 3))
    try:
        points = np.asarray(content[side], np.float64).reshape(len(content[side]), -1)
    except (KeyError, TypeError, ValueError):
        raise CaptureProblem(path, "'{side}' is missing or not a list of points", _SHAPE, side=side) from None
    if points.shape[1] != 3 or not np.isfinite(points).all():
        raise CaptureProblem(path, "'{side}' is not a list of finite [x, y, z]", _SHAPE, side=side)
    return points


def on_a_line(points: np.ndarray) -> bool:
    """Whether points (L, 3) lie so nearly on one line that picking them a little off would turn the object about it."""
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return not spread[1] > _LEAST_WIDTH * spread[0]
