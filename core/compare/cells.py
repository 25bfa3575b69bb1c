"""Pieces of the comparison's tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

Figures = dict[str, Any]
NONE = "–"


def table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [_line(headings), _line(["---"] * len(headings)), *(_line(row) for row in rows)]
    return "\n".join(lines)


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def number(value: float | None, digits: int = 2) -> str:
    """A figure, or a dash where there is none."""
    return NONE if value is None else f"{value:.{digits}f}"


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
