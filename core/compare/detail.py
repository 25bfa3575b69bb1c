"""Table 1, internal detail: held-out sections of every row, beside the paper's own figures."""

from __future__ import annotations

import math

from . import paper
from .cells import NONE, Figures, detail_cells, mean, number, ordered, section_rows, table
from .leads import best_of, lead_lines, remark

_PAPER = ("PIQE", "PSNR (dB) ↑", "SSIM ↑", "paper: PIQE", "paper: PSNR", "paper: SSIM")
_HEADINGS = ("", *_PAPER, "error (10⁻³ mm⁻¹) ↓", "whole volume (dB) ↑", "projections (dB) ↑", "photos (dB) ↑")
_TEXT = (
    "Held-out sections against the truth; the best PSNR and SSIM are bold. PIQE, which the paper gives, rates pictures "
    "without the truth and gives flat material near 100: the nearer to the truth's own, in the last row, the better. "
    "Error: what the PSNR is, without a full scale: the root of the mean squared difference. Whole volume: PSNR of all "
    "voxels, full scale their largest, as R²-Gaussian measures. Projections and photos are those that were kept back."
)
_GIVEN = (
    "Here rows that see X-rays were given this very volume, held-out sections too: the figures say how well they "
    "follow it, not who is best."
)
# Full scales that differ by less are not told apart.
_LITTLE_DB = 1.0


def detail_table(captures: Figures) -> str:
    """The tables of all captures that have something to be measured against; "" if there is none."""
    shown = {name: one for name, one in captures.items() if one.get("truth")}
    if not shown:
        return ""
    parts = ["## 1. Internal detail", _TEXT]
    for name, one in shown.items():
        parts += [_title(name, one), *([_GIVEN] if one["truth"].get("given") else [])]
        parts.append(table(_HEADINGS, _rows(name, one)))
    whole = {name: shown[name] for name in paper.one_of_each(shown) if _counts(name, shown[name])}
    if len(whole) > 1:
        title = (
            f"**Mean of {len(whole)} objects** ({', '.join(whole)}), the paper's of its objects of these names. Full "
            "scales differ from object to object: rows may be compared with each other, not with the paper's."
        )
        parts += [title, table(("", *_PAPER), _mean_rows(whole))]
    gain = lead_lines(shown)
    return "\n\n".join([*parts, gain] if gain else parts)


def _counts(name: str, capture: Figures) -> bool:
    """Whether a capture is in the mean."""
    return paper.object_of(name) is not None and capture["truth"]["exact"] and not capture["truth"].get("given")


def _title(name: str, capture: Figures) -> str:
    truth = capture["truth"]
    title = (
        f"**{name}**: measured on {_how_many(truth)} of {truth['source']}, {number(max(truth['voxel_mm']))} mm voxels, "
        f"full scale {truth['peak_per_mm']:.4f} mm⁻¹"
    )
    if not truth["exact"]:
        return f"{title} (no truth: its faults count as right)"
    # Comparisons of earlier versions do not say it.
    material = truth.get("material_per_mm")
    if not material:
        return title
    lower = 20 * math.log10(truth["peak_per_mm"] / material)
    if lower < _LITTLE_DB:
        return title
    return (
        f"{title}; half of the object attenuates less than {material:.4f} mm⁻¹: with that as full scale every PSNR "
        f"here is {lower:.1f} dB lower"
    )


def _how_many(truth: Figures) -> str:
    held_out, measured = truth["held_out_sections"], truth.get("measured_sections")
    if measured in (None, held_out):
        return f"the {held_out} held-out sections"
    return f"the {measured} of {held_out} held-out sections that show the object"


def _rows(name: str, capture: Figures) -> list[list[str]]:
    best = {figure: best_of(capture, figure, digits) for figure, digits in (("psnr", 2), ("ssim", 3))}
    rows = []
    for method, row in ordered(capture["methods"]):
        for place, (label, figures) in enumerate(section_rows(method, row)):
            cells = detail_cells(figures)
            for index, found in ((1, best["psnr"]), (2, best["ssim"])):
                if found is not None and label in found.labels:
                    cells[index] = f"**{cells[index]}**"
            theirs = paper.detail(method, name) if place == 0 else None
            # What does not depend on how a set is cut stands once.
            others = _other_cells(row) if place == 0 else [NONE] * 3
            label += remark(figures, capture)
            rows.append([label, *cells, *detail_cells(theirs), _error(figures, capture), *others])
    truth = capture["truth"]
    if truth.get("nothing"):
        nothing = truth["nothing"]
        rows.append(
            ["nothing at all (air)", *detail_cells(nothing), *[NONE] * 3, _error(nothing, capture), *[NONE] * 3]
        )
    label = "the truth" if truth["exact"] else truth["source"]
    rows.append([label, *detail_cells(truth.get("sections")), *[NONE] * 7])
    return rows


def _error(figures: Figures, capture: Figures) -> str:
    """Of a PSNR that is the mean over sections the error is a geometric mean."""
    psnr = figures.get("psnr")
    return NONE if psnr is None else number(1000 * capture["truth"]["peak_per_mm"] * 10 ** (-psnr / 20))


def _other_cells(row: Figures) -> list[str]:
    return [number((row.get(key) or {}).get("psnr")) for key in ("volume", "projections", "photos")]


def _mean_rows(captures: Figures) -> list[list[str]]:
    found: dict[str, tuple[str, int, list[Figures]]] = {}
    for one in captures.values():
        for method, row in ordered(one["methods"]):
            for place, (label, figures) in enumerate(section_rows(method, row)):
                found.setdefault(label, (method, place, []))[2].append(figures)
    objects = [known for name in captures if (known := paper.object_of(name)) is not None]
    rows = []
    for label, (method, place, parts) in found.items():
        # A mean over fewer objects than the others' is not comparable.
        whole = len(parts) == len(captures)
        ours = {key: mean([one.get(key) for one in parts]) for key in ("piqe", "psnr", "ssim")} if whole else None
        theirs = paper.mean_detail(method, objects) if place == 0 else None
        rows.append([label, *detail_cells(ours), *detail_cells(theirs)])
    return rows
