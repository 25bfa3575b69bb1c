"""Sums of Gaussians at the nodes of a voxel grid with numpy alone: each is evaluated in the box that it reaches."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ..gaussians import GaussianSet
from ..rotations import normalize_quats, quats_to_matrices
from ..steps import run_through

# Boxes of one batch stay in a core's second-level cache; a larger one is cut into layers.
_BATCH_ELEMENTS = 1 << 17
_MOST_ELEMENTS = 1 << 20
# Sides of boxes are rounded up to one of four in each doubling: more would mean smaller batches, fewer more voxels.
_SIZES_LOG2 = 2


def add_gaussians(
    values: np.ndarray,
    gaussians: GaussianSet,
    origin: np.ndarray,
    side: float,
    cutoff_sigmas: float,
    tick: Callable[[float], None] | None = None,
) -> None:
    """Adds Σ ρ·exp(−½(x−μ)ᵀΣ⁻¹(x−μ)) to the values of cubic voxels at their centres.

    Args:
        values: (nz, ny, nx) float32 in one piece, changed.
        gaussians: numpy set, finite, scales > 0.
        origin: (3,) the centre of voxel [0, 0, 0], mm.
        side: of a voxel, mm.
        cutoff_sigmas: how far a splat is evaluated along each axis of the grid, at least.
        tick: called with the part that is done, 0..1, now and then; may raise to stop.
    """
    run_through(add_in_steps(values, gaussians, origin, side, cutoff_sigmas), tick)


def add_in_steps(
    values: np.ndarray, gaussians: GaussianSet, origin: np.ndarray, side: float, cutoff_sigmas: float
) -> Generator[float, None, None]:
    """As `add_gaussians`, with breaks that tell the part that is done."""
    boxes = _boxes(gaussians, values.shape, origin, side, cutoff_sigmas)
    done, all_of_them = 0, int(np.prod(boxes.sizes, axis=1).sum())
    steps = np.array([1, values.shape[2], values.shape[1] * values.shape[2]])
    for part in _batches(boxes):
        x, y, z = (np.arange(int(count)) * step for count, step in zip(part.sizes[0], steps, strict=True))
        voxels = (z[:, None, None] + y[:, None] + x).ravel()
        # Much faster than it was before numpy 1.25, and a batch may have any voxel several times.
        np.add.at(values.reshape(-1), ((part.first @ steps)[:, None] + voxels).ravel(), _patches(part).ravel())
        done += len(part.first) * len(voxels)
        yield done / all_of_them
    if all_of_them == 0:
        yield 1.0


@dataclass(frozen=True, eq=False)
class _Boxes:
    """Where splats are evaluated, and what is needed for it; lengths are in voxels.

    Attributes:
        center: (M, 3) float64 x, y, z from the centre of voxel [0, 0, 0].
        first: (M, 3) int64 x, y, z of a box's first voxel.
        sizes: (M, 3) int64 voxels along x, y, z.
        factor: (M, 6) float64 xx, xy, xz, yy, yz, zz of the upper triangular R with R·d the offset d in sigmas: a sum
            of squares, so that long thin splats lose no digits.
        density: (M,) mm⁻¹.
    """

    center: np.ndarray
    first: np.ndarray
    sizes: np.ndarray
    factor: np.ndarray
    density: np.ndarray

    def select(self, which: np.ndarray | slice) -> _Boxes:
        return _Boxes(*(getattr(self, name)[which] for name in ("center", "first", "sizes", "factor", "density")))


def _boxes(
    gaussians: GaussianSet, shape: tuple[int, ...], origin: np.ndarray, side: float, cutoff_sigmas: float
) -> _Boxes:
    """Boxes of the splats that reach the grid, their sides rounded up as far as the grid goes."""
    counts = np.array(shape[::-1])
    center = (gaussians.means.astype(np.float64) - origin) / side
    axes = quats_to_matrices(normalize_quats(gaussians.quats.astype(np.float64)))
    scales = gaussians.scales.astype(np.float64) / side
    reach = cutoff_sigmas * np.linalg.norm(axes * scales[:, None, :], axis=2)
    low = np.clip(np.ceil(center - reach), 0, counts).astype(np.int64)
    high = np.clip(np.floor(center + reach) + 1, 0, counts).astype(np.int64)
    seen = np.flatnonzero((high > low).all(axis=1))
    low, sizes = low[seen], (high - low)[seen]
    grain = 1 << np.maximum(np.frexp(sizes)[1] - 1 - _SIZES_LOG2, 0)
    sizes = np.minimum(-(-sizes // grain) * grain, counts)
    first = np.minimum(low, counts - sizes)
    whiten = axes[seen].swapaxes(1, 2) / scales[seen][:, :, None]
    boxes = _Boxes(center[seen], first, sizes, _triangular(whiten), gaussians.density[seen].astype(np.float64))
    return _in_layers(boxes)


def _triangular(whiten: np.ndarray) -> np.ndarray:
    """(M, 6) `_Boxes.factor`: R of the QR decomposition of matrices (M, 3, 3), by Gram and Schmidt."""
    x, y, z = whiten[:, :, 0], whiten[:, :, 1], whiten[:, :, 2]
    xx, first = _normalized(x)
    xy, xz = _dot(first, y), _dot(first, z)
    yy, second = _normalized(y - xy[:, None] * first)
    yz = _dot(second, z)
    zz, _ = _normalized(z - xz[:, None] * first - yz[:, None] * second)
    return np.stack([xx, xy, xz, yy, yz, zz], axis=1)


def _normalized(vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    length = np.sqrt(_dot(vectors, vectors))
    return length, vectors / np.maximum(length, 1e-300)[:, None]


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("ij,ij->i", a, b)


def _in_layers(boxes: _Boxes) -> _Boxes:
    """Boxes of which none has too many voxels: large ones are cut across z into layers of the same thickness, the last
    of them thinner."""
    nx, ny, nz = boxes.sizes.T
    thick = np.minimum(np.maximum(_MOST_ELEMENTS // (nx * ny), 1), nz)
    layers = -(-nz // thick)
    which = np.repeat(np.arange(len(layers)), layers)
    number = np.arange(len(which)) - np.repeat(np.cumsum(layers) - layers, layers)
    cut = boxes.select(which)
    cut.first[:, 2] += number * thick[which]
    cut.sizes[:, 2] = np.minimum(thick[which], nz[which] - number * thick[which])
    return cut


def _batches(boxes: _Boxes) -> Iterator[_Boxes]:
    """Boxes of the same size, some at a time."""
    order = np.lexsort((boxes.first[:, 2], *boxes.sizes.T))
    boxes = boxes.select(order)
    if len(order) == 0:
        return
    changes = np.flatnonzero(np.diff(boxes.sizes, axis=0).any(axis=1)) + 1
    ends = [0, *changes.tolist(), len(order)]
    for start, stop in pairwise(ends):
        step = max(1, _BATCH_ELEMENTS // int(np.prod(boxes.sizes[start])))
        for first in range(start, stop, step):
            yield boxes.select(slice(first, min(first + step, stop)))


def _patches(part: _Boxes) -> np.ndarray:
    """(M, nz, ny, nx) float32 values of M splats in boxes of one size, mm⁻¹."""
    x, y, z = (
        (part.first[:, k] - part.center[:, k])[:, None] + np.arange(int(part.sizes[0, k]), dtype=np.float64)
        for k in range(3)
    )
    xx, xy, xz, yy, yz, zz = (part.factor[:, k, None] for k in range(6))
    plane = (xy * y)[:, None, :] + (xz * z)[:, :, None]
    values = plane.astype(np.float32)[..., None] + (xx * x).astype(np.float32)[:, None, None, :]
    values *= values
    rest = ((yy * y)[:, None, :] + (yz * z)[:, :, None]) ** 2 + ((zz * z) ** 2)[:, :, None]
    values += rest.astype(np.float32)[..., None]
    values *= np.float32(-0.5)
    np.exp(values, out=values)
    values *= part.density.astype(np.float32)[:, None, None, None]
    return values
