"""Table 2, alignment: how far the two halves lie apart, and whether the true similarity was found."""

from __future__ import annotations

from . import paper
from .cells import NONE, Figures, number, table
from .starts import is_found

_TEXT = (
    "How far the photo splats lie from the radiative splats (chamfer distance). The true similarity has a distance, "
    "too, for centres of either half lie a little inside of the surface: what counts is how much more than it there is."
)
_HEADINGS = ("", "alignment", "mm", "% of diagonal", "more than the true similarity, mm", "paper: mm")
_FOUND = (
    "Against the true similarity. The run's own line is after the joint refinement, where that is in use; random "
    "starts are of the alignment stage alone."
)
_FOUND_HEADINGS = (
    "",
    "decided by",
    "found",
    "scale % (worst)",
    "rotation ° (worst)",
    "upright axis ° (worst)",
    "translation mm (worst)",
    "warned that shape alone does not decide",
)


def alignment_table(captures: Figures) -> str:
    """The tables of all captures that photos and X-rays were aligned of; "" if there is none."""
    shown = {name: one for name, one in captures.items() if one.get("alignment")}
    if not shown:
        return ""
    distances = [row for name, one in shown.items() for row in _distances(name, one)]
    found = [row for name, one in shown.items() for row in _found(name, one["alignment"])]
    parts = ["## 2. Alignment", _TEXT, table(_HEADINGS, distances)]
    if found:
        parts += [_FOUND, table(_FOUND_HEADINGS, found)]
    without = [name for name, one in shown.items() if not one["alignment"].get("starts")]
    if without:
        parts.append(f"{', '.join(without)}: no random starts were tried.")
    return "\n\n".join(parts)


def _distances(name: str, one: Figures) -> list[list[str]]:
    least = (one["alignment"].get("chamfer_at_truth") or {}).get("mm")
    rows = []
    for step, label, chamfer in _steps(one):
        mm = chamfer.get("mm")
        more = NONE if mm is None or least is None or step == "truth" else f"{mm - least:+.2f}"
        theirs = number(paper.chamfer_mm(step, name))
        rows.append([name, label, number(mm), number(chamfer.get("percent_of_diagonal")), more, theirs])
    return rows


def _steps(one: Figures) -> list[tuple[str, str, Figures]]:
    """Step, label and chamfer figures: the InsideOut row's, and with a joint refinement the paper's last step of the
    row whose halves stay apart."""
    chamfer, joint = one["alignment"].get("chamfer") or {}, one["alignment"].get("refined") == "joint"
    apart = (one["methods"].get("apart") or one["ablation"].get("apart") or {}).get("chamfer") or {}
    last = apart if joint else chamfer
    rows = [
        ("none", "none", chamfer.get("none")),
        ("align", "hierarchical", chamfer.get("align")),
        ("internal", "hierarchical + internal", last.get("internal")),
    ]
    if joint:
        rows.append(("joint", "hierarchical + joint", chamfer.get("internal")))
    if one["alignment"].get("chamfer_at_truth"):
        rows.append(("truth", "the true similarity", one["alignment"]["chamfer_at_truth"]))
    return [(step, label, figures or {}) for step, label, figures in rows]


def _found(name: str, alignment: Figures) -> list[list[str]]:
    """A line for each way that random starts were decided, and one for the run itself."""
    rows = []
    for way, starts in (alignment.get("starts") or {}).items():
        of = starts["of"]
        found, warned = f"{starts['found']} of {of}", f"{starts['ambiguous']} of {of}"
        rows.append([name, f"{way}, random starts", found, *_worst(starts["worst"]), warned])
    errors = alignment.get("errors")
    if errors:
        warned = "no" if alignment["ambiguity"] in (None, "none") else f"yes ({alignment['ambiguity']})"
        way = "landmarks" if alignment.get("by_landmarks") else "shape"
        rows.append([name, f"{way}, the run itself", "yes" if is_found(errors) else "no", *_worst(errors), warned])
    return rows


def _worst(errors: Figures) -> list[str]:
    return [number(errors[name]) for name in ("scale_percent", "rotation_deg", "tilt_deg", "translation_mm")]
