"""A room behind the object: a texture that stands still in the image."""

from __future__ import annotations

import numpy as np

_MIDDLE = (0.52, 0.50, 0.46)
# How much of a channel's contrast is its own; the rest all three share.
_OWN = 0.35


def room(width: int, height: int, contrast: float, rng: np.random.Generator) -> np.ndarray:
    """(height, width, 3) sRGB float32 in 0..1: random patterns of all sizes, with amplitudes of 1 / f as in photographs
    (Field, JOSA A 4(12), 1987).

    Args:
        contrast: standard deviation of each channel.
    """
    frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)[None])
    frequency[0, 0] = np.inf
    patterns = []
    for _ in range(4):
        wave = np.fft.rfft2(rng.standard_normal((height, width))) / frequency
        pattern = np.fft.irfft2(wave, s=(height, width))
        patterns.append(pattern / max(float(pattern.std()), 1e-9))
    shared, own = patterns[0], np.stack(patterns[1:], axis=-1)
    mixed = np.sqrt(1 - _OWN**2) * shared[..., None] + _OWN * own
    return np.clip(np.asarray(_MIDDLE) + contrast * mixed, 0, 1).astype(np.float32)
