"""The skull's colours, in sRGB: a teaching model's pastels, another for each bone, with the sutures drawn."""

from __future__ import annotations

import numpy as np

from .texture import waves

Color = tuple[float, float, float]

FRONTAL, PARIETAL_LEFT, PARIETAL_RIGHT = (0.97, 0.74, 0.67), (0.99, 0.90, 0.60), (0.76, 0.90, 0.64)
OCCIPITAL, TEMPORAL, SPHENOID = (0.62, 0.76, 0.93), (0.97, 0.76, 0.50), (0.48, 0.80, 0.76)
ZYGOMATIC, MAXILLA, NASAL = (0.76, 0.65, 0.90), (0.95, 0.94, 0.76), (0.97, 0.56, 0.64)
LACRIMAL, MANDIBLE, INSIDE = (0.92, 0.86, 0.48), (0.90, 0.74, 0.64), (0.78, 0.66, 0.52)
SUTURE, IVORY, GUM, METAL, DISC = (
    (0.36, 0.20, 0.13),
    (0.98, 0.95, 0.86),
    (0.66, 0.47, 0.36),
    (0.62, 0.64, 0.67),
    (0.36, 0.47, 0.66),
)
VERTEBRAE = ((0.93, 0.80, 0.56), (0.62, 0.80, 0.86), (0.86, 0.68, 0.74), (0.70, 0.84, 0.66))
_SUTURE_MM = 0.34


def paint(points: np.ndarray, groups: dict[str, np.ndarray], braincase: np.ndarray, sockets: np.ndarray) -> np.ndarray:
    """(N, 3) sRGB colours.

    Args:
        points: (N, 3) mm on the surface, the face towards −y.
        groups: signed distances (N,) of "cranium", "mandible", "teeth", "vertebrae", "discs" and "metal".
        braincase, sockets: (N,) signed distances of the room for the brain, and in the eyes' sockets and the nose.
    """
    rgb = np.empty((len(points), 3), np.float32)
    names = list(groups)
    nearest = np.argmin(np.stack([groups[name] for name in names]), axis=0)
    for index, name in enumerate(names):
        on_it = nearest == index
        if on_it.any():
            rgb[on_it] = _PAINTERS[name](points[on_it])
    lining = (nearest == names.index("cranium")) & (braincase < 0.4)
    rgb[lining] = INSIDE
    deep = np.where(sockets < 0.5, np.clip((points[:, 1] + 32) / 14, 0, 1), 0)
    rgb *= 1 - 0.6 * deep[:, None]
    return np.clip(rgb * (1 + _mottling(points)[:, None]), 0, 1)


def _cranium(points: np.ndarray) -> np.ndarray:
    """Bones painted over one another; where the last one's border runs, a suture."""
    ragged = points + _ragged(points)
    rgb = np.tile(np.asarray(PARIETAL_LEFT, np.float32), (len(points), 1))
    sutured = np.zeros(len(points), bool)
    for field, color in _bones(ragged):
        rgb[field < 0] = color
        sutured = np.where(np.abs(field) < _SUTURE_MM, True, sutured & (field > 0))
    rgb[sutured] = SUTURE
    return rgb


