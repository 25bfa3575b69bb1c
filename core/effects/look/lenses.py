"""The lens of cameras that stand where they are said to: what bends the places where points are seen.

Points of several photos and the lenses of groups of photos are fitted together, poses stay (bundle adjustment; Triggs
et al., 2000). A change of the focal length and a shift of the principal point are free beside the lens: what they
explain, or points that are farther or nearer, is no lens. For an object that is small beside its distance a focal
length and a size cannot be told apart; a ridge then keeps the focal length that is given.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.stats import f as fisher

from ...capture.tracks import Tracks
from ...views import Camera
from .equations import in_places, inverse_blocks

NUMBERS = 7
"""Of a group: the focal length's change as a share, the principal point's shift in px along x and y, OpenCV's k1, k2,
p1, p2."""

_PINHOLE = (0, 1, 2)
_KINDS = ((3,), (4,), (5, 6))
# Cauchy's weights are half at so many deviations; what is further away are wrong matches and gleams.
_CAUCHY, _ROUNDS, _ROUNDS_AGAIN = 2.4, 10, 4
# Numbers are expected to move points by no more than so much.
_USUAL_PX = {**dict.fromkeys(_PINHOLE, 1.0), **dict.fromkeys((3, 4, 5, 6), 30.0)}
# Numbers beside k1 are taken where they explain what is no chance, and as much as can be seen.
_CHANCE, _LEAST_PX = 1e-3, 0.1
# Points so many times farther from the middle than corners are wrong.
_FAR = 2.0
# Less than this share of a step outwards in the scene leads outwards in the photo: the lens folds.
_LEAST_SLOPE = 0.2


@dataclass(frozen=True, eq=False)
class Lenses:
    """What points say of G lenses.

    Attributes:
        numbers: (G, 7) see `NUMBERS`; 0 of what is not needed.
        covariance: (G, 7, 7) of those.
        chance: that the lenses explain so much where there are none.
        explained: the share of the squares of what sightings are off by beside pinholes.
    """

    numbers: np.ndarray
    covariance: np.ndarray
    chance: float
    explained: float


def distorted(places: np.ndarray, lens: np.ndarray) -> np.ndarray:
    """Where a lens shows places (E, 2), x / z and y / z, as OpenCV has it.

    Args:
        lens: (4,) or (E, 4): k1, k2, p1, p2.
    """
    x, y = places[..., 0], places[..., 1]
    k1, k2, p1, p2 = np.moveaxis(np.asarray(lens, np.float64), -1, 0)
    square = x**2 + y**2
    radial = 1 + square * (k1 + square * k2)
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (square + 2 * x**2),
            y * radial + p1 * (square + 2 * y**2) + 2 * p2 * x * y,
        ],
        axis=-1,
    )


def folds(lens: np.ndarray, reach: float) -> bool:
    """Whether farther out in the scene is hardly farther out in the photo somewhere, or even farther in.

    Args:
        lens: (4,) k1, k2, p1, p2.
        reach: the largest distance from the middle that is looked at, as a share of the focal length.
    """
    square = np.linspace(0, reach, 50) ** 2
    return bool((1 + 3 * lens[0] * square + 5 * lens[1] * square**2).min() < _LEAST_SLOPE)


def as_stored(cameras: Sequence[Camera], tracks: Tracks, numbers: np.ndarray) -> Tracks:
    """Sightings in photos from which lenses were taken out, where the photos themselves have them.

    Args:
        cameras: in whose pixels sightings are, without a lens.
        numbers: (N, 7) of each photo, what was taken out.
    """
    focal, middle = _inner(cameras)
    own, focal, middle = numbers[tracks.photo], focal[tracks.photo], middle[tracks.photo]
    bent = distorted((tracks.seen - middle) / focal, own[:, 3:])
    return replace(tracks, seen=focal * (1 + own[:, :1]) * bent + middle + own[:, 1:3])


def fitted(
    cameras: Sequence[Camera], tracks: Tracks, group: np.ndarray, start: np.ndarray, reach: Sequence[float]
) -> Lenses:
    """Robust least squares for all points and the lens of each group.

    k1 is always there, k2, p1 and p2 are where a Wald test asks for them, so that what points do not show does not bend
    the corners. The covariance is that of photos drawn by chance (clustered by photo; Liang and Zeger, 1986): what is
    wrong with a pose, or in the way a photo was taken, is the same for all of its points.

    Args:
        cameras: with the given focal lengths and principal points.
        tracks: as photos have them, see `as_stored`.
        group: (N,) of each photo; −1 for photos without a lens to be found.
        start: (G, 7) to begin with.
        reach: (G,) see `folds`; no numbers beside k1 are taken that make a lens fold within it.
    """
    system = _System(cameras, tracks, group, _FAR * max(reach))
    weights = np.ones(len(tracks.photo))
    state = _State(tracks.points, start, weights, 0.5)
    whole = system.solved(state, (*_PINHOLE, *range(3, NUMBERS)), _ROUNDS, robust=True)
    kinds: tuple[int, ...] = (*_PINHOLE, *_KINDS[0])
    found = _only(system, whole, kinds)
    for more in _KINDS[1:]:
        wider = _only(system, whole, kinds + more)
        plain = not any(folds(own[3:], far) for own, far in zip(wider.numbers, reach, strict=True))
        if plain and system.chance(wider, more) < _CHANCE and system.moves(wider, more) >= _LEAST_PX:
            kinds, found = kinds + more, wider
    bends = tuple(kind for kind in kinds if kind not in _PINHOLE)
    chance = system.chance(found, bends)
    explained = 1 - system.squares(found) / system.squares(_only(system, whole, _PINHOLE))
    # What says nothing else stays as it was given.
    still = system.chance(found, _PINHOLE) >= _CHANCE or system.moves(found, _PINHOLE) < _LEAST_PX
    if still:
        found = _only(system, whole, bends)
    return Lenses(found.numbers, found.covariance, chance, explained)


@dataclass(frozen=True, eq=False)
class _State:
    """Points (P, 3), numbers (G, 7), weights (E,) and px that sightings are off by."""

    points: np.ndarray
    numbers: np.ndarray
    weights: np.ndarray
    spread: float


@dataclass(frozen=True, eq=False)
class _Solved(_State):
    """And the covariance (7 G, 7 G), as (G, 7, 7) without what groups have in common."""

    whole: np.ndarray

    @property
    def covariance(self) -> np.ndarray:
        groups = len(self.numbers)
        places = np.arange(groups)
        return self.whole.reshape(groups, NUMBERS, groups, NUMBERS)[places, :, places]


def _only(system: _System, whole: _Solved, kinds: tuple[int, ...]) -> _Solved:
    """Those numbers alone, weights as they are."""
    numbers = np.zeros_like(whole.numbers)
    numbers[:, list(kinds)] = whole.numbers[:, list(kinds)]
    return system.solved(replace(whole, numbers=numbers), kinds, _ROUNDS_AGAIN, robust=False)


class _System:
    """The equations of all sightings, in px: a column and a row in turn."""

    def __init__(self, cameras: Sequence[Camera], tracks: Tracks, group: np.ndarray, far: float) -> None:
        poses = np.array([np.asarray(camera.world_to_camera, np.float64)[:3] for camera in cameras])
        focal, middle = _inner(cameras)
        self._pose, self._focal, self._middle = poses[tracks.photo], focal[tracks.photo], middle[tracks.photo]
        self._tracks, self._group, self._far = tracks, np.asarray(group)[tracks.photo], far
        self._groups = int(group.max(initial=-1)) + 1
        self._photos = np.unique(tracks.photo, return_inverse=True)[1]

    def solved(self, state: _State, kinds: tuple[int, ...], rounds: int, robust: bool) -> _Solved:
        """Rounds of Gauss and Newton for points and some of the numbers of all groups."""
        for left in reversed(range(rounds)):
            residual, by_point, by_lens = self._equations(state)
            square = (residual.reshape(-1, 2) ** 2).sum(axis=1)
            if robust:
                # Of two normal numbers the squares' median is 2 ln 2 variances.
                free = max(2 * len(square) - 3 * len(state.points) - self._groups * len(kinds), 1)
                known = square[square > 0]
                median = float(np.median(known)) if len(known) else 0.0
                variance = median / (2 * np.log(2)) * 2 * len(square) / free
                spread = max(variance**0.5, 1e-6)
                state = replace(state, spread=spread, weights=1 / (1 + square / (_CAUCHY * spread) ** 2))
            columns = [NUMBERS * place + kind for place in range(self._groups) for kind in kinds]
            sizes = np.sqrt(by_lens.multiply(by_lens).sum(axis=0) / max(len(square), 1))[columns]
            unknown = by_lens[:, columns]
            usual = np.array([_USUAL_PX[kind] for kind in kinds] * self._groups)
            ridge = (state.spread * sizes / usual) ** 2 + 1e-12
            weighted = sparse.diags_array(np.repeat(state.weights, 2))
            own = inverse_blocks(by_point.T @ weighted @ by_point)
            mixed = (unknown.T @ weighted @ by_point).tocsr()
            of_points = by_point.T @ (weighted @ residual)
            normal = (unknown.T @ weighted @ unknown - mixed @ own @ mixed.T).toarray()
            inverse = np.linalg.inv(normal + np.diag(ridge))
            now = state.numbers.ravel()[columns]
            step = inverse @ (unknown.T @ (weighted @ residual) - mixed @ (own @ of_points) - ridge * now)
            moved = own @ (of_points - mixed.T @ step)
            numbers = state.numbers.ravel().copy()
            numbers[columns] += step
            if left == 0:
                alone = unknown.toarray() - by_point @ (own @ mixed.T.toarray())
                covariance = inverse @ self._scatter(alone, residual, state) @ inverse
                whole = np.zeros((numbers.size, numbers.size))
                whole[np.ix_(columns, columns)] = covariance
            state = replace(
                state, points=state.points + moved.reshape(-1, 3), numbers=numbers.reshape(state.numbers.shape)
            )
        return _Solved(state.points, state.numbers, state.weights, state.spread, whole)

    def squares(self, found: _Solved) -> float:
        """The weighted squares of what sightings are off by."""
        residual = self._equations(found)[0].reshape(-1, 2)
        return float((found.weights * (residual**2).sum(axis=1)).sum())

    def chance(self, found: _Solved, kinds: tuple[int, ...]) -> float:
        """That those numbers are as far from 0 if they are 0: Wald's test, by Fisher's distribution."""
        columns = [NUMBERS * place + kind for place in range(self._groups) for kind in kinds]
        photos, used = int(self._photos.max()) + 1, len(columns)
        if photos <= used:
            return 1.0
        values = found.numbers.ravel()[columns]
        statistic = float(values @ np.linalg.pinv(found.whole[np.ix_(columns, columns)], hermitian=True) @ values)
        return float(fisher.sf(statistic / used, used, photos - used))

    def moves(self, found: _Solved, kinds: tuple[int, ...]) -> float:
        """Px, root mean square, by which those numbers move sightings as far as points and the others cannot."""
        _, by_point, by_lens = self._equations(found)
        numbers = np.zeros_like(found.numbers)
        numbers[:, list(kinds)] = found.numbers[:, list(kinds)]
        ways = by_lens @ numbers.ravel()
        weighted = sparse.diags_array(np.repeat(found.weights, 2))
        own = inverse_blocks(by_point.T @ weighted @ by_point)
        ways = ways - by_point @ (own @ (by_point.T @ (weighted @ ways)))
        return float(np.sqrt((ways**2).sum() / max(len(found.weights), 1)))

    def _equations(self, state: _State) -> tuple[np.ndarray, sparse.csr_array, sparse.csr_array]:
        """Residuals (2 E,), and what points and numbers change of where sightings are expected."""
        tracks, focal = self._tracks, self._focal
        local = np.einsum("eij,ej->ei", self._pose[:, :, :3], state.points[tracks.point]) + self._pose[:, :, 3]
        depth = np.maximum(local[:, 2], 1e-6 * np.abs(local).max(axis=1) + 1e-12)
        slope = local[:, :2] / depth[:, None]
        # What no photo shows, a wrong match behind a camera, counts for nothing.
        shown = (np.abs(slope).max(axis=1) < self._far).astype(np.float64)
        slope = slope * shown[:, None]
        own = np.zeros((len(slope), NUMBERS))
        known = self._group >= 0
        own[known] = state.numbers[self._group[known]]
        bent, scale = distorted(slope, own[:, 3:]), focal * (1 + own[:, :1])
        residual = ((tracks.seen - scale * bent - self._middle - own[:, 1:3]) * shown[:, None]).ravel()
        by_local = np.zeros((len(depth), 2, 3))
        by_local[:, 0, 0] = by_local[:, 1, 1] = 1 / depth
        by_local[:, :, 2] = -slope / depth[:, None]
        by_local = (scale * shown[:, None])[:, :, None] * (_slopes(slope, own[:, 3:]) @ by_local)
        by_point = in_places(by_local @ self._pose[:, :, :3], tracks.point, len(tracks.points))
        by_number = _by_number(slope, bent, scale, focal) * shown[:, None, None]
        return residual, by_point, in_places(by_number, self._group, self._groups)

    def _scatter(self, alone: np.ndarray, residual: np.ndarray, state: _State) -> np.ndarray:
        """(K, K) of the sums that photos contribute to the equations; `alone` (2 E, K) is what no point can explain."""
        weighted = alone * (np.repeat(state.weights, 2) * residual)[:, None]
        photos = int(self._photos.max()) + 1
        sums = np.zeros((photos, alone.shape[1]))
        np.add.at(sums, np.repeat(self._photos, 2), weighted)
        free = max(len(residual) - 3 * len(state.points) - alone.shape[1], 1)
        return sums.T @ sums * photos / max(photos - 1, 1) * len(residual) / free


def _inner(cameras: Sequence[Camera]) -> tuple[np.ndarray, np.ndarray]:
    focal = np.array([[camera.fx, camera.fy] for camera in cameras], np.float64)
    return focal, np.array([[camera.cx, camera.cy] for camera in cameras], np.float64)


def _slopes(places: np.ndarray, lens: np.ndarray) -> np.ndarray:
    """(E, 2, 2) the derivatives of `distorted` by the places."""
    x, y = places.T
    k1, k2, p1, p2 = lens.T
    square = x**2 + y**2
    radial, more = 1 + square * (k1 + square * k2), 2 * (k1 + 2 * k2 * square)
    mixed = more * x * y + 2 * p1 * x + 2 * p2 * y
    across = np.stack([radial + more * x**2 + 2 * p1 * y + 6 * p2 * x, mixed], axis=-1)
    down = np.stack([mixed, radial + more * y**2 + 6 * p1 * y + 2 * p2 * x], axis=-1)
    return np.stack([across, down], axis=1)


def _by_number(slope: np.ndarray, bent: np.ndarray, scale: np.ndarray, focal: np.ndarray) -> np.ndarray:
    """(E, 2, 7) px by each of the numbers of a group."""
    x, y = slope.T
    square, none, one = x**2 + y**2, np.zeros_like(x), np.ones_like(x)
    radial = scale * slope * square[:, None]
    kinds = [
        focal * bent,
        np.stack([one, none], axis=1),
        np.stack([none, one], axis=1),
        radial,
        radial * square[:, None],
        scale * np.stack([2 * x * y, square + 2 * y**2], axis=1),
        scale * np.stack([square + 2 * x**2, 2 * x * y], axis=1),
    ]
    return np.stack(kinds, axis=2)
