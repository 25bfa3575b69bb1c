"""Table 4, the ablation; fewer projections; and what time each row took."""

from __future__ import annotations

from ..bench.machine import where
from ..train.budget import ENOUGH, MOST
from .ablation import ABLATION
from .cells import NONE, Figures, number, ordered, table
from .thinning import THINNED

_ABLATION = (
    "The final model with one thing changed. A row that says so changes nothing on its object: what it leaves out is "
    "not in use there. Sections and projections gain by the joint refinement through further steps on projections: "
    "photos and sections reach nothing that attenuates, but in the two rows that let them."
)
_ABLATION_HEADINGS = (
    "",
    "",
    "held-out photos (dB)",
    "held-out projections (dB)",
    "sections (dB)",
    "SSIM",
    "X-ray seconds",
    "minutes",
)
# The row that others change one thing of, by modality; of these rows another.
_WHOLE = {"both": "insideout", "xray": "ablation/xray_half"}
_WHOLE_OF = {"ablation/sections_kept": "apart", "ablation/without_finish": "apart"}
_FEWER = (
    "Training projections thinned to even steps; InsideOut sees X-rays alone here. X-ray seconds are what fitting "
    "took, with how far that is from what the row was to take; the seconds in all of FDK and SART include ITK-RTK "
    "being loaded."
)
_FEWER_HEADINGS = (
    "",
    "projections",
    "method",
    "held-out projections (dB)",
    "volume (dB)",
    "sections (dB)",
    "X-ray seconds",
    "seconds in all",
)
_TIME = (
    "Minutes of training, all parts of a resumed run counted. X-ray seconds, without those of compiling kernels, with "
    f"how far they are from what the row was to take; (!) beyond {100 * ENOUGH:.0f} to {100 * MOST:.0f} %: four tries "
    "and one more were still outside."
)
_TIME_HEADINGS = (
    "",
    "method",
    "minutes",
    "splats",
    "X-ray iterations chosen",
    "for seconds",
    "X-ray seconds taken",
)


def ablation_table(captures: Figures) -> str:
    """The ablation of all captures, and for each what the joint refinement brought; "" if there is none."""
    rows: list[list[str]] = []
    verdicts: list[str] = []
    labels = [method.name for method in ABLATION]
    for name, one in captures.items():
        for method in sorted(one["ablation"], key=lambda name: labels.index(name) if name in labels else len(labels)):
            row = one["ablation"][method]
            photos, projections, sections = (row.get(key) or {} for key in ("photos", "projections", "sections"))
            rows.append(
                [
                    name,
                    row["label"] + _remark(one["ablation"], method),
                    number(photos.get("psnr")),
                    number(projections.get("psnr")),
                    number(sections.get("psnr")),
                    number(sections.get("ssim"), 3),
                    taken(row),
                    number(row["seconds"] / 60, 1),
                ]
            )
        if one["ablation"] and (one.get("alignment") or {}).get("refined") == "joint":
            verdicts += _verdict(name, {**one["methods"], **one["ablation"]})
    if not rows:
        return ""
    parts = ["## 4. Ablation", _ABLATION, table(_ABLATION_HEADINGS, rows)]
    return "\n\n".join([*parts, "\n".join(verdicts)] if verdicts else parts)


def _remark(rows: Figures, method: str) -> str:
    """What to say after a row's label."""
    row, base = rows[method], _WHOLE_OF.get(method, _WHOLE[rows[method]["modality"]])
    if row.get("taken_back"):
        return f" (sections not followed: {row['taken_back']})"
    measured = ("photos", "projections", "sections")
    if method != base and base in rows and all(row.get(key) == rows[base].get(key) for key in measured):
        return " (changes nothing here)"
    return ""


def _verdict(name: str, rows: Figures) -> list[str]:
    """A line that says what the joint refinement brought on a capture, of the rows that there are."""
    if "insideout" not in rows:
        return []
    others = (("apart", "the paper's five stages"), ("ablation/align", "the alignment alone"))
    parts = [
        f"against {label} {' and '.join(gains)}"
        for method, label in others
        if method in rows and (gains := _gains(rows["insideout"], rows[method]))
    ]
    return [f"- {name}: the joint refinement brings, {'; '.join(parts)}."] if parts else []


def _gains(row: Figures, other: Figures) -> list[str]:
    gains = []
    for key in ("sections", "photos"):
        ours, theirs = ((one.get(key) or {}).get("psnr") for one in (row, other))
        if ours is not None and theirs is not None:
            gains.append(f"{ours - theirs:+.2f} dB on {key}")
    return gains


def fewer_projections(captures: Figures) -> str:
    """Rows with thinned projections; "" if there is none."""
    rows = []
    for name, one in captures.items():
        numbers = dict(one["projections"])
        if numbers and one.get("photos") is None and one.get("training_projections"):
            # Without photos the methods' own rows are those with all projections.
            numbers[str(one["training_projections"])] = one["methods"]
        for count in sorted(numbers, key=int, reverse=True):
            for method in THINNED:
                if method in numbers[count]:
                    row = numbers[count][method]
                    shown = [(row.get(key) or {}).get("psnr") for key in ("projections", "volume", "sections")]
                    cells = [number(value) for value in shown]
                    rows.append([name, count, row["label"], *cells, taken(row), number(row["seconds"], 0)])
    return "\n\n".join(["## Fewer projections", _FEWER, table(_FEWER_HEADINGS, rows)]) if rows else ""


def time_table(captures: Figures) -> str:
    """What time each row took, and which rows are of another machine than the InsideOut row; "" if there is none."""
    rows = []
    for name, one in captures.items():
        for _, row in ordered(one["methods"]):
            budget = row.get("budget") or {}
            rows.append(
                [
                    name,
                    row["label"] + _other_machine(row, one),
                    number(row["seconds"] / 60, 1),
                    NONE if row.get("splats") is None else str(row["splats"]),
                    NONE if not budget.get("iterations") else str(budget["iterations"]),
                    number(budget.get("seconds"), 0),
                    taken(row),
                ]
            )
    return "\n\n".join(["## Time", _TIME, table(_TIME_HEADINGS, rows)]) if rows else ""


def _other_machine(row: Figures, capture: Figures) -> str:
    reference = capture["methods"].get("insideout") or {}
    if not row.get("machine") or not reference.get("machine"):
        return ""
    return "" if where(row["machine"]) == where(reference["machine"]) else " (!) other machine"


def taken(row: Figures) -> str:
    """A row's X-ray seconds; of one that was to take a time, with how far off it is and a mark where that is much."""
    seconds, wanted = row.get("xray_seconds"), (row.get("budget") or {}).get("seconds")
    if not seconds or not wanted:
        return number(seconds, 0)
    return f"{seconds:.0f} ({seconds / wanted - 1:+.0%}){' (!)' if is_outside(row) else ''}"


def is_outside(row: Figures) -> bool:
    """Whether a row took clearly less or more than the X-ray seconds that it was to take."""
    seconds, wanted = row.get("xray_seconds"), (row.get("budget") or {}).get("seconds")
    if not seconds or not wanted:
        return False
    return not ENOUGH * wanted <= seconds <= MOST * wanted
