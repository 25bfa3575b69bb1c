"""What a reader of the tables has to know of a row, told of what the capture has."""

from __future__ import annotations

from ..capture.model import Capture
from .methods import Method


def note_of(method: Method, capture: Capture) -> str:
    """A row's note; those of the whole pipeline speak of photos, projections and sections only where they were used.

    Args:
        capture: as methods are given it, without a volume that they are measured against.
    """
    if method.name == "insideout":
        return _insideout(capture) or method.note
    if method.name == "apart" and capture.photos is None:
        return (
            "Radiative splats follow the projections and the sections of an FDK of them, without the joint refinement; "
            "that is taken back where it costs the training projections more than 2 dB."
        )
    return method.note


def _insideout(capture: Capture) -> str:
    """Of the InsideOut row of a capture that has not both photos and projections; "" where it has."""
    if capture.projections is None and capture.volume is None:
        return "Photos alone, which say nothing of the inside."
    if capture.projections is None:
        photos = ", photo splats their outlines after the alignment" if capture.photos is not None else ""
        return f"There are no projections to be fitted: radiative splats follow the volume's sections{photos}."
    if capture.photos is None:
        return "Of projections alone: no photos, no alignment, and no sections in the joint refinement."
    return ""
