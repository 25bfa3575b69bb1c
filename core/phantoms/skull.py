"""A small teaching skull on four cervical vertebrae, carried by a steel rod, each bone another colour.

The braincase, the sinuses and the vertebral canal are hollow; the vault is spongy between two dense tables. A burr
hole under a titanium plate, a lost premolar and the vertebrae's turn make left and right differ.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from . import skull_bones as bones
from .materials import Material
from .model import Part, Phantom
from .sculpture import Piece, Step, add, carve, group, sculpt, smooth_cut
from .skull_paint import paint

# Mass fractions after ICRU Report 46: cortical bone, and spongiosa with its marrow.
BONE = Material(
    "cortical bone",
    (("H", 0.034), ("C", 0.155), ("N", 0.042), ("O", 0.438), ("P", 0.103), ("S", 0.003), ("Ca", 0.225)),
    1.92,
)
_SPONGY = Material(
    "spongy bone with marrow",
    (("H", 0.085), ("C", 0.404), ("N", 0.028), ("O", 0.375), ("P", 0.034), ("Ca", 0.074)),
    1.18,
)
_TOOTH = Material("enamel and dentine", "Ca10P6O26H2", 2.6)
_DISC = Material("silicone", "C2H6OSi", 1.12)
STEEL = Material("stainless steel", (("Fe", 0.70), ("Cr", 0.18), ("Ni", 0.10), ("Mn", 0.02)), 7.95)
_TITANIUM = Material("titanium alloy Ti6Al4V", (("Ti", 0.90), ("Al", 0.06), ("V", 0.04)), 4.43)
_ENERGY_KEV = 80.0


def skull() -> Phantom:
    """The phantom, looking towards −y."""
    parts = (
        Part("cranium", cranium, BONE),
        Part("diploe", diploe, _SPONGY),
        Part("braincase", braincase, None),
        Part("sinuses", sinuses, None),
        Part("mandible", mandible, BONE),
        Part("mandible's marrow", mandible_marrow, _SPONGY),
        Part("teeth", teeth, _TOOTH),
        Part("discs", discs, _DISC),
        Part("vertebrae", vertebrae, BONE),
        Part("vertebral marrow", vertebral_marrow, _SPONGY),
        Part("rod", rod, STEEL),
        Part("plate and screws", plate, _TITANIUM),
    )
    return Phantom(
        name="skull",
        parts=parts,
        surface=surface,
        color=_color,
        size_mm=(64.0, 90.0, 102.0),
        energy_kev=_ENERGY_KEV,
        landmarks=_landmarks(),
    )


def vault(points: np.ndarray) -> np.ndarray:
    """The cranium's outside without the face."""
    return sculpt(points, bones.vault())


def cranium(points: np.ndarray, skin: np.ndarray | None = None) -> np.ndarray:
    """Cranium and upper jaw, the braincase and the sinuses not yet taken out.

    Args:
        skin: (N,) the vault's distances where they are known already.
    """
    return sculpt(points, bones.cranium(), vault(points) if skin is None else skin)


def braincase(points: np.ndarray, skin: np.ndarray | None = None) -> np.ndarray:
    """The room for the brain, its floor in three steps from the brow to the foramen magnum, and the burr hole."""
    room = (vault(points) if skin is None else skin) + _wall(points)
    y, z = points[:, 1], points[:, 2]
    front = 0.955 * (15.5 - z) - 0.30 * (y + 34)
    middle = np.maximum(-12.5 - y, 0.5 - z)
    back = np.maximum(3.0 - y, -3.0 - z)
    floor = np.minimum(np.minimum(front, middle), back)
    room = smooth_cut(room, floor, 3.0)
    return sculpt(points, bones.braincase(), room)


def _wall(points: np.ndarray) -> np.ndarray:
    """Thickness of the vault in mm: thin at the temples, thick at the brow and at the back."""
    x, y, z = np.abs(points[:, 0]), points[:, 1], points[:, 2]
    temples = np.exp(-(((x - 24) / 8) ** 2) - ((y + 4) / 14) ** 2 - ((z - 10) / 10) ** 2)
    back = np.exp(-(((y - 36) / 9) ** 2) - ((z - 8) / 10) ** 2)
    return (2.9 - 1.0 * temples + 0.9 * back).astype(np.float32)


