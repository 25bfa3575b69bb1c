"""What a phantom is: solids as signed distances with attenuations, a visible surface, and a painter."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

SignedDistance = Callable[[np.ndarray], np.ndarray]
"""(N, 3) points in mm -> (N,) distance to the surface in mm, negative inside, never more than the true distance."""


@dataclass(frozen=True)
class Part:
    """A solid that adds `attenuation` to every point inside it.

    Attenuations add up, so a cavity is a part with the negative attenuation of its wall, and a line integral is
    the sum of chord length times attenuation over the parts.

    Attributes:
        name: for people ("shell 1", "cavity 1", "glue seam").
        distance: signed distance of the solid.
        attenuation: mm⁻¹, of either sign.
    """

    name: str
    distance: SignedDistance
    attenuation: float


@dataclass(frozen=True)
class Phantom:
    """An object with known truth, in the world (X-ray) frame, z up.

    Attributes:
        name: as on the command line.
        parts: all solids; see `Part`.
        surface: signed distance of what photos show.
        color: (points (N, 3) mm on the surface, normals (N, 3)) -> (N, 3) sRGB values in 0..1.
        size_mm: (3,) extent along x, y, z of a box about the origin that holds all parts.
        landmarks: (L, 3) mm, points on the surface that a person would recognise in a photo and in a scan.
    """

    name: str
    parts: tuple[Part, ...]
    surface: SignedDistance
    color: Callable[[np.ndarray, np.ndarray], np.ndarray]
    size_mm: tuple[float, float, float]
    landmarks: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))

    def attenuation(self, points: np.ndarray) -> np.ndarray:
        """(...,) attenuation in mm⁻¹ at points (..., 3) mm."""
        flat = np.ascontiguousarray(points, np.float32).reshape(-1, 3)
        total = np.zeros(len(flat), np.float32)
        for part in self.parts:
            total += part.attenuation * (part.distance(flat) < 0)
        return np.maximum(total, 0.0).reshape(np.shape(points)[:-1])

    def voxel_means(self, points: np.ndarray, spacing_mm: float) -> np.ndarray:
        """(...,) attenuation averaged over voxels of `spacing_mm` centred on points (..., 3), to first order.

        A voxel that a surface cuts counts by the share that the signed distance at its centre implies.
        """
        flat = np.ascontiguousarray(points, np.float32).reshape(-1, 3)
        total = np.zeros(len(flat), np.float32)
        for part in self.parts:
            total += part.attenuation * np.clip(0.5 - part.distance(flat) / spacing_mm, 0.0, 1.0)
        return np.maximum(total, 0.0).reshape(np.shape(points)[:-1])
