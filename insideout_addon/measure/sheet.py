"""A sheet of evenly spaced sections: all in one scale, numbered, with an overview that shows where they are.

Numpy alone, no bpy.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass

import numpy as np

from ...core.digits import decimals, fixed
from ...core.errors import SettingError
from ...core.render.section_numpy import SectionSplats, section_density
from ...core.views import Plane
from .look import Look
from .page import FAINT, MM_PER_INCH, Color, Outline, Page
from .ticks import round_step

# Those of ISO 5455, and 2:3, 1:3, 1:4 of archaeological drawings with their counterparts; paper to model.
_LARGER = ((50, 1), (20, 1), (10, 1), (5, 1), (4, 1), (3, 1), (2, 1), (3, 2))
SCALES = (*_LARGER, (1, 1), *((model, paper) for paper, model in reversed(_LARGER)), (1, 100), (1, 200), (1, 500))
# ISO 216, mm.
PAPERS = {"A4": (210, 297), "A3": (297, 420), "A2": (420, 594), "A1": (594, 841), "A0": (841, 1189)}
# mm on the paper.
_MARGIN, _HEAD, _FOOT, _GAP, _WIDEST_GAP, _LABEL = 12.0, 15.0, 17.0, 4.0, 12.0, 5.5
_TITLE_SIZE, _TEXT_SIZE, _SMALL_SIZE, _STROKE, _OVER = 5.0, 3.2, 2.6, 0.12, 1.0
_BAR_WIDTH, _BAR_HEIGHT, _BAR_STEPS = 62.0, 3.2, 512
_LINES: Color = (0.0, 0.45, 0.75)
# What is left around the model in each picture, as part of its longest side.
_AROUND = 0.03
_WORLD_AXES = {
    "X": ((0, 1, 0), (0, 0, -1), (1, 0, 0)),
    "Y": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "Z": ((1, 0, 0), (0, -1, 0), (0, 0, 1)),
}


@dataclass(frozen=True, eq=False)
class Series:
    """Parallel sections through a box of the model, mm in the model's frame.

    Attributes:
        right, down, along: (3,) unit vectors: a picture's row and column, and from section to section.
        origin: (3,) where positions along the series are 0.
        low, high: (3,) of the box along right, down and along, from the origin.
        positions: along the series.
        around: what is left around the box in pictures, mm; `low` and `high` hold it along right and down.
        name: of the axis, "" where positions are told from the section plane.
    """

    right: np.ndarray
    down: np.ndarray
    along: np.ndarray
    origin: np.ndarray
    low: np.ndarray
    high: np.ndarray
    positions: np.ndarray
    around: float
    name: str

    def plane(self, position: float, pixel_mm: float) -> Plane:
        """The section there, its picture as large as the box."""
        return _plane(self.origin + position * self.along, self.right, self.down, self.low[:2], self.high[:2], pixel_mm)

    @property
    def step(self) -> float:
        """Distance from section to section, mm."""
        return float(self.high[2] - self.low[2]) / len(self.positions)

    def label(self, index: int) -> str:
        """What stands under a section: its number and where it is."""
        position = fixed(self.positions[index], decimals(self.step, 2, 1))
        sign = "+" if float(position) > 0 and not self.name else ""
        place = f"{self.name} = {position} mm" if self.name else f"{sign}{position} mm"
        return f"{index + 1}  {place}".replace("-", "−")


def axis_series(box: np.ndarray, axis: str, count: int) -> Series:
    """Sections at right angles to an axis of the model, each in the middle of one of `count` equal parts.

    Seen from the front ("Y"), the right ("X") or above ("Z").

    Args:
        box: (2, 3) lowest and highest corner, mm.
        axis: "X", "Y" or "Z".
    """
    right, down, along = (np.array(way, np.float64) for way in _WORLD_AXES[axis])
    return _series(box, right, down, along, np.zeros(3), count, axis.lower())


def plane_series(box: np.ndarray, plane: Plane, count: int) -> Series:
    """Sections parallel to a plane; positions are told from it, positive towards the side that it is seen from."""
    right, down = (np.asarray(way, np.float64) / np.linalg.norm(way) for way in (plane.u, plane.v))
    return _series(box, right, down, np.cross(down, right), np.asarray(plane.origin, np.float64), count, "")


def _series(
    box: np.ndarray, right: np.ndarray, down: np.ndarray, along: np.ndarray, origin: np.ndarray, count: int, name: str
) -> Series:
    if count < 1:
        raise SettingError("A sheet of {count} sections is empty; choose a count of at least 1.", count=count)
    corners = np.stack(np.meshgrid(*np.asarray(box, np.float64).T, indexing="ij"), axis=-1).reshape(8, 3) - origin
    spread = corners @ np.stack([right, down, along], axis=1)
    low, high = spread.min(axis=0), spread.max(axis=0)
    positions = low[2] + (np.arange(count) + 0.5) / count * (high[2] - low[2])
    around = _AROUND * float((high - low).max())
    low[:2], high[:2] = low[:2] - around, high[:2] + around
    return Series(right, down, along, origin, low, high, positions, around, name)


def _plane(
    origin: np.ndarray, right: np.ndarray, down: np.ndarray, low: np.ndarray, high: np.ndarray, pixel_mm: float
) -> Plane:
    width, height = (max(2, round(float(side) / pixel_mm)) for side in high - low)
    u, v = right * (high[0] - low[0]) / width, down * (high[1] - low[1]) / height
    return Plane(origin + low[0] * right + low[1] * down, u, v, width, height)


@dataclass(frozen=True, eq=False)
class _Overview:
    """A section along the series, through the box's middle.

    Attributes:
        upright: the series goes from below upward or from above downward, else from left to right.
        size: (2,) width and height, mm of the model.
    """

    series: Series
    upright: bool
    size: np.ndarray

    @classmethod
    def of(cls, series: Series) -> _Overview:
        upright = abs(series.along[2]) > 0.7
        depth = series.high[2] - series.low[2] + 2 * series.around
        size = (series.high - series.low)[:2]
        return cls(series, upright, np.array([size[0], depth] if upright else [depth, size[1]]))

    @property
    def upward(self) -> bool:
        """Which way an upright series goes."""
        return bool(self.series.along[2] > 0)

    def plane(self, pixel_mm: float) -> Plane:
        series = self.series
        ends = np.array([0.0, 0.0, series.around])
        low, high = series.low - ends, series.high + ends
        if self.upright:
            origin = series.origin + 0.5 * (low[1] + high[1]) * series.down
            down, ends = (-series.along, (-high[2], -low[2])) if self.upward else (series.along, (low[2], high[2]))
            return _plane(origin, series.right, down, *_spans((low[0], high[0]), ends), pixel_mm)
        origin = series.origin + 0.5 * (low[0] + high[0]) * series.right
        return _plane(origin, series.along, series.down, *_spans((low[2], high[2]), (low[1], high[1])), pixel_mm)


def _spans(across: tuple[float, float], down: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    return np.array([across[0], down[0]]), np.array([across[1], down[1]])


@dataclass(frozen=True)
class Arrangement:
    """How sections lie on the paper.

    Attributes:
        paper: its name.
        width, height: of the paper, mm.
        scale: paper to model, as in 1:2.
        columns, rows: of sections, beside the overview.
    """

    paper: str
    width: float
    height: float
    scale: tuple[int, int]
    columns: int
    rows: int

    @property
    def enlarged(self) -> float:
        """mm of the paper in one of the model."""
        return self.scale[0] / self.scale[1]


def arrange(count: int, section_mm: Sequence[float], overview_mm: Sequence[float], real_size: bool) -> Arrangement:
    """The largest usual scale at which all fits on A4; in real size the smallest paper instead.

    Args:
        section_mm, overview_mm: width and height, mm of the model.

    Raises:
        SettingError: not even A0 is large enough.
    """
    for paper, (short, long) in (PAPERS if real_size else {"A4": PAPERS["A4"]}).items():
        for scale in ((1, 1),) if real_size else SCALES:
            fitting = [
                Arrangement(paper, width, height, scale, columns, -(-count // columns))
                for width, height in ((long, short), (short, long))
                for columns in range(1, count + 1)
            ]
            fitting = [way for way in fitting if min(_free(way, section_mm, overview_mm)) >= 0]
            if fitting:
                # Full rows first, then what leaves as much free to the right as below.
                return min(fitting, key=lambda way: (way.columns * way.rows, _unevenness(way, section_mm, overview_mm)))
    size = " x ".join(f"{side:.0f}" for side in section_mm)
    raise SettingError(
        "{count} sections of {size} mm do not fit on A0 paper in real size; choose fewer, or let the scale be chosen.",
        count=count,
        size=size,
    )


def _free(way: Arrangement, section_mm: Sequence[float], overview_mm: Sequence[float]) -> tuple[float, float]:
    """What is left of the paper's width and height when all is at the least distance, mm; negative: too much."""
    width, height = (way.enlarged * side for side in section_mm)
    wide = way.enlarged * overview_mm[0] + way.columns * (width + _GAP)
    high = max(way.enlarged * overview_mm[1] + _LABEL, way.rows * (height + _LABEL + _GAP) - _GAP)
    return way.width - 2 * _MARGIN - wide, way.height - 2 * _MARGIN - _HEAD - _FOOT - high


