"""Little signs for painted bands, after hieroglyphs; they say nothing."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

Sign = Callable[[np.ndarray, np.ndarray], np.ndarray]


def write(u: np.ndarray, v: np.ndarray, seed: int = 0) -> np.ndarray:
    """(N,) whether a point of a band has ink.

    Args:
        u: (N,) across the band, −1..1 from edge to edge.
        v: (N,) along the band, in heights of a sign, upward; each unit holds another sign.
        seed: which text.
    """
    cell = np.floor(v).astype(int)
    kind = (cell * 7 + cell * cell * 3 + seed * 5) % len(_SIGNS)
    inner = 2.3 * (v - cell - 0.5)
    ink = np.zeros(len(u), bool)
    for index, sign in enumerate(_SIGNS):
        chosen = np.flatnonzero((kind == index) & (np.abs(u) < 1))
        if len(chosen):
            ink[chosen] = sign(1.15 * u[chosen], inner[chosen])
    return ink


def _stroke(
    u: np.ndarray, v: np.ndarray, start: tuple[float, float], end: tuple[float, float], half: float = 0.13
) -> np.ndarray:
    along = np.subtract(end, start)
    share = np.clip(((u - start[0]) * along[0] + (v - start[1]) * along[1]) / (along @ along), 0, 1)
    return np.hypot(u - start[0] - share * along[0], v - start[1] - share * along[1]) < half


def _ring(u: np.ndarray, v: np.ndarray, wide: float, high: float, half: float = 0.13) -> np.ndarray:
    reach = np.hypot(u / wide, v / high)
    return np.abs(reach - 1) < half / min(wide, high)


def _life(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    loop = _ring(u, v - 0.52, 0.3, 0.42)
    return loop | _stroke(u, v, (0, 0.1), (0, -0.95)) | _stroke(u, v, (-0.55, 0.02), (0.55, 0.02))


def _eye(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    lids = np.abs(np.abs(v - 0.15) - 0.42 * (1 - (u / 0.9) ** 2)) < 0.12
    tear = _stroke(u, v, (0.1, -0.2), (0.05, -0.8)) | _stroke(u, v, (0.2, -0.3), (0.65, -0.7))
    brow = _stroke(u, v, (-0.8, 0.72), (0.8, 0.78), 0.1)
    return (lids & (np.abs(u) < 0.95)) | (np.hypot(u, v - 0.15) < 0.24) | tear | brow


def _bird(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    body = np.hypot((u + 0.1 + 0.4 * v) / 0.42, (v - 0.02) / 0.55) < 1
    head = np.hypot(u - 0.25, v - 0.62) < 0.26
    beak = _stroke(u, v, (0.4, 0.62), (0.75, 0.5), 0.09)
    legs = _stroke(u, v, (0.05, -0.4), (0.05, -0.9), 0.08) | _stroke(u, v, (-0.3, -0.9), (0.4, -0.9), 0.08)
    return body | head | beak | legs | _stroke(u, v, (-0.1, -0.2), (-0.75, -0.75))


def _water(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    zigzag = 0.22 * np.abs(((u * 2.2 + 20) % 1.0) * 4 - 2) - 0.22
    return (np.abs((np.abs(v) - 0.4) - zigzag * np.sign(v)) < 0.13) & (np.abs(u) < 0.9)


def _sun(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    return _ring(u, v, 0.62, 0.62) | (np.hypot(u, v) < 0.22)


def _reed(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    leaf = np.hypot((u - 0.12) / 0.3, (v - 0.25) / 0.7) < 1
    return (leaf & (u > -0.08)) | _stroke(u, v, (-0.1, 0.85), (-0.1, -0.95), 0.1)


def _basket(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    bowl = (np.hypot(u / 0.85, (v - 0.1) / 0.7) < 1) & (v < 0.1)
    return bowl | _stroke(u, v, (-0.5, 0.6), (0.5, 0.6))


def _snake(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    wave = (np.abs(v + 0.25 - 0.22 * np.sin(5 * u)) < 0.13) & (np.abs(u) < 0.85)
    return wave | _stroke(u, v, (0.8, -0.4), (0.6, 0.5)) | _stroke(u, v, (0.55, 0.5), (0.2, 0.42), 0.1)


def _pillar(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    bars = (np.abs(u) < 0.55) & (v > 0.1) & (np.abs((v * 4) % 1.0 - 0.5) < 0.27)
    return bars | (np.abs(u) < 0.2) | ((np.abs(u) < 0.5) & (v < -0.75))


def _seated(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    head = np.hypot(u - 0.05, v - 0.62) < 0.27
    body = (np.abs(u + 0.1 + 0.2 * v) < 0.25) & (np.abs(v + 0.05) < 0.5)
    legs = (np.abs(v + 0.6) < 0.27) & (np.abs(u - 0.08) < 0.5)
    return head | body | legs | _stroke(u, v, (0.0, 0.1), (0.65, 0.25), 0.1)


def _house(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    wall = (np.maximum(np.abs(u) / 0.8, np.abs(v) / 0.5) < 1) & (np.maximum(np.abs(u) / 0.55, np.abs(v) / 0.26) > 1)
    return wall & ~((np.abs(u) < 0.22) & (v < 0))


def _beetle(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    body = np.hypot(u / 0.42, (v + 0.15) / 0.55) < 1
    legs = (np.abs(np.abs(u) - 0.55) < 0.2) & (np.abs(np.abs(v + 0.1) - 0.35 - 0.4 * (np.abs(u) - 0.4)) < 0.09)
    return (body & (np.abs(u) > 0.05)) | legs | (np.hypot(u, v - 0.55) < 0.24)


_SIGNS: tuple[Sign, ...] = (
    _life, _bird, _water, _eye, _reed, _sun, _snake, _pillar, _basket, _seated, _house, _beetle
)  # fmt: skip
