"""Pieces of the comparison's tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from .methods import METHODS

Figures = dict[str, Any]
NONE = "–"


def table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table; a "|" in a cell is escaped."""
    lines = [_line(headings), _line(["---"] * len(headings)), *(_line(row) for row in rows)]
    return "\n".join(lines)


def _line(cells: Sequence[str]) -> str:
    written = [cell.replace("|", "\\|") for cell in cells]
    return f"| {' | '.join(written)} |"


def number(value: float | None, digits: int = 2) -> str:
    """A figure, or a dash where there is none."""
    return NONE if value is None else f"{value:.{digits}f}"


def decibels(value: float | None) -> str:
    """A PSNR with its unit, or a dash where there is none, as of sections that hardly show the object."""
    return NONE if value is None else f"{number(value)} dB"


def detail_cells(figures: Figures | None) -> list[str]:
    """PIQE, PSNR and SSIM."""
    figures = figures or {}
    return [number(figures.get("piqe")), number(figures.get("psnr")), number(figures.get("ssim"), 3)]


def section_rows(name: str, row: Figures) -> list[tuple[str, Figures]]:
    """A row's section figures under their labels: one for attenuation, two for photo splats and X-Gaussian's."""
    sections = row.get("sections")
    if not sections:
        return []
    rows = [(f"{row['label']}, as the paper does", sections["paper"])] if "paper" in sections else []
    if row["modality"] == "photos":
        return [*rows, (f"{row['label']}, occupancy", sections["occupancy"])]
    return [*rows, (row["label"], sections)]


def ordered(methods: Figures) -> list[tuple[str, Figures]]:
    """Rows in the order of `METHODS`, those that are known no more last."""
    known = list(METHODS)
    return sorted(methods.items(), key=lambda item: known.index(item[0]) if item[0] in known else len(known))


def mean(values: Sequence[float | None]) -> float | None:
    """Of the figures that there are; None if there is none."""
    given = [value for value in values if value is not None]
    return sum(given) / len(given) if given else None


def share(value: float | None) -> str:
    """A share 0..1 in percent, or a dash where there is none; with a digit more where it is nearly nothing or all."""
    if value is None:
        return NONE
    percent = 100 * value
    nearly = 0.05 <= percent < 0.5 or 99.5 <= percent < 99.95
    return f"{percent:.{1 if nearly else 0}f} %"
