"""What an import will cost, said before it is made."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ...core.ply import read_header
from .native import draws_splats

# Bytes a splat, measured with 1 M splats in Blender 5.0 (instances and Cycles) or counted from the attributes.
_ATTRIBUTES = 12 + 12 + 16 + 16 + 4 + 1 + 4 + 4 + 16
_HARMONIC = 12
_INSTANCE = 62
_CYCLES_POINT = 69
_CYCLES_INSTANCE = 1600
AUTOMATIC_ELLIPSOIDS = 150_000
# Of larger models: those that matter most.
MOST_ELLIPSOIDS = 50_000


@dataclass(frozen=True)
class ImportCost:
    """What an import takes.

    Attributes:
        splats: of the file.
        ellipsoids: at most so many of them are shown as such, the others as points.
        scene_bytes: held while the .blend is open.
        cycles_bytes: more while Cycles renders.
    """

    splats: int
    ellipsoids: int
    scene_bytes: int
    cycles_bytes: int


def import_cost(path: Path, display: str, view_dependent: bool = True) -> ImportCost:
    """The memory that importing `path` will take, from its header alone.

    Args:
        display: as in `chosen_display`.
        view_dependent: whether the view-dependent colour is imported.

    Raises:
        GaussianFileError: not a .ply.
    """
    count, record, _ = read_header(Path(path))
    harmonics = sum(name.startswith("f_rest_") for name in record.names or ()) // 3 if view_dependent else 0
    chosen = chosen_display(display, count)
    ellipsoids = {"POINTS": 0, "ELLIPSOIDS": count, "MIXED": min(count, MOST_ELLIPSOIDS)}[chosen]
    # What is shown is a copy, without the splats that are too faint to see, and without what is not drawn.
    copies = 2 if draws_splats() else 1
    scene = count * (2 * _ATTRIBUTES + copies * _HARMONIC * harmonics) + ellipsoids * _INSTANCE
    return ImportCost(count, ellipsoids, scene, ellipsoids * _CYCLES_INSTANCE + (count - ellipsoids) * _CYCLES_POINT)


def chosen_display(display: str, count: int) -> str:
    """POINTS, ELLIPSOIDS or MIXED; AUTOMATIC goes by the number of splats, and by whether Blender draws them."""
    if display != "AUTOMATIC":
        return display
    return "ELLIPSOIDS" if count <= AUTOMATIC_ELLIPSOIDS and not draws_splats() else "MIXED"