def _unevenness(way: Arrangement, section_mm: Sequence[float], overview_mm: Sequence[float]) -> float:
    across, down = _free(way, section_mm, overview_mm)
    return abs(across / (way.columns + 1) - down / way.rows)


def draw_sheet_in_steps(
    splats: SectionSplats,
    series: Series,
    look: Look,
    title: str,
    letter: Callable[[str], Outline],
    dots_per_inch: float = 200.0,
    real_size: bool = False,
) -> Generator[float, None, Page]:
    """The sheet as a page. Yields the share that is done.

    Args:
        look: in which densities are shown.
        title: stands on top: the model's name.
        letter: makes the outlines of texts.
        dots_per_inch: of the pictures on the paper.
        real_size: scale 1:1 on paper as large as it takes.

    Raises:
        SettingError: as `arrange`.
    """
    overview = _Overview.of(series)
    section_mm = (series.high - series.low)[:2]
    way = arrange(len(series.positions), section_mm, overview.size, real_size)
    page = Page(way.width, way.height, letter, title)
    _draw_head(page, series, way)
    scale = way.enlarged
    _draw_foot(page, look, scale)
    pixel = MM_PER_INCH / dots_per_inch / scale
    width, height = scale * section_mm
    across, down = _free(way, section_mm, overview.size)
    gap_x = _GAP + min(max(across / (way.columns + 1), 0), _WIDEST_GAP - _GAP)
    gap_y = _GAP + (min(max(down / (way.rows - 1), 0), _WIDEST_GAP - _GAP) if way.rows > 1 else 0.0)
    seen = scale * overview.size
    left = 0.5 * (page.width - seen[0] - way.columns * (width + gap_x))
    body_top, body = _MARGIN + _HEAD, page.height - 2 * _MARGIN - _HEAD - _FOOT
    grid_height = way.rows * (height + _LABEL) + (way.rows - 1) * gap_y
    top = body_top + 0.5 * (body - max(grid_height, seen[1] + _LABEL))
    _draw_overview(page, overview, look.pixels(section_density(splats, overview.plane(pixel))), left, top, scale)
    count = len(series.positions)
    yield 1 / (count + 1)
    labels = [series.label(index) for index in range(count)]
    # All of one size, hardly wider than their pictures.
    longest = max(page.letter(label).width for label in labels)
    size = min(_TEXT_SIZE, (width + _OVER) / max(longest, 1e-9))
    for index, position in enumerate(series.positions):
        row, column = divmod(index, way.columns)
        x = left + seen[0] + gap_x + column * (width + gap_x)
        y = top + row * (height + _LABEL + gap_y)
        page.picture(x, y, width, height, look.pixels(section_density(splats, series.plane(position, pixel))))
        page.frame(x, y, width, height, _STROKE, FAINT)
        page.text(x, y + height + 4.0, labels[index], size)
        yield (index + 2) / (count + 1)
    return page


