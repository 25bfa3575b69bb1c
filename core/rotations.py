"""Quaternions, w first, for numpy arrays and torch tensors alike."""

from __future__ import annotations

from typing import Any

import numpy as np


def quats_to_matrices(quats: Any) -> Any:
    """Rotation matrices (N, 3, 3) of unit quaternions (N, 4), w first; numpy in numpy out, torch in torch out."""
    w, x, y, z = quats[:, 0], quats[:, 1], quats[:, 2], quats[:, 3]
    entries = [
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    ]
    if isinstance(quats, np.ndarray):
        return np.stack(entries, axis=-1).reshape(-1, 3, 3)
    import torch

    return torch.stack(entries, dim=-1).reshape(-1, 3, 3)


def normalize_quats(quats: np.ndarray) -> np.ndarray:
    """(N, 4) unit quaternions; a zero or non-finite quaternion becomes the identity."""
    quats = np.asarray(quats)
    norms = np.linalg.norm(quats.astype(np.float64), axis=-1, keepdims=True)
    good = np.isfinite(norms) & (norms > 1e-12)
    identity = np.array([1.0, 0.0, 0.0, 0.0])
    return np.where(good, quats / np.where(good, norms, 1.0), identity).astype(quats.dtype)


def matrix_to_quat(matrix: np.ndarray) -> np.ndarray:
    """The unit quaternion (4,), w first and w >= 0, of one proper rotation matrix (3, 3).

    From the eigenvector of the largest eigenvalue of Bar-Itzhack's matrix (J. Guidance 23(6), 2000), which
    stays accurate for every rotation and for slightly non-orthogonal input.
    """
    m = np.asarray(matrix, np.float64)
    k = np.array(
        [
            [m[0, 0] - m[1, 1] - m[2, 2], 0, 0, 0],
            [m[0, 1] + m[1, 0], m[1, 1] - m[0, 0] - m[2, 2], 0, 0],
            [m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], m[2, 2] - m[0, 0] - m[1, 1], 0],
            [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], np.trace(m)],
        ]
    )
    x, y, z, w = np.linalg.eigh(k / 3.0)[1][:, -1]
    quat = np.array([w, x, y, z])
    return quat if w >= 0 else -quat


def matrices_to_quats(matrices: np.ndarray) -> np.ndarray:
    """Unit quaternions (N, 4), w first, of N proper rotation matrices (N, 3, 3) at once.

    Of the four numbers the largest is found from the diagonal, the others from it (Shepperd, J. Guidance 1(3), 1978).
    """
    m = np.asarray(matrices, np.float64)
    diagonal = np.diagonal(m, axis1=1, axis2=2)
    # Row i is q_i · (w, x, y, z), 4 times.
    products = np.empty((len(m), 4, 4))
    products[:, 0, 0] = 1 + diagonal.sum(axis=1)
    for axis in range(3):
        after, last = (axis + 1) % 3, (axis + 2) % 3
        products[:, 1 + axis, 1 + axis] = 1 + diagonal[:, axis] - diagonal[:, after] - diagonal[:, last]
        with_w = m[:, last, after] - m[:, after, last]
        products[:, 0, 1 + axis] = products[:, 1 + axis, 0] = with_w
        crossed = m[:, after, axis] + m[:, axis, after]
        products[:, 1 + axis, 1 + after] = products[:, 1 + after, 1 + axis] = crossed
    largest = np.diagonal(products, axis1=1, axis2=2).argmax(axis=1)
    rows = products[np.arange(len(m)), largest]
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def multiply_quats(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Hamilton product of quaternions (..., 4), w first: the rotation `right` first, then `left`."""
    w1, x1, y1, z1 = np.moveaxis(np.asarray(left), -1, 0)
    w2, x2, y2, z2 = np.moveaxis(np.asarray(right), -1, 0)
    return np.stack(
        [
            w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
            w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
            w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
            w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
        ],
        axis=-1,
    )
