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
BLUR_PX = 1.0
# What is cut off at a border, and what blurring makes of it.
MARGIN = 3
FEWEST_PIXELS = 4 * MARGIN
"""Of a view's shorter side; half of what is smaller is cut off."""
# Residuals beyond so many deviations count less: streaks, dead pixels, metal.
ROBUST = 2.5
WEIGHINGS = 2
# Registrations until detectors stay where they are, and what of the last one says that they do not.
_ROUNDS, _DONE_PX, _UNSETTLED_PX = 5, 0.02, 0.1


@dataclass(frozen=True, eq=False)
class Shifts:
    """Where the detectors of M views stand beside where they should, and how sure that is.

    Attributes:
        shift_mm: (M, 2) along their rows and columns.
        tilt_rad: (M,) turned in their plane, from rows towards columns.
        error_mm, tilt_error_rad: (M, 2) and (M,) one standard error.
        left: (M,) rms of what the reprojection does not explain before any of this is taken out, line integrals.
    """

    shift_mm: np.ndarray
    tilt_rad: np.ndarray
    error_mm: np.ndarray
    tilt_error_rad: np.ndarray
    left: np.ndarray


@dataclass(frozen=True, eq=False)
class Registration:
    """Where detectors stand after some rounds.

    Attributes:
        shifts: in all.
        settled: whether the last round left them where they were.
        gain: how much of the mean square that the first reprojection did not explain the last one does; negative where
            moving the detectors made it worse.
    """

    shifts: Shifts
    settled: bool
    gain: float


def register(evidence: RayEvidence) -> Registration:
    """Where the detectors of all projections stand beside where the files say.

    The volume is made of the training views alone, and held-out ones are registered with it: two numbers for each.

    Raises:
        CaptureError: the projections cannot be reconstructed.
        Cancelled: through the evidence's reporter.
    """
    views, training = evidence.views, evidence.training
    shift, tilt, volume, first = np.zeros((len(views.images), 2)), 0.0, evidence.volume, 0.0
    for round_ in range(_ROUNDS):
        here = replace(views, detectors=moved(views.detectors, shift, np.full(len(shift), tilt)))
        volume = evidence.volume if round_ == 0 else evidence.reconstructed(here)
        found = measured_shifts(evidence, here, evidence.project(volume, here.detectors))
        last = float((found.left[training] ** 2).mean())
        first = first or last
        turn = float(np.median(found.tilt_rad[training]))
        shift, tilt = shift + found.shift_mm, tilt + turn
        step = in_pixels(found.shift_mm[training], views.detectors[0])
        turned = abs(turn) * rim_px(views.detectors[0])
        if np.abs(step).max() < _DONE_PX and turned < _DONE_PX:
            break
    settled = max(float(np.sqrt((step**2).mean())), turned) < _UNSETTLED_PX
    shifts = replace(found, shift_mm=shift, tilt_rad=np.full(len(shift), tilt))
    return Registration(shifts, settled, 1 - last / max(first, 1e-30))


def rim_px(detector: Detector) -> float:
    """From the detector's middle to the middle of its farther edges, in widths of a pixel."""
    wide, high = detector.width * np.linalg.norm(detector.u), detector.height * np.linalg.norm(detector.v)
    return 0.5 * float(max(wide, high) / np.linalg.norm(detector.u))


def measured_shifts(evidence: RayEvidence, views: Projections, reprojected: np.ndarray) -> Shifts:
    """Shift and turn of each view against the reprojection of a volume: one Gauss-Newton step of a robust fit.

    With a gain a and a detector that stands at (du, dv) and is turned by θ, the measured image is
    a·r + du ∂r/∂u + dv ∂r/∂v + θ (x ∂r/∂v − y ∂r/∂u) in mm, r the reprojection.

    Args:
        reprojected: (M, height, width) what `views` should show.
    """
    rows, left = [], []
    for image, drawn, detector in zip(views.images, reprojected, views.detectors, strict=True):
        evidence.reporter.check()
        fitted, rest = _fit(image, drawn, float(np.linalg.norm(detector.u) / np.linalg.norm(detector.v)))
        rows.append(fitted * np.append(_pitch_mm(detector), 1.0))
        left.append(rest)
    found = np.stack(rows)
    values, errors = found[:, 0], found[:, 1]
    return Shifts(values[:, :2], values[:, 2], errors[:, :2], errors[:, 2], np.array(left))


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


def _pitch_mm(detector: Detector) -> np.ndarray:
    """(2,) mm a pixel along rows and columns."""
    return np.array([np.linalg.norm(detector.u), np.linalg.norm(detector.v)])


def in_pixels(shift_mm: np.ndarray, detector: Detector) -> np.ndarray:
    """(..., 2) shifts along rows and columns in pixels of the detector."""
    return shift_mm / _pitch_mm(detector)


def _fit(image: np.ndarray, drawn: np.ndarray, wide: float) -> tuple[np.ndarray, float]:
    """(2, 3) du, dv in pixels and θ in rad, and their standard errors; rms of what the drawn image is off by.

    Args:
        wide: width of a pixel over its height.
    """
    target, model = (gaussian_filter(np.asarray(part, np.float64), BLUR_PX) for part in (image, drawn))
    by_row, by_column = np.gradient(model)
    height, width = model.shape
    y, x = (np.arange(count) + 0.5 - count / 2 for count in (height, width))
    turn = wide * x[None, :] * by_row - y[:, None] * by_column / wide
    inner = np.s_[MARGIN:-MARGIN, MARGIN:-MARGIN]
    columns = np.stack([part[inner].ravel() for part in (by_column, by_row, turn, model)], axis=1)
    wanted = (target - model)[inner].ravel()
    # A column that nothing is in has no number: its error is what tells.
    size = np.maximum(np.sqrt((columns**2).sum(axis=0)), 1e-12)
    columns = columns / size
    weights = np.ones(len(wanted))
    for _ in range(WEIGHINGS):
        normal = (columns * weights[:, None]).T @ columns + 1e-9 * np.eye(4)
        numbers = np.linalg.solve(normal, columns.T @ (weights * wanted))
        rest = wanted - columns @ numbers
        spread = max(1.4826 * float(np.median(np.abs(rest[weights > 0]))), 1e-12)
        weights = np.minimum(1.0, ROBUST * spread / np.maximum(np.abs(rest), 1e-12))
    # Blurring makes neighbours alike: as many numbers are independent as blurred pixels fit into the image.
    alike = 4 * np.pi * BLUR_PX**2
    variance = alike * float((weights * rest**2).sum() / max(weights.sum(), 1.0))
    errors = np.sqrt(variance * np.diag(np.linalg.inv(normal)))
    return np.stack([numbers[:3], errors[:3]]) / size[:3], float(np.sqrt((wanted**2).mean()))
