"""What an import will cost, said before it is made."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ...core.ply import read_header

# Bytes a splat, measured with 1 M splats in Blender 5.0 (instances and Cycles) or counted from the attributes.
_ATTRIBUTES = 12 + 12 + 16 + 16 + 4 + 1 + 4 + 4 + 16
_HARMONIC = 12
_INSTANCE = 62
_CYCLES_POINT = 69
_CYCLES_INSTANCE = 1600
AUTOMATIC_ELLIPSOIDS = 150_000


@dataclass(frozen=True)
class ImportCost:
    """Attributes: splats; scene_bytes, held while the .blend is open; cycles_bytes, more while Cycles renders."""

    splats: int
    scene_bytes: int
    cycles_bytes: int


def import_cost(path: Path, display: str, view_dependent: bool = True) -> ImportCost:
    """The memory that importing `path` will take, from its header alone.

    Args:
        display: "POINTS", "ELLIPSOIDS" or "AUTOMATIC" (ellipsoids up to AUTOMATIC_ELLIPSOIDS splats).
        view_dependent: whether the view-dependent colour is imported.

    Raises:
        GaussianFileError: not a .ply.
    """
    count, record, _ = read_header(Path(path))
    harmonics = sum(name.startswith("f_rest_") for name in record.names or ()) // 3 if view_dependent else 0
    ellipsoids = chosen_display(display, count) == "ELLIPSOIDS"
    scene = _ATTRIBUTES + _HARMONIC * harmonics + (_INSTANCE if ellipsoids else 0)
    cycles = _CYCLES_INSTANCE if ellipsoids else _CYCLES_POINT
    return ImportCost(count, count * scene, count * cycles)


def chosen_display(display: str, count: int) -> str:
    """POINTS or ELLIPSOIDS; AUTOMATIC goes by the number of splats."""
    if display != "AUTOMATIC":
        return display
    return "ELLIPSOIDS" if count <= AUTOMATIC_ELLIPSOIDS else "POINTS"
