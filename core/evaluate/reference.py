"""The volume that held-out sections are measured against."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..errors import CaptureError
from ..fdk_process import fdk
from ..volume import Volume, compress

if TYPE_CHECKING:
    from ..stages.context import StageContext

GIVEN = "the capture's volume"
"""What a volume of the user's is called."""


def make_reference(context: StageContext, first: float, last: float, stage: str) -> None:
    """Leaves the FDK of all projections, held-out ones too, as `initialize/reference.npz`, not compressed yet; nothing
    is fitted to it.

    `initialize` calls it, while ITK-RTK is loaded. Nothing is made where the user brought a volume that has the model's
    scale.

    Args:
        first, last: the share of `stage` that it takes, for its progress.

    Raises:
        CaptureError: the projections cannot be reconstructed.
        Cancelled: the user asked to stop.
    """
    projections = context.projections
    if projections is None or _own(context) is not None:
        return
    every = np.ones(len(projections.images), bool)
    volume = fdk(projections, every, reporter=context.reporter.within(first, last), stage=stage)
    volume.save(_path(context), compressed=False)


def reference_volume(context: StageContext) -> tuple[Volume, str]:
    """The user's volume, or what `make_reference` left (made now if it is gone or damaged), and which of them it is.

    Where nobody knows the scale of the user's volume beside projections, it says nothing about a model's densities.

    Raises:
        CaptureError, Cancelled: as `make_reference`.
    """
    own = _own(context)
    if own is not None:
        return own, GIVEN
    try:
        volume = Volume.load(_path(context))
    except CaptureError:
        make_reference(context, 0.7, 0.75, "report")
        compress(_path(context), context.reporter.check)
        volume = Volume.load(_path(context))
    return volume, "FDK of all projections"


def _own(context: StageContext) -> Volume | None:
    return context.capture.volume_in_model() if context.capture.can_follow_volume else None


def _path(context: StageContext) -> Path:
    return context.run.stage("initialize") / "reference.npz"
