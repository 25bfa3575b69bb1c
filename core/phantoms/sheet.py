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
_PAPER, _INK = (255, 255, 255), (20, 20, 20)


def contact_sheet(
    path: Path,
    names: Sequence[str] = (),
    photos_by: str = "cycles",
    reporter: Reporter | None = None,
) -> Path:
    """Writes a JPEG with a row for each phantom: a photo, a radiograph, an axial and a coronal section.

    All cells of a row but the photo have the same scale (the radiograph at the axis) and carry a scale bar of 10 or
    20 mm. They are white where most is taken away.

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
    sections = [_section(phantom, tables, plane) for plane in ("axial", "coronal")]
    side = _field_mm(phantom)
    cells = [_photo(phantom, photos_by, reporter), _radiograph(phantom, tables), *sections]
    for cell in cells[1:]:
        _scale_bar(cell, 20 if side > 90 else 10, side)
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


def _radiograph(phantom: Phantom, tables: PartTables) -> Image.Image:
    """From the front, white where most is taken away."""
    scan = scan_geometry(phantom, _CELL, _CELL)
    detector = scan.detector(-0.5 * np.pi)
    # The scale at the axis is that of the sections.
    pixel = _field_mm(phantom) / _CELL * scan.source_to_detector_mm / scan.source_to_axis_mm
    u, v = (pixel * np.asarray(axis) / np.linalg.norm(axis) for axis in (detector.u, detector.v))
    (depth,) = project(tables, [replace(detector, u=u, v=v)], monochromatic(phantom.energy_kev))
    return _gray(depth)


def _section(phantom: Phantom, tables: PartTables, plane: str) -> Image.Image:
    """Through the box's middle; axial is seen from above with the front down, coronal from the front."""
    spacing = _field_mm(phantom) / _CELL
    along = (np.arange(_CELL) + 0.5 - _CELL / 2) * spacing
    right, up = np.meshgrid(along, -along)
    flat = np.zeros_like(right)
    points = np.stack((right, up, flat) if plane == "axial" else (right, flat, up), axis=-1).reshape(-1, 3)
    attenuations = np.array([material.attenuation(phantom.energy_kev) for material in tables.materials])
    values = tables.voxel_means(points, spacing, attenuations).reshape(_CELL, _CELL)
    return _gray(values)


def _gray(values: np.ndarray) -> Image.Image:
    """Square roots, so that wood shows beside bone. White lies a fourth above the 95th percentile: small bits of metal
    saturate, and in an object of one material its grains show."""
    shown = values[values > 0]
    white = 1.25 * float(np.quantile(shown, 0.95)) if len(shown) else 1.0
    gray = np.round(255 * np.sqrt(np.clip(values / white, 0, 1))).astype(np.uint8)
    return Image.fromarray(gray).convert("RGB")


def _scale_bar(cell: Image.Image, length_mm: int, side_mm: float) -> None:
    draw, right, bottom = ImageDraw.Draw(cell), _CELL - 10, _CELL - 12
    left = right - length_mm * _CELL / side_mm
    draw.rectangle((left, bottom - 3, right, bottom), fill=(255, 255, 255))
    draw.text((left, bottom - 20), f"{length_mm} mm", (255, 255, 255), _font(13))


def _header() -> np.ndarray:
    header = Image.new("RGB", (4 * _CELL + 5 * _GAP, _LABEL), _PAPER)
    for column, title in enumerate(_TITLES):
        ImageDraw.Draw(header).text((_GAP + column * (_CELL + _GAP), 6), title, _INK, _font(14))
    return np.asarray(header)


def _font(size: int) -> ImageFont.ImageFont | ImageFont.FreeTypeFont:
    return ImageFont.load_default(size)
