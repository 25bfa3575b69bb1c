"""What a comparison found, in a line for each capture: the InsideOut row, who is best, and how far off it is."""

from __future__ import annotations

from .against import no_truth
from .cells import NONE, Figures, number, table
from .leads import Best, Lead, best_of, leads_of
from .mesh_tables import inner_measured
from .planned import rows_not_run

_READING = (
    "PSNR (dB) says how near something is to the truth: 6 dB more are half the error. SSIM says how alike they look: 1 "
    "is the same. A dash: there is no such figure."
)


def in_short(captures: Figures, same_time: bool) -> str:
    """One line for each capture that has an InsideOut row and a truth; "" if there is none.

    Args:
        same_time: methods that go by time were given that of InsideOut's X-ray half.
    """
    shown = {
        name: one for name, one in captures.items() if one.get("truth") and "insideout" in (one.get("methods") or {})
    }
    if not shown:
        return ""
    best = "best of the rows run" if any(rows_not_run(one) for one in shown.values()) else "best of all rows"
    headings = ["", "sections (dB)", f"dB: {best}?", "SSIM", f"SSIM: {best}?", "ahead of (dB)"]
    headings += ["photos (dB)", "frame off: scale %, rotation °, mm"]
    headings += ["outer surface off, mm (voxels)", "inner surface off, mm (voxels)", "minutes"]
    rows = [[_name(name, one), *_short(one, one["methods"]["insideout"])] for name, one in shown.items()]
    text = (
        "The InsideOut row of each capture. Ahead of: the best row of a published method that sees X-rays, and "
        "R²-Gaussian at our rates, which nobody published. "
        + ("Those that go by time have that of InsideOut's X-ray half. " if same_time else "")
        + "Surfaces: the mean distance, the worse of both ways. "
        + _READING
    )
    unknown = [f"† {no_truth(name, one['truth'])}" for name, one in shown.items() if not one["truth"]["exact"]]
    return "\n\n".join(["## In short", text, table(headings, rows), *unknown])


def _name(name: str, capture: Figures) -> str:
    """With what its InsideOut row says of itself, where that was made by an earlier version."""
    _, before, how = capture["methods"]["insideout"]["label"].partition(" [as it was")
    return f"{name}{'' if capture['truth']['exact'] else ' †'}{before}{how}"


def _short(capture: Figures, row: Figures) -> list[str]:
    sections, photos, mesh = (row.get(key) or {} for key in ("sections", "photos", "mesh"))
    lead = next((lead for lead in leads_of(capture) if lead.label == row["label"]), None)
    return [
        number(sections.get("psnr")),
        _who_is_best(best_of(capture, "psnr", 2), 2),
        number(sections.get("ssim"), 3),
        _who_is_best(best_of(capture, "ssim", 3), 3),
        NONE if lead is None else _ahead(lead),
        number(photos.get("psnr")),
        _frame(capture.get("alignment")),
        _worse_way(mesh.get("outer")),
        _inner(capture, mesh.get("inner")),
        number(row["seconds"] / 60, 1),
    ]


def _who_is_best(best: Best | None, digits: int) -> str:
    if best is None:
        return NONE
    if "insideout" not in best.methods:
        return f"no: {', '.join(best.labels)} {best.value:.{digits}f}"
    if best.of == 1:
        return "the only row"
    others = [label for method, label in zip(best.methods, best.labels, strict=True) if method != "insideout"]
    return f"yes, as {', '.join(others)}" if others else "yes"


def _ahead(lead: Lead) -> str:
    tuned = "" if lead.tuned is None else f", {lead.tuned} {lead.over_tuned:+.2f}"
    return f"{lead.best} {lead.over_best:+.2f}{tuned}"


def _frame(alignment: Figures | None) -> str:
    errors = (alignment or {}).get("errors")
    if not alignment or not errors:
        return NONE
    off = ", ".join(number(errors[name]) for name in ("scale_percent", "rotation_deg", "translation_mm"))
    return f"{off} (by landmarks)" if alignment.get("by_landmarks") else off


def _inner(capture: Figures, side: Figures | None) -> str:
    """Also of how much of the inner surfaces it is, where that is not all."""
    off, measured = _worse_way(side), inner_measured(capture)
    return off if off == NONE or not measured else f"{off}, of {measured} of them"


def _worse_way(side: Figures | None) -> str:
    ways = [way for way in (side or {}).values() if way]
    if not ways:
        return NONE
    worse = max(ways, key=lambda way: way["mean_mm"])
    return f"{worse['mean_mm']:.2f} ({worse['mean_voxels']:.2f})"
