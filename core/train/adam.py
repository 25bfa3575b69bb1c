"""Adam (Kingma and Ba, arXiv 1412.6980) in one pass over a flat buffer."""

from __future__ import annotations

import numpy as np

from ..compiled import njit, prange
from ..threads import loops_only

_CHUNK = 16384
_FAST = {"contract", "nsz", "arcp"}
# Under 1.2e-38 float32 has no full precision, and processors calculate several times slower. The moments of a parameter
# that has no gradient any more would fall to 5e-45 and stay there, for a tenth less is rounded to the same: one step on
# such parameters took 60 times as long. A gradient of 1e-18 moves a thousandth of the rate, beside an epsilon of
# 1e-15.
_LEAST_GRADIENT, _LEAST_FIRST, _LEAST_SECOND = np.float32(1e-18), np.float32(1e-30), np.float32(1e-36)


@njit(parallel=loops_only(), cache=True, fastmath=_FAST, error_model="numpy")
def adam_step(
    values, gradients, first, second, ends, rates, limits, step, beta1, beta2, epsilon
):  # type: ignore[no-untyped-def]  # fmt: skip
    """One step in place; the gradients are 0 afterwards.

    Gradients under 1e-18, first moments under 1e-30 and second ones under 1e-36 count as 0.

    Args:
        values, gradients, first, second: float32, all of one size; `first` and `second` are the moments.
        ends: (G,) int64, one past the last place of each group, rising to the size.
        rates: (G,) float64 learning rates; a group whose rate is 0 is left alone, moments and all.
        limits: (G, 2) float32 that values stay within.
        step: number of this step, from 1; corrects the moments' bias.
        epsilon: added to the root of the second moment.
    """
    keep1, keep2 = np.float32(beta1), np.float32(beta2)
    new1, new2 = np.float32(1 - beta1), np.float32(1 - beta2)
    unbias = np.float32(1 / (1 - beta2**step))
    small = np.float32(epsilon)
    # A gradient whose square is infinite would leave the second moment infinite and the parameter dead.
    largest = np.float32(1e18)
    for chunk in prange((values.size + _CHUNK - 1) // _CHUNK):
        begin, stop = chunk * _CHUNK, min((chunk + 1) * _CHUNK, values.size)
        for group in range(ends.size):
            scale = np.float32(rates[group] / (1 - beta1**step))
            low = max(begin, ends[group - 1] if group else 0)
            high = max(min(stop, ends[group]), low)
            least, most = limits[group, 0], limits[group, 1]
            if scale > 0:
                for i in range(np.uint64(low), np.uint64(high)):
                    gradient = min(max(gradients[i], -largest), largest)
                    gradient = np.float32(0.0) if abs(gradient) < _LEAST_GRADIENT else gradient
                    m = keep1 * first[i] + new1 * gradient
                    m = np.float32(0.0) if abs(m) < _LEAST_FIRST else m
                    v = keep2 * second[i] + new2 * gradient * gradient
                    v = np.float32(0.0) if v < _LEAST_SECOND else v
                    first[i] = m
                    second[i] = v
                    value = values[i] - scale * m / (np.sqrt(v * unbias) + small)
                    value = least if value < least else value
                    values[i] = most if value > most else value
                    # While it is in cache.
                    gradients[i] = np.float32(0.0)
            else:
                gradients[low:high] = np.float32(0.0)


@njit(parallel=loops_only(), cache=True, fastmath={"reassoc", "nsz"}, error_model="numpy")
def all_finite(values):  # type: ignore[no-untyped-def]
    """Whether no float32 of `values` is NaN or infinite."""
    chunks = (values.size + _CHUNK - 1) // _CHUNK
    spoilt = np.zeros(chunks, np.float32)
    for chunk in prange(chunks):
        total = np.float32(0.0)
        for i in range(np.uint64(chunk * _CHUNK), np.uint64(min((chunk + 1) * _CHUNK, values.size))):
            # 0 for a number, NaN for anything else.
            total += np.float32(0.0) * values[i]
        spoilt[chunk] = total
    return not np.isnan(spoilt.sum())
