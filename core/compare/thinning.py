"""Fewer projections: R²-Gaussian's protocol of 75, 50 and 25 (arXiv 2405.20693)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..capture.model import Capture, Projections
from ..errors import SettingError

THINNED = ("fdk", "sart", "r2_gaussian", "r2_at_our_rates", "insideout")
"""The rows of this table, of those that were chosen; InsideOut sees X-rays alone."""


def with_projections(capture: Capture, count: int) -> Capture:
    """The X-rays of a capture with `count` of its training projections at even steps, and all held-out ones.

    Raises:
        SettingError: fewer than three are asked for, or the capture has none or fewer than that.
    """
    projections = capture.projections
    if projections is None:
        raise SettingError(f"--projections {count}: {capture.path} has no projections; leave the option out.")
    training = np.flatnonzero(~projections.held_out)
    if not 3 <= count <= len(training):
        raise SettingError(
            f"--projections {count}: {capture.path} has {len(training)} training projections; choose 3 to "
            f"{len(training)}."
        )
    places = training[(np.arange(count) * len(training)) // count]
    half = capture.xrays_only()
    thinned = _with(projections, places)
    return replace(half, projections=thinned, volume=None, digest=f"{half.digest}, {count} projections")


def with_fewer_projections(capture: Capture, share: int) -> Capture:
    """A capture, photos and all, with every `share`-th of its training projections and all held-out ones."""
    projections = capture.projections
    if projections is None:
        return capture
    thinned = _with(projections, np.flatnonzero(~projections.held_out)[::share])
    return replace(capture, projections=thinned, digest=f"{capture.digest}, 1 of {share} training projections")


def _with(projections: Projections, places: np.ndarray) -> Projections:
    """Those at some places, and the held-out ones."""
    kept = np.sort(np.concatenate([places, np.flatnonzero(projections.held_out)]))
    return replace(
        projections,
        images=projections.images[kept],
        detectors=[projections.detectors[index] for index in kept],
        held_out=projections.held_out[kept],
        angles_rad=projections.angles_rad[kept],
    )
