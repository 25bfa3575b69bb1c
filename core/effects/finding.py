"""What looking for an effect found, and how a run's report says it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from ..told import Told


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
        numbers: what the model of an effect of X-rays works with: plain values and numpy arrays; none of effects of
            photos, which are learnt with the splats.
    """

    name: str
    found: bool | None
    strength: float | None
    unit: str
    threshold: float
    reason: Told
    error: float | None = None
    numbers: Mapping[str, Any] = field(default_factory=dict)


def say(row: dict[str, Any], sentence: Told) -> None:
    """Adds a sentence to what a row of `core.effects.choose.Choice` says."""
    row["reason"] = f"{row['reason']} {sentence}"
    # A row that another version has left has no templates: it stays English, rather than lose its beginning.
    if "told" in row:
        row["told"] = [*row["told"], sentence.to_json()]


def unsay(row: dict[str, Any], sentence: Told) -> None:
    """Takes the sentence away again if it is what the row says last."""
    if row["reason"].endswith(f" {sentence}"):
        row["reason"] = row["reason"].removesuffix(f" {sentence}")
        if "told" in row:
            row["told"] = row["told"][:-1]