def _fitted(page: Page, x: float, y: float, text: str, size: float, width: float) -> None:
    """Lettering no wider than its place."""
    page.text(x, y, text, min(size, width / max(page.letter(text).width, 1e-9)))


def _draw_head(page: Page, series: Series, way: Arrangement) -> None:
    inner = page.width - 2 * _MARGIN
    _fitted(page, _MARGIN, _MARGIN + 4.0, page.title, _TITLE_SIZE, inner)
    cut = f"at right angles to {series.name}" if series.name else "parallel to the section plane, positions from it"
    spacing = f", every {series.step:.3g} mm" if len(series.positions) > 1 else ""
    text = f"Sections {cut}{spacing}  ·  scale {way.scale[0]}:{way.scale[1]} on {way.paper}"
    _fitted(page, _MARGIN, _MARGIN + 10.0, text, _TEXT_SIZE, inner)


def _draw_foot(page: Page, look: Look, scale: float) -> None:
    base = page.height - _MARGIN
    # 20 to 50 mm of paper.
    length = round_step(20.0 / scale)
    page.rectangle(_MARGIN, base - 5.6, length * scale, 1.2)
    page.rectangle(_MARGIN + 0.5 * length * scale, base - 5.3, 0.5 * length * scale - 0.3, 0.6, (1.0, 1.0, 1.0))
    page.text(_MARGIN, base, "0", _TEXT_SIZE)
    page.text(_MARGIN + length * scale, base, f"{length:g} mm", _TEXT_SIZE, 0.5 if length * scale > 14 else 0.0)
    left = page.width - _MARGIN - _BAR_WIDTH - 5.0
    window = look.window
    shades = np.linspace(window.low, window.high, _BAR_STEPS)[None, :]
    page.picture(left, base - 4.4 - _BAR_HEIGHT, _BAR_WIDTH, _BAR_HEIGHT, look.pixels(shades))
    page.frame(left, base - 4.4 - _BAR_HEIGHT, _BAR_WIDTH, _BAR_HEIGHT, _STROKE, FAINT)
    for value, text in look.ticks(window.low, window.high, 6):
        x = left + (value - window.low) / window.span * _BAR_WIDTH
        page.rectangle(x - 0.06, base - 4.4, 0.12, 1.0)
        page.text(x, base, text, _SMALL_SIZE, 0.5)
    page.text(left - 4.0, base - 4.9, look.name, _TEXT_SIZE, 1.0)


def _draw_overview(page: Page, overview: _Overview, pixels: np.ndarray, left: float, top: float, scale: float) -> None:
    """The model along the series, a line with its number for each section."""
    width, height = scale * overview.size
    page.picture(left, top, width, height, pixels)
    page.frame(left, top, width, height, _STROKE, FAINT)
    series = overview.series
    places = scale * (series.positions - series.low[2] + series.around)
    every = max(1, int(np.ceil(1.3 * _SMALL_SIZE / max(scale * series.step, 1e-9))))
    if overview.upright and overview.upward:
        places = height - places
    for index, place in enumerate(places):
        if overview.upright:
            page.rectangle(left, top + place - 0.1, width, 0.2, _LINES)
        else:
            page.rectangle(left + place - 0.1, top, 0.2, height, _LINES)
        if index % every:
            continue
        if overview.upright:
            page.text(left - 0.8, top + place + 0.35 * _SMALL_SIZE, str(index + 1), _SMALL_SIZE, 1.0, _LINES)
        else:
            page.text(left + place, top + height + 3.4, str(index + 1), _SMALL_SIZE, 0.5, _LINES)
