"""The attenuation that parts an object from the air around and in it. Numpy alone."""

from __future__ import annotations

import numpy as np

_BINS, _MOST_LOOKED_AT = 512, 50_000_000
# Share of what is not air that lies below a threshold. Below one between air and a material lie half its surface's
# voxels and noise, up to 0.51 of all where walls are thin; below one between two materials lies the lighter one, 0.60
# of all and more. Where the share alone does not tell, material has an attenuation that is frequent, surfaces have not.
_PERHAPS_MATERIAL, _HUMP = 0.4, 1.3
# The noise of much air beside a small object has any share, but ends: 0.01 of what Otsu parts from the rest of it is
# over four times as large. Thin plastic beside metal has no frequent attenuation; 0.03 to 0.05 of it is.
_SURELY_MATERIAL, _TAIL = 0.75, 0.025
# The lightest material over a threshold: 1.7 times as many values per mm⁻¹ within 15 % of it as under it, and 0.03 of
# what is not air. Surfaces alone have up to 1.5 times as many; walls of half a voxel 1.9, as if they were a material.
# Half of it is a threshold where values are as rare as just under it, or else it is in the noise of air.
_WIDTH, _STANDS_OUT, _LEAST_SHARE, _AS_RARE = 0.15, 1.7, 0.03, 1.25


def evenly(values: np.ndarray) -> np.ndarray:
    """The values (N,), of more than 50 million every second, third, ..."""
    flat = np.asarray(values).reshape(-1)
    return flat[:: max(1, -(-flat.size // _MOST_LOOKED_AT))]


def large_attenuation(values: np.ndarray) -> float:
    """The size of an object's larger attenuations, > 0: the 99.9th percentile of a volume, which leaves out FDK's
    outliers, or of a thin rod in a large box, which is less of it than that, the median of what is not air.

    Of a large volume some voxels are looked at, see `evenly`.
    """
    values = evenly(values)
    solid = values[values > air_threshold(values)]
    return max(float(np.percentile(values, 99.9)), float(np.median(solid)) if solid.size else 0.0, 1e-12)


def air_threshold(values: np.ndarray) -> float:
    """The value that parts air from the lightest material; infinity when all values are the same.

    Otsu's threshold (IEEE Trans. SMC 9(1), 1979) of a skull with a steel rod parts bone from steel. Where most of what
    is not air lies below the threshold, it parts materials, and the values below it are parted again. What is then
    more than half the lightest material is lowered to half of it: Otsu's threshold of bone and a little marrow lies a
    hair below the marrow, and noise in it would be caves. Values under 0 count as 0: FDK undershoots beside edges.

    Args:
        values: attenuation of any shape; those that are not finite are left out.
    """
    values = np.asarray(values)
    below = values = np.maximum(values[np.isfinite(values)], 0.0)
    threshold = np.inf
    while below.size and below.min() < below.max():
        lower = _otsu(below)
        if np.isfinite(threshold) and not _parts_materials(values, below, lower):
            break
        threshold, below = lower, values[values < lower]
    return min(threshold, _half_of_lightest(values, threshold)) if np.isfinite(threshold) else threshold


def _otsu(values: np.ndarray) -> float:
    """Otsu's threshold; half way where no value lies near it, for any in that gap would do."""
    if np.ptp(values) < 2 * _BINS * np.spacing(values.max()):
        # Bins' edges have the values' precision, and numpy 2 makes none that it does not tell apart.
        values = values.astype(np.float64)
    counts, edges = np.histogram(values, _BINS)
    centers = 0.5 * (edges[:-1] + edges[1:])
    # Both ends of the histogram hold values, so neither class is ever empty.
    below, above = np.cumsum(counts), np.cumsum(counts[::-1])[::-1]
    moment = counts * centers
    mean_below, mean_above = np.cumsum(moment) / below, np.cumsum(moment[::-1])[::-1] / above
    between = below[:-1].astype(np.float64) * above[1:] * (mean_below[:-1] - mean_above[1:]) ** 2
    threshold = float(centers[int(between.argmax())])
    under, over = values[values <= threshold], values[values > threshold]
    # Values that differ in their last bit only may all lie on one side.
    return 0.5 * (float(under.max(initial=values.min())) + float(over.min(initial=values.max())))


def _parts_materials(values: np.ndarray, below: np.ndarray, lower: float) -> bool:
    """Whether the values `below` a threshold, themselves parted at `lower`, hold a material and not air alone."""
    above = below[below >= lower]
    share = len(above) / np.count_nonzero(values >= lower)
    if share > _PERHAPS_MATERIAL and _hump(below, lower) > _HUMP:
        return True
    return share > _SURELY_MATERIAL and float(np.mean(above >= 4 * lower)) > _TAIL


def _half_of_lightest(values: np.ndarray, threshold: float) -> float:
    """Half of the lightest material over a threshold; infinity where none stands out, or noise is there."""
    counts, edges = np.histogram(values, 4 * _BINS, (0.25 * threshold, 2.25 * threshold))
    below = np.concatenate([[0], np.cumsum(counts)])
    # Half of a material at 1.5 to 2.5 times the threshold is near enough to it: nothing to mend.
    materials = threshold * np.linspace(1.0, 1.45, 31)

    def between(low: float, high: float) -> np.ndarray:
        """How many values lie between these multiples of each material, per multiple."""
        return (np.interp(high * materials, edges, below) - np.interp(low * materials, edges, below)) / (high - low)

    at, under = between(1 - _WIDTH, 1 + _WIDTH), between(0.5, 1 - _WIDTH)
    ratio = at / np.maximum(under, 1)
    best = int(ratio.argmax())
    share = 2 * _WIDTH * at[best] / np.count_nonzero(values >= threshold)
    noise = between(0.45, 0.55)[best] / max(under[best], 1)
    if best == len(materials) - 1 or ratio[best] < _STANDS_OUT or share < _LEAST_SHARE or noise > _AS_RARE:
        return np.inf
    return 0.5 * float(materials[best])


def _hump(values: np.ndarray, threshold: float) -> float:
    """How many times more frequent some values about and above a threshold are than values under them."""
    top = min(float(values.max()), 4 * threshold)
    counts = np.maximum(np.histogram(values, 16, (0.5 * threshold, top))[0], 1)
    return float((counts[1:] / np.minimum.accumulate(counts)[:-1]).max())
