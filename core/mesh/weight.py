"""What a model weighs: mass, balance and hollows, from its splats. Numpy alone."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Generator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..digits import decimals, fixed
from ..files import atomic_write
from ..gaussians import GaussianSet
from ..render.volume_numpy import attenuating, sample_in_steps
from ..steps import part_of_work, run_through
from ..volume import Volume
from .cavities import Cavity, find_cavities, smallest_voxels
from .density_map import DensityCurve
from .mass import MassProperties, gaussian_mass_properties, mass_properties
from .walls import Walls, walls_in_steps

_MM3_PER_CM3 = 1000.0
# Share of the work that is done when the grid is sampled.
_SAMPLED = 0.5


@dataclass(frozen=True, eq=False)
class Weight:
    """Figures of a body in its own frame.

    Attributes:
        properties: mass, centre and inertia.
        cavities: closed hollows, the largest first; None where they were not looked for.
        calibration: how densities were told, in words.
    """

    properties: MassProperties
    cavities: tuple[Cavity, ...] | None
    calibration: str


def weigh(
    gaussians: GaussianSet,
    curve: DensityCurve,
    *,
    cavities: bool = True,
    edge_mm_inv: float = 0.0,
    smallest_mm3: float = 0.0,
    voxels: int = 0,
    tick: Callable[[float], None] | None = None,
) -> Weight:
    """Weighs a model: its splats exactly where density is proportional to attenuation, else sampled on a grid.

    Args:
        gaussians: numpy arrays, mm.
        cavities: whether to look for closed hollows, which takes a grid too.
        edge_mm_inv: what attenuates less is air in a hollow; 0: half way to the lightest material of the calibration.
        smallest_mm3: smaller hollows are left out; 0: 64 voxels.
        voxels: of the grid along the longest side; 0: as large as splats are.
        tick: called with the part that is done, 0..1, where there is a grid; may raise to stop.

    Raises:
        SettingError: the model has no density, its mass is not positive, or a setting is out of range.
    """
    steps = weigh_in_steps(
        gaussians, curve, cavities=cavities, edge_mm_inv=edge_mm_inv, smallest_mm3=smallest_mm3, voxels=voxels
    )
    return run_through(steps, tick)


def weigh_in_steps(
    gaussians: GaussianSet,
    curve: DensityCurve,
    *,
    cavities: bool = True,
    edge_mm_inv: float = 0.0,
    smallest_mm3: float = 0.0,
    voxels: int = 0,
) -> Generator[float, None, Weight]:
    """As `weigh`, with breaks that tell the part that is done."""
    seen, factor = attenuating(gaussians), curve.factor
    edge, smallest = edge_mm_inv or curve.edge_mm_inv, smallest_mm3 or None
    properties = None if factor is None else gaussian_mass_properties(seen, factor)
    if properties is not None and not cavities:
        return Weight(properties, None, curve.description)
    volume = yield from part_of_work(sample_in_steps(seen, voxels), 0.0, _SAMPLED)
    fewest = 0.5 * smallest_voxels(volume, smallest)
    walls = yield from part_of_work(walls_in_steps(volume, edge, fewest, curve.air_mm_inv), _SAMPLED, 1.0)
    if properties is None:
        properties = mass_on_grid(volume, walls, curve)
    found = tuple(find_cavities(volume, edge, smallest, walls)) if cavities else None
    return Weight(properties, found, curve.description)


def mass_on_grid(volume: Volume, walls: Walls, curve: DensityCurve) -> MassProperties:
    """Sums over voxels; one at a surface has the part of its wall's density that it has of its wall's attenuation.

    Half in metal and half in air it would else count as a whole one of something in between.

    Raises:
        SettingError: the total mass is not positive.
    """
    near = walls.behind > walls.air_mm_inv
    density = np.where(near, walls.filled(volume.values) * curve(walls.behind), curve(volume.values))
    return mass_properties(Volume(density, volume.spacing_mm, volume.origin_mm), 1.0)


def weight_rows(weight: Weight) -> list[tuple[str, str, str]]:
    """The mass table: quantity, value, unit."""
    properties, rows = weight.properties, [("mass", f"{weight.properties.mass_g:.6g}", "g")]

    def add(name: str, values: np.ndarray, parts: tuple[str, ...], unit: str) -> None:
        rows.extend((f"{name} {part}", f"{value:.6g}", unit) for part, value in zip(parts, values, strict=True))

    add("centre of mass", properties.center_mm, ("x", "y", "z"), "mm")
    entries = properties.inertia_g_mm2[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    add("inertia", entries, ("xx", "yy", "zz", "xy", "xz", "yz"), "g mm²")
    add("principal moment", properties.principal_moments, ("1", "2", "3"), "g mm²")
    for number, cavity in enumerate(weight.cavities or (), 1):
        rows.append((f"cavity {number} volume", f"{cavity.volume_mm3:.6g}", "mm³"))
        add(f"cavity {number} centre", cavity.center_mm, ("x", "y", "z"), "mm")
    rows.append(("calibration", weight.calibration, ""))
    return rows


def save_weight(path: Path, weight: Weight, note: str = "") -> None:
    """Writes the mass table as .csv, atomically. Inertia is about the centre of mass, along the model's axes.

    Args:
        note: what else a reader has to know, as the last row; none where it is empty.
    """
    text, notes = io.StringIO(), [("note", note, "")] if note else []
    csv.writer(text, lineterminator="\n").writerows([("quantity", "value", "unit"), *weight_rows(weight), *notes])
    with atomic_write(Path(path), "w") as stream:
        stream.write(text.getvalue())


def center_text(center_mm: np.ndarray) -> str:
    """A place to a tenth of a millimetre."""
    return " / ".join(fixed(value, 1) for value in center_mm) + " mm"


def mass_text(mass_g: float) -> str:
    """Grams with four digits, kilograms from 10 on."""
    return f"{mass_g:.4g} g" if mass_g < 9999.5 else f"{mass_g / 1000:.4g} kg"


def volume_text(volume_mm3: float) -> str:
    """Cubic centimetres, or cubic millimetres of what has less than a tenth of one."""
    small = volume_mm3 < 0.1 * _MM3_PER_CM3
    return f"{fixed(volume_mm3, decimals(volume_mm3, 2))} mm³" if small else f"{volume_mm3 / _MM3_PER_CM3:.3g} cm³"
