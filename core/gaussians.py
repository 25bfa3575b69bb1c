"""GaussianSet: the one type that flows through every stage. Importable with numpy alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np

from .densities import PER_MM, Densities
from .rotations import matrix_to_quat, multiply_quats, normalize_quats, quats_to_matrices
from .similarity import Similarity
from .spherical_harmonics import rotate_sh, sh_degree


class Modality(IntEnum):
    """Where a splat came from; the `modality` property of a .ply."""

    RGB = 0
    XRAY = 1
    CLONE = 2


@dataclass(frozen=True, eq=False)
class GaussianSet:
    """N 3D Gaussians, all parameters activated: linear scales, opacities in 0..1, density in mm⁻¹.

    Fields are numpy arrays between stages and torch tensors while a renderer or an optimiser holds them;
    `to_torch` and `to_numpy` go from one to the other. Lengths are mm in the world (X-ray) frame; a set that has
    not been aligned yet is in the photo frame and its lengths have no unit.

    Attributes:
        means: (N, 3) centres.
        quats: (N, 4) unit quaternions, w first.
        scales: (N, 3) standard deviations along the axes, > 0.
        opacities: (N,) peak opacity in 0..1; of an X-ray set the display opacity.
        sh: (N, K, 3) colour coefficients as 3DGS has them, K in 1, 4, 9, 16.
        density: (N,) peak attenuation ρ in mm⁻¹; 0 for splats that X-rays do not see.
        modality: (N,) uint8, a `Modality`.
    """

    means: Any
    quats: Any
    scales: Any
    opacities: Any
    sh: Any
    density: Any
    modality: Any

    def __len__(self) -> int:
        return int(self.means.shape[0])

    @property
    def sh_degree(self) -> int:
        """Degree of the colour functions, 0 to 3."""
        return sh_degree(self.sh.shape[1])

    @classmethod
    def create(
        cls,
        means: np.ndarray,
        scales: np.ndarray | float,
        *,
        quats: np.ndarray | None = None,
        opacities: np.ndarray | float = 1.0,
        sh: np.ndarray | None = None,
        density: np.ndarray | float = 0.0,
        modality: np.ndarray | Modality = Modality.RGB,
    ) -> GaussianSet:
        """A numpy set with what is not given filled in: no rotation, opaque, mid-grey, no attenuation.

        Args:
            means: (N, 3).
            scales: (N, 3), (N, 1) or one number for isotropic splats.
        """
        means = np.ascontiguousarray(means, np.float32).reshape(-1, 3)
        count = len(means)

        def filled(value: Any, shape: tuple[int, ...], dtype: type) -> np.ndarray:
            return np.ascontiguousarray(np.broadcast_to(np.asarray(value, dtype), shape)).copy()

        return cls(
            means=means,
            quats=normalize_quats(filled([1, 0, 0, 0] if quats is None else quats, (count, 4), np.float32)),
            scales=filled(scales, (count, 3), np.float32),
            opacities=filled(opacities, (count,), np.float32),
            sh=np.zeros((count, 1, 3), np.float32) if sh is None else np.ascontiguousarray(sh, np.float32),
            density=filled(density, (count,), np.float32),
            modality=filled(modality, (count,), np.uint8),
        )

    @classmethod
    def empty(cls, degree: int = 0) -> GaussianSet:
        """A set of no splats with colour functions of the given degree."""
        return cls.create(np.zeros((0, 3)), 1.0, sh=np.zeros((0, (degree + 1) ** 2, 3)))

    @classmethod
    def concatenate(cls, sets: Sequence[GaussianSet]) -> GaussianSet:
        """All splats of numpy `sets` in order; colour functions are padded with zeros to the highest degree."""
        coefficients = max(part.sh.shape[1] for part in sets)
        padded = [part.with_sh_coefficients(coefficients) for part in sets]
        return cls(**{f.name: np.concatenate([getattr(part, f.name) for part in padded]) for f in fields(cls)})

    def with_sh_coefficients(self, coefficients: int) -> GaussianSet:
        """The same numpy set with K = `coefficients`, cut or padded with zeros."""
        sh = np.zeros((len(self), coefficients, 3), np.float32)
        shared = min(coefficients, self.sh.shape[1])
        sh[:, :shared] = self.sh[:, :shared]
        return replace(self, sh=sh)

    def select(self, which: Any) -> GaussianSet:
        """The splats that a boolean mask, an index array or a slice picks."""
        return GaussianSet(**{f.name: getattr(self, f.name)[which] for f in fields(self)})

    def covariances(self) -> Any:
        """Σ = R S Sᵀ Rᵀ, (N, 3, 3), squared lengths."""
        factors = quats_to_matrices(self.quats) * self.scales[:, None, :]
        return factors @ factors.swapaxes(-1, -2)

    def transformed(self, similarity: Similarity) -> GaussianSet:
        """The numpy set moved by a similarity.

        Means, quats, scales and SH bands turn and grow with it. `density` is divided by the scale, so that line
        integrals, which have no unit, stay what they were (facts of R2-Gaussian, arXiv 2405.20693).
        """
        turn = matrix_to_quat(similarity.rotation)
        return replace(
            self,
            means=similarity.apply(self.means.astype(np.float64)).astype(np.float32),
            quats=normalize_quats(multiply_quats(turn, self.quats.astype(np.float64))).astype(np.float32),
            scales=(self.scales * similarity.scale).astype(np.float32),
            sh=rotate_sh(self.sh, similarity.rotation),
            density=(self.density / similarity.scale).astype(np.float32),
        )

    def integrals(self) -> np.ndarray:
        """(N,) float64 integral of each splat's attenuation over space, ρ·(2π)^{3/2}·s₁s₂s₃, mm²; numpy sets."""
        return (2 * np.pi) ** 1.5 * self.density.astype(np.float64) * np.prod(self.scales.astype(np.float64), axis=1)

    def to_torch(self, dtype: Any = None, device: Any = "cpu") -> GaussianSet:
        """The same set as torch tensors (float32 unless `dtype` says otherwise; modality stays uint8)."""
        import torch

        return GaussianSet(
            **{
                f.name: torch.as_tensor(getattr(self, f.name)).to(
                    device=device, dtype=torch.uint8 if f.name == "modality" else dtype or torch.float32
                )
                for f in fields(self)
            }
        )

    def to_numpy(self) -> GaussianSet:
        """The same set as float32 numpy arrays, detached from any graph."""

        def array(value: Any) -> np.ndarray:
            return value if isinstance(value, np.ndarray) else value.detach().cpu().numpy()

        return GaussianSet(
            **{
                f.name: np.ascontiguousarray(
                    array(getattr(self, f.name)), np.uint8 if f.name == "modality" else np.float32
                )
                for f in fields(self)
            }
        )

    def save(self, path: Path, densities: Densities = PER_MM) -> None:
        """Writes a .ply (see `core.ply`), atomically.

        Args:
            densities: what they are in, which the file's header says.
        """
        from .ply import write_ply

        write_ply(self.to_numpy(), Path(path), densities=densities)

    @classmethod
    def load(cls, path: Path) -> GaussianSet:
        """Reads a .ply (see `core.ply`). Raises GaussianFileError."""
        from .ply import read_ply

        return read_ply(Path(path))
