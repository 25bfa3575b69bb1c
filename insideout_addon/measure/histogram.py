"""How much of a section's area or of the model's volume has which density. Numpy alone, no bpy."""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...core.files import atomic_write
from ...core.render.section_numpy import SectionSplats
from ...core.views import Plane
from ..scene.section_image import pixel_mm
from .look import Look
from .material_box import sample_box_in_steps
from .page import FAINT, INK, Color, Outline, Page
from .ticks import round_step

_CLASSES = 180
# Single places may be many times as dense as all others; they are counted in one class above the rest.
_TOP_PERCENTILE, _HEADROOM, _AIR = 99.9, 1.25, 0.02
_CELLS = 96
_WIDTH, _HEIGHT = 180.0, 110.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 24.0, 10.0, 20.0, 20.0
_TITLE_SIZE, _TEXT_SIZE, _SMALL_SIZE, _OVERLAP = 5.0, 3.4, 3.0, 0.1
_MARK: Color = (0.0, 0.45, 0.75)
_AIR_BAR = 0.8


@dataclass(frozen=True, eq=False)
class Histogram:
    """Amounts by density.

    Attributes:
        edges: (n + 1,) of the classes, mm⁻¹.
        amounts: (n,) mm² or mm³ in each class.
        above: amount that is denser than the last edge.
        unit: "mm²" or "mm³".
        mark: density of the contours, mm⁻¹; 0 for none.
    """

    edges: np.ndarray
    amounts: np.ndarray
    above: float
    unit: str
    mark: float = 0.0


def density_histogram(values: np.ndarray, amount: float, unit: str, mark: float = 0.0) -> Histogram:
    """Counts densities of any shape, mm⁻¹; each stands for `amount` mm² or mm³."""
    found = np.nan_to_num(np.asarray(values, np.float64)).ravel()
    material = found[found > 0]
    material = material[material > _AIR * np.percentile(material, _TOP_PERCENTILE)] if material.size else material
    top = min(_HEADROOM * float(np.percentile(material, _TOP_PERCENTILE)), found.max()) if material.size else 1.0
    width = round_step(top / _CLASSES)
    edges = width * np.arange(int(np.ceil(top / width)) + 1)
    # What overlapping negative splats push below 0 is air too.
    counts, _ = np.histogram(np.maximum(found, 0.0), edges)
    return Histogram(edges, counts * amount, float((found > edges[-1]).sum() * amount), unit, mark)


def section_histogram(values: np.ndarray, plane: Plane, mark: float = 0.0) -> Histogram:
    """Area by density of a section (height, width), mm²."""
    across, down = pixel_mm(plane)
    return density_histogram(values, across * down, "mm²", mark)


def volume_histogram_in_steps(
    splats: SectionSplats, box: np.ndarray, cells: int = _CELLS
) -> Generator[float, None, Histogram]:
    """Volume by density in a box (2, 3), mm³, from the middles of cells, `cells` of them along its longest side.

    Yields the share that is done.
    """
    values, steps = yield from sample_box_in_steps(splats, np.asarray(box, np.float64), cells)
    return density_histogram(values, float(steps.prod()), "mm³")


def save_histogram_csv(path: Path, histogram: Histogram, relative: bool = False) -> None:
    """Writes one row a class: from and to mm⁻¹, amount, share of all; the last row is open to above.

    Args:
        relative: densities are in no unit, and their columns claim none.
    """
    name = "area_mm2" if histogram.unit == "mm²" else "volume_mm3"
    unit = "relative" if relative else "per_mm"
    total = max(float(histogram.amounts.sum()) + histogram.above, 1e-300)
    with atomic_write(Path(path), "w") as stream:
        stream.write(f"density_from_{unit},density_to_{unit},{name},share\n")
        for low, high, amount in zip(histogram.edges[:-1], histogram.edges[1:], histogram.amounts, strict=True):
            stream.write(f"{low:.8g},{high:.8g},{amount:.8g},{amount / total:.8g}\n")
        stream.write(f"{histogram.edges[-1]:.8g},inf,{histogram.above:.8g},{histogram.above / total:.8g}\n")


