"""What the tables' decibels look like: sections of the truth, of each row, and their differences, on one sheet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from ..files import atomic_write
from ..volume import ARCHIVE_ERRORS

CUT = "cut.npz"
"""Where a row's folder keeps the sections that are shown."""
SHEET = "sections.png"
SHOWN = ("fdk", "sart", "r2_gaussian", "r2_at_our_rates", "insideout")
"""The rows that have a column, of those that were made: with more of them nobody could see the differences."""
DIFFERENCE_SHARE = 0.2
"""Share of the full scale at which the colours of a difference end."""

_CELL, _GAP, _LINE = 300, 14, 22
# Share of the full scale: where half of the object attenuates less it can hardly be seen, as plastic beside steel.
_FAINT = 0.25
_MARGIN = 4
_PAPER, _INK = (255, 255, 255), (20, 20, 20)
# Okabe and Ito's blue and vermilion, which people who confuse red and green can tell apart.
_LESS, _MORE = np.array([0, 114, 178.0]), np.array([213, 94, 0.0])


@dataclass(frozen=True, eq=False)
class Cut:
    """One row's sections.

    Attributes:
        label: over its column.
        note: under the label, as its PSNR.
        images: (H, W) attenuations in mm⁻¹, one for each section shown, upright.
    """

    label: str
    note: str
    images: Sequence[np.ndarray]


def telling_sections(references: Sequence[np.ndarray], kinds: Sequence[str]) -> list[int]:
    """Of each kind the place of the section with the most edges: there is most to get wrong."""
    edges = [sum(float(np.abs(np.diff(image, axis=axis)).sum()) for axis in (0, 1)) for image in references]
    places = range(len(references))
    return [max((p for p in places if kinds[p] == kind), key=lambda p: edges[p]) for kind in dict.fromkeys(kinds)]


def save_cut(path: Path, images: Sequence[np.ndarray]) -> None:
    """Keeps a row's sections, float32."""
    with atomic_write(path) as stream:
        np.savez_compressed(stream, *(np.asarray(image, np.float32) for image in images))


def load_cut(path: Path) -> list[np.ndarray]:
    """What `save_cut` kept; nothing if there is no such file, or it is damaged."""
    try:
        with np.load(path) as kept:
            return [kept[name] for name in kept.files]
    except ARCHIVE_ERRORS:
        return []


def draw_sections(
    path: Path, truth: Cut, cuts: Sequence[Cut], full_scale: float, pixel_mm: float, *, air: float, material: float
) -> None:
    """Writes the sheet as PNG: a column for the truth and one for each row, under each section its difference.

    Args:
        full_scale: white, mm⁻¹. Greys go by the square root where half of the object would be all but black.
            Differences are white at 0, and blue or orange from `DIFFERENCE_SHARE` of it on.
        pixel_mm: width of the sections' pixels.
        air: mm⁻¹; what attenuates no more is around the object.
        material: mm⁻¹; half of the object attenuates less.
    """
    windows = [_around(image > air) for image in truth.images]
    exponent = 0.5 if material < _FAINT * full_scale else 1.0
    zooms = [max(1, round(_CELL / max(rows.stop - rows.start, cols.stop - cols.start))) for rows, cols in windows]
    columns = [truth, *cuts]
    sides = [
        ((cols.stop - cols.start) * zoom, (rows.stop - rows.start) * zoom)
        for (rows, cols), zoom in zip(windows, zooms, strict=True)
    ]
    wide, high = max(side[0] for side in sides), sum(2 * (side[1] + _GAP) for side in sides)
    size = (_GAP + len(columns) * (wide + _GAP), 2 * _LINE + _GAP + high + 2 * _LINE + _GAP)
    sheet = Image.new("RGB", size, _PAPER)
    for index, cut in enumerate(columns):
        left, top = _GAP + index * (wide + _GAP), _GAP
        for line in (cut.label, cut.note):
            _write(sheet, (left, top), line, wide)
            top += _LINE
        for place, (window, zoom, side) in enumerate(zip(windows, zooms, sides, strict=True)):
            shown, true = cut.images[place][window], truth.images[place][window]
            sheet.paste(_enlarged(_grey(shown, full_scale, exponent), zoom), (left, top))
            top += side[1] + _GAP
            if index:
                sheet.paste(_enlarged(_difference(shown - true, full_scale), zoom), (left, top))
            else:
                _scale_bar(sheet, (left, top), pixel_mm / zoom)
            top += side[1] + _GAP
    _legend(sheet, size[1] - 2 * _LINE - _GAP, full_scale, exponent)
    with atomic_write(path) as stream:
        sheet.save(stream, "PNG")


def _around(inside: np.ndarray) -> tuple[slice, slice]:
    """The rows and columns that hold what is inside, with a little air; all where nothing is."""
    spans = []
    for axis in (1, 0):
        places = np.flatnonzero(inside.any(axis=axis))
        size = inside.shape[1 - axis]
        first, last = (places[0], places[-1]) if len(places) else (0, size - 1)
        spans.append(slice(max(0, int(first) - _MARGIN), min(size, int(last) + 1 + _MARGIN)))
    return spans[0], spans[1]


def _grey(values: np.ndarray, full_scale: float, exponent: float) -> np.ndarray:
    shade = np.round(255 * np.clip(values / full_scale, 0, 1) ** exponent).astype(np.uint8)
    return np.repeat(shade[..., None], 3, axis=2)


def _difference(values: np.ndarray, full_scale: float) -> np.ndarray:
    share = np.clip(values / (DIFFERENCE_SHARE * full_scale), -1, 1)[..., None]
    color = np.where(share < 0, _LESS, _MORE)
    return np.round(255 + np.abs(share) * (color - 255)).astype(np.uint8)


def _enlarged(pixels: np.ndarray, zoom: int) -> Image.Image:
    return Image.fromarray(np.kron(pixels, np.ones((zoom, zoom, 1), np.uint8)))


def _scale_bar(sheet: Image.Image, corner: tuple[int, int], pixel_mm: float) -> None:
    """Of 1, 2 or 5 mm times a power of ten: the longest that is no longer than a fourth of a cell."""
    room = 0.25 * _CELL * pixel_mm
    power = 10.0 ** np.floor(np.log10(room))
    length = max(step * power for step in (1, 2, 5) if step * power <= room)
    left, top = corner
    ImageDraw.Draw(sheet).rectangle((left, top, left + length / pixel_mm, top + 3), fill=_INK)
    _write(sheet, (left, top + 8), f"{length:g} mm", _CELL)


def _legend(sheet: Image.Image, top: int, full_scale: float, exponent: float) -> None:
    end = DIFFERENCE_SHARE * full_scale
    greys = "" if exponent == 1 else "; greys by the square root, so that what is faint can be seen"
    lines = (
        f"Sections: black 0, white {full_scale:.3g} per mm{greys}.",
        f"Under them what differs from the first column: blue {end:.2g} per mm less or further, white the same, "
        f"orange {end:.2g} per mm more or further.",
    )
    for index, line in enumerate(lines):
        _write(sheet, (_GAP, top + index * _LINE), line, sheet.width - 2 * _GAP)


def _write(sheet: Image.Image, place: tuple[int, int], text: str, wide: int) -> None:
    """In letters as large as there is room for; Pillow's own font has no superscripts."""
    text, size = text.replace("²", "2"), 17
    draw = ImageDraw.Draw(sheet)
    while size > 8 and draw.textlength(text, ImageFont.load_default(size)) > wide:
        size -= 1
    draw.text(place, text, _INK, ImageFont.load_default(size))
