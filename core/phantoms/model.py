"""What a phantom is: solids as signed distances with materials, a visible surface, and a painter."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from .materials import Material

SignedDistance = Callable[[np.ndarray], np.ndarray]
"""(N, 3) points in mm -> (N,) distance to the surface in mm, negative inside, never more than the true distance."""


@dataclass(frozen=True)
class Part:
    """A solid of one material. Later parts of a phantom take the place of earlier ones where they overlap.

    Attributes:
        name: for people ("shell 1", "cavity 1", "glue seam").
        distance: signed distance of the solid.
        material: what it is made of; None for air, which makes the part a cavity.
        thinnest_mm: thickness of its thinnest wire, wall or crack. None: found out, from how deep one can be inside
            the part; say it where thin things hang on a thick one.
    """

    name: str
    distance: SignedDistance
    material: Material | None
    thinnest_mm: float | None = None


@dataclass(frozen=True)
class Phantom:
    """An object with known truth, in the world (X-ray) frame, z up.

    Attributes:
        name: as on the command line.
        parts: all solids in order; see `Part`.
        surface: signed distance of what photos show.
        color: (points (N, 3) mm on the surface, normals (N, 3)) -> (N, 3) sRGB values in 0..1.
        size_mm: (3,) extent along x, y, z of a box about the origin that holds all parts.
        energy_kev: photon energy that `attenuation` is for; of a spectrum's mean.
        landmarks: (L, 3) mm, points on the surface that a person would recognise in a photo and in a scan.
        of_revolution: its shape looks the same from all sides, so that an alignment needs landmarks.
    """

    name: str
    parts: tuple[Part, ...]
    surface: SignedDistance
    color: Callable[[np.ndarray, np.ndarray], np.ndarray]
    size_mm: tuple[float, float, float]
    energy_kev: float
    landmarks: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    of_revolution: bool = False

    def attenuation(self, points: np.ndarray) -> np.ndarray:
        """(...,) attenuation in mm⁻¹ at points (..., 3) mm."""
        flat = np.ascontiguousarray(points, np.float32).reshape(-1, 3)
        found = np.zeros(len(flat), np.float32)
        for part in self.parts:
            found[part.distance(flat) < 0] = self._attenuation_of(part)
        return found.reshape(np.shape(points)[:-1])

    def voxel_means(self, points: np.ndarray, spacing_mm: float) -> np.ndarray:
        """(...,) attenuation averaged over voxels of `spacing_mm` centred on points (..., 3), to first order.

        A voxel that a surface cuts counts by the share that the signed distance at its centre implies.
        """
        flat = np.ascontiguousarray(points, np.float32).reshape(-1, 3)
        found = np.zeros(len(flat), np.float32)
        for part in self.parts:
            share = np.clip(0.5 - part.distance(flat) / spacing_mm, 0.0, 1.0)
            found += share * (self._attenuation_of(part) - found)
        return found.reshape(np.shape(points)[:-1])

    def _attenuation_of(self, part: Part) -> float:
        return 0.0 if part.material is None else part.material.attenuation(self.energy_kev)
