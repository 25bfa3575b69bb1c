"""Air and material of a volume told apart, and what the walls at their surfaces are made of. Numpy alone."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from itertools import product

import numpy as np

from ..errors import SettingError
from ..steps import part_of_work, run_through
from ..volume import Volume
from .labelling import label_components

# A wall is followed into its depth, up to so many voxels, while it gets denser by this part from voxel to voxel.
_DEEPEST, _RISE = 10, 0.004
# Where it ends while it still does, it is as dense as the others, unless it reaches less than this part of them: then
# it is of another material.
_SAME = 0.6
AROUND = 1
_FRAME, _MATERIAL, _UNRANKED = -1, 0, -100


@dataclass(frozen=True, eq=False)
class Walls:
    """What each voxel near a surface has to do with.

    Attributes:
        owner: (nz, ny, nx) int32. AROUND for the air around the object, the numbers above it for hollows, for air and
            for that part of a wall which is nearest to it; less than AROUND deep in material.
        behind: (nz, ny, nx) float32 mm⁻¹, the attenuation of the wall at whose surface a voxel lies, on either side of
            it, as far as the surface is blurred; 0 elsewhere.
        hollows: how many.
        air_mm_inv: what air has.
    """

    owner: np.ndarray
    behind: np.ndarray
    hollows: int
    air_mm_inv: float

    def filled(self, values: np.ndarray) -> np.ndarray:
        """How much of each voxel near a surface its wall fills, from all voxels' values; 0 for the other voxels.

        It may be a little under 0 or over 1, by noise.
        """
        near = self.behind > self.air_mm_inv
        above = np.where(near, self.behind - self.air_mm_inv, 1)
        return np.where(near, (np.nan_to_num(values) - self.air_mm_inv) / above, 0)


def find_walls(volume: Volume, level_mm_inv: float, smallest_voxels: float = 1.0, air_mm_inv: float = 0.0) -> Walls:
    """Follows all walls of a volume from their surface into their depth.

    Air is what attenuates less than the level. A hollow is air that is not joined through voxels' faces with the air
    around. Where a wall gets no denser any more it has its own attenuation, which is handed on to its surface and into
    the air before it, a layer of voxels at a time. Blur is log-concave, so a wall's rise, as a part of what it has
    reached, gets less and less with depth; where it gets more again another material begins.

    Args:
        smallest_voxels: hollows of fewer count as air around.
        air_mm_inv: what air has.

    Raises:
        SettingError: the level is not above that.
    """
    return run_through(walls_in_steps(volume, level_mm_inv, smallest_voxels, air_mm_inv))


def walls_in_steps(
    volume: Volume, level_mm_inv: float, smallest_voxels: float = 1.0, air_mm_inv: float = 0.0
) -> Generator[float, None, Walls]:
    """As `find_walls`, with a break after each layer of voxels that tells the part that is done."""
    if not (np.isfinite(level_mm_inv) and level_mm_inv > air_mm_inv >= 0):
        raise SettingError(
            "The edge of air is {level_mm_inv:g} mm⁻¹; give an attenuation above {air_mm_inv:g}.",
            level_mm_inv=level_mm_inv,
            air_mm_inv=air_mm_inv,
        )
    # A frame of air: what the volume's border cuts open is joined with what is around.
    values = np.pad(np.nan_to_num(np.asarray(volume.values, np.float32)), 1)
    owner, hollows = _owners(values < level_mm_inv, smallest_voxels)
    yield 0.0
    behind = yield from _Layers(values, owner).attenuation_behind()
    inner = (slice(1, -1),) * 3
    return Walls(owner[inner], behind[inner], hollows, air_mm_inv)


def _owners(air: np.ndarray, fewest: float) -> tuple[np.ndarray, int]:
    """int32 for each voxel, _MATERIAL, AROUND or a hollow's number, and the number of hollows."""
    labels, count = label_components(air)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    kept = sizes >= max(fewest, 1)
    kept[[0, labels[0, 0, 0]]] = False
    owner_of = np.full(count + 1, AROUND, np.int32)
    owner_of[0] = _MATERIAL
    owner_of[kept] = AROUND + 1 + np.arange(kept.sum())
    owner = owner_of[labels]
    for axis in range(3):
        owner.swapaxes(0, axis)[[0, -1]] = _FRAME
    return owner, int(kept.sum())


