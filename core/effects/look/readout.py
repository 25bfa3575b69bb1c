"""Whether cameras moved while their photos were read out: what a motion for each photo explains of how far points lie
from where they were seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.stats import f as fisher

from ...capture.tracks import Tracks
from ...views import Camera
from .equations import in_places, inverse_blocks

# Of a photo's points, those that most others see, too: of them all whole sides could be missing.
_POINTS_A_PHOTO = 300
# Cauchy's weights are half at so many deviations; what is further away are wrong matches and gleams.
_CAUCHY, _ROUNDS = 2.4, 8
# Motions and lenses are expected to be as given but for so much: what photos hardly tell of them stays there.
_USUAL_PX = 1.0
_POSE = 6


@dataclass(frozen=True, eq=False)
class Motions:
    """What is seen of the motions of N photos.

    Attributes:
        square: (N,) mean square of the ways in px that a motion from row to row moves a photo's points.
        across: (N,) the same of a motion from column to column, looked for in what the other leaves: what noise and
            whatever else points are off by makes of either.
        by_rows, by_columns: the share of the squares that each explains of what is left before it.
        chance, chance_across: that a motion from row to row, from column to column, explains so much where there is
            none.
    """

    square: np.ndarray
    across: np.ndarray
    by_rows: float
    by_columns: float
    chance: float
    chance_across: float


def chosen(tracks: Tracks, photos: int, fewest: int, most: int = _POINTS_A_PHOTO) -> Tracks:
    """Of the points, up to `most` in each photo that most others see, too; none of photos with fewer than `fewest`."""
    counts = np.bincount(tracks.photo, minlength=photos)
    tracks = _kept(tracks, counts[tracks.photo] >= fewest)
    seen = np.bincount(tracks.point, minlength=len(tracks.points))
    wanted = np.zeros(len(tracks.points), bool)
    for place in range(photos):
        own = tracks.point[tracks.photo == place]
        wanted[own[np.argsort(-seen[own], kind="stable")[:most]]] = True
    return _kept(tracks, wanted[tracks.point])


def _kept(tracks: Tracks, sightings: np.ndarray) -> Tracks:
    """Those sightings (E,) of points that are left with two or more."""
    seen = np.bincount(tracks.point[sightings], minlength=len(tracks.points))
    sightings = sightings & (seen[tracks.point] >= 2)
    places, point = np.unique(tracks.point[sightings], return_inverse=True)
    return Tracks(tracks.points[places], tracks.photo[sightings], point, tracks.seen[sightings])


def motions(cameras: Sequence[Camera], tracks: Tracks) -> Motions:
    """One robust step of Gauss and Newton for the motion of each photo, all points, and a lens for each size of photos.

    In the middle of a readout poses stay as they are given: a motion counts by what they leave, for it is with them
    that splats are trained. Were they free as well, photos of an object that fills a narrow field of view would agree
    with any motion and an object that is bent to suit it.

    Args:
        cameras: perspective.
        tracks: of photos without any there is no motion.
    """
    system = _System(cameras, tracks)
    size = np.array([[camera.width, camera.height] for camera in cameras])[tracks.photo]
    since = tracks.seen / size - 0.5
    rows, columns = system.moving(since[:, 1]), system.moving(since[:, 0])
    weights, spread = np.ones(len(tracks.photo)), 0.5 * _USUAL_PX
    free = system.free(rows)
    for _ in range(_ROUNDS):
        found = system.solved(rows, weights, spread)
        square = (found.left**2).sum(axis=1)
        # Of two normal numbers the squares' median is 2 ln 2 variances.
        spread = max(float(np.sqrt(np.median(square) / (2 * np.log(2)) * 2 * len(square) / free)), 1e-6)
        weights = 1 / (1 + square / (_CAUCHY * spread) ** 2)
    still = system.solved(None, weights, spread).cost
    first = system.solved(rows, weights, spread)
    then = system.solved(columns, weights, spread, without=rows @ first.numbers)
    before = system.solved(None, weights, spread, without=rows @ first.numbers).cost

    def chance(before: float, after: _Solved) -> float:
        used = max(after.used, 1.0)
        return float(fisher.sf(max(before - after.cost, 0.0) / used / (after.cost / free), used, free))

    return Motions(
        system.ways(rows, first.numbers),
        system.ways(columns, then.numbers),
        1 - first.cost / still,
        1 - then.cost / before,
        chance(still, first),
        chance(before, then),
    )


@dataclass(frozen=True, eq=False)
class _Solved:
    """Numbers of motions; what all leave of the residuals (E, 2); its weighted squares, and those of the numbers by the
    ridge; how many numbers that are not held back at 0 the motions amount to."""

    numbers: np.ndarray
    left: np.ndarray
    cost: float
    used: float


class _System:
    """The linear equations of all sightings: their columns and rows in turn, in px."""

    def __init__(self, cameras: Sequence[Camera], tracks: Tracks) -> None:
        self._photo, self._photos = tracks.photo, len(cameras)
        poses = np.array([np.asarray(camera.world_to_camera, np.float64)[:3] for camera in cameras])[tracks.photo]
        focal = np.array([[camera.fx, camera.fy] for camera in cameras])[tracks.photo]
        middle = np.array([[camera.cx, camera.cy] for camera in cameras])[tracks.photo]
        local = np.einsum("eij,ej->ei", poses[:, :, :3], tracks.points[tracks.point]) + poses[:, :, 3]
        depth = local[:, 2]
        slope = local[:, :2] / depth[:, None]
        self._residual = (tracks.seen - focal * slope - middle).ravel()
        by_local = np.zeros((len(depth), 2, 3))
        by_local[:, 0, 0] = by_local[:, 1, 1] = 1 / depth
        by_local[:, :, 2] = -slope / depth[:, None]
        by_local *= focal[:, :, None]
        # In px, so that all numbers are of one size: turns by 1 / f, shifts by depth / f.
        turns = np.einsum("eij,ekj->eik", by_local, np.cross(np.eye(3)[None], local[:, None]))
        usual = np.array([np.median(depth[tracks.photo == place]) for place in np.unique(tracks.photo)])
        usual = usual[np.unique(tracks.photo, return_inverse=True)[1]]
        self._by_pose = np.concatenate([turns, by_local * usual[:, None, None]], axis=2) / focal[:, :1, None]
        self._points = in_places(np.einsum("eij,ejk->eik", by_local, poses[:, :, :3]), tracks.point, len(tracks.points))
        sizes = [(camera.width, camera.height) for camera in cameras]
        group = np.array([sorted(set(sizes)).index(size) for size in sizes])[tracks.photo]
        self._lenses = in_places(_by_lens(slope, focal), group, len(set(sizes)))

    def moving(self, since: np.ndarray) -> sparse.csr_array:
        """The equations of motions of which the part `since` (E,) has been made when each point is seen."""
        return in_places(self._by_pose * since[:, None, None], self._photo, self._photos)

    def solved(
        self, moving: sparse.csr_array | None, weights: np.ndarray, spread: float, without: np.ndarray | None = None
    ) -> _Solved:
        """The least squares, weighted and with a ridge; None for photos that stand still.

        Args:
            spread: px that sightings are off by as a rule.
            without: (2 E,) what is known of the residuals and taken off them.
        """
        residual = self._residual if without is None else self._residual - without
        unknown = self._lenses if moving is None else sparse.hstack([self._lenses, moving], "csr")
        lenses, ridge = self._lenses.shape[1], (spread / _USUAL_PX) ** 2
        weighted = sparse.diags_array(np.repeat(weights, 2))
        # Points are eliminated first, each by itself (Schur's complement).
        own = inverse_blocks(self._points.T @ weighted @ self._points)
        mixed = (unknown.T @ weighted @ self._points).tocsr()
        of_points = self._points.T @ (weighted @ residual)
        normal = (unknown.T @ weighted @ unknown - mixed @ own @ mixed.T).toarray()
        inverse = np.linalg.inv(normal + ridge * np.eye(len(normal)))
        numbers = inverse @ (unknown.T @ (weighted @ residual) - mixed @ (own @ of_points))
        left = residual - unknown @ numbers - self._points @ (own @ (of_points - mixed.T @ numbers))
        left = left.reshape(-1, 2)
        cost = float((weights * (left**2).sum(axis=1)).sum() + ridge * (numbers**2).sum())
        used = float((inverse * normal.T).sum(axis=1)[lenses:].sum())
        return _Solved(numbers[lenses:], left, cost, used)

    def free(self, moving: sparse.csr_array) -> int:
        """How many more equations there are than unknowns, at least 1."""
        used = self._lenses.shape[1] + moving.shape[1] + self._points.shape[1]
        return max(len(self._residual) - used, 1)

    def ways(self, moving: sparse.csr_array, numbers: np.ndarray) -> np.ndarray:
        """(N,) mean square over each photo's points of how far motions move them; 0 without points."""
        square = ((moving @ numbers).reshape(-1, 2) ** 2).sum(axis=1)
        counts = np.bincount(self._photo, minlength=self._photos)
        return np.bincount(self._photo, square, self._photos) / np.maximum(counts, 1)


def _by_lens(slope: np.ndarray, focal: np.ndarray) -> np.ndarray:
    """(E, 2, 7) ways in px by focal length, principal point, and two numbers each of radial and of tangential
    distortion (as OpenCV has them); each with a root mean square of 1."""
    x, y = slope.T
    squared, none = x**2 + y**2, np.zeros_like(x)
    kinds = [
        slope,
        np.stack([none + 1, none], axis=1),
        np.stack([none, none + 1], axis=1),
        slope * squared[:, None],
        slope * squared[:, None] ** 2,
        np.stack([2 * x * y, squared + 2 * y**2], axis=1),
        np.stack([squared + 2 * x**2, 2 * x * y], axis=1),
    ]
    ways = np.stack(kinds, axis=2) * focal[:, :, None]
    return ways / np.maximum(np.sqrt((ways**2).sum(axis=1).mean(axis=0)), 1e-12)
