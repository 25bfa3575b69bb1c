"""Real spherical harmonics as 3DGS stores them (Kerbl et al. 2023): basis, rotation, DC colour. Numpy alone."""

from __future__ import annotations

import numpy as np

C0 = 0.28209479177387814
C1 = 0.4886025119029199
C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
C3 = (
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
)

# More than the seven unknowns of band 3; and how many functions are turned at once, for memory's sake.
_DIRECTIONS, _AT_ONCE = 24, 8192


def sh_degree(coefficients: int) -> int:
    """The degree (0 to 3) that has this many coefficients a channel (1, 4, 9, 16).

    Raises:
        ValueError: another count.
    """
    degrees = {1: 0, 4: 1, 9: 2, 16: 3}
    if coefficients not in degrees:
        raise ValueError(f"spherical harmonics need 1, 4, 9 or 16 coefficients a channel, not {coefficients}")
    return degrees[coefficients]


def sh_basis(directions: np.ndarray, degree: int) -> np.ndarray:
    """Basis values (N, (degree + 1)²) at unit directions (N, 3), degree 0 to 3, in 3DGS's order and signs."""
    x, y, z = np.asarray(directions).T
    columns = [np.full_like(x, C0)]
    if degree >= 1:
        columns += [-C1 * y, C1 * z, -C1 * x]
    if degree >= 2:
        columns += [
            C2[0] * x * y,
            C2[1] * y * z,
            C2[2] * (2 * z * z - x * x - y * y),
            C2[3] * x * z,
            C2[4] * (x * x - y * y),
        ]
    if degree >= 3:
        columns += [
            C3[0] * y * (3 * x * x - y * y),
            C3[1] * x * y * z,
            C3[2] * y * (4 * z * z - x * x - y * y),
            C3[3] * z * (2 * z * z - 3 * x * x - 3 * y * y),
            C3[4] * x * (4 * z * z - x * x - y * y),
            C3[5] * z * (x * x - y * y),
            C3[6] * x * (x * x - 3 * y * y),
        ]
    return np.stack(columns, axis=-1)


def rotate_sh(sh: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Coefficients (N, K, 3) of the same colour functions after the object is turned by `rotation` (3, 3).

    Each band is closed under rotation, so its (2l + 1)² matrix is the exact solution of a least-squares fit of
    the turned basis on more directions than unknowns.
    """
    degree = sh_degree(sh.shape[1])
    turned = sh.astype(np.float64).copy()
    directions = _fibonacci_sphere(64)
    there = sh_basis(directions, degree)
    back = sh_basis(directions @ np.asarray(rotation, np.float64), degree)
    for band in range(1, degree + 1):
        part = slice(band * band, (band + 1) * (band + 1))
        matrix = np.linalg.lstsq(there[:, part], back[:, part], rcond=None)[0]
        turned[:, part] = np.einsum("ij,njc->nic", matrix, turned[:, part])
    return turned.astype(sh.dtype)


def rotate_sh_each(sh: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """As `rotate_sh`, with a rotation (N, 3, 3) for each of the colour functions (N, K, 3)."""
    degree = sh_degree(sh.shape[1])
    turned = sh.astype(np.float64)
    directions = _fibonacci_sphere(_DIRECTIONS)
    there = sh_basis(directions, degree)
    bands = [slice(band * band, (band + 1) * (band + 1)) for band in range(1, degree + 1)]
    fits = [np.linalg.pinv(there[:, band]) for band in bands]
    for start in range(0, len(sh), _AT_ONCE):
        rows = slice(start, start + _AT_ONCE)
        back = sh_basis((directions @ rotations[rows]).reshape(-1, 3), degree).reshape(-1, _DIRECTIONS, len(there.T))
        for band, fit in zip(bands, fits, strict=True):
            turned[rows, band] = fit @ (back[:, :, band] @ turned[rows, band])
    return turned.astype(sh.dtype)


def rgb_to_sh(rgb: np.ndarray) -> np.ndarray:
    """DC coefficients (N, 3) that show the colours `rgb` (N, 3) in 0..1."""
    return (np.asarray(rgb) - 0.5) / C0


def sh_to_rgb(dc: np.ndarray) -> np.ndarray:
    """Colours (N, 3), clipped to 0..1, that the DC coefficients (N, 3) show."""
    return np.clip(np.asarray(dc) * C0 + 0.5, 0.0, 1.0)


def _fibonacci_sphere(count: int) -> np.ndarray:
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / count
    angle = np.pi * (1 + 5**0.5) * index
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=-1)
