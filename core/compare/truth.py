"""What models are measured against: the truth of a synthetic capture, else the volume of all its projections."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..capture.digest import content_digest
from ..capture.model import Capture, Projections
from ..errors import CaptureError
from ..fdk_process import end_fdk, fdk
from ..phantoms.truth import Surface, read_truth
from ..progress import Reporter
from ..similarity import Similarity
from ..volume import Volume
from .code import CODE


@dataclass(frozen=True, eq=False)
class Truth:
    """The attenuation that models should have.

    Attributes:
        volume: mm⁻¹ in the world frame.
        exact: whether it is the truth of a synthetic object; else a volume that has errors of its own.
        source: which of them, in words.
        similarity: photo frame to mm, if it is known.
        outer, inner: the object's surfaces; None where they are not stored.
        digest: the same digest, the same truth.
        at_centers: the volume has the values at voxel centres, not averages over voxels.
    """

    volume: Volume
    exact: bool
    source: str
    similarity: Similarity | None = None
    outer: Surface | None = None
    inner: Surface | None = None
    digest: str = ""
    at_centers: bool = False

    @property
    def surface_unknown(self) -> bool:
        """Whether surfaces could only be taken from values at points, between which they are a staircase."""
        return self.at_centers and self.outer is None

    @property
    def middle_mm(self) -> np.ndarray:
        """(3,) the centre of the object's attenuation: where errors of a similarity are measured."""
        values = np.maximum(self.volume.values.astype(np.float64), 0.0)
        total = values.sum()
        if total <= 0:
            return self.volume.box_mm.mean(axis=0)
        axes = ((1, 2), (0, 2), (0, 1))
        index = [float((values.sum(axis=axes[k]) * np.arange(values.shape[k])).sum() / total) for k in (2, 1, 0)]
        return self.volume.origin_mm + np.array(index) * self.volume.spacing_mm


def find_truth(capture: Capture, kept: Path, reporter: Reporter) -> Truth | None:
    """`truth.npz` of the capture, else its volume, else the FDK of all its projections, held-out ones too.

    A volume is in the scale of models, which are fitted to the projections beside it: Hounsfield units have the water
    that those show, and grey values that fit none are no truth.

    Args:
        kept: folder that the FDK is kept in.

    Returns:
        None for photos alone.

    Raises:
        CaptureError: truth.npz cannot be read, or the projections cannot be reconstructed.
        Cancelled: the user asked to stop.
    """
    file = capture.path / "truth.npz"
    if file.exists():
        stored = read_truth(capture.path)
        return Truth(
            stored.volume,
            True,
            "the true attenuation",
            stored.photo_to_world,
            stored.outer,
            stored.inner,
            content_digest(file),
            stored.at_centers,
        )
    digest, in_model = capture.digest, capture.volume_in_model()
    if in_model is not None and capture.can_follow_volume:
        if in_model is not capture.volume:
            digest += f", its water {capture.densities.water_per_mm:g} per mm"
        return Truth(in_model, False, "the capture's volume", digest=digest)
    if capture.projections is None:
        return None
    file = kept / f"reference {capture.digest[:12]} {CODE['fdk']}.npz"
    volume = _reference(capture.projections, file, reporter)
    digest += f", reference {CODE['fdk']}"
    if in_model is not None:
        digest += ", its volume no truth"
    return Truth(volume, False, "the FDK of all projections", digest=digest)


def _reference(projections: Projections, file: Path, reporter: Reporter) -> Volume:
    """The FDK of all projections, kept in a file; made now if that is missing or damaged."""
    try:
        return Volume.load(file)
    except CaptureError:
        try:
            fdk(projections, np.ones(len(projections.images), bool), reporter=reporter).save(file)
        finally:
            end_fdk()
    return Volume.load(file)


def without_truth(capture: Capture) -> Capture:
    """The capture that methods are given: a volume beside projections is what they are measured against, and is
    taken away. Where there are no projections it stays: there is nothing else to see the inside by."""
    if capture.volume is None or capture.projections is None:
        return capture
    return replace(capture, volume=None, digest=f"{capture.digest}, without its volume")
