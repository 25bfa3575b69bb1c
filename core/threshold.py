"""The attenuation that parts an object from the air around and in it."""

from __future__ import annotations

import numpy as np

_BINS = 512
# Below a level that parts air from one material lie half its surface's voxels and noise: up to half of all that is not
# air where walls are thin. Below one that parts two materials lies nearly all of the lighter one.
_MOST_BETWEEN = 0.65


def air_threshold(values: np.ndarray) -> float:
    """The value that parts air from the lightest material; infinity when all values are the same.

    Otsu's threshold (IEEE Trans. SMC 9(1), 1979) of a skull with a steel rod parts bone from steel. Where most of what
    is not air lies below the threshold, it parts materials, and the values below it are parted again. Values under 0
    count as 0: FDK undershoots beside edges.

    Args:
        values: attenuation of any shape; those that are not finite are left out.
    """
    from skimage.filters import threshold_otsu

    values = np.asarray(values)
    below = values = np.maximum(values[np.isfinite(values)], 0.0)
    threshold = np.inf
    while below.size and below.min() < below.max():
        lower = float(threshold_otsu(below, nbins=_BINS))
        between, not_air = np.count_nonzero(below >= lower), np.count_nonzero(values >= lower)
        if between < _MOST_BETWEEN * not_air and np.isfinite(threshold):
            break
        threshold, below = lower, values[values < lower]
    return threshold
