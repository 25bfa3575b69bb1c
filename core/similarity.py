"""The similarity transform Sim(3): x -> scale · rotation · x + translation. Numpy alone."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Similarity:
    """A rotation (det +1), a uniform scale and a translation; never a reflection, never a shear.

    Attributes:
        scale: > 0; mm per unit of the source frame when the target is the X-ray frame.
        rotation: (3, 3) proper rotation.
        translation: (3,) in the target frame's units.
    """

    scale: float = 1.0
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    translation: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def apply(self, points: np.ndarray) -> np.ndarray:
        """(..., 3) points of the source frame in the target frame."""
        return self.scale * np.asarray(points) @ self.rotation.T + self.translation

    def inverse(self) -> Similarity:
        """The transform that undoes this one."""
        back = self.rotation.T
        return Similarity(1.0 / self.scale, back, -(back @ self.translation) / self.scale)

    def after(self, first: Similarity) -> Similarity:
        """The composition `x -> self(first(x))`."""
        return Similarity(
            self.scale * first.scale,
            self.rotation @ first.rotation,
            self.scale * self.rotation @ first.translation + self.translation,
        )

    def to_json(self) -> dict[str, Any]:
        return {
            "scale": float(self.scale),
            "rotation": np.asarray(self.rotation, float).tolist(),
            "translation": np.asarray(self.translation, float).tolist(),
        }

    @classmethod
    def from_json(cls, content: dict[str, Any]) -> Similarity:
        return cls(
            float(content["scale"]),
            np.array(content["rotation"], float),
            np.array(content["translation"], float),
        )
