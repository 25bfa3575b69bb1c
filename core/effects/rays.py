"""Effects of X-rays: what they are looked for in, and what is made of the projections where they are found.

Each is a module of this package with the functions

- `detect(evidence: RayEvidence) -> EffectFinding`: measured on `evidence.projections`, from which effects that were
  found before are taken out already;
- `corrected(projections, numbers, tick) -> Projections`: the projections, and the detectors where they truly stood,
  as they would be without the effect; `numbers` are those of the finding, `tick` is called between views and may raise
  to stop. Noise cannot be taken out: the projections then say how well they are known;
- `drawn(image, view, projections, numbers) -> np.ndarray`: the other way round, a projection (height, width) rendered
  without the effect as the scanner has it. What only the FDK sees (`truncation`), pixels that a fit has told already
  (`ring`) and noise have no such function, and what they are worth is not tried.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from ..capture.describe import cut_off_share
from ..capture.detectors import project_points
from ..capture.model import Projections
from ..fdk_process import fdk, project
from ..progress import Reporter
from ..told import Told
from ..views import Detector
from ..volume import Volume

# What effects do is seen in coarse views (`coarse_block`): an FDK of them and its projections take a second or two.
_LONGEST, _SHORTEST = 160, 48
_MOST_VOXELS = 96
# Of e¹⁰⁰ photons one arrives: what is said to let through less is no line integral as detectors measure it.
_DEEPEST = 100.0
# Where the axis of rotation is seen by a detector that is set off to see more, as a share of its width from an end.
_SET_OFF = 0.4


def coarse_block(height: int, width: int) -> int:
    """Side in pixels of the square blocks whose means effects of X-rays are looked for in.

    They are as large as to leave at most 160 pixels along the detector's longer side, but not so large as to leave
    fewer than 48 along the shorter one. So of a wide, low detector more is looked at: one of 90 x 1000 pixels as it is,
    one of 100 x 1000 as 50 x 500.

    Args:
        height, width: of the detector in pixels.
    """
    return max(1, min(-(-max(height, width) // _LONGEST), min(height, width) // _SHORTEST))


@dataclass(frozen=True, eq=False)
class RayEvidence:
    """The projections of a capture and what was computed of them, each once.

    Attributes:
        projections: all, held-out ones among them, at full size.
        reporter: progress out, cancel in.
        seed: of every random choice.
    """

    projections: Projections
    reporter: Reporter = field(default_factory=Reporter)
    seed: int = 0

    def after(self, projections: Projections) -> RayEvidence:
        """The evidence once an effect is taken out."""
        return self if projections is self.projections else replace(self, projections=projections)

    @cached_property
    def training(self) -> np.ndarray:
        """Indices of the projections that are not held out; where effects are measured for all, those are what says
        how large they are."""
        return np.flatnonzero(~self.projections.held_out)

    @cached_property
    def block(self) -> int:
        """Side of the blocks of pixels that `views` has the means of, see `coarse_block`."""
        return coarse_block(*self.projections.images.shape[1:])

    @cached_property
    def views(self) -> Projections:
        """All projections, in their order, of pixels as coarse as `coarse_block` has them."""
        return self.projections if self.block == 1 else self.projections.in_blocks(self.block)

    @cached_property
    def cut_off(self) -> float:
        """The share of training views in which the object reaches the left or right end of the detector."""
        images = self.views.images[self.training]
        return cut_off_share(np.where(np.isfinite(images), images, np.float32(0)), axis=2)

    @cached_property
    def set_off(self) -> bool:
        """Whether the detector is set off to one side to see more: what a view leaves out is in the opposite one."""
        detectors, middle = self.projections.detectors, self.projections.box_mm.mean(axis=0)
        axis = float(np.median([project_points(detectors[index], middle)[0] for index in self.training]))
        return min(axis, detectors[0].width - axis) < _SET_OFF * detectors[0].width

    @cached_property
    def voxels(self) -> tuple[int, int, int]:
        """(nx, ny, nz) of `volume`: the scan's own grid, at most 96 along its longest side."""
        share = min(1.0, _MOST_VOXELS / max(self.projections.voxels))
        nx, ny, nz = (max(1, round(share * count)) for count in self.projections.voxels)
        return nx, ny, nz

    @cached_property
    def volume(self) -> Volume:
        """FDK of the training views under a Hann window, negative values kept.

        Raises CaptureError and Cancelled as `core.fdk_process.fdk`.
        """
        return self.reconstructed(self.views)

    @cached_property
    def reprojected(self) -> np.ndarray:
        """(M, height, width) line integrals of `volume` along the rays of all `views`."""
        return self.project(self.volume, self.views.detectors)

    def reconstructed(self, views: Projections) -> Volume:
        """FDK of other coarse views on the same grid: with detectors put right, say."""
        return fdk(views, voxels=self.voxels, window="hann", reporter=self.reporter.silent())

    def project(self, volume: Volume, detectors: Sequence[Detector]) -> np.ndarray:
        """(M, height, width) float32 line integrals of a volume, no unit."""
        return project(volume, detectors, self.reporter)


def of_another_unit(depth: float) -> Told | None:
    """Why nothing is known of the light behind line integrals as large as `depth`; None where it is."""
    if depth <= _DEEPEST:
        return None
    deep = (
        "Line integrals of {depth:,.0f} are in another unit: so little light would arrive that nothing is known of it."
    )
    return Told(deep, depth=depth)


def arriving(integrals: np.ndarray) -> np.ndarray:
    """The share of light behind line integrals, floats in whose precision it is; never nothing, so that it has a
    logarithm."""
    return np.maximum(np.exp(-integrals), np.finfo(integrals.dtype).tiny)
