"""How long work tells what it is doing and learns that it should stop."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from .errors import Cancelled


@dataclass(frozen=True)
class Progress:
    """One message from a running stage.

    Attributes:
        stage: capture (reading it), initialize, surface, align, internal, fuse or report; phantom or bin while a
            capture or a smaller scan is made.
        part: which half works ("rgb", "xray") or what step ("sfm", "fdk", "icp"); "" when it is the whole.
        fraction: 0..1 of the stage.
        iteration, iterations: of an optimisation; 0 where there is none.
        loss: the current training loss.
        heldout_psnr: dB on held-out views, when it was just measured.
        heldout: points of the part's curve that its listener does not have yet: the one that was just measured, or all
            of earlier where a run goes on; as `train.loop.optimise` has them.
        splats: current number of Gaussians.
        message: a short sentence for the user ("compiling kernels, once"); `Told` where there are values in it.
    """

    stage: str
    part: str = ""
    fraction: float = 0.0
    iteration: int = 0
    iterations: int = 0
    loss: float | None = None
    heldout_psnr: float | None = None
    heldout: Sequence[dict[str, Any]] | None = None
    splats: int | None = None
    message: str = ""

    def to_json(self) -> dict[str, Any]:
        return {key: value for key, value in asdict(self).items() if value not in (None, "")}


# Called between pieces of work; raises to stop it.
Tick = Callable[[], None]


def unstopped() -> None:
    """The tick of work that nothing stops."""


class Reporter:
    """Passes progress on and carries the wish to cancel back.

    Args:
        listener: called with each `Progress`, at most about ten times a second for a stage's part.
        is_cancelled: asked between iterations; must be fast.
        seconds: of the whole run until now, those of earlier stages and before it was broken off included; since the
            reporter was made if None.
    """

    def __init__(
        self,
        listener: Callable[[Progress], None] | None = None,
        is_cancelled: Callable[[], bool] | None = None,
        seconds: Callable[[], float] | None = None,
    ) -> None:
        self._listener = listener
        self._is_cancelled = is_cancelled
        self._seconds = seconds
        self._born = time.monotonic()
        self._last: tuple[str, str, float] = ("", "", 0.0)

    def update(self, progress: Progress) -> None:
        """Sends `progress` on; drops it when the last one was just now and this one brings no news.

        Raises:
            Cancelled: the user asked to stop.
        """
        self.check()
        if self._listener is None:
            return
        stage, part, when = self._last
        now = time.monotonic()
        known = progress.heldout_psnr is not None or progress.heldout is not None
        news = progress.message or known or progress.fraction >= 1.0
        if news or (stage, part) != (progress.stage, progress.part) or now - when > 0.1:
            self._last = (progress.stage, progress.part, now)
            self._listener(progress)

    def within(self, first: float, last: float) -> Reporter:
        """A reporter for a part of this one's work: its fractions 0..1 are passed on as `first`..`last`."""

        def pass_on(progress: Progress) -> None:
            self.update(replace(progress, fraction=first + (last - first) * progress.fraction))

        return Reporter(pass_on, self.is_cancelled, self.seconds)

    def silent(self) -> Reporter:
        """A reporter for work that is told of by whoever asked for it: it can be cancelled, and says nothing."""
        return Reporter(None, self.is_cancelled, self.seconds)

    def seconds(self) -> float:
        """How long the run has taken so far."""
        return time.monotonic() - self._born if self._seconds is None else self._seconds()

    def is_cancelled(self) -> bool:
        """Whether the user asked to stop."""
        return self._is_cancelled is not None and self._is_cancelled()

    def check(self) -> None:
        """Raises Cancelled when the user asked to stop; call it between any two iterations."""
        if self.is_cancelled():
            raise Cancelled
