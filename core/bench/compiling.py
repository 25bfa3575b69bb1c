"""Kernels compiled before anything is timed: what is measured first would wait for them, and nothing after it."""

from __future__ import annotations

from ..capture.model import Capture
from ..forecast.speed import drawn_with, measure_speed
from ..progress import Progress, Reporter
from ..settings import Settings

_LONG_SIDE = 100


def compile_kernels(capture: Capture, settings: Settings, reporter: Reporter) -> None:
    """Those that a run of the capture draws and trains with; none where others than Numba's are asked for."""
    if settings.kernel != "cpu":
        return
    from ..render.kernels.cpu import announce, warm_up

    renderers = drawn_with(capture)
    if capture.photos is not None:
        renderers = (*renderers, "splat_effects")
    announce(reporter, Progress("capture", "kernels"), renderers)
    warm_up(renderers)
    # Losses and optimisers are compiled by steps of a training: half a minute of the first run in a new environment.
    measure_speed(capture, _LONG_SIDE, reporter.check)
