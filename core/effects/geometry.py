"""A scan that is not as the files say: the detector beside its place or turned in its plane, and from view to view a
detector, or an object, that shakes. What moves smoothly is taken out before (`motion`).

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
from ..progress import Tick, unstopped
from ..told import Told
from .finding import EffectFinding
from .look.reproject import FEWEST_PIXELS, in_pixels, moved, register, rim_px
from .rays import RayEvidence

# Edges two pixels wide that are off by 0.3 pixels cost a projection what is left of it at 42 dB.
_LEAST_PX = 0.25
# Views are registered in blocks of pixels: what a clean scan is found to be off by, and the least that is told, of one.
_SYSTEMATIC_BLOCKS, _LEAST_BLOCKS = 0.02, 0.1
# In errors: certainly off, and certainly not off by what matters.
_SURE, _SURELY_NOT = 3.0, 2.0
# Of what the FDK did not explain, the detectors' places have to explain so much.
_LEAST_GAIN = 0.02
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
    least = max(_LEAST_PX, _LEAST_BLOCKS * evidence.block)
    untold = _untold(evidence)
    if untold is not None:
        return EffectFinding("geometry", None, None, "px", least, untold)
    registration = register(evidence)
    found, first = registration.shifts, projections.detectors[0]
    offset, rest = _without_frame(found.shift_mm, projections.angles_rad, training)
    rim, views = rim_px(first), float(np.sqrt(len(training)))
    shaking = float(np.sqrt((in_pixels(rest[training], first) ** 2).mean()))
    unsure = float(np.median(in_pixels(found.error_mm[training], first)))
    sizes = {
        "offset": (abs(offset) / float(np.linalg.norm(first.u)), max(shaking, unsure) / views),
        "turn": (abs(float(found.tilt_rad[0])) * rim, float(np.median(found.tilt_error_rad[training])) * rim / views),
        "views": (shaking, unsure),
    }
    systematic = _SYSTEMATIC_BLOCKS * evidence.block
    sizes = {name: (size, float(np.hypot(error, systematic))) for name, (size, error) in sizes.items()}
    certain = {name: size > _SURE * error for name, (size, error) in sizes.items()}
    needed = {name: certain[name] and size >= least for name, (size, _) in sizes.items()}
    off = any(needed.values())
    strength, error = max((pair for name, pair in sizes.items() if needed[name] or not off), key=lambda pair: pair[0])
    verdict: bool | None = off or None
    why = Told("under {least:.2g} that does not matter.", least=least)
    if off and registration.settled and registration.gain >= _LEAST_GAIN:
        why = Told("from {least:.2g} on that blurs the inside.", least=least)
    elif off:
        verdict = None
        why = Told(
            "but views agree no better with them, so the detector's place is not what is wrong."
            if registration.settled
            else "but they change with every look, so the detector's place is not what is wrong."
        )
    elif all(size + _SURELY_NOT * error < least for size, error in sizes.values()):
        verdict = False
    else:
        unclear = "too uncertain (by {error:.2f}) to tell whether that is under {least:.2g}, which would not matter."
        why = Told(unclear, error=error, least=least)
    reason = Told(
        "The detector is {offset:.2f} pixels beside its place and turned by {turn:.2f} pixels at its rim, and views "
        "differ by {views:.2f} pixels; {why}",
        offset=sizes["offset"][0],
        turn=sizes["turn"][0],
        views=shaking,
        why=why,
    )
    # What is not certain is noise, and turning a detector costs the FDK an interpolation.
    shift = np.zeros_like(found.shift_mm)
    shift[:, 0] = offset if certain["offset"] else 0.0
    shift += rest if certain["views"] else 0.0
    tilt = found.tilt_rad if certain["turn"] else np.zeros_like(found.tilt_rad)
    numbers = {"shift_mm": shift, "tilt_rad": tilt} if any(certain.values()) else {}
    return EffectFinding("geometry", verdict, strength, "px", least, reason, error, numbers)


def _without_frame(shift_mm: np.ndarray, angles_rad: np.ndarray, training: np.ndarray) -> tuple[float, np.ndarray]:
    """The offset along the rows, and (M, 2) what differs from view to view.

    An object at (x, y, z) beside its place is seen at −x sin θ + y cos θ along the rows and at −z down the columns.
    """
    columns = np.stack([np.ones_like(angles_rad), -np.sin(angles_rad), np.cos(angles_rad)], axis=1)
    numbers = np.linalg.lstsq(columns[training], shift_mm[training, 0], rcond=None)[0]
    rest = np.stack([shift_mm[:, 0] - columns @ numbers, shift_mm[:, 1] - shift_mm[training, 1].mean()], axis=1)
    return float(numbers[0]), rest


def _untold(evidence: RayEvidence) -> Told | None:
    """Why the projections cannot tell where detector and object were; None if they can."""
    if evidence.projections.detectors[0].parallel:
        return Told("Where the detector of a parallel beam stands cannot be told.")
    count = len(evidence.training)
    if count < _FEWEST_VIEWS:
        return Told("{count} projections are too few to tell where the detector stood.", count=count)
    height, width = evidence.views.images.shape[1:]
    if min(height, width) < FEWEST_PIXELS:
        small = "Projections of {width} x {height} pixels are too small to tell where the detector stood."
        return Told(small, width=width, height=height)
    # Of all views: those that are held out leave gaps, not less of a turn.
    turned = coverage(evidence.projections, np.full(len(evidence.projections.detectors), True))["angular_range_deg"]
    if turned < _LEAST_TURN_DEG:
        part = "Views over {degrees:.0f} degrees do not tell an offset of the detector from the object's place."
        return Told(part, degrees=turned)
    return None


def corrected(projections: Projections, numbers: Mapping[str, Any], tick: Tick = unstopped) -> Projections:
    """The projections with detectors where they stood: moved by `shift_mm` (M, 2), turned by `tilt_rad` (M,)."""
    return replace(projections, detectors=moved(projections.detectors, numbers["shift_mm"], numbers["tilt_rad"]))


def drawn(image: np.ndarray, view: int, projections: Projections, numbers: Mapping[str, Any]) -> np.ndarray:
    """A rendered projection itself: it is rendered onto the detector where that stood."""
    return image
