"""The effects that a run knows, and what looking for one found."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

PHOTO_EFFECTS = ("exposure", "rolling_shutter", "defocus", "pixel_integration")
"""Effects of photos; so far they are not looked for, and used where a user asks for them."""

XRAY_EFFECTS = ("scatter", "beam_hardening", "geometry")
"""Effects of X-rays, in the order in which they are looked for: what was found before is taken out first."""


@dataclass(frozen=True, eq=False)
class EffectFinding:
    """Whether a capture shows an effect of X-rays.

    Attributes:
        name: one of `XRAY_EFFECTS`.
        found: whether it is needed; None where the capture cannot tell. `auto` never uses what cannot be told.
        strength: what was measured, in `unit`; None where nothing could be.
        unit: as it is shown, "px" or "% of the peak".
        threshold: of the strength, from which the effect is needed.
        reason: one plain sentence with the numbers.
        error: one standard error of the strength; None where it is not known.
        numbers: what its model works with: plain values and numpy arrays.
    """

    name: str
    found: bool | None
    strength: float | None
    unit: str
    threshold: float
    reason: str
    error: float | None = None
    numbers: Mapping[str, Any] = field(default_factory=dict)
