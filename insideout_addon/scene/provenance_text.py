"""Where a model comes from, in words, in the language of Blender's interface."""

from __future__ import annotations

import math
from typing import Any

from bpy.app.translations import pgettext_iface as iface_
from bpy.app.translations import pgettext_n as n_

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
    return [*lines, iface_("Held out: {figures}").format(figures=", ".join(figures))] if figures else lines


def _part(content: dict[str, Any], name: str) -> dict[str, Any]:
    found = content.get(name)
    return found if isinstance(found, dict) else {}
