"""What looking for an effect found."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True, eq=False)
class EffectFinding:
    """Whether a capture shows an effect.

    Attributes:
        name: one of those of `core.effect_names`.
        found: whether it is needed; None where the capture cannot tell. `auto` never uses what cannot be told.
        strength: what was measured, in `unit`; None where nothing could be.
        unit: as it is shown, "px" or "% of the peak".
        threshold: of the strength, from which the effect is needed.
        reason: one plain sentence with the numbers.
        error: one standard error of the strength; None where it is not known.
        numbers: what the model of an effect of X-rays works with: plain values and numpy arrays; none of an effect that
            is only told, and of those of photos, which are learnt with the splats.
    """

    name: str
    found: bool | None
    strength: float | None
    unit: str
    threshold: float
    reason: str
    error: float | None = None
    numbers: Mapping[str, Any] = field(default_factory=dict)
