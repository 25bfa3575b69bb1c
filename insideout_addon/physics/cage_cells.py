"""Which cells of a grid a cage is made of: one body without the air around it. Numpy alone, no bpy."""

from __future__ import annotations

import numpy as np

# A cell that has less than these shares of what the heaviest around it has, or a typical one, holds a mere rim or haze:
# a box that sticks out has too few neighbours to keep its shape. A group of cells with less than the last share of the
# whole floats in air.
_RIM, _HAZE, _FLOATS = 0.2, 0.02, 0.01
_AT_ONCE = 512


def chosen_cells(weights: np.ndarray) -> np.ndarray:
    """(nx, ny, nz) bool, the cells of a body.

    Parts that lie in each other without touching, as dolls in a doll, are joined by the cells of the gaps between them:
    else what is inside would fall through what is around it. Parts that lie side by side stay apart.

    Args:
        weights: (nx, ny, nz) mass of the cells.
    """
    order = np.sort(weights[weights > 0])
    half = order[np.searchsorted(np.cumsum(order), 0.5 * order.sum())]
    heaviest = weights
    for axis in range(3):
        heaviest = np.maximum(heaviest, np.maximum(_shifted(heaviest, 1, axis), _shifted(heaviest, -1, axis)))
    labels = _labels((weights > _RIM * heaviest) & (weights > _HAZE * half))
    shares = np.bincount(labels.ravel(), weights.ravel())
    shares[0] = 0.0
    parts = shares >= min(_FLOATS * shares.sum(), shares.max())
    body = parts[labels] & (labels > 0)
    joined, fewest = body, int(_labels(body).max())
    for gap in range(1, max(weights.shape) // 2 + 1):
        if fewest == 1:
            break
        closed = body | _closed(body, gap)
        groups = int(_labels(closed).max())
        if groups < fewest:
            joined, fewest = closed, groups
    return joined


def nearest_chosen(chosen: np.ndarray) -> np.ndarray:
    """(nx, ny, nz) the number of each chosen cell in the order of `np.argwhere`, of others -1 - that of the nearest."""
    index = np.empty(chosen.shape, np.int64)
    places, others = np.argwhere(chosen), np.argwhere(~chosen)
    index[chosen] = np.arange(len(places))
    for start in range(0, len(others), _AT_ONCE):
        part = others[start : start + _AT_ONCE]
        # Squared distances but for a term that is the same for all.
        distance = (places * places).sum(axis=1) - 2 * part @ places.T
        index[tuple(part.T)] = -1 - distance.argmin(axis=1)
    return index


def _labels(cells: np.ndarray) -> np.ndarray:
    """Numbers from 1 on of the groups of cells that share faces; 0 where there is none."""
    labels = np.where(cells, np.arange(1, cells.size + 1).reshape(cells.shape), 0)
    while True:
        spread = np.where(cells, _around(labels, np.maximum), 0)
        if (spread == labels).all():
            break
        labels = spread
    return np.unique(np.append(labels.ravel(), 0), return_inverse=True)[1][:-1].reshape(cells.shape)


def _closed(cells: np.ndarray, times: int) -> np.ndarray:
    """Morphological closing: gaps of up to twice as many cells are filled, outer shapes stay."""
    grown = np.pad(cells, times)
    for _ in range(times):
        grown = _around(grown, np.logical_or)
    for _ in range(times):
        grown = ~_around(~grown, np.logical_or)
    return grown[times:-times, times:-times, times:-times]


def _shifted(values: np.ndarray, by: int, axis: int) -> np.ndarray:
    """Each cell's neighbour along an axis; 0 beyond the grid."""
    padded = np.pad(values, [(1, 1) if k == axis else (0, 0) for k in range(3)])
    return np.take(padded, np.arange(values.shape[axis]) + 1 + by, axis=axis)


def _around(values: np.ndarray, combine: np.ufunc) -> np.ndarray:
    """Each cell combined with the six that share its faces."""
    found = values.copy()
    for axis in range(values.ndim):
        ahead, behind = np.moveaxis(found, axis, 0), np.moveaxis(values, axis, 0)
        ahead[1:] = combine(ahead[1:], behind[:-1])
        ahead[:-1] = combine(ahead[:-1], behind[1:])
    return found
