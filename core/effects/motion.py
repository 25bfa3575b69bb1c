"""An object that moves while it is X-rayed: that settles, slides or turns slowly, or gives way once.

Found from how views differ from the reprojection of their FDK, in order of acquisition (`look/settling.py`). What
differs from view to view in no order is no motion, and neither is what goes round with the detector: that is left to
`geometry`, which is looked for after this. For a cone beam a rigid motion of the object is the opposite one of source
and detector together, so that it is taken out of the scan's geometry, not of its images.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from ..capture.describe import MOST_CUT_OFF
from ..capture.model import Projections
from ..fdk import coverage
from ..progress import Tick, unstopped
from ..told import Told
from .finding import EffectFinding
from .look.reproject import FEWEST_PIXELS
from .look.settling import settling
from .look.trajectory import Motion, acquired, goes_one_way
from .rays import RayEvidence

# A smooth way of half a pixel is off by a seventh of one, rms; edges two pixels wide that are off by 0.3 pixels cost a
# projection what is left of it at 42 dB, and the FDK has it from all sides.
_LEAST_PX = 0.5
# Views are registered in blocks of pixels: the least that is told, of one.
_LEAST_BLOCKS = 0.2
# In errors: certainly a motion, and certainly none that matters.
_SURE, _SURELY_NOT = 3.0, 2.0
# Of what the FDK did not explain, the motion has to explain so much.
_LEAST_GAIN = 0.02
_FEWEST_VIEWS = 16
# Over less than a turn few rays are seen from both sides, and an object that goes on turning is hardly noticed.
_LEAST_TURN_DEG = 344.0


def detect(evidence: RayEvidence) -> EffectFinding:
    """How far the object went during the scan, as large as the detector sees it; where it was on average is the
    frame's.

    Raises:
        CaptureError: the projections cannot be reconstructed.
        Cancelled: through the evidence's reporter.
    """
    least = max(_LEAST_PX, _LEAST_BLOCKS * evidence.block)
    untold = _untold(evidence)
    if untold is not None:
        return EffectFinding("motion", None, None, "px", least, untold)
    times = acquired(evidence.projections)
    if times is None:
        reason = Told(
            "The scan makes more than one turn and does not say in which the projections that are kept back were taken."
            if goes_one_way(evidence.projections)
            else "Angles of the projections do not follow each other, so that nothing is known of when they were taken."
        )
        return EffectFinding("motion", None, None, "px", least, reason)
    found = settling(evidence, times)
    strength, error = found.range_px, found.error_px
    told = Told(
        "The object moves by {px:.2f} pixels during the scan, {slip:.2f} of them at once"
        if found.slip_px > 0
        else "The object moves by {px:.2f} pixels during the scan",
        px=strength,
        slip=found.slip_px,
    )
    certain = found.certain and strength > _SURE * error
    verdict: bool | None = None
    if strength < least and (certain or strength + _SURELY_NOT * error < least):
        verdict, why = False, Told("under {least:.2g} that does not matter.", least=least)
    elif not certain:
        why = Told("too uncertain (by {error:.2f}) to tell it from views that differ in no order.", error=error)
    elif not found.settled:
        why = Told("but it changes with every look, so that the motion is not what is wrong.")
    elif found.gain < _LEAST_GAIN:
        why = Told("but views agree no better with it, so that the motion is not what is wrong.")
    else:
        verdict, why = True, Told("from {least:.2g} on that blurs the inside.", least=least)
    motion = found.motion
    numbers = {"shift_mm": motion.shift_mm, "turn_rad": motion.turn_rad, "middle_mm": motion.middle_mm}
    reason = Told("{told}; {why}", told=told, why=why)
    return EffectFinding("motion", verdict, strength, "px", least, reason, error, numbers if certain else {})


def _untold(evidence: RayEvidence) -> Told | None:
    """Why the projections cannot tell whether the object moved; None if they can."""
    projections = evidence.projections
    if any(detector.parallel for detector in projections.detectors):
        return Told("Motion is not looked for in a parallel beam.")
    count = len(evidence.training)
    if count < _FEWEST_VIEWS:
        return Told("{count} projections are too few to tell whether the object moved.", count=count)
    height, width = evidence.views.images.shape[1:]
    if min(height, width) < FEWEST_PIXELS:
        small = "Projections of {width} x {height} pixels are too small to tell whether the object moved."
        return Told(small, width=width, height=height)
    # Whoever leaves `truncation` out has an FDK of rows that end in the object.
    if projections.beyond or (evidence.cut_off > MOST_CUT_OFF and not evidence.set_off):
        return Told("Whether an object moves cannot be told where the detector is too narrow for it.")
    turned = coverage(projections, np.full(len(projections.detectors), True))["angular_range_deg"]
    if turned < _LEAST_TURN_DEG:
        return Told("Views over {degrees:.0f} degrees do not tell whether the object moved.", degrees=turned)
    return None


def corrected(projections: Projections, numbers: Mapping[str, Any], tick: Tick = unstopped) -> Projections:
    """The projections with sources and detectors where the object saw them.

    Args:
        numbers: `shift_mm` (M, 3) and `turn_rad` (M, 3) of the object in each view, about `middle_mm` (3,).
    """
    motion = Motion(*(np.asarray(numbers[name], np.float64) for name in ("shift_mm", "turn_rad", "middle_mm")))
    tick()
    return replace(projections, detectors=motion.seen_by(projections.detectors))


def drawn(image: np.ndarray, view: int, projections: Projections, numbers: Mapping[str, Any]) -> np.ndarray:
    """A rendered projection itself: it is rendered from where source and detector stood beside the object."""
    return image
