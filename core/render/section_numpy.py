"""Plane cuts with numpy alone, for processes without torch and Numba (Blender's)."""

from __future__ import annotations

import numpy as np

from ..gaussians import GaussianSet, Modality
from ..rotations import normalize_quats, quats_to_matrices
from ..views import Plane

CUTOFF_SIGMAS = 5.3
PATCH_ELEMENTS = 1 << 21


def section_density(gaussians: GaussianSet, plane: Plane, cutoff_sigmas: float = CUTOFF_SIGMAS) -> np.ndarray:
    """Attenuation on a plane, or its mean over a slab: Σ ρ·w as `core.render.section` has it.

    Splats too far from the plane are dropped first. The rest are 2D Gaussians on the plane; those with footprints of
    about the same size are evaluated together.

    Args:
        gaussians: numpy arrays; clones are left out.
        plane: pixels; `thickness_mm` > 0 gives the mean over the slab.
        cutoff_sigmas: distance from a centre after which a splat is left out.

    Returns:
        (height, width) float32, mm⁻¹.
    """
    image = np.zeros(plane.height * plane.width)
    kept = (gaussians.density != 0) & (gaussians.modality != int(Modality.CLONE))
    for values in (gaussians.means, gaussians.quats, gaussians.scales, gaussians.density[:, None]):
        kept &= np.isfinite(values).all(axis=1)
    normal = plane.normal
    offset = np.full(len(gaussians), np.inf)
    offset[kept] = np.abs((gaussians.means[kept].astype(np.float64) - np.asarray(plane.origin)) @ normal)
    half = 0.5 * max(float(plane.thickness_mm), 0.0)
    index = np.flatnonzero(offset <= half + cutoff_sigmas * gaussians.scales.max(axis=1, initial=0.0))
    if len(index) == 0:
        return image.reshape(plane.height, plane.width).astype(np.float32)
    y, center, box = _footprints(gaussians.select(index), plane, half, cutoff_sigmas)
    density = gaussians.density[index].astype(np.float64)
    sizes = np.maximum(box[:, 1] - box[:, 0], box[:, 3] - box[:, 2])
    visible = (box[:, 1] > box[:, 0]) & (box[:, 3] > box[:, 2])
    # In order of thickness, so that thin and thick slabs seldom share a batch.
    by_thickness = np.argsort((y[:, :, 3] ** 2).sum(axis=1), kind="stable")
    for doubling in range(max(plane.width, plane.height).bit_length() + 1):
        edge = 1 << doubling
        chosen = by_thickness[(visible & (sizes <= edge) & (sizes > edge // 2))[by_thickness]]
        columns, rows = min(edge, plane.width), min(edge, plane.height)
        step = max(1, PATCH_ELEMENTS // (columns * rows))
        for start in range(0, len(chosen), step):
            part = chosen[start : start + step]
            image += _patches(y[part], center[part], box[part], density[part], plane, half, columns, rows)
    return image.reshape(plane.height, plane.width).astype(np.float32)


def _footprints(
    gaussians: GaussianSet, plane: Plane, half: float, cutoff: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Whitened plane frames, reference pixels and pixel boxes (left, right, top, bottom) of splats.

    Frames are (n, 3, 4): columns along u, along v, from the centre to the reference, and the normal.
    """
    scales = np.clip(gaussians.scales.astype(np.float64), 1e-12, 1e12)
    whiten = quats_to_matrices(normalize_quats(gaussians.quats.astype(np.float64))).swapaxes(1, 2) / scales[:, :, None]
    means = gaussians.means.astype(np.float64)
    u, v = np.asarray(plane.u, np.float64), np.asarray(plane.v, np.float64)
    normal = plane.normal
    area = np.linalg.norm(np.cross(u, v))
    apart = means - np.asarray(plane.origin, np.float64)
    center = np.stack([apart @ np.cross(v, normal), apart @ np.cross(normal, u)], axis=1) / area
    y_u, y_v, y_n = whiten @ u, whiten @ v, whiten @ normal
    y_0 = -y_n * (apart @ normal)[:, None]
    reach = np.sqrt((y_n * y_n).sum(1))
    if half > 0:
        # A slab's footprint is the splat's shadow along the normal.
        axis = y_n / reach[:, None]
        flat_u = y_u - (y_u * axis).sum(1)[:, None] * axis
        flat_v = y_v - (y_v * axis).sum(1)[:, None] * axis
        limit = np.full(len(means), cutoff * cutoff)
    else:
        flat_u, flat_v = y_u, y_v
    uu, uv, vv = (flat_u * flat_u).sum(1), (flat_u * flat_v).sum(1), (flat_v * flat_v).sum(1)
    cross = np.cross(flat_u, flat_v)
    determinant = np.maximum((cross * cross).sum(1), 1e-300)
    if half <= 0:
        u0, v0 = (y_u * y_0).sum(1), (y_v * y_0).sum(1)
        shift = np.stack([uv * v0 - vv * u0, uv * u0 - uu * v0], axis=1) / determinant[:, None]
        center = center + shift
        y_0 = y_0 + shift[:, :1] * y_u + shift[:, 1:] * y_v
        limit = np.maximum(cutoff * cutoff - (y_0 * y_0).sum(1), 0.0)
        limit = np.where((y_0 * y_0).sum(1) > cutoff * cutoff, -1.0, limit)
    spread = np.sqrt(np.maximum(limit, 0)[:, None] * np.stack([vv, uu], axis=1) / determinant[:, None])
    size = np.array([plane.width, plane.height])
    first = np.clip(np.ceil(center - spread - 0.5), 0, size).astype(np.int64)
    last = np.clip(np.floor(center + spread - 0.5) + 1, 0, size).astype(np.int64)
    last[limit < 0] = 0
    box = np.stack([first[:, 0], last[:, 0], first[:, 1], last[:, 1]], axis=1)
    return np.stack([y_u, y_v, y_0, y_n], axis=2), center, box


def _patches(
    y: np.ndarray,
    center: np.ndarray,
    box: np.ndarray,
    density: np.ndarray,
    plane: Plane,
    half: float,
    columns: int,
    rows: int,
) -> np.ndarray:
    """The flattened image of splats on patches of columns x rows pixels that hold their boxes."""
    left = np.minimum(box[:, 0], plane.width - columns)
    top = np.minimum(box[:, 2], plane.height - rows)
    right = (left[:, None] + np.arange(columns) + 0.5 - center[:, :1]).astype(np.float32)
    down = (top[:, None] + np.arange(rows) + 0.5 - center[:, 1:]).astype(np.float32)
    if half > 0:
        reach = np.linalg.norm(y[:, :, 3], axis=1)
        normal = y[:, :, 3] / reach[:, None]
        along = np.einsum("na,nak->nk", normal, y[:, :, :3]).astype(np.float32)
        flat = y[:, :, :3] - normal[:, :, None] * along[:, None, :]
        m = along[:, 0, None, None] * right[:, None, :] + (along[:, 1:2] * down + along[:, 2:])[:, :, None]
        eta = (half * reach).astype(np.float32)[:, None, None]
        weights = _mean_over_slab(m, eta) * np.exp(-0.5 * _squared(flat, right, down))
    else:
        peak = np.exp(-0.5 * (y[:, :, 2] ** 2).sum(1))
        density = density * peak
        flat = y[:, :, :3].copy()
        flat[:, :, 2] = 0
        weights = np.exp(-0.5 * _squared(flat, right, down))
    weights *= density.astype(np.float32)[:, None, None]
    index = (top[:, None] + np.arange(rows))[:, :, None] * plane.width + (left[:, None] + np.arange(columns))[
        :, None, :
    ]
    return np.bincount(index.ravel(), weights.ravel(), minlength=plane.height * plane.width)


def _squared(flat: np.ndarray, right: np.ndarray, down: np.ndarray) -> np.ndarray:
    """‖flat·(right, down, 1)‖² on patches, (n, rows, columns) float32, as a sum of squares: p², then q².

    The third column is in the plane of the first two (or zero), so that two components hold everything.
    """
    u, v, base = flat[:, :, 0], flat[:, :, 1], flat[:, :, 2]
    length = np.maximum(np.linalg.norm(u, axis=1), 1e-300)
    first = u / length[:, None]
    along = (first * v).sum(1)
    rest = v - along[:, None] * first
    other = np.linalg.norm(rest, axis=1)
    second = rest / np.maximum(other, 1e-300)[:, None]
    b = along[:, None] * down + (first * base).sum(1)[:, None]
    q = other[:, None] * down + (second * base).sum(1)[:, None]
    p = length.astype(np.float32)[:, None, None] * right[:, None, :] + b.astype(np.float32)[:, :, None]
    p *= p
    p += (q * q).astype(np.float32)[:, :, None]
    return p


def _mean_over_slab(m: np.ndarray, eta: np.ndarray) -> np.ndarray:
    """Mean of exp(−½(m + t)²) over t in ±eta, float32; the series for thin slabs, where the CDFs cancel."""
    thin = eta < 0.5
    if not thin.any():
        return np.sqrt(np.pi / 8) / eta * (_erf(m + eta) - _erf(m - eta))
    m2 = np.minimum(m * m, 1e3)
    e2 = np.where(thin, eta * eta, 0)
    series = 1 + e2 / 6 * (m2 - 1) + e2**2 / 120 * (m2 * m2 - 6 * m2 + 3)
    series += e2**3 / 5040 * (m2**3 - 15 * m2 * m2 + 45 * m2 - 15)
    series *= np.exp(-0.5 * m2)
    if thin.all():
        return series
    difference = np.sqrt(np.pi / 8) / np.where(thin, 1, eta) * (_erf(m + eta) - _erf(m - eta))
    return np.where(thin, series, difference)


def _erf(t: np.ndarray) -> np.ndarray:
    """erf(t/√2), Abramowitz and Stegun 7.1.26: absolute error 1.5e-7."""
    size = np.abs(t)
    s = 1 / (1 + 0.3275911 * np.sqrt(0.5) * size)
    p = s * (0.254829592 + s * (-0.284496736 + s * (1.421413741 + s * (-1.453152027 + s * 1.061405429))))
    return np.sign(t) * (1 - p * np.exp(-0.5 * np.minimum(size, 30) ** 2))
