"""What a set is trained towards on sections of the volume and on their contours, by iteration.

Every series answers from the iteration's number alone, so that a resumed optimisation sees what an unbroken one saw.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from scipy import ndimage

from ...sections import SectionView, choose_planes, outer_contour, reference_section
from ...threshold import air_threshold, large_attenuation
from ...volume import Volume

# The soft step from air to material, in shares of the threshold: one voxel of partial volume is no sharp edge.
_SOFTNESS = 0.25


@dataclass(frozen=True, eq=False)
class EdgeTarget:
    """Where photo splats belong on a section.

    Attributes:
        band: (H, W) float32, 1 on the outer contour and its neighbours.
        weight: (H, W) float32, 0 where the section cannot tell.
    """

    band: torch.Tensor
    weight: torch.Tensor


class SectionSeries:
    """Sections of a volume: jittered ones to train on, still ones to measure on.

    Args:
        volume: attenuation in mm⁻¹.
        planes: series names, as in `choose_planes`.
        step_mm: distance between planes; the default rule if None.
        seed: of jitter and order.

    Attributes:
        volume: the same.
        scale: the attenuation counted as 1 in losses, `large_attenuation` of the volume.
        threshold: attenuation between air and the lightest material.
    """

    def __init__(self, volume: Volume, planes: Sequence[str], step_mm: float | None = None, seed: int = 0) -> None:
        self.volume = volume
        self.scale = large_attenuation(volume.values)
        self.threshold = air_threshold(volume.values)
        self._planes, self._step, self._seed = tuple(planes), step_mm, seed
        still = self._choose(None)
        self.held_out = [view for view in still if view.held_out]
        self.training_count = len(still) - len(self.held_out)

    def view(self, iteration: int) -> SectionView:
        """The training section of an iteration, at a position that is new in every round."""
        lap, place = divmod(iteration, self.training_count)
        random = np.random.default_rng([self._seed, 1, lap])
        views = [view for view in self._choose(int(random.integers(2**31))) if not view.held_out]
        return views[int(random.permutation(self.training_count)[place])]

    def spacing_mm(self) -> dict[str, float]:
        """Distance between neighbouring planes of each series."""
        found = {}
        for kind in self._planes:
            positions = [view.position_mm for view in self._choose(None) if view.kind == kind]
            axis = {"sagittal": 0, "coronal": 1, "axial": 2}[kind]
            extent = float(self.volume.box_mm[1, axis] - self.volume.box_mm[0, axis])
            found[kind] = extent / len(positions)
        return found

    def density(self, view: SectionView) -> torch.Tensor:
        """(H, W) float32 attenuation on a section, ≥ 0."""
        return torch.from_numpy(reference_section(self.volume, view).astype(np.float32))

    def material(self, view: SectionView) -> torch.Tensor:
        """(H, W) float32, 0 in air to 1 in material, half way at the threshold."""
        return torch.from_numpy(soft_material(reference_section(self.volume, view), self.threshold))

    def skin(self, view: SectionView) -> torch.Tensor:
        """(H, W) bool, material beside air that is connected with the outside of the box, and what is near it: some
        three voxels in all. Walls of a bore belong to it, whether photos see them or not."""
        return torch.from_numpy(self._skin(view))

    def _skin(self, view: SectionView) -> np.ndarray:
        wall = Volume(self._exposed, self.volume.spacing_mm, self.volume.origin_mm).section(view.plane) > 0.05
        return np.asarray(ndimage.binary_dilation(wall, iterations=1))

    def edge(self, view: SectionView) -> EdgeTarget:
        """The outer contour as a band, with the rest of the outside surface left undecided.

        A bore or a hole that photos look into can be closed on a section, and the outer contour passes it by. Its
        wall must not be emptied: weight 0 there.
        """
        contour = outer_contour(reference_section(self.volume, view), self.threshold)
        band = ndimage.binary_dilation(contour.edge, iterations=1)
        undecided = self._skin(view) & ~band
        return EdgeTarget(torch.from_numpy(band.astype(np.float32)), torch.from_numpy((~undecided).astype(np.float32)))

    def outside_surface(self) -> np.ndarray:
        """(P, 3) points in mm where material meets air that is connected with the outside of the box."""
        from skimage.measure import marching_cubes

        values = np.pad(self.volume.values, 1)
        if not values.min() < self.threshold < values.max():
            return np.zeros((0, 3))
        voxels = marching_cubes(values, self.threshold)[0]
        # Each point lies on the edge between a voxel of material and one of air: is that air outside?
        ends = np.floor(voxels).astype(int), np.ceil(voxels).astype(int)
        reached = np.any([self._outside[tuple(end.T)] for end in ends], axis=0)
        return self.volume.origin_mm + (voxels[reached, ::-1] - 1) * self.volume.spacing_mm

    @cached_property
    def _outside(self) -> np.ndarray:
        """(nz + 2, ny + 2, nx + 2) bool, air that is connected with the outside of the box, one voxel around it too."""
        labels, _ = ndimage.label(np.pad(self.volume.values <= self.threshold, 1, constant_values=True))
        return labels == labels[0, 0, 0]

    @cached_property
    def _exposed(self) -> np.ndarray:
        """(nz, ny, nx) float32, 1 on material beside air that is connected with the outside of the box."""
        exposed = ndimage.binary_dilation(self._outside) & np.pad(self.volume.values > self.threshold, 1)
        return np.ascontiguousarray(exposed[1:-1, 1:-1, 1:-1], np.float32)

    def _choose(self, jitter_seed: int | None) -> list[SectionView]:
        return choose_planes(self.volume.box_mm, self._step, self._planes, self.volume.spacing_mm, jitter_seed)


def soft_material(values: np.ndarray, threshold: float) -> np.ndarray:
    """(…) float32 share of material: a logistic step at the threshold; 0 everywhere when there is no threshold."""
    if not np.isfinite(threshold):
        return np.zeros(np.shape(values), np.float32)
    steps = (np.asarray(values, np.float64) - threshold) / (_SOFTNESS * abs(threshold) + 1e-30)
    return (0.5 * (1 + np.tanh(0.5 * np.clip(steps, -60, 60)))).astype(np.float32)


def unit_length(volume: Volume) -> float:
    """Half the longest side of the volume's box in mm: the length that counts as 1."""
    return 0.5 * float(np.max(volume.box_mm[1] - volume.box_mm[0]))
