"""Who is best on a capture, and by how much this project's own rows are ahead of published methods."""

from __future__ import annotations

from dataclasses import dataclass

from . import paper
from .cells import Figures, ordered, section_rows
from .planned import rows_not_run

# Rows of this project's own, whole or in part, which are no rivals of each other; and a rival with our own rates.
_OWN = ("insideout", "apart", "additive")
_TUNED = "r2_at_our_rates"
_NEAR_DB = 1.0


def remark(figures: Figures, capture: Figures) -> str:
    """What to say after the label of section figures that are no nearer to the truth than air everywhere is, but for
    1 dB; "" for others, and where nobody measured air."""
    nothing = ((capture.get("truth") or {}).get("nothing") or {}).get("psnr")
    psnr = figures.get("psnr")
    if nothing is None or psnr is None or psnr > nothing + _NEAR_DB:
        return ""
    return " (found nothing)" if psnr >= nothing - _NEAR_DB else " (further off than nothing)"


def was_given(capture: Figures) -> bool:
    """Whether rows that see X-rays were given the very volume, held-out sections too: then nothing says who is best."""
    return bool((capture.get("truth") or {}).get("given"))


@dataclass(frozen=True)
class Best:
    """The rows that a figure of the sections, as it is shown, is the largest of.

    Attributes:
        methods, labels: whose, in the tables' order.
        value: the figure.
        of: how many rows have it.
    """

    methods: list[str]
    labels: list[str]
    value: float
    of: int


def best_of(capture: Figures, figure: str, digits: int) -> Best | None:
    """Of all rows of a capture, photo rows and this project's own too; None where no row has the figure.

    Args:
        figure: "psnr" or "ssim".
        digits: that it is shown with: what looks the same in the table is the same.
    """
    known = [
        (method, label, round(one[figure], digits))
        for method, row in ordered(capture["methods"])
        for label, one in section_rows(method, row)
        if one.get(figure) is not None
    ]
    if not known or was_given(capture):
        return None
    most = max(value for _, _, value in known)
    first = [(method, label) for method, label, value in known if value == most]
    return Best([method for method, _ in first], [label for _, label in first], most, len(known))


@dataclass(frozen=True)
class Lead:
    """By how many dB of section PSNR a row of this project's own is ahead.

    Attributes:
        label: the row's.
        best, over_best: the best row of a published method that sees X-rays, and the lead over it.
        tuned, over_tuned: R²-Gaussian at our rates, None where it was not run.
    """

    label: str
    best: str
    over_best: float
    tuned: str | None = None
    over_tuned: float | None = None


def leads_of(capture: Figures) -> list[Lead]:
    """Of one capture's figures. A row that found nothing is no rival.

    None where the truth is not exact: FDK and SART would be measured against a relative of theirs. None where rows were
    given what they are measured against.
    """
    if not (capture.get("truth") or {}).get("exact") or was_given(capture):
        return []
    values = {
        method: (row["label"], max(known))
        for method, row in capture["methods"].items()
        if row["modality"] != "photos" and (known := _rivalling(method, row, capture))
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


def _rivalling(method: str, row: Figures, capture: Figures) -> list[float]:
    """PSNR (dB) of a row's sections, each way they are cut, without those of a rival that found nothing."""
    return [
        one["psnr"]
        for _, one in section_rows(method, row)
        if one.get("psnr") is not None and (method in _OWN or not remark(one, capture))
    ]


def lead_lines(captures: Figures) -> str:
    """The leads on each capture and in the mean, beside the paper's; "" if there is none."""
    lines: list[str] = []
    means: dict[tuple[str, str], dict[str, float]] = {}
    counted = paper.one_of_each(name for name, one in captures.items() if leads_of(one))
    for name, one in captures.items():
        rivals = "the rows run of published methods" if rows_not_run(one) else "published methods"
        for lead in leads_of(one):
            line = f"- {name}: {lead.label} {lead.over_best:+.2f} dB against the best of {rivals} that see X-rays"
            line += f" ({lead.best})"
            if lead.tuned is not None and lead.over_tuned is not None:
                line += f", {lead.over_tuned:+.2f} dB against {lead.tuned}"
            lines.append(line)
            if name in counted:
                means.setdefault((lead.label, "the best of each"), {})[name] = lead.over_best
                if lead.tuned is not None and lead.over_tuned is not None:
                    means.setdefault((lead.label, lead.tuned), {})[name] = lead.over_tuned
    if not lines:
        return ""
    lines += [
        f"- mean of {len(found)} objects ({', '.join(found)}): {label} {sum(found.values()) / len(found):+.2f} dB "
        f"against {rival}, ahead on {sum(lead > 0 for lead in found.values())}"
        for (label, rival), found in means.items()
        if len(found) > 1
    ]
    if any(paper.object_of(name) for name in captures):
        lines.append("- paper: +1.67 dB over X-Gaussian, +3.33 dB over 3DGS, mean of its five objects")
    return "\n".join(lines)
