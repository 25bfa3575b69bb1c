"""A section as colours, with its colour bar, and as a file. Numpy alone, no bpy."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from ...core.colormap import density_colors
from ...core.steps import part_of_work, run_through
from ...core.views import Plane
from .contours import automatic_level, line_length, lines_in_steps, polygon_area
from .lettering import lettering
from .png import write_png, write_png_in_steps
from .section_position import Position

# Below this part of the window's high a section is air and drawn transparent, so that one looks into hollows.
_AIR = 0.10
_BACKGROUND, _INK = 255, 30
_SHADES = 2048
# A difference is shown up to this part of the window's span, either way.
_DIFFERENCE = 0.25


@dataclass(frozen=True)
class Window:
    """The densities, mm⁻¹, shown darkest and brightest."""

    low: float
    high: float

    @property
    def span(self) -> float:
        """From low to high, never zero."""
        return max(self.high - self.low, 1e-12)

    def of_differences(self) -> Window:
        """As far to both sides of zero, for differences of densities shown in this window."""
        return Window(-_DIFFERENCE * self.span, _DIFFERENCE * self.span)


@dataclass(frozen=True)
class Unit:
    """What attenuations μ are written in: factor · μ + offset."""

    label: str
    factor: float = 1.0
    offset: float = 0.0


UNIT = "mm⁻¹"
HOUNSFIELD = "HU"
PER_MM = Unit(UNIT)
# Of grey values, which were only scaled.
RELATIVE_UNIT = Unit("rel")


def hounsfield(water: float, difference: bool = False) -> Unit:
    """Hounsfield units, 1000·(μ - water) / water.

    Args:
        water: its attenuation in the scan, mm⁻¹.
        difference: of two densities, where water itself drops out.
    """
    return Unit(HOUNSFIELD, 1000 / water, 0.0 if difference else -1000.0)


def section_rgba(values: np.ndarray, window: Window, colors: str = "inferno") -> np.ndarray:
    """(height, width, 4) float32 in 0..1: colours of densities, air and what is no number transparent.

    From a table of `_SHADES` colours, which is ten times as fast as a colour for each pixel and looks the same.

    Args:
        colors: one of `core.colormap.COLOR_MAPS`.
    """
    rgba = _table(colors).take(_shade(values, window), axis=0)
    if window.low > 0:
        rgba[..., 3] = _opacity(values, window)
    return rgba


def difference_rgba(differences: np.ndarray, material: np.ndarray, window: Window) -> np.ndarray:
    """(height, width, 4) float32 in 0..1: blue below zero, red above, transparent where both are air.

    Args:
        differences: (height, width) mm⁻¹.
        material: (height, width) the denser of the two, mm⁻¹.
        window: of the densities.
    """
    rgba = _table("difference").take(_shade(differences, window.of_differences()), axis=0)
    rgba[..., 3] = _opacity(material, window)
    return rgba


def _opacity(values: np.ndarray, window: Window) -> np.ndarray:
    """0 of air, 1 of material: what is air does not depend on which densities are shown darkest."""
    return _table("inferno")[_shade(values, Window(min(window.low, 0.0), window.high)), 3]


def _shade(values: np.ndarray, window: Window) -> np.ndarray:
    place = (np.asarray(values, np.float32) - window.low) * ((_SHADES - 1) / window.span) + 0.5
    # What is not a number becomes the lowest shade; `clip` would keep it.
    return np.fmin(np.fmax(place, 0), _SHADES - 1).astype(np.intp)


@cache
def _table(colors: str) -> np.ndarray:
    """(_SHADES, 4) float32 colours from the window's low to its high."""
    places = np.linspace(0.0, 1.0, _SHADES)
    alpha = np.clip((places - 0.5 * _AIR) / (0.5 * _AIR), 0.0, 1.0)
    return np.concatenate([density_colors(places, 0.0, 1.0, colors), alpha[:, None]], axis=1).astype(np.float32)


def ticks(window: Window, count: int = 5, unit: Unit = PER_MM) -> list[tuple[float, str]]:
    """Evenly spread places in 0..1 along the colour bar, each with its density as text."""
    places = np.linspace(0.0, 1.0, count)
    values = unit.factor * (window.low + places * (window.high - window.low)) + unit.offset
    span = max(unit.factor * (window.high - window.low), 1e-9)
    digits = int(np.clip(2 - np.floor(np.log10(span)), 0, 6))
    # Rounding leaves no "-0".
    texts = [f"{value:.{digits}f}" for value in np.round(values, digits) + 0.0]
    return [(float(place), text) for place, text in zip(places, texts, strict=True)]