class _Layers:
    """Layers of voxels along all surfaces, each an array of indices into the flattened volume."""

    def __init__(self, values: np.ndarray, owner: np.ndarray) -> None:
        self._values, self._owner = values.reshape(-1), owner.reshape(-1)
        self._shape = values.shape
        around = np.array(list(product((-1, 0, 1), repeat=3)))
        moved = np.abs(around).sum(axis=1)
        steps = around @ np.array([values.shape[1] * values.shape[2], values.shape[2], 1])
        self._faces = steps[moved == 1]
        # Over faces alone a layer would be thinner askew than along the axes, over corners too thicker.
        self._steps = steps[(moved == 1) | (moved == 2)]
        # 1 and more in a wall, from its surface on; 0 and less in the air before it.
        self._rank = np.full(len(self._values), _UNRANKED, np.int8)
        # Of each layer of the wall: where it still gets denser, and what it has reached.
        self._rising: list[np.ndarray] = []
        self._reached: list[np.ndarray] = []

    def attenuation_behind(self) -> Generator[float, None, np.ndarray]:
        """`Walls.behind`; yields the part that is done."""
        self._wall = yield from part_of_work(self._claim_walls(), 0.0, 1 / 3)
        self._air = yield from part_of_work(self._rank_air(), 1 / 3, 2 / 3)
        behind = np.zeros(len(self._values), np.float32)
        yield from part_of_work(self._hand_on(behind), 2 / 3, 1.0)
        return behind.reshape(self._shape)

    def _hand_on(self, behind: np.ndarray) -> Generator[float, None, None]:
        """Fills in what is behind, from the depth of the walls to their surface and into the air before it."""
        usual_of, total = self._usual(), len(self._wall) + len(self._air)
        for height in range(len(self._wall), 0, -1):
            layer, rising, own = (parts[height - 1] for parts in (self._wall, self._rising, self._reached))
            usual = usual_of[self._owner[layer]]
            ends = np.where(own > _SAME * usual, np.maximum(own, usual), own)
            behind[layer] = np.where(rising, self._mean_of_rank(behind, layer, height + 1, ends), own)
            yield (len(self._wall) + 1 - height) / total
        for depth, layer in enumerate(self._air):
            behind[layer] = self._mean_of_rank(behind, layer, 1 - depth, self._values[layer])
            yield (len(self._wall) + 1 + depth) / total

    def _claim_walls(self) -> Generator[float, None, list[np.ndarray]]:
        """Gives material to the air that is nearest, and ranks it; the layers from the surface on.

        A wall is followed only from where it still gets denser.
        """
        inside = np.flatnonzero(self._owner == _MATERIAL)
        best = np.zeros(len(inside), self._owner.dtype)
        for step in self._faces:
            np.maximum(best, self._owner[inside + step], out=best)
        front = inside[best > _MATERIAL]
        self._owner[front] = best[best > _MATERIAL]
        rise_of = np.full(len(self._values), np.inf, np.float32)
        layers: list[np.ndarray] = []
        while len(front) > 0:
            layers.append(front)
            self._rank[front] = height = len(layers)
            # Scans are noisy, and neighbours along a surface should be alike.
            here = self._mean_of_rank(self._values, front, height, self._values[front])
            before = self._mean_of_rank(self._values, front, height - 1, here * (height > 1))
            rise = 1 - before / here
            another = rise > self._mean_of_rank(rise_of, front, height - 1, np.full(len(front), np.inf))
            rise_of[front] = rise if height > 1 else np.inf
            self._reached.append(np.where(another, before, here))
            self._rising.append((rise > _RISE) & ~another)
            front = self._deeper(front[self._rising[-1]]) if height < _DEEPEST else front[:0]
            yield height / _DEEPEST
        return layers

    def _deeper(self, front: np.ndarray) -> np.ndarray:
        """Material beside a layer that is no one's yet, given to the layer's owners."""
        # What two reach at once goes to the hollow, not to the air around.
        front = front[np.argsort(self._owner[front], kind="stable")]
        found, claim = (front[:, None] + self._steps).ravel(), np.repeat(self._owner[front], len(self._steps))
        free = self._owner[found] == _MATERIAL
        self._owner[found[free]] = claim[free]
        return np.unique(found[free])

    def _rank_air(self) -> Generator[float, None, list[np.ndarray]]:
        """Ranks the air before the walls, 0, -1, ..., in as many layers as the walls have."""
        layers: list[np.ndarray] = []
        front = self._wall[0] if self._wall else np.zeros(0, np.int64)
        while len(layers) < len(self._wall) and len(front) > 0:
            found = np.unique((front[:, None] + self._steps).ravel())
            front = found[(self._owner[found] >= AROUND) & (self._rank[found] == _UNRANKED)]
            self._rank[front] = -len(layers)
            layers.append(front)
            yield len(layers) / len(self._wall)
        return layers

    def _mean_of_rank(self, values: np.ndarray, layer: np.ndarray, rank: int, otherwise: np.ndarray) -> np.ndarray:
        """Mean of `values` of each voxel's neighbours of a rank, `otherwise` where it has none."""
        total, number = np.zeros(len(layer)), np.zeros(len(layer))
        for step in self._steps:
            hit = self._rank[layer + step] == rank
            total += np.where(hit, values[layer + step], 0)
            number += hit
        return np.where(number > 0, total / np.maximum(number, 1), otherwise)

    def _usual(self) -> np.ndarray:
        """The attenuation of each owner's walls, by its number: the median of where they get no denser any more; where
        they do so everywhere, all being thin, what a tenth of their voxels exceeds."""
        usual = np.zeros(max(int(self._owner.max()), AROUND) + 1, np.float32)
        if self._wall:
            index = np.concatenate(self._wall)
            self._put_quantiles(usual, index, 0.9)
            self._put_quantiles(usual, index[~np.concatenate(self._rising)], 0.5)
        return usual

    def _put_quantiles(self, quantile_of: np.ndarray, index: np.ndarray, part: float) -> None:
        """Sets for each owner of voxels among `index` a quantile of their attenuation."""
        index = index[np.argsort(self._owner[index], kind="stable")]
        numbers, firsts = np.unique(self._owner[index], return_index=True)
        for number, first, last in zip(numbers, firsts, np.append(firsts, len(index))[1:], strict=True):
            quantile_of[number] = np.quantile(self._values[index[first:last]], part)
