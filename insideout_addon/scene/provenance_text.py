"""Where a model comes from, in words, in the language of Blender's interface."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from bpy.app.translations import pgettext_iface as iface_
from bpy.app.translations import pgettext_n as n_

from ..effects import EFFECT_TEXTS
from ..told_text import told_text

EFFECT_UNITS = (
    "px",
    "%",
    n_("times"),
    n_("% at the 95th percentile"),
    n_("% of the peak"),
    n_("% of the projections"),
)
"""What strengths of effects are told in."""

_HELDOUT = {"photos": n_("photos"), "projections": n_("projections"), "sections": n_("sections")}


def provenance_lines(provenance: dict[str, Any]) -> list[str]:
    """What a panel shows: what was captured and how, then the figures of what the run held back.

    Args:
        provenance: as `provenance_of` a model.
    """
    run, capture, heldout, versions = (_part(provenance, name) for name in ("run", "capture", "heldout", "versions"))
    date = str(run.get("finished", ""))[:10]
    engine = f"InsideOut {versions['insideout']}" if versions.get("insideout") else ""
    made = [str(part) for part in (capture.get("name"), run.get("preset"), date, engine) if part]
    figures = []
    for name, word in _HELDOUT.items():
        psnr = _part(heldout, name).get("psnr")
        if isinstance(psnr, int | float) and math.isfinite(psnr):
            figures.append(f"{iface_(word)} {psnr:.1f} dB")
    lines = [" · ".join(made)] if made else []
    if figures:
        told = iface_("Tested on images that were kept back, more is better: {figures}")
        lines.append(told.format(figures=", ".join(figures)))
    return lines


@dataclass(frozen=True)
class EffectLine:
    """What a run says about one effect.

    Attributes:
        found: whether it is there; None where that is not known.
        used: whether the run made use of it.
        told: its name, whether it is there, how strong, whether it was used, what it was worth.
        reason: why, with the numbers; English where an older engine has told it.
    """

    found: bool | None
    used: bool
    told: str
    reason: str


def effect_lines(provenance: dict[str, Any]) -> list[EffectLine]:
    """What a panel shows of the effects that a run looked for or was asked for; [] of a run that was not.

    Args:
        provenance: as `provenance_of` a model.
    """
    effects = _part(provenance, "effects")
    return [_effect_line(name, _part(effects, name)) for name in effects if _part(effects, name)]


def _effect_line(name: str, row: dict[str, Any]) -> EffectLine:
    found, used, strength = row.get("found"), row.get("used") is True, row.get("strength")
    if isinstance(found, bool):
        state = iface_("found") if found else iface_("not needed")
    else:
        unseen = row.get("half") == "photos" and row.get("threshold") is None
        found, state = None, iface_("not looked for") if unseen else iface_("cannot tell")
    told = [state]
    if isinstance(strength, int | float) and math.isfinite(strength):
        unit = str(row.get("unit", ""))
        told.append(f"{strength:.2g} {iface_(unit) if unit else ''}".strip())
    told.append(iface_("used") if used else iface_("not used"))
    gain = row.get("gain_db")
    if isinstance(gain, int | float) and math.isfinite(gain):
        told.append(iface_("worth {gain} dB in a trial").format(gain=f"{gain:+.1f}"))
    longer = row.get("times_as_long")
    if isinstance(longer, int | float) and math.isfinite(longer):
        told.append(iface_("steps {times} times as long").format(times=f"{longer:.1f}"))
    # A newer version may know more of them.
    title = iface_(EFFECT_TEXTS[name][0]) if name in EFFECT_TEXTS else name
    return EffectLine(found, used, f"{title}: {', '.join(told)}", told_text(row.get("told"), row.get("reason")))


def _part(content: dict[str, Any], name: str) -> dict[str, Any]:
    found = content.get(name)
    return found if isinstance(found, dict) else {}