def _bones(points: np.ndarray) -> list[tuple[np.ndarray, Color]]:
    """Each bone's field, negative in it and about the distance in mm to its border, in order of painting."""
    side, y, z = np.abs(points[:, 0]), points[:, 1], points[:, 2]
    below = np.maximum
    lambdoid = 0.72 * (z - 29.0) + 0.69 * side
    occipital = np.minimum(below(lambdoid, 14.0 - y), below.reduce([side - 13.0, -y + 1.0, z + 1.0]))
    coronal = 0.97 * (y + 17.0) - 0.24 * (z - 12.0)
    frontal = below(coronal, 9.0 - z + 0.25 * np.maximum(7.0 - side, 0))
    squama = np.hypot(y - 3.0, z - 1.5) - 15.5
    mastoid = below.reduce([z - 6.0, y - 15.0, 1.0 - y])
    temporal = below(np.minimum(squama, mastoid), 12.5 - side)
    wing = below.reduce([y + 11.0, -23.5 - y, z - 13.5 + 0.2 * (y + 17), 5.0 - side, side - 23.5])
    base = below.reduce([y + 3.0, -22.0 - y, z - 6.0, side - 16.0])
    sphenoid = np.minimum(wing, base)
    maxilla = below.reduce([y + 15.0, z - 11.0, side - 20.0])
    cheek = below.reduce([15.2 - 0.33 * z - side, y + 12.0, z - 10.2, -12.0 - z, 21.5 - side - 0.9 * (-17.5 - y)])
    nasal = below.reduce([side - 3.0, y + 33.0, z - 12.6, 2.0 - z])
    medial = below.reduce([side - 8.6 + 0.15 * (y + 30), y + 13.0, -33.0 - y, z - 11.5, -0.5 - z])
    return [
        (points[:, 0], PARIETAL_RIGHT),
        (occipital, OCCIPITAL),
        (frontal, FRONTAL),
        (temporal, TEMPORAL),
        (sphenoid, SPHENOID),
        (maxilla, MAXILLA),
        (cheek, ZYGOMATIC),
        (nasal, NASAL),
        (medial, LACRIMAL),
    ]


def _ragged(points: np.ndarray) -> np.ndarray:
    """(N, 3) shifts that make sutures wander, more on the vault than in the face."""
    x, y, z = points.T
    amount = 0.22 + 0.38 / (1 + np.exp(-0.4 * (z - 16)))
    waves = (
        np.sin(2.9 * y + 1.3 * z) + 0.6 * np.sin(6.1 * y - 4.0 * z),
        np.sin(2.7 * x + 0.9 * z) + 0.6 * np.sin(5.7 * x - 3.1 * z + 1.0),
        np.sin(3.1 * x + 1.1 * y) + 0.6 * np.sin(6.3 * x + 2.2 * y + 2.0),
    )
    return (amount * np.stack(waves)).T.astype(np.float32)


def _teeth(points: np.ndarray) -> np.ndarray:
    """Ivory crowns, darker at the necks."""
    rgb = np.tile(np.asarray(IVORY, np.float32), (len(points), 1))
    from_edge = np.abs(points[:, 2] + 20.5)
    share = np.clip((from_edge - 2.4) / 2.2, 0, 1)[:, None]
    return rgb + 0.75 * share * (np.asarray(GUM, np.float32) - rgb)


def _mandible(points: np.ndarray) -> np.ndarray:
    return np.tile(np.asarray(MANDIBLE, np.float32), (len(points), 1))


def _vertebrae(points: np.ndarray) -> np.ndarray:
    # Spines hang down, so the border between two vertebrae slopes with them.
    height = points[:, 2] + 0.16 * np.maximum(points[:, 1] - 3, 0)
    level = np.clip(np.round((-11.0 - height) / 9.0), 0, 3).astype(int)
    return np.asarray(VERTEBRAE, np.float32)[level]


def _discs(points: np.ndarray) -> np.ndarray:
    return np.tile(np.asarray(DISC, np.float32), (len(points), 1))


def _metal(points: np.ndarray) -> np.ndarray:
    brushed = 1 + 0.10 * np.sin(9 * points[:, 2] + 2 * points[:, 0])
    return np.asarray(METAL, np.float32) * brushed[:, None]


def _mottling(points: np.ndarray) -> np.ndarray:
    """A little texture: large plain areas would hold no detail to compare."""
    pits = waves(points, 2.6, seed=3) > 1.8
    return 0.03 * waves(points, 0.5, seed=1) + 0.02 * waves(points, 2.2, seed=2) - 0.12 * pits


_PAINTERS = {
    "cranium": _cranium,
    "mandible": _mandible,
    "teeth": _teeth,
    "vertebrae": _vertebrae,
    "discs": _discs,
    "metal": _metal,
}