def diploe(points: np.ndarray) -> np.ndarray:
    """The spongy layer between the vault's tables, 0.8 mm below either side, tapering out above the base."""
    x, y, z = points[:, 0], points[:, 1], points[:, 2]
    skin = vault(points)
    table = 0.8 + 0.12 * np.sin(0.7 * x + 0.4 * z) * np.sin(0.6 * y)
    taper = 0.12 * np.maximum(np.maximum(17.0 - 0.28 * y, 8.0) + 6.0 - z, 0)
    return np.maximum(skin, -(skin + _wall(points))) + table + taper


def sinuses(points: np.ndarray) -> np.ndarray:
    """Air in the upper jaw, the forehead and the sphenoid."""
    return sculpt(points, bones.sinuses())


def mandible(points: np.ndarray) -> np.ndarray:
    """The lower jaw."""
    return sculpt(points, bones.mandible())


def mandible_marrow(points: np.ndarray) -> np.ndarray:
    """What is spongy inside the lower jaw's body."""
    return sculpt(points, bones.mandible_marrow())


def teeth(points: np.ndarray) -> np.ndarray:
    """31 teeth with their roots: the upper left first premolar is lost."""
    return sculpt(points, bones.teeth())


def vertebrae(points: np.ndarray) -> np.ndarray:
    """Atlas, axis and two more, with the vertebral canal and the transverse foramina."""
    return sculpt(points, bones.vertebrae())


def vertebral_marrow(points: np.ndarray) -> np.ndarray:
    """What is spongy inside the vertebral bodies."""
    return sculpt(points, bones.vertebral_marrow())


def discs(points: np.ndarray) -> np.ndarray:
    """Soft discs between the vertebrae."""
    return sculpt(points, bones.discs())


def rod(points: np.ndarray) -> np.ndarray:
    """The rod and the nut that the column stands on."""
    return sculpt(points, bones.rod())


def plate(points: np.ndarray) -> np.ndarray:
    """The plate over the burr hole, with its screws."""
    return bones.plate(vault(points), points)


def surface(points: np.ndarray) -> np.ndarray:
    """Everything that is not air."""
    skin = vault(points)
    total = np.maximum(cranium(points, skin), -braincase(points, skin))
    return sculpt(points, _rest(), total)


@lru_cache(maxsize=1)
def _rest() -> tuple[Step, ...]:
    """All but the cranium, upon it: the sinuses out of it first."""
    solids = (bones.mandible(), bones.teeth(), bones.vertebrae(), bones.discs(), bones.rod())
    return (
        carve(group(bones.sinuses())),
        *(add(group(steps)) for steps in solids),
        add(Piece(plate, bones.HOLE, 12.0)),
    )


def _color(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    points = np.asarray(points, np.float32)
    groups = {
        "cranium": cranium(points),
        "mandible": mandible(points),
        "teeth": teeth(points),
        "vertebrae": vertebrae(points),
        "discs": discs(points),
        "metal": np.minimum(rod(points), plate(points)),
    }
    return paint(points, groups, braincase(points), bones.sockets(points))


def _landmarks() -> np.ndarray:
    """Nasion, chin, both zygomata, inion, vertex, the right mastoid's tip, the nut's edge: on the surface, mm."""
    outside = np.array(
        [
            [0, -60, 12.5],
            [0, -60, -34],
            [60, -27, -3],
            [-60, -27, -3],
            [0, 60, 4],
            [0, 4, 60],
            [-20, 7, -40],
            [40, -2, -45],
        ]
    )
    inside = np.array(
        [[0, 0, 12.5], [0, 0, -34], [0, -27, -3], [0, -27, -3], [0, 0, 4], [0, 4, 0], [-20, 7, 0], [0, -2, -45]]
    )
    share = np.linspace(0, 1, 4001)[:, None]
    found = []
    for start, end in zip(outside, inside, strict=True):
        line = (start + share * (end - start)).astype(np.float32)
        found.append(line[np.argmax(surface(line) < 0)])
    return np.array(found, np.float64)