def round_length(most: float) -> float:
    """The largest of ..., 0.1, 0.2, 0.5, 1, 2, 5, 10, ... that is not above `most`: what a scale bar may stand for."""
    power = 10.0 ** np.floor(np.log10(most) + 1e-9)
    return float(power * max(step for step in (1.0, 2.0, 5.0) if step * power <= most * (1 + 1e-9)))


def bar_rgba(steps: int = 256, colors: str = "inferno") -> np.ndarray:
    """(steps, 1, 4) colours of the bar, brightest on top."""
    shades = density_colors(np.linspace(1.0, 0.0, steps)[:, None], 0.0, 1.0, colors)
    return np.concatenate([shades, np.ones((steps, 1, 1))], axis=-1).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Picture:
    """A section in colours.

    Attributes:
        rgba: (height, width, 4) float32 in 0..1.
        window: values of the colour bar's ends, mm⁻¹.
        colors: one of `core.colormap.COLOR_MAPS`.
        unit: what the colour bar's numbers are written in.
        name: what it shows, in words.
    """

    rgba: np.ndarray
    window: Window
    colors: str = "inferno"
    unit: Unit = PER_MM
    name: str = "Model"


def with_caption(picture: Picture) -> np.ndarray:
    """(height, width, 3) uint8: as `with_bar`, under a line that says what the picture shows, and in which unit."""
    figure = with_bar(picture)
    size = _letter_size(figure.shape[0])
    letters = lettering(f"{picture.name}, {picture.unit.label}", size)
    margin = 6 * size
    width = max(figure.shape[1], letters.shape[1] + 2 * margin)
    canvas = np.full((figure.shape[0] + letters.shape[0] + 2 * margin, width, 3), _BACKGROUND, np.uint8)
    canvas[-figure.shape[0] :, : figure.shape[1]] = figure
    _write(canvas, letters, margin, margin)
    return canvas


def with_position(figure: np.ndarray, plane: Plane, size: int) -> np.ndarray:
    """(height, width, 3) uint8: a figure over a line that says where in the model its plane lies.

    Args:
        size: pixels to a dot of the letters.
    """
    letters = lettering(Position.of(plane).text, size)
    margin = 6 * size
    width = max(figure.shape[1], letters.shape[1] + 2 * margin)
    canvas = np.full((figure.shape[0] + letters.shape[0] + 2 * margin, width, 3), _BACKGROUND, np.uint8)
    canvas[: figure.shape[0], : figure.shape[1]] = figure
    _write(canvas, letters, figure.shape[0] + margin, margin)
    return canvas


def with_bar(picture: Picture) -> np.ndarray:
    """(height, width, 3) uint8: a picture over white with a labelled colour bar to its right."""
    rgba = picture.rgba
    section = rgba[..., :3] * rgba[..., 3:] + (1 - rgba[..., 3:])
    height = max(section.shape[0], 120)
    size = _letter_size(height)
    labels = [(place, lettering(text, size)) for place, text in ticks(picture.window, unit=picture.unit)]
    widest = max(mask.shape[1] for _, mask in labels)
    bar_width, gap = 10 * size + 6, 6 * size
    canvas = np.full((height, section.shape[1] + bar_width + widest + 4 * gap, 3), _BACKGROUND, np.uint8)
    canvas[: section.shape[0], : section.shape[1]] = np.rint(section * 255)
    left, top, bottom = section.shape[1] + gap, 12 * size + gap, height - 8 * size
    shades = np.linspace(1.0, 0.0, bottom - top)[:, None]
    canvas[top:bottom, left : left + bar_width] = np.rint(density_colors(shades, 0.0, 1.0, picture.colors) * 255)
    _write(canvas, lettering(picture.unit.label, size), top - 10 * size, left)
    for place, mask in labels:
        row = round(bottom - 1 - place * (bottom - 1 - top)) - mask.shape[0] // 2
        _write(canvas, mask, row, left + bar_width + gap)
    return canvas


