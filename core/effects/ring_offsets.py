"""What pixels add to all line integrals alike, from what a fit leaves of them.

A fit of compact, smooth splats draws rings badly, so that the mean over all views of what is measured less what is
rendered has most of a pixel's own offset. It also has what the fit has not reached yet and all views share, outlines of
a body of revolution above all: there it is larger than pixels' offsets, whose deviation is known, and counts less. That
is told apart in bands: of offsets, which are as strong at all wavelengths, each has a known share, while an object
leaves its outlines in one band and what it lacks of shading in another. What is smooth is the object's.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter, uniform_filter

from ..capture.model import Projections
from ..progress import Tick, unstopped

# Before, the object is still blurred. Of what is left after 5 % of the steps half as much again is the object's.
_FROM = 0.4
_SMOOTH_PX = 3.0
# Deviations of the Gaussians that part the bands. Of waves of 32 px and more a fit leaves more of ellipsoids than there
# is of offsets.
_BANDS_PX = (1.5, 3.0, 6.0)
# Pixels around whose energy is looked at, in deviations of the band, and how many times the energy of offsets may still
# be theirs: that of so few differs by chance.
_AROUND, _CHANCE = 5.0, 1.3
# A round is all views once; of very many, as many as leave ten of them.
_ROUNDS = 10
# Views that tell how alike all are: a large one takes a quarter of a second.
_VIEWS_ALIKE = 60


class RingOffsets:
    """Offsets of a detector's pixels, estimated anew after each round of views.

    Args:
        shape: (height, width) of the detector.
        views: how many are shown in turn.
        steps: of the whole fit, a view each.
        deviation: of the offsets, as line integrals (`ring.detect`).

    Attributes:
        values: (height, width) float32, what to take off all projections; zeros at first.
        energy: of what views leave on average, without what is smooth, over that of the offsets: what is beyond 1 the
            object leaves, too. 0 at first.
    """

    def __init__(self, shape: tuple[int, int], views: int, steps: int, deviation: float) -> None:
        self.values, self.energy = np.zeros(shape, np.float32), 0.0
        self._steps, self._deviation = steps, deviation
        self._round = max(1, min(views, steps // _ROUNDS))
        self._forget()

    def observe(self, step: int, left: np.ndarray) -> None:
        """What step number `step` leaves of its view: (height, width) measured less rendered, offsets and all; what is
        not finite counts for nothing."""
        known = np.isfinite(left)
        self._sum += np.where(known, left, 0.0)
        self._seen += known
        self._shown += 1
        if self._shown < self._round:
            return
        if step + 1 >= _FROM * self._steps:
            mean = self._sum / np.maximum(self._seen, 1)
            self.values = told_apart(mean, self._deviation)
            self.energy = float(np.mean(without_smooth(mean) ** 2)) / max(self._deviation**2, 1e-30)
        self._forget()

    def state(self) -> dict[str, Any]:
        """For a checkpoint; tensors, as those are read without pickle."""
        import torch

        arrays = {"values": self.values, "sum": self._sum, "seen": self._seen}
        tensors = {name: torch.from_numpy(array.copy()) for name, array in arrays.items()}
        return {**tensors, "shown": self._shown, "energy": self.energy}

    def restore(self, state: dict[str, Any]) -> None:
        """From a checkpoint. Raises ValueError for a detector of another size."""
        if tuple(state["values"].shape) != self.values.shape:
            raise ValueError(f"offsets of {tuple(state['values'].shape)} pixels, not of {self.values.shape}")
        self.values, self._sum = state["values"].numpy().copy(), state["sum"].numpy().copy()
        self._seen, self._shown, self.energy = state["seen"].numpy().copy(), int(state["shown"]), state["energy"]

    def _forget(self) -> None:
        self._sum, self._seen, self._shown = np.zeros(self.values.shape), np.zeros(self.values.shape, np.int64), 0


def alike(projections: Projections, deviation: float, tick: Tick = unstopped) -> float:
    """How much of what is not smooth in training views all of them share, 0..1 of its energy: near 1 for a body of
    revolution. Of more than 60 views as many are looked at, evenly spread.

    Args:
        deviation: of the pixels' offsets, which all views share and which do not count.
        tick: called between views; may raise to stop.
    """
    count, energy = 0, 0.0
    total = np.zeros(projections.images.shape[1:])
    training = np.flatnonzero(~projections.held_out)
    for place in np.linspace(0, len(training) - 1, min(len(training), _VIEWS_ALIKE)).astype(int):
        tick()
        image = projections.images[training[place]]
        rough = without_smooth(np.where(np.isfinite(image), image, 0.0).astype(np.float64))
        count, energy, total = count + 1, energy + float(np.mean(rough**2)), total + rough
    offsets = deviation**2
    shared = float(np.mean((total / max(count, 1)) ** 2)) - offsets
    return float(np.clip(shared / max(energy / max(count, 1) - offsets, 1e-30), 0.0, 1.0))


def without_smooth(mean: np.ndarray) -> np.ndarray:
    """(height, width) what views leave on average, measured less rendered, where neighbours differ."""
    rough: np.ndarray = mean - gaussian_filter(mean, _SMOOTH_PX)
    return rough


def told_apart(mean: np.ndarray, deviation: float) -> np.ndarray:
    """(height, width) float32 offsets in what views leave on average, measured less rendered.

    Each band of wavelengths counts in full where it has up to 1.3 times the energy that offsets give it, and by the
    square of the ratio where it has more.

    Args:
        deviation: of the offsets; 0 leaves none.
    """
    offsets, sharper, finer_px = np.zeros(mean.shape), mean, 0.0
    for coarser_px in _BANDS_PX:
        smoother = gaussian_filter(mean, coarser_px)
        band = sharper - smoother
        around = 2 * round(0.5 * _AROUND * coarser_px) + 1
        energy, expected = uniform_filter(band**2, around), _CHANCE * deviation**2 * _share(finer_px, coarser_px)
        offsets += np.square(expected / np.maximum(np.maximum(energy, expected), 1e-30)) * band
        sharper, finer_px = smoother, coarser_px
    return offsets.astype(np.float32)


def _share(finer_px: float, coarser_px: float) -> float:
    """Energy of white noise of deviation 1 between two Gaussians, the finer of which may be 0 for none."""
    both = 1 / (finer_px**2 + coarser_px**2)
    alone = 1.0 if finer_px == 0 else 1 / (4 * np.pi * finer_px**2)
    return float(alone + 1 / (4 * np.pi * coarser_px**2) - both / np.pi)
