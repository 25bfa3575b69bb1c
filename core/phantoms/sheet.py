"""A contact sheet of phantoms: what each looks like outside, to X-rays, and cut open."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from ..errors import SettingError
from ..files import atomic_write
from ..progress import Progress, Reporter
from .make import PHANTOMS
from .model import Phantom
from .part_tables import PartTables
from .projections import project
from .scanner import scan_geometry
from .settings import CaptureSettings
from .shots import Shot, camera_at
from .spectrum import monochromatic
from .studio import take_photos

_CELL, _GAP, _LABEL = 300, 12, 26
_TITLES = ("photo", "radiograph", "axial section", "coronal section")
_PAPER, _INK, _MARK = (255, 255, 255), (20, 20, 20), (255, 160, 40)
# Sections are looked for at so many places in the middle part of the box, at a fraction of a cell's pixels.
_PLACES, _MIDDLE, _COARSE = 15, 0.8, 100


def contact_sheet(
    path: Path,
    names: Sequence[str] = (),
    photos_by: str = "cycles",
    reporter: Reporter | None = None,
) -> Path:
    """Writes a JPEG with a row for each phantom: a photo, a radiograph, an axial and a coronal section.

    Sections are those with the most edges, there is most to see; ticks beside the radiograph say where the axial one
    lies. Radiograph (at the axis) and coronal section have the same scale, the axial section has its own, and each a
    scale bar. They are bright where most is taken away: both sections of a row alike, the radiograph by itself.

    Args:
        names: keys of `PHANTOMS`; all of them by default.
        photos_by: "cycles" or "rays".

    Raises:
        SettingError: an unknown name, or Cycles is asked for and there is no Blender.
        Cancelled: through `reporter`.
    """
    names, reporter = list(names) or sorted(PHANTOMS), reporter or Reporter()
    unknown = [name for name in names if name not in PHANTOMS]
    if unknown:
        raise SettingError(f"phantom '{unknown[0]}' is not known; choose any of: {', '.join(sorted(PHANTOMS))}.")
    rows = []
    for index, name in enumerate(names):
        reporter.update(Progress("phantom", name, index / len(names), index, len(names)))
        rows.append(_row(PHANTOMS[name](), photos_by, reporter))
    with atomic_write(path) as stream:
        Image.fromarray(np.concatenate([_header(), *rows])).save(stream, "JPEG", quality=90, subsampling=0)
    return path


def _row(phantom: Phantom, photos_by: str, reporter: Reporter) -> np.ndarray:
    tables = PartTables.bake(phantom, step=lambda done: reporter.check())
    side, wide = _field_mm(phantom), 1.06 * max(phantom.size_mm[:2])
    height = _telling_place(phantom, tables, "axial", wide)
    axial = _section(phantom, tables, "axial", height, wide)
    coronal = _section(phantom, tables, "coronal", _telling_place(phantom, tables, "coronal", side), side)
    white = _white(np.stack([axial, coronal]))
    depth = _radiograph(phantom, tables)
    shown = _gray(depth, _white(depth)), _gray(axial, white), _gray(coronal, white)
    cells = [_photo(phantom, photos_by, reporter), *shown]
    for cell, seen in zip(cells[1:], (side, wide, side), strict=True):
        _scale_bar(cell, seen)
    _ticks(cells[1], height, side)
    row = Image.new("RGB", (4 * _CELL + 5 * _GAP, _CELL + _LABEL + _GAP), _PAPER)
    ImageDraw.Draw(row).text((_GAP, 4), phantom.name.replace("_", " "), _INK, _font(16))
    for column, cell in enumerate(cells):
        row.paste(cell, (_GAP + column * (_CELL + _GAP), _LABEL))
    return np.asarray(row)


def _photo(phantom: Phantom, photos_by: str, reporter: Reporter) -> Image.Image:
    effects = ("table",) if photos_by == "cycles" else ()
    settings = CaptureSettings(
        photos=1, photo_width=_CELL, photo_height=_CELL, photos_by=photos_by, effects=effects, samples=64
    )
    # The front is -y: from there, a little to the side and from above.
    camera = camera_at(np.radians(-65.0), np.radians(18.0), max(phantom.size_mm), _CELL, _CELL)
    (pixels,) = take_photos(phantom, [Shot(camera)], settings, 0, reporter)
    return Image.fromarray(pixels)


def _field_mm(phantom: Phantom) -> float:
    return 1.06 * max(phantom.size_mm)


def _radiograph(phantom: Phantom, tables: PartTables) -> np.ndarray:
    """Line integrals from the front."""
    scan = scan_geometry(phantom, _CELL, _CELL)
    detector = scan.detector(-0.5 * np.pi)
    # The scale at the axis is that of the sections.
    pixel = _field_mm(phantom) / _CELL * scan.source_to_detector_mm / scan.source_to_axis_mm
    u, v = (pixel * np.asarray(axis) / np.linalg.norm(axis) for axis in (detector.u, detector.v))
    (depth,) = project(tables, [replace(detector, u=u, v=v)], monochromatic(phantom.energy_kev))
    return depth


def _section(
    phantom: Phantom, tables: PartTables, plane: str, place_mm: float, side_mm: float, pixels: int = _CELL
) -> np.ndarray:
    """Attenuation in a square of `side_mm`; axial is seen from above with the front down, coronal from the front.

    Args:
        place_mm: along z of an axial section, along y of a coronal one, from the box's middle.
    """
    spacing = side_mm / pixels
    along = (np.arange(pixels) + 0.5 - pixels / 2) * spacing
    right, up = np.meshgrid(along, -along)
    flat = np.full_like(right, place_mm)
    points = np.stack((right, up, flat) if plane == "axial" else (right, flat, up), axis=-1).reshape(-1, 3)
    attenuations = np.array([material.attenuation(phantom.energy_kev) for material in tables.materials])
    return tables.voxel_means(points, spacing, attenuations).reshape(pixels, pixels)


def _telling_place(phantom: Phantom, tables: PartTables, plane: str, side_mm: float) -> float:
    """Where a section has the most edges."""
    reach = 0.5 * _MIDDLE * phantom.size_mm[2 if plane == "axial" else 1]

    def edges(place: float) -> float:
        cut = np.sqrt(_section(phantom, tables, plane, place, side_mm, _COARSE))
        return sum(float(np.abs(np.diff(cut, axis=axis)).sum()) for axis in (0, 1))

    return max(np.linspace(-reach, reach, _PLACES), key=edges)


def _white(values: np.ndarray) -> float:
    """A fourth above the 95th percentile: small bits of metal saturate, and in an object of one material its grains
    show."""
    shown = values[values > 0]
    return 1.25 * float(np.quantile(shown, 0.95)) if len(shown) else 1.0


def _gray(values: np.ndarray, white: float) -> Image.Image:
    """Square roots, so that wood shows beside bone."""
    gray = np.round(255 * np.sqrt(np.clip(values / white, 0, 1))).astype(np.uint8)
    return Image.fromarray(gray).convert("RGB")


def _scale_bar(cell: Image.Image, side_mm: float) -> None:
    length_mm = 20 if side_mm > 90 else 10
    draw, right, bottom = ImageDraw.Draw(cell), _CELL - 10, _CELL - 12
    left = right - length_mm * _CELL / side_mm
    draw.rectangle((left, bottom - 3, right, bottom), fill=(255, 255, 255))
    draw.text((left, bottom - 20), f"{length_mm} mm", (255, 255, 255), _font(13))


def _ticks(cell: Image.Image, height_mm: float, side_mm: float) -> None:
    """At both edges of a cell, where the axial section lies."""
    y = _CELL / 2 - height_mm * _CELL / side_mm
    for x in (0, _CELL - 14):
        ImageDraw.Draw(cell).rectangle((x, y - 1, x + 13, y + 1), fill=_MARK)


def _header() -> np.ndarray:
    header = Image.new("RGB", (4 * _CELL + 5 * _GAP, _LABEL), _PAPER)
    for column, title in enumerate(_TITLES):
        ImageDraw.Draw(header).text((_GAP + column * (_CELL + _GAP), 6), title, _INK, _font(14))
    return np.asarray(header)


def _font(size: int) -> ImageFont.ImageFont | ImageFont.FreeTypeFont:
    return ImageFont.load_default(size)