def _letter_size(height: int) -> int:
    """Pixels to a dot of the letters beside a picture of this height."""
    return max(1, height // 220)


def save_figures(path: Path, pictures: Sequence[Picture], window: Window, plane: Plane) -> None:
    """Writes pictures of one section side by side, each with its colour bar, as an 8-bit PNG of real size.

    Several have captions, and below them stands where the section lies in the model; both are in the file's text, too.
    """
    run_through(save_figures_in_steps(path, pictures, window, plane))


def save_figures_in_steps(
    path: Path, pictures: Sequence[Picture], window: Window, plane: Plane
) -> Generator[float, None, None]:
    """As `save_figures`, with breaks that tell the share that is done; closed before its end the file is as it was."""
    figures = []
    for picture in pictures:
        yield 0.5 * len(figures) / len(pictures)
        figures.append(with_caption(picture) if len(pictures) > 1 else with_bar(picture))
    relative = pictures[0].unit == RELATIVE_UNIT
    texts = {**_provenance(plane, window, relative), "Pictures": ", ".join(picture.name for picture in pictures)}
    figure = with_position(np.concatenate(figures, axis=1), plane, _letter_size(pictures[0].rgba.shape[0]))
    writing = write_png_in_steps(path, figure, pixel_mm(plane), texts)
    yield from part_of_work(writing, 0.5, 1.0)


def save_values(path: Path, values: np.ndarray, window: Window, plane: Plane, relative: bool = False) -> None:
    """Writes the section as a 16-bit grey PNG whose grey is linear in density over the window.

    density = low + grey / 65535 · (high - low); low and high are in the file's text, in mm⁻¹ unless densities are
    `relative`.
    """
    grey = np.rint(np.clip((values - window.low) / window.span, 0, 1) * 65535).astype(np.uint16)
    write_png(path, grey, pixel_mm(plane), _provenance(plane, window, relative))


def pixel_mm(plane: Plane) -> tuple[float, float]:
    """Width and height of a pixel, mm."""
    u, v = (float(np.linalg.norm(np.asarray(step, np.float64))) for step in (plane.u, plane.v))
    return u, v


def size_mm(plane: Plane) -> tuple[float, float]:
    """Width and height of the section, mm."""
    u, v = pixel_mm(plane)
    return plane.width * u, plane.height * v


@dataclass(frozen=True, eq=False)
class Contour:
    """One iso-line of a section.

    Attributes:
        section_mm: (n, 2) mm along the section's row and column from its top-left corner.
        model_mm: (n, 3) the same points in the model's frame.
        area_mm2: what it encloses; 0 if open.
        length_mm: along the line.
    """

    section_mm: np.ndarray
    model_mm: np.ndarray
    area_mm2: float
    length_mm: float


def section_contours(values: np.ndarray, plane: Plane, level: float = 0.0) -> list[Contour]:
    """Iso-lines at `level` mm⁻¹ (0: half of the material's median), in millimetres, the longest first."""
    return run_through(contours_in_steps(values, plane, level))


def contours_in_steps(values: np.ndarray, plane: Plane, level: float = 0.0) -> Generator[float, None, list[Contour]]:
    """As `section_contours`, with breaks that tell the share that is done, 0 to 1."""
    u, v = np.asarray(plane.u, np.float64), np.asarray(plane.v, np.float64)
    size = np.array(pixel_mm(plane))
    contours = []
    lines = yield from lines_in_steps(values, level if level > 0 else automatic_level(values))
    for line in lines:
        flat = line * size
        placed = np.asarray(plane.origin, np.float64) + line[:, :1] * u + line[:, 1:] * v
        contours.append(Contour(flat, placed, polygon_area(flat), line_length(flat)))
    return sorted(contours, key=lambda contour: contour.length_mm, reverse=True)


def _write(canvas: np.ndarray, mask: np.ndarray, row: int, column: int) -> None:
    row = min(max(row, 0), canvas.shape[0] - mask.shape[0])
    window = canvas[row : row + mask.shape[0], column : column + mask.shape[1]]
    window[mask[: window.shape[0], : window.shape[1]]] = _INK


def _provenance(plane: Plane, window: Window, relative: bool) -> dict[str, str]:
    def row(vector: np.ndarray) -> str:
        return " ".join(f"{value:.6g}" for value in np.asarray(vector, np.float64))

    unit = "relative" if relative else "1/mm"
    return {
        "Software": "InsideOut",
        f"Density low ({unit})": f"{window.low:.9g}",
        f"Density high ({unit})": f"{window.high:.9g}",
        "Position": Position.of(plane).text,
        "Plane origin (mm)": row(plane.origin),
        "Plane u (mm per pixel)": row(plane.u),
        "Plane v (mm per pixel)": row(plane.v),
    }
