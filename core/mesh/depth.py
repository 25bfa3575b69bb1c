"""How deep points lie under the outermost surface of an object. Numpy alone."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from ..errors import SettingError
from ..steps import part_of_work, run_through
from ..volume import Volume
from .labelling import label_components

# One voxel of air for the cross that looks for outside, and one for its arms.
_FRAME = 2
# A place between those where the surface is known may be so far from the next of them, in voxels.
_BETWEEN = 0.75
_AT_A_TIME = 1 << 14
# Shares of the work that are done when it is known what is outside, and where the surface is.
_OUTSIDE, _SURFACE = 0.1, 0.4
_CORNERS = tuple(product((0, 1), repeat=3))
# All that share a face or an edge.
_AROUND = tuple(way for way in product((-1, 0, 1), repeat=3) if 0 < sum(map(abs, way)) < 3)


def depth_under_surface(volume: Volume, level: float, points_mm: np.ndarray) -> np.ndarray:
    """Distance of points to the surface between the air around an object and all else: material, and hollows in it.

    Inner shells count from the outermost surface. Air is what attenuates less than the level. Outside is what a cross
    of seven voxels sweeps that moves in air from the border on, through faces. So a gap of one or two voxels, of which
    a model as blurred as that could not tell whether it is open, does not let outside into a hollow; a wider one does.

    The outside voxel that is nearest to each voxel is found exactly (`_nearest_outside`); between voxels the surface is
    the plane through the places where linear interpolation reaches the level beside that outside voxel.

    Args:
        volume: mm⁻¹; around it there is air.
        level: mm⁻¹.
        points_mm: (N, 3).

    Returns:
        (N,) float32 mm, 0 outside.

    Raises:
        SettingError: nothing in the volume attenuates as much as the level.
    """
    return run_through(depth_in_steps(volume, level, points_mm))


def depth_in_steps(volume: Volume, level: float, points_mm: np.ndarray) -> Generator[float, None, np.ndarray]:
    """As `depth_under_surface`, with breaks that tell the share that is done."""
    values = np.pad(np.nan_to_num(np.asarray(volume.values, np.float32)), _FRAME)
    air = values < level
    if air.all():
        raise SettingError(
            "Nothing of the model attenuates {level:.4g} mm⁻¹, so it has no surface; lower the level.", level=level
        )
    outside = _outside(air)
    yield _OUTSIDE
    # Where a gap is closed there is air on both sides of the surface, which then lies half way.
    values = np.where(air & ~outside, np.float32(2 * level), values)
    spacing = np.asarray(volume.spacing_mm, np.float64)
    origin = np.asarray(volume.origin_mm, np.float64) - _FRAME * spacing
    filled = Volume(values, spacing, origin)
    facets = yield from part_of_work(_facets_in_steps(filled, outside, level), _OUTSIDE, _SURFACE)
    yield _SURFACE
    depth = np.zeros(len(points_mm), np.float32)
    under = np.flatnonzero(filled.sample(points_mm) > level)
    for start in range(0, len(under), _AT_A_TIME):
        some = under[start : start + _AT_A_TIME]
        depth[some] = facets.distance(np.asarray(points_mm, np.float64)[some] - origin)
        yield _SURFACE + (1 - _SURFACE) * min((start + _AT_A_TIME) / len(under), 1.0)
    return depth


def _outside(air: np.ndarray) -> np.ndarray:
    """What a cross of seven voxels sweeps in the air, starting from a corner."""
    labels, _ = label_components(~_with_neighbours(~air))
    return _with_neighbours(labels == labels[0, 0, 0])


def _with_neighbours(mask: np.ndarray) -> np.ndarray:
    """The mask and the voxels that share a face with it."""
    grown = mask.copy()
    for axis in range(3):
        source, target = mask.swapaxes(0, axis), grown.swapaxes(0, axis)
        target[:-1] |= source[1:]
        target[1:] |= source[:-1]
    return grown


@dataclass(frozen=True, eq=False)
class _Facets:
    """The surface as a plane beside each outside voxel that has a face in common with it.

    Attributes:
        of_voxel: (nz, ny, nx) int32, the number of the nearest one's facet; -1 for outside voxels that have none.
        voxels: (F,) these outside voxels in the flattened array.
        places: (F, 3) x, y, z on the surface, mm from the centre of voxel [0, 0, 0].
        inward: (F, 3) unit normals.
        spacing: (3,) mm.
    """

    of_voxel: np.ndarray
    voxels: np.ndarray
    places: np.ndarray
    inward: np.ndarray
    spacing: np.ndarray

    def distance(self, points: np.ndarray) -> np.ndarray:
        """(M,) mm from points (M, 3) to the nearest facet.

        The outside voxel that is nearest to a voxel may lie a few voxels beside what is nearest to a point in it: from
        the best facet of the eight voxels around a point the search goes on to the neighbours while one is better.
        """
        shape = np.array(self.of_voxel.shape[::-1])
        steps = np.array(_strides(self.of_voxel.shape))
        low = np.clip((points / self.spacing).astype(np.int64), 0, shape - 2) @ steps
        best, squared = np.full(len(points), -1, np.int32), np.full(len(points), np.inf)
        active = np.arange(len(points))
        self._improve(points, best, squared, active, low, [np.array(corner) @ steps for corner in _CORNERS])
        around = [np.array(way) @ steps for way in _AROUND]
        while len(active):
            before = squared[active]
            self._improve(points, best, squared, active, self.voxels[best[active]], around)
            active = active[squared[active] < before]
        return np.sqrt(squared)

    def _improve(
        self,
        points: np.ndarray,
        best: np.ndarray,
        squared: np.ndarray,
        which: np.ndarray,
        voxels: np.ndarray,
        ways: Sequence[int],
    ) -> None:
        """Looks at the facets of voxels at steps from one for each point, and takes over what is better."""
        flat = self.of_voxel.reshape(-1)
        for way in ways:
            facet = flat[voxels + way]
            apart = points[which] - self.places[facet]
            length = np.einsum("ij,ij->i", apart, apart)
            along = np.einsum("ij,ij->i", apart, self.inward[facet])
            # The facet goes on around its place, as far as the next one.
            length -= np.minimum(length - along**2, (_BETWEEN * self.spacing.max()) ** 2)
            better = (facet >= 0) & (length < squared[which])
            best[which[better]], squared[which[better]] = facet[better], np.maximum(length[better], 0.0)


def _facets_in_steps(filled: Volume, outside: np.ndarray, level: float) -> Generator[float, None, _Facets]:
    """A plane across the gradient at each outside voxel with neighbours inside, as far away as linear interpolation on
    the way to these says, the more so the straighter the way."""
    spacing = np.asarray(filled.spacing_mm, np.float64)
    flat, beside = filled.values.reshape(-1), outside.reshape(-1)
    seeds = np.flatnonzero(_with_neighbours(~outside).reshape(-1) & beside)
    here = flat[seeds].astype(np.float64)
    gradient, ways = np.zeros((2, len(seeds), 3))
    for axis, (step, length) in enumerate(zip(_strides(outside.shape), spacing, strict=True)):
        # At the array's own border that is a voxel of another row, of air as well: the frame.
        before, after = (np.clip(seeds + way, 0, len(flat) - 1) for way in (-step, step))
        gradient[:, axis] = (flat[after] - flat[before]) / (2 * length)
        for other, sign in ((before, -1.0), (after, 1.0)):
            there = flat[other].astype(np.float64)
            met = ~beside[other] & (sign * gradient[:, axis] > 0)
            ways[met, axis] = sign * length * (level - here[met]) / (there[met] - here[met])
    inward = gradient / np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-300)
    weights = np.where(ways == 0, 0.0, inward**2)
    away = (weights * ways * inward).sum(axis=1) / np.maximum(weights.sum(axis=1), 1e-300)
    z, y, x = np.unravel_index(seeds, outside.shape)
    places = np.stack([x, y, z], axis=1) * spacing + away[:, None] * inward
    number = np.full(outside.size, -1, np.int32)
    number[seeds] = np.arange(len(seeds), dtype=np.int32)
    yield 0.25
    nearest = yield from part_of_work(_nearest_outside(outside, spacing), 0.25, 1.0)
    return _Facets(number[nearest], seeds, places, inward, spacing)


def _strides(shape: tuple[int, ...]) -> tuple[int, int, int]:
    """From a voxel to the next along x, y, z in the flattened array."""
    return 1, shape[2], shape[1] * shape[2]


def _nearest_outside(outside: np.ndarray, spacing: np.ndarray) -> Generator[float, None, np.ndarray]:
    """(nz, ny, nx) the index of each voxel's nearest outside one in the flattened array.

    Squared distances one axis after the other, each the least of those before plus the square of the way along the axis
    (Felzenszwalb and Huttenlocher, Theory of Computing 8, 2012). Only voxels farther from outside than a way can
    gain by it, which become few soon.
    """
    shape, (_, ny_step, nz_step) = outside.shape, _strides(outside.shape)
    along = np.arange(shape[2], dtype=np.int32)
    before = np.maximum.accumulate(np.where(outside, along, -(2**20)), axis=2)
    after = np.minimum.accumulate(np.where(outside, along, 2**20)[:, :, ::-1], axis=2)[:, :, ::-1]
    nearest = np.where(along - before <= after - along, before, after)
    way = (np.abs(nearest - along) * spacing[0]).astype(np.float32).reshape(-1)
    squared = way * way
    source = (np.arange(outside.size).reshape(shape) + (nearest - along)).reshape(-1)
    inside = np.flatnonzero(~outside.reshape(-1))
    yield 0.3
    for share, step, length in ((0.6, ny_step, spacing[1]), (1.0, nz_step, spacing[2])):
        squared, source = _along_axis(squared, source, inside, step, float(length))
        yield share
    return source.reshape(shape)


def _along_axis(
    squared: np.ndarray, source: np.ndarray, active: np.ndarray, step: int, length: float
) -> tuple[np.ndarray, np.ndarray]:
    best, of_best = squared.copy(), source.copy()
    count = 0
    while True:
        count += 1
        more = np.float32((count * length) ** 2)
        # The frame is outside, so that none gets so far as to leave the array.
        active = active[best[active] > more]
        if len(active) == 0:
            return best, of_best
        for other in (active - count * step, active + count * step):
            found = squared[other] + more
            better = found < best[active]
            best[active[better]] = found[better]
            of_best[active[better]] = source[other[better]]
