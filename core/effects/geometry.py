"""A scan that is not as the files say: the detector beside its place or turned in its plane, and from view to view a
detector that shakes or an object that moves, which look alike.

Found as in projection matching (e.g. Dengler, Ultramicroscopy 30(3), 1989; for splats "Revisiting Pose Sensitivity in
Splat-based CT", CVPR 2026, says why it matters): the FDK of the views is projected again, each view is registered with
its reprojection, the detectors are moved, and so on until they stay where they are. A constant offset smears the FDK
over a circle and leaves its middle where it is, so that the offset is seen whole.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from ..capture.model import Projections
from ..fdk import coverage
from .finding import EffectFinding
from .look.reproject import moved, register
from .rays import RayEvidence

# Edges two pixels wide that are off by 0.3 pixels cost a projection what is left of it at 42 dB.
_LEAST_PX = 0.25
_SURE = 3.0
_FEWEST_VIEWS = 16
# Over less than a turn an offset looks like an object beside the axis: its error grows 2.3 times over half of one.
_LEAST_TURN_DEG = 344.0


def detect(evidence: RayEvidence) -> EffectFinding:
    """How far the detector is off, the largest of three: its offset, its turn at the rim, and what differs from view to
    view, rms.

    An offset along the columns cannot be told from an object that stands higher, nor can an object beside the axis be
    told to be anywhere else: that is left to the frame.

    Raises:
        CaptureError: the projections cannot be reconstructed.
        Cancelled: through the evidence's reporter.
    """
    projections, training = evidence.projections, evidence.training
    reason = _untold(evidence)
    if reason:
        return EffectFinding("geometry", None, None, "px", _LEAST_PX, reason)
    found = register(evidence)
    offset, rest = _without_frame(found.shift_mm, projections.angles_rad, training)
    pixel_mm = float(np.linalg.norm(projections.detectors[0].u))
    rim, views = 0.5 * projections.images.shape[2], float(np.sqrt(len(training)))
    shaking = float(np.sqrt((rest[training] ** 2).mean())) / pixel_mm
    unsure = float(np.median(found.error_mm[training])) / pixel_mm
    sizes = {
        "offset": (abs(offset) / pixel_mm, max(shaking, unsure) / views),
        "turn": (abs(float(found.tilt_rad[0])) * rim, float(np.median(found.tilt_error_rad[training])) * rim / views),
        "views": (shaking, unsure),
    }
    real = {name: size >= _LEAST_PX and size > _SURE * error for name, (size, error) in sizes.items()}
    needed = any(real.values())
    strength, error = max((pair for name, pair in sizes.items() if real[name] or not needed), key=lambda pair: pair[0])
    told = (
        f"The detector is {sizes['offset'][0]:.2f} pixels beside its place and turned by {sizes['turn'][0]:.2f} pixels "
        f"at its rim, and views differ by {shaking:.2f} pixels"
    )
    least = f"from {_LEAST_PX:g} on that blurs the inside." if needed else f"under {_LEAST_PX:g} that does not matter."
    shift = np.zeros_like(found.shift_mm)
    shift[:, 0] = offset
    # Where views do not differ, their own numbers are noise.
    shift += rest if real["views"] else 0.0
    numbers = {"shift_mm": shift, "tilt_rad": found.tilt_rad}
    return EffectFinding("geometry", needed, strength, "px", _LEAST_PX, f"{told}; {least}", error, numbers)


def _without_frame(shift_mm: np.ndarray, angles_rad: np.ndarray, training: np.ndarray) -> tuple[float, np.ndarray]:
    """The offset along the rows, and (M, 2) what differs from view to view.

    An object at (x, y, z) beside its place is seen at −x sin θ + y cos θ along the rows and at −z down the columns.
    """
    columns = np.stack([np.ones_like(angles_rad), -np.sin(angles_rad), np.cos(angles_rad)], axis=1)
    numbers = np.linalg.lstsq(columns[training], shift_mm[training, 0], rcond=None)[0]
    rest = np.stack([shift_mm[:, 0] - columns @ numbers, shift_mm[:, 1] - shift_mm[training, 1].mean()], axis=1)
    return float(numbers[0]), rest


def _untold(evidence: RayEvidence) -> str:
    """Why the projections cannot tell where detector and object were; "" if they can."""
    if evidence.projections.detectors[0].parallel:
        return "Where the detector of a parallel beam stands cannot be told."
    if len(evidence.training) < _FEWEST_VIEWS:
        return f"{len(evidence.training)} projections are too few to tell where the detector stood."
    # Of all views: those that are held out leave gaps, not less of a turn.
    turned = coverage(evidence.projections, np.full(len(evidence.projections.detectors), True))["angular_range_deg"]
    if turned < _LEAST_TURN_DEG:
        return f"Views over {turned:.0f} degrees do not tell an offset of the detector from the object's place."
    return ""


def corrected(projections: Projections, numbers: Mapping[str, Any]) -> Projections:
    """The projections with detectors where they stood: moved by `shift_mm` (M, 2), turned by `tilt_rad` (M,)."""
    return replace(projections, detectors=moved(projections.detectors, numbers["shift_mm"], numbers["tilt_rad"]))
