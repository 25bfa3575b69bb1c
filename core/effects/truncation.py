"""Truncation: an object that is wider than the detector, so that projections end in the middle of its shadow.

Pixels are what they are; nothing is taken out of them, and held-out ones are measured as they were. It is the FDK that
needs rows to end in air: from then on it continues them (`core.continuation`, Hsieh et al., Med. Phys. 31(9), 2004).
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
from .rays import RayEvidence

_NAME, _UNIT = "truncation", "% of the projections"
_THRESHOLD = 100 * MOST_CUT_OFF
# Of the width, so far an FDK may continue a row at either side: an object twice as wide as the detector.
_BEYOND = 0.5


def detect(evidence: RayEvidence) -> EffectFinding:
    """The share of projections in which the object reaches the left or right end of the detector, in percent: what
    `insideout check` warns of. It is counted, not estimated, and has no error.

    `numbers`: "beyond", how far an FDK may continue rows at either side, over their width.
    """
    untold = _untold(evidence)
    if untold is not None:
        return EffectFinding(_NAME, None, None, _UNIT, _THRESHOLD, untold)
    share = 100 * evidence.cut_off
    found = share > _THRESHOLD
    why = Told(
        "the FDK takes what is beyond for air, which makes the rim bright and the middle hollow."
        if found
        else "up to {most:g} % does not matter.",
        most=_THRESHOLD,
    )
    told = "The object leaves the detector at the side in {share:.0f} % of the projections; {why}"
    reason = Told(told, share=share, why=why)
    return EffectFinding(_NAME, found, share, _UNIT, _THRESHOLD, reason, None, {"beyond": _BEYOND} if share else {})


def corrected(projections: Projections, numbers: Mapping[str, Any], tick: Tick = unstopped) -> Projections:
    """The same projections, whose rows an FDK continues at both sides."""
    tick()
    return replace(projections, beyond=float(numbers["beyond"]))


def _untold(evidence: RayEvidence) -> Told | None:
    """Why rows of these projections cannot be continued; None if they can."""
    projections = evidence.projections
    if len(projections.detectors) < 2 or not evidence.training.size:
        return Told("There are too few projections for an FDK, and nothing else needs rows that go on.")
    if evidence.set_off:
        return Told(
            "The detector is set off to see more of the object: what a projection leaves out is in the opposite one."
        )
    if projections.detectors[0].parallel:
        return None
    turned = coverage(projections, np.full(len(projections.detectors), True))["angular_range_deg"]
    if turned < 360:
        part = "Views over {degrees:.0f} degrees cannot be continued: the weights of a short scan would not fit."
        return Told(part, degrees=turned)
    return None
