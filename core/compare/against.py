"""What a reader has to know before the figures: what they were measured against, and what is missing of them."""

from __future__ import annotations

from . import paper
from .cells import Figures, number, ordered
from .planned import rows_not_run
from .row_tables import is_outside

# Of the names of captures that InsideOut's presets were chosen on, beside the paper's objects.
_HEAD = "shepp"


def measured_against(content: Figures) -> str:
    """A line for each fact; "" where nothing was measured yet."""
    captures = content["captures"]
    lines = [line for name, one in captures.items() for line in _truth(name, one)]
    lines += [*_tuned(captures), *_paper(captures), *_missing(content), *_outside(captures)]
    return "\n".join(["## What it was measured against", "", *(f"- {line}" for line in lines)]) if lines else ""


def no_truth(name: str, truth: Figures) -> str:
    """What a capture is measured against that nobody knows the truth of."""
    return f"{name}: there is no truth; measured against {truth['source']}, whose faults count as right."


def still_to_come(content: Figures) -> str:
    """What says that the comparison is not finished; "" where it is."""
    coming = {name: rows for name, rows in (content.get("coming") or {}).items() if rows}
    rows = "; ".join(f"{name}: {', '.join(rows)}" for name, rows in coming.items())
    return f"**In progress.** Rows still to come: {rows}." if coming else ""


def _truth(name: str, capture: Figures) -> list[str]:
    truth = capture.get("truth")
    if not truth:
        return [f"{name}: photos alone, so there is nothing that its inside could be measured against."]
    if truth["exact"]:
        lines = [f"{name}: {truth['source']}, {number(max(truth['voxel_mm']))} mm voxels."]
    else:
        lines = [no_truth(name, truth)]
    if truth.get("given"):
        lines.append(
            f"{name}: there are no projections. Rows that see X-rays were given this volume, held-out sections too, so "
            "no row is said to be ahead."
        )
    return lines


def _tuned(captures: Figures) -> list[str]:
    exact = [name for name, one in captures.items() if (one.get("truth") or {}).get("exact")]
    tuned = [name for name in exact if paper.object_of(name) or name.lower().startswith(_HEAD)]
    others = [name for name, one in captures.items() if one.get("truth") and name not in tuned]
    lines = []
    if tuned:
        lines.append(
            f"InsideOut's presets were chosen on true sections of {', '.join(tuned)}, among others; rivals have their "
            "published settings, but for what their notes at the end say."
        )
    if others:
        lines.append(f"InsideOut's presets were not chosen on {', '.join(others)}.")
    return lines


def _paper(captures: Figures) -> list[str]:
    if not any(paper.object_of(name) for name in captures):
        return []
    return [
        "“Paper” are the figures of *InsideOut* (ICCV 2025) for its own five objects, which were never released; ours "
        "of the same names are other objects, so the columns stand side by side and are no contest."
    ]


def _missing(content: Figures) -> list[str]:
    """Rows that nobody asked for; captures that lack the same share a line."""
    coming = content.get("coming") or {}
    without: dict[tuple[str, ...], list[str]] = {}
    for name, one in content["captures"].items():
        if missing := [label for label in rows_not_run(one) if label not in coming.get(name, [])]:
            without.setdefault(tuple(missing), []).append(name)
    return [f"Rows not run of {', '.join(names)}: {', '.join(rows)}." for rows, names in without.items()]


def _outside(captures: Figures) -> list[str]:
    rows = [
        f"{name}, {row['label']} ({row['xray_seconds']:.0f} s of {row['budget']['seconds']:.0f})"
        for name, one in captures.items()
        for _, row in ordered(one["methods"])
        if is_outside(row)
    ]
    return [f"Rows that did not take the time that they were to take: {'; '.join(rows)}."] if rows else []
