"""How widths of edges grow with the distance from a photo's focus, beside edges of the same place in other photos."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from ...views import Camera
from .sharpness import edges, front

View = tuple[np.ndarray, Camera]

# Of a photo, chosen evenly; more tell hardly more.
_EDGES_A_PHOTO = 600
# Of a photo's longer side: points so near to an edge say how far away it is, and points closer to each other than that
# cover each other.
_NEAR, _COVER = 0.02, 0.016
# Of the object's radius: how much farther away a covered point is, and how far points beside an edge may be apart.
_BEHIND, _APART = 0.12, 0.1
# Cubes of space along the object's diameter: what lies in one is the same thing in all photos.
_CUBES = 15
_ROUNDS, _LEAST = 8, 0.3
_RIDGE = 1e-3
# Isotropic, and across and along two pairs of axes; each with what is the same at all depths, a slope and a bend.
_KINDS, _POWERS = 3, 3


@dataclass(frozen=True, eq=False)
class Sharpness:
    """Edges of several photos.

    Attributes:
        photo: (E,) place among the photos.
        thing: (E,) number of the part of the object.
        nearness: (E,) inverse of the depth, in inverse radii of the object.
        direction: (E,) rad, across the edge in the image.
        width2: (E,) square of its width, px² of the image.
    """

    photo: np.ndarray
    thing: np.ndarray
    nearness: np.ndarray
    direction: np.ndarray
    width2: np.ndarray


@dataclass(frozen=True, eq=False)
class Bends:
    """How the squares of widths bend with nearness, a photo a row.

    Attributes:
        bend: (N, 3) px² at half of the range of nearness from where they are least: in all directions, and how much
            of it differs between them, along two pairs of axes; not numbers where there are too few edges.
        error: (N,) of the first.
        slope: (N,) px² over half of the range.
        spread: (N,) deviation of nearness over half of the range.
        half: half of the range of nearness over nearness: the 5th to 95th percentile in the middle one of photos.
    """

    bend: np.ndarray
    error: np.ndarray
    slope: np.ndarray
    spread: np.ndarray
    half: float


def sharpness(views: Sequence[View], points: np.ndarray, tick: Callable[[], None]) -> Sharpness:
    """Edges of photos that points (P, 3) in front of everything lie beside.

    Args:
        tick: called between photos; may raise to stop.
    """
    low, high = np.percentile(points, [2, 98], axis=0)
    radius = max(0.5 * float(np.linalg.norm(high - low)), 1e-12)
    cubes = np.floor(points / (2 * radius / _CUBES)).astype(np.int64)
    things = np.unique(cubes, axis=0, return_inverse=True)[1].ravel()
    rows = [np.zeros((0, 5))]
    for place, (image, camera) in enumerate(views):
        tick()
        side = max(camera.width, camera.height)
        shown, depth = front(points, camera, max(_COVER * side, 2.0), _BEHIND * radius)
        if not len(shown):
            continue
        found = edges(image)
        columns, lines, _ = camera.pixels_of(points[shown])
        tree = cKDTree(np.stack([columns, lines], axis=1))
        apart, which = tree.query(found.place, k=[1, 2, 3, 4], distance_upper_bound=max(_NEAR * side, 2.0))
        beside = np.where(np.isfinite(apart), np.append(depth, np.nan)[which], np.nan)
        known = np.flatnonzero(np.isfinite(apart[:, 0]))
        known = known[np.nanmax(beside[known], axis=1) - np.nanmin(beside[known], axis=1) < _APART * radius]
        known = known[np.linspace(0, len(known) - 1, min(len(known), _EDGES_A_PHOTO)).round().astype(int)]
        nearness = radius / np.nanmean(beside[known], axis=1)
        thing = things[shown[which[known, 0]]]
        photo = np.full(len(known), place)
        rows.append(np.stack([photo, thing, nearness, found.direction[known], found.width2[known]], axis=1))
    photo, thing, nearness, direction, width2 = np.concatenate(rows).T
    thing = np.unique(thing.astype(np.int64), return_inverse=True)[1]
    return Sharpness(photo.astype(np.int64), thing, nearness, direction, width2)


def bends(found: Sharpness, photos: int, fewest: int) -> Bends:
    """Robust least squares of squared widths: of each thing one, and of each photo a parabola of nearness.

    What is soft itself is soft in all photos; what a photo blurs all over, or the more the nearer it is, has no bend.

    Args:
        photos: how many there are.
        fewest: edges that a photo needs.
    """
    apart = depths(found, photos, fewest)
    if apart is None:
        unknown = np.full(photos, np.nan)
        return Bends(np.full((photos, _KINDS), np.nan), unknown, unknown, unknown, 0.0)
    away, enough = apart.away, apart.enough
    turned = [np.ones_like(away), np.cos(2 * found.direction), np.sin(2 * found.direction)]
    values = np.stack([kind * away**power for kind in turned for power in range(_POWERS)], axis=1)
    numbers, errors = (part.reshape(photos, _KINDS, _POWERS) for part in fitted(values, found, photos))
    numbers[~enough], errors[~enough] = np.nan, np.nan
    spread = np.full(photos, np.nan)
    spread[enough] = [away[found.photo == place].std() for place in np.flatnonzero(enough)]
    return Bends(numbers[:, :, 2], errors[:, 0, 2], numbers[:, 0, 1], spread, apart.share)


class Depths(NamedTuple):
    """Which of N photos have enough edges (N,), how much nearer than the middle of its photo each edge lies (E,), over
    half of the range of nearness, and that half over nearness."""

    enough: np.ndarray
    away: np.ndarray
    share: float


def depths(found: Sharpness, photos: int, fewest: int) -> Depths | None:
    """None where no photo has `fewest` edges."""
    counts = np.bincount(found.photo, minlength=photos)
    ranges = [found.nearness[found.photo == place] for place in np.flatnonzero(counts >= fewest)]
    if not ranges:
        return None
    half = float(np.median([0.5 * np.subtract(*np.percentile(each, [95, 5])) for each in ranges]))
    middle = np.zeros(photos)
    middle[counts >= fewest] = [np.median(each) for each in ranges]
    away = (found.nearness - middle[found.photo]) / max(half, 1e-12)
    return Depths(counts >= fewest, away, half / float(np.median(np.concatenate(ranges))))


def fitted(values: np.ndarray, found: Sharpness, photos: int) -> tuple[np.ndarray, np.ndarray]:
    """(N, K) numbers of the photos' columns `values` (E, K), and their errors; a constant of each thing is beside."""
    count, wide = values.shape
    rows, edge = np.repeat(np.arange(count), wide), np.arange(count)
    columns = (wide * found.photo[:, None] + np.arange(wide)).ravel()
    of_photo = sparse.csr_array((values.ravel(), (rows, columns)), shape=(count, wide * photos))
    of_thing = sparse.csr_array((np.ones(count), (edge, found.thing)))
    weights, wanted = np.ones(count), found.width2
    for _ in range(_ROUNDS):
        weighted, total = sparse.diags_array(weights), of_thing.T @ weights
        mixed = (of_photo.T @ weighted @ of_thing) @ sparse.diags_array(1 / np.sqrt(total))
        normal = (of_photo.T @ weighted @ of_photo - mixed @ mixed.T).toarray()
        inverse = np.linalg.inv(normal + _RIDGE * np.eye(len(normal)))
        means = of_thing @ ((of_thing.T @ (weights * wanted)) / total)
        numbers = inverse @ (of_photo.T @ (weights * (wanted - means)))
        left = wanted - of_photo @ numbers
        left -= of_thing @ ((of_thing.T @ (weights * left)) / total)
        spread = max(1.4826 * float(np.median(np.abs(left))), 1e-6)
        weights = 1 / np.maximum(np.abs(left) / spread, _LEAST)
    shape = photos, wide
    return numbers.reshape(shape), (spread * np.sqrt(np.diag(inverse))).reshape(shape)
