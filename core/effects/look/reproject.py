"""How far measured views are from what a volume made of them says they should show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter

from ...capture.model import Projections
from ...views import Detector
from ..rays import RayEvidence

# Noise has steep slopes, too: both sides are blurred before they are compared.
_BLUR_PX = 1.0
# What is cut off at a border, and what blurring makes of it.
_MARGIN = 3
# Residuals beyond so many deviations count less: streaks, dead pixels, metal.
_ROBUST = 2.5
_WEIGHINGS = 2
# Registrations until detectors stay where they are.
_ROUNDS, _DONE_PX = 5, 0.02


@dataclass(frozen=True, eq=False)
class Shifts:
    """Where the detectors of M views stand beside where they should, and how sure that is.

    Attributes:
        shift_mm: (M, 2) along their rows and columns.
        tilt_rad: (M,) turned in their plane, from rows towards columns.
        error_mm, tilt_error_rad: (M, 2) and (M,) one standard error.
    """

    shift_mm: np.ndarray
    tilt_rad: np.ndarray
    error_mm: np.ndarray
    tilt_error_rad: np.ndarray


def register(evidence: RayEvidence) -> Shifts:
    """Where the detectors of all projections stand beside where the files say.

    The volume is made of the training views alone, and held-out ones are registered with it.

    Raises:
        CaptureError: the projections cannot be reconstructed.
        Cancelled: through the evidence's reporter.
    """
    views, training = evidence.views, evidence.training
    shift, tilt, volume = np.zeros((len(views.images), 2)), 0.0, evidence.volume
    for _ in range(_ROUNDS):
        here = replace(views, detectors=moved(views.detectors, shift, np.full(len(shift), tilt)))
        volume = evidence.volume if not shift.any() else evidence.reconstructed(here)
        found = measured_shifts(evidence, here, evidence.project(volume, here.detectors))
        turn = float(np.median(found.tilt_rad[training]))
        shift, tilt = shift + found.shift_mm, tilt + turn
        if np.abs(found.shift_mm[training]).max() < _DONE_PX * np.linalg.norm(views.detectors[0].u):
            break
    return replace(found, shift_mm=shift, tilt_rad=np.full(len(shift), tilt))


def measured_shifts(evidence: RayEvidence, views: Projections, reprojected: np.ndarray) -> Shifts:
    """Shift and turn of each view against the reprojection of a volume: one Gauss-Newton step of a robust fit.

    With a gain a and a detector that stands at (du, dv) and is turned by θ, the measured image is
    a·r + du ∂r/∂u + dv ∂r/∂v + θ (x ∂r/∂v − y ∂r/∂u), r the reprojection.

    Args:
        reprojected: (M, height, width) what `views` should show.
    """
    rows = []
    for image, drawn, detector in zip(views.images, reprojected, views.detectors, strict=True):
        evidence.reporter.check()
        rows.append(_fit(image, drawn) * _to_mm(detector))
    found = np.stack(rows)
    values, errors = found[:, 0], found[:, 1]
    return Shifts(values[:, :2], values[:, 2], errors[:, :2], errors[:, 2])


def moved(detectors: Sequence[Detector], shift_mm: np.ndarray, tilt_rad: np.ndarray) -> list[Detector]:
    """Detectors (M,) shifted by (M, 2) mm along their rows and columns, and turned by (M,) rad in their plane."""
    return [_moved(*each) for each in zip(detectors, shift_mm, tilt_rad, strict=True)]


def _moved(detector: Detector, shift_mm: np.ndarray, tilt_rad: float) -> Detector:
    u, v = np.asarray(detector.u, np.float64), np.asarray(detector.v, np.float64)
    along, down = u / np.linalg.norm(u), v / np.linalg.norm(v)
    center = np.asarray(detector.center, np.float64) + shift_mm[0] * along + shift_mm[1] * down
    cos, sin = np.cos(tilt_rad), np.sin(tilt_rad)
    turned = np.linalg.norm(u) * (cos * along + sin * down), np.linalg.norm(v) * (cos * down - sin * along)
    return replace(detector, center=center, u=turned[0], v=turned[1])


def _to_mm(detector: Detector) -> np.ndarray:
    """(3,) factors from pixels to mm, and 1 for an angle."""
    return np.array([np.linalg.norm(detector.u), np.linalg.norm(detector.v), 1.0])


def _fit(image: np.ndarray, drawn: np.ndarray) -> np.ndarray:
    """(2, 3) du, dv in pixels and θ in rad, and their standard errors."""
    target, model = (gaussian_filter(np.asarray(part, np.float64), _BLUR_PX) for part in (image, drawn))
    by_row, by_column = np.gradient(model)
    height, width = model.shape
    y, x = (np.arange(count) + 0.5 - count / 2 for count in (height, width))
    turn = x[None, :] * by_row - y[:, None] * by_column
    inner = np.s_[_MARGIN:-_MARGIN, _MARGIN:-_MARGIN]
    columns = np.stack([part[inner].ravel() for part in (by_column, by_row, turn, model)], axis=1)
    wanted = (target - model)[inner].ravel()
    # A column that nothing is in has no number: its error is what tells.
    size = np.maximum(np.sqrt((columns**2).sum(axis=0)), 1e-12)
    columns = columns / size
    weights = np.ones(len(wanted))
    for _ in range(_WEIGHINGS):
        normal = (columns * weights[:, None]).T @ columns + 1e-9 * np.eye(4)
        numbers = np.linalg.solve(normal, columns.T @ (weights * wanted))
        rest = wanted - columns @ numbers
        spread = max(1.4826 * float(np.median(np.abs(rest[weights > 0]))), 1e-12)
        weights = np.minimum(1.0, _ROBUST * spread / np.maximum(np.abs(rest), 1e-12))
    # Blurring makes neighbours alike: as many numbers are independent as blurred pixels fit into the image.
    alike = 4 * np.pi * _BLUR_PX**2
    variance = alike * float((weights * rest**2).sum() / max(weights.sum(), 1.0))
    errors = np.sqrt(variance * np.diag(np.linalg.inv(normal)))
    return np.stack([numbers[:3], errors[:3]]) / size[:3]
