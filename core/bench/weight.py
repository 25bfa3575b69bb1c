"""How far weighing is off where the truth is known: bodies with a formula, and phantoms."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from ..errors import SettingError
from ..mesh.cavities import find_cavities, smallest_voxels
from ..mesh.density_map import DensityCurve, curve_of_materials
from ..mesh.walls import find_walls
from ..mesh.weight import Weight, mass_on_grid, weigh
from ..phantoms.counted import counted_weight
from ..phantoms.matryoshka import matryoshka
from ..phantoms.model import Phantom
from ..phantoms.part_tables import PartTables
from ..phantoms.skull import skull
from ..phantoms.truth import truth_volume
from ..volume import Volume
from .bodies import BODIES, GLASS, PMMA, scan, splats_of, weight_by_formula

PHANTOMS: dict[str, Callable[[], Phantom]] = {"matryoshka": partial(matryoshka, 5), "skull": skull}
# Of the skull the braincase and the sinuses are open.
_CLOSED = ("matryoshka",)
_ENERGY_KEV = 60.0
# What splats blur adds to inertia by the square of their width.
_BODY_VOXEL_MM, _SPLATS_MM = 0.4, (0.5, 0.25)
_WIDEST_MM = 5.0


def measure_weights(
    phantoms: Sequence[str] = tuple(PHANTOMS),
    voxel_mm: float = 0.75,
    tell: Callable[[str], None] | None = None,
) -> list[dict[str, Any]]:
    """Weighs each body from a perfect scan and from splats of two widths, and phantoms from a perfect scan; materials
    are told.

    Args:
        phantoms: keys of `PHANTOMS`.
        voxel_mm: of the phantoms' scans.
        tell: called with what comes next.

    Returns:
        A row each: `body`, `weighed` (what it was weighed from), `mass_g`, `found_g`, `off` (a share of the true mass),
        `center_off_mm`, `inertia_off` (the largest difference of an entry as a share of the largest), `cavities_mm3`
        and `cavities_found_mm3` (lists, the largest first; None where they are not looked for), `cavity_off` (the share
        by which the worst is off; None where there are none, or not as many as there should be), `cpu_seconds` (of the
        weighing, on one core).

    Raises:
        SettingError: an unknown phantom, or voxels that are too large or none.
    """
    if not 0 < voxel_mm <= _WIDEST_MM:
        raise SettingError(f"bench weight: --voxel-mm is {voxel_mm:g}; give more than 0, and {_WIDEST_MM:g} at most.")
    for name in phantoms:
        if name not in PHANTOMS:
            raise SettingError(f"bench weight: there is no phantom '{name}'; choose among {', '.join(PHANTOMS)}.")
    tell = tell or (lambda _: None)
    rows, curve = [], curve_of_materials([PMMA.name, GLASS.name], _ENERGY_KEV)
    for name, body in BODIES.items():
        tell(name)
        exact, volume = weight_by_formula(body), scan(body, _ENERGY_KEV, _BODY_VOXEL_MM)
        rows.append(_row(name, f"voxels of {_BODY_VOXEL_MM:g} mm", exact, partial(weigh_scan, volume, curve)))
        for wide in _SPLATS_MM:
            splats = splats_of(scan(body, _ENERGY_KEV, wide))
            rows.append(_row(name, f"splats of {wide:g} mm", exact, partial(weigh, splats, curve)))
    for name in phantoms:
        tell(f"{name}: its truth")
        phantom = PHANTOMS[name]()
        tables = PartTables.bake(phantom)
        exact = counted_weight(phantom, tables, voxel_mm / 2)
        volume = truth_volume(phantom, tables, voxel_mm)
        tell(name)
        weighed = partial(weigh_scan, volume, curve_of_phantom(phantom), name in _CLOSED)
        rows.append(_row(name, f"voxels of {voxel_mm:g} mm", exact, weighed))
    return rows


def weigh_scan(volume: Volume, curve: DensityCurve, cavities: bool = True) -> Weight:
    """As `weigh`, from a volume in place of splats."""
    edge = curve.edge_mm_inv
    walls = find_walls(volume, edge, 0.5 * smallest_voxels(volume, None), curve.air_mm_inv)
    found = tuple(find_cavities(volume, edge, walls=walls)) if cavities else None
    return Weight(mass_on_grid(volume, walls, curve), found, curve.description)


def curve_of_phantom(phantom: Phantom) -> DensityCurve:
    """Through the materials that it is made of."""
    materials = {part.material for part in phantom.parts if part.material is not None}
    points = sorted((material.attenuation(phantom.energy_kev), material.density_g_cm3) for material in materials)
    attenuations, densities = np.array([(0.0, 0.0), *points]).T
    return DensityCurve(attenuations, densities, f"its materials at {phantom.energy_kev:g} keV")


def _row(body: str, weighed: str, exact: Weight, weighing: Callable[[], Weight]) -> dict[str, Any]:
    begin = time.process_time()
    found = weighing()
    seconds = time.process_time() - begin
    true, got = exact.properties, found.properties
    row = {
        "body": body,
        "weighed": weighed,
        "mass_g": true.mass_g,
        "found_g": got.mass_g,
        "off": got.mass_g / true.mass_g - 1,
        "center_off_mm": float(np.linalg.norm(got.center_mm - true.center_mm)),
        "inertia_off": float(np.abs(got.inertia_g_mm2 - true.inertia_g_mm2).max() / true.inertia_g_mm2.max()),
        "cavities_mm3": None,
        "cavities_found_mm3": None,
        "cavity_off": None,
        "cpu_seconds": seconds,
    }
    if exact.cavities is not None and found.cavities is not None:
        known, seen = ([cavity.volume_mm3 for cavity in weight.cavities or ()] for weight in (exact, found))
        row |= {"cavities_mm3": known, "cavities_found_mm3": seen}
        if known and len(known) == len(seen):
            row["cavity_off"] = max((b / a - 1 for a, b in zip(known, seen, strict=True)), key=abs)
    return row
