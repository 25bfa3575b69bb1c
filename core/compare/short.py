"""What a comparison found, in a few lines: the InsideOut row of each capture and its lead over the others."""

from __future__ import annotations

from dataclasses import dataclass

from .cells import NONE, Figures, number, section_rows, table

# Rows of this project's own, whole or in part, which are no rivals of each other; and a rival with our own rates.
_OWN = ("insideout", "apart", "additive")
_TUNED = "r2_at_our_rates"


@dataclass(frozen=True)
class Lead:
    """By how many dB of section PSNR a row of this project's own is ahead.

    Attributes:
        label: the row's.
        best, over_best: the best other radiative row of published methods, and the lead over it.
        tuned, over_tuned: R²-Gaussian at our rates, None where it was not run.
    """

    label: str
    best: str
    over_best: float
    tuned: str | None = None
    over_tuned: float | None = None


def leads_of(capture: Figures) -> list[Lead]:
    """Of one capture's figures; none where the truth is not exact: FDK and SART would be measured against a relative
    of theirs."""
    if not (capture.get("truth") or {}).get("exact"):
        return []
    values = {
        method: (row["label"], max(known))
        for method, row in capture["methods"].items()
        if row["modality"] != "photos"
        and (known := [psnr for _, one in section_rows(method, row) if (psnr := one["psnr"]) is not None])
    }
    ours = [values.pop(method) for method in _OWN if method in values]
    tuned, published = values.pop(_TUNED, None), values
    if not published:
        return []
    best, most = max(published.values(), key=lambda item: item[1])
    return [
        Lead(label, best, psnr - most, *((tuned[0], psnr - tuned[1]) if tuned else (None, None)))
        for label, psnr in ours
    ]


def lead_lines(captures: Figures) -> str:
    """The leads on each capture and in the mean, beside the paper's; "" if there is none."""
    lines: list[str] = []
    means: dict[tuple[str, str], list[float]] = {}
    for name, one in captures.items():
        for lead in leads_of(one):
            means.setdefault((lead.label, "the best of each"), []).append(lead.over_best)
            line = f"- {name}: {lead.label} {lead.over_best:+.2f} dB against the best published radiative row"
            line += f" ({lead.best})"
            if lead.tuned is not None and lead.over_tuned is not None:
                means.setdefault((lead.label, lead.tuned), []).append(lead.over_tuned)
                line += f", {lead.over_tuned:+.2f} dB against {lead.tuned}"
            lines.append(line)
    if not lines:
        return ""
    lines += [
        f"- mean of {len(found)} objects: {label} {sum(found) / len(found):+.2f} dB against {rival}, "
        f"ahead on {sum(lead > 0 for lead in found)}"
        for (label, rival), found in means.items()
        if len(found) > 1
    ]
    return "\n".join([*lines, "- paper: +1.67 dB over X-Gaussian, +3.33 dB over 3DGS, mean of its objects"])


def in_short(captures: Figures, same_time: bool) -> str:
    """One line for each capture that has an InsideOut row and a truth; "" if there is none.

    Args:
        same_time: radiative rows were given the time of InsideOut's X-ray half.
    """
    rows = [
        [name, *_short(one, one["methods"]["insideout"])]
        for name, one in captures.items()
        if one.get("truth") and "insideout" in one["methods"]
    ]
    if not rows:
        return ""
    headings = ["", "sections (dB)", "SSIM", "ahead of (dB)", "photos (dB)", "frame off: scale %, rotation °, mm"]
    headings += ["outer surface off, mm (voxels)", "inner surface off, mm (voxels)", "minutes"]
    text = (
        "The InsideOut row of each capture. Ahead of: the best row of a published method that sees X-rays, and "
        "R²-Gaussian at our rates, which is none. "
        + ("Those that go by time have that of InsideOut's X-ray half. " if same_time else "")
        + "Surfaces: the mean distance, the worse of both ways."
    )
    return "\n\n".join(["## In short", text, table(headings, rows)])


def _short(capture: Figures, row: Figures) -> list[str]:
    sections, photos, mesh = (row.get(key) or {} for key in ("sections", "photos", "mesh"))
    lead = next((lead for lead in leads_of(capture) if lead.label == row["label"]), None)
    return [
        number(sections.get("psnr")),
        number(sections.get("ssim"), 3),
        NONE if lead is None else _ahead(lead),
        number(photos.get("psnr")),
        _frame(capture.get("alignment")),
        _worse_way(mesh.get("outer")),
        _worse_way(mesh.get("inner")),
        number(row["seconds"] / 60, 1),
    ]


def _ahead(lead: Lead) -> str:
    tuned = "" if lead.tuned is None else f", {lead.tuned} {lead.over_tuned:+.2f}"
    return f"{lead.best} {lead.over_best:+.2f}{tuned}"


def _frame(alignment: Figures | None) -> str:
    errors = (alignment or {}).get("errors")
    if not alignment or not errors:
        return NONE
    off = ", ".join(number(errors[name]) for name in ("scale_percent", "rotation_deg", "translation_mm"))
    return f"{off} (by landmarks)" if alignment.get("by_landmarks") else off


def _worse_way(side: Figures | None) -> str:
    ways = [way for way in (side or {}).values() if way]
    if not ways:
        return NONE
    worse = max(ways, key=lambda way: way["mean_mm"])
    return f"{worse['mean_mm']:.2f} ({worse['mean_voxels']:.2f})"