def draw_histogram(histogram: Histogram, look: Look, title: str, letter: Callable[[str], Outline]) -> Page:
    """The histogram as a page: bars in the colours of the section, amounts on a logarithmic axis.

    Most of a section is air and little of it metal; on a linear axis one would see the air alone.
    """
    page = Page(_WIDTH, _HEIGHT, letter, title)
    page.text(_LEFT, 9.0, title, min(_TITLE_SIZE, (_WIDTH - _LEFT - _RIGHT) / max(letter(title).width, 1e-9)))
    what = "Area" if histogram.unit == "mm²" else "Volume"
    step = look.unit.factor * (histogram.edges[1] - histogram.edges[0])
    page.text(_LEFT, 15.0, f"{what} in classes of {step:.3g} {look.unit.label}, {histogram.unit}", _TEXT_SIZE)
    amounts = histogram.amounts
    seen = amounts[amounts > 0]
    decades = _decades(seen)
    wide, high = _WIDTH - _LEFT - _RIGHT, _HEIGHT - _TOP - _BOTTOM
    base, top = _HEIGHT - _BOTTOM, float(histogram.edges[-1])

    def height(amount: float) -> float:
        share = (np.log10(amount) - decades[0]) / (decades[1] - decades[0])
        return float(np.clip(share, 0, 1) * high)

    for decade in range(decades[0], decades[1] + 1):
        y = base - height(10.0**decade)
        page.rectangle(_LEFT, y - 0.05, wide, 0.1, FAINT)
        page.text(_LEFT - 2.0, y + 0.35 * _SMALL_SIZE, _power_of_ten(decade), _SMALL_SIZE, 1.0)
    _draw_bars(page, histogram, look, wide, base, height)
    page.rectangle(_LEFT, base - 0.1, wide, 0.2)
    for value, text in look.ticks(0.0, top, 8):
        x = _LEFT + value / top * wide
        page.rectangle(x - 0.1, base, 0.2, 1.6)
        page.text(x, base + 5.4, text, _SMALL_SIZE, 0.5)
    page.text(_LEFT + 0.5 * wide, base + 12.5, look.name, _TEXT_SIZE, 0.5)
    if 0 < histogram.mark < top:
        x = _LEFT + histogram.mark / top * wide
        page.rectangle(x - 0.15, base - high, 0.3, high, _MARK)
        right = histogram.mark < 0.6 * top
        text = f"contour {look.number(histogram.mark):.4g}"
        page.text(x + (1.5 if right else -1.5), base - high + 3.2, text, _SMALL_SIZE, 0.0 if right else 1.0, _MARK)
    if histogram.above > 0:
        share = 100 * histogram.above / (float(amounts.sum()) + histogram.above)
        page.text(_WIDTH - _RIGHT, base + 12.5, f"denser than that: {share:.2g} %", _SMALL_SIZE, 1.0, INK)
    return page


def _draw_bars(
    page: Page, histogram: Histogram, look: Look, wide: float, base: float, height: Callable[[float], float]
) -> None:
    middles = 0.5 * (histogram.edges[:-1] + histogram.edges[1:])
    colors = look.rgb(middles[None, :], _AIR_BAR)[0]
    each = wide / len(histogram.amounts)
    for index, amount in enumerate(histogram.amounts):
        if amount > 0:
            red, green, blue = (float(part) for part in colors[index])
            tall = max(height(float(amount)), 0.3)
            # A little under the next one: where two smooth edges meet, the paper would show through.
            under = _OVERLAP if index + 1 < len(histogram.amounts) and histogram.amounts[index + 1] > 0 else 0.0
            page.rectangle(_LEFT + index * each, base - tall, each + under, tall, (red, green, blue))


def _decades(amounts: np.ndarray) -> tuple[int, int]:
    """Powers of ten around amounts."""
    if amounts.size == 0:
        return 0, 1
    low, high = int(np.floor(np.log10(amounts.min()))), int(np.ceil(np.log10(amounts.max())))
    return low, max(high, low + 1)


def _power_of_ten(decade: int) -> str:
    return f"{10**decade:,}".replace(",", " ") if decade >= 0 else f"{10.0**decade:.{-decade}f}"
