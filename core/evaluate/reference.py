"""The volume that held-out sections are measured against."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..fdk_process import fdk
from ..volume import Volume

if TYPE_CHECKING:
    from ..stages.context import StageContext


def reference_volume(context: StageContext, first: float, last: float, stage: str) -> tuple[Volume, str]:
    """The user's volume, or the FDK of all projections, held-out ones included; nothing is fitted to it.

    The FDK is kept in the run folder: `initialize` makes it while ITK-RTK is loaded, the report reads it.

    Args:
        first, last: the share of `stage` that an FDK takes, for its progress.

    Returns:
        The volume, and what it is.

    Raises:
        CaptureError: the projections cannot be reconstructed.
        Cancelled: the user asked to stop.
    """
    capture = context.capture
    if capture.volume is not None:
        return capture.volume, "the capture's volume"
    if capture.projections is None:
        raise AssertionError("called for captures with X-rays only")
    path = context.run.stage("initialize") / "reference.npz"
    if not path.exists():
        every = np.ones(len(capture.projections.images), bool)
        fdk(capture.projections, every, reporter=context.reporter.within(first, last), stage=stage).save(path)
    return Volume.load(path), "FDK of all projections"
