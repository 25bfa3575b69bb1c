"""Bodies of nested balls, whose mass, balance and hollows have a formula. Numpy alone."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ..gaussians import GaussianSet, Modality
from ..mesh.cavities import Cavity
from ..mesh.mass import MassProperties
from ..mesh.material_table import TabulatedMaterial, find_material
from ..mesh.weight import Weight
from ..volume import Volume

PMMA, GLASS = find_material("PMMA"), find_material("glass")
_SIDE_MM = 32.0


@dataclass(frozen=True)
class Ball:
    """A ball that takes the place of what is there.

    Attributes:
        center_mm: x, y, z.
        material: None for air.
    """

    center_mm: tuple[float, float, float]
    radius_mm: float
    material: TabulatedMaterial | None

    @property
    def volume_mm3(self) -> float:
        return 4 / 3 * np.pi * self.radius_mm**3

    @property
    def density_g_cm3(self) -> float:
        return 0.0 if self.material is None else self.material.density_g_cm3

    def attenuation(self, energy_kev: float) -> float:
        """mm⁻¹."""
        return 0.0 if self.material is None else self.material.attenuation(energy_kev)


Body = tuple[Ball, ...]
"""Each ball lies within the one before."""

_OFF = (3.0, -2.0, 1.0)
BODIES: dict[str, Body] = {
    "solid ball": (Ball(_OFF, 9.0, PMMA),),
    "hollow ball": (Ball(_OFF, 9.0, PMMA), Ball(_OFF, 6.0, None)),
    "ball with its hollow off the middle": (Ball(_OFF, 9.0, PMMA), Ball((5.0, -2.0, 2.0), 4.0, None)),
    "offset core": (Ball(_OFF, 9.0, PMMA), Ball((3.0, 1.0, 0.0), 4.0, GLASS)),
    "nested shells": (Ball(_OFF, 11.0, PMMA), Ball(_OFF, 9.0, None), Ball(_OFF, 7.0, GLASS), Ball(_OFF, 5.0, None)),
}
"""Within 16 mm of the origin along each axis."""


def weight_by_formula(body: Body) -> Weight:
    """What a body weighs: each ball is as much more, or less, as it is denser than the one that it lies in."""
    densities = np.array([ball.density_g_cm3 for ball in body])
    masses = 1e-3 * np.array([ball.volume_mm3 for ball in body]) * np.diff(densities, prepend=0.0)
    centers = np.array([ball.center_mm for ball in body])
    center = masses @ centers / masses.sum()
    inertia = np.zeros((3, 3))
    for mass, place, ball in zip(masses, centers - center, body, strict=True):
        inertia += mass * ((0.4 * ball.radius_mm**2 + place @ place) * np.eye(3) - np.outer(place, place))
    return Weight(MassProperties(float(masses.sum()), center, inertia), _hollows(body), "formula")


def _hollows(body: Body) -> tuple[Cavity, ...]:
    """The balls of air, without what lies in them, the largest first."""
    found = []
    for ball, within in pairwise((*body, Ball((0.0, 0.0, 0.0), 0.0, None))):
        if ball.material is None:
            volume = ball.volume_mm3 - within.volume_mm3
            moment = ball.volume_mm3 * np.array(ball.center_mm) - within.volume_mm3 * np.array(within.center_mm)
            found.append(Cavity(volume, moment / volume))
    return tuple(sorted(found, key=lambda cavity: -cavity.volume_mm3))


def scan(body: Body, energy_kev: float, spacing_mm: float) -> Volume:
    """A body's attenuation, each voxel the mean over itself."""
    count = round(_SIDE_MM / spacing_mm)
    volume = Volume.centered(np.zeros((count, count, count), np.float32), np.full(3, spacing_mm))
    axis = volume.origin_mm[0] + spacing_mm * np.arange(count)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij")[::-1], axis=-1)
    before = 0.0
    for ball in body:
        share = np.clip(0.5 - (np.linalg.norm(points - ball.center_mm, axis=-1) - ball.radius_mm) / spacing_mm, 0, 1)
        volume.values[:] += np.float32(ball.attenuation(energy_kev) - before) * share.astype(np.float32)
        before = ball.attenuation(energy_kev)
    return volume


def splats_of(volume: Volume) -> GaussianSet:
    """Round splats in all voxels that attenuate, whose standard deviation is a voxel.

    So near to each other they sum up to the volume's values, to eight digits where those are even.
    """
    places = np.argwhere(volume.values > 0)
    density = volume.values[tuple(places.T)] / (2 * np.pi) ** 1.5
    means = volume.origin_mm + places[:, ::-1] * volume.spacing_mm
    return GaussianSet.create(means, float(volume.spacing_mm[0]), density=density, modality=Modality.XRAY)
