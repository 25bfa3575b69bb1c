"""Adam (Kingma and Ba, arXiv 1412.6980) in one pass over a flat buffer."""

from __future__ import annotations

import numba
import numpy as np


@numba.njit(parallel=True, cache=True, fastmath={"contract", "nsz", "arcp"}, error_model="numpy")
def adam_step(values, gradients, first, second, rate, step, beta1, beta2, epsilon):  # type: ignore[no-untyped-def]
    """One step in place.

    Args:
        values, gradients, first, second: float32, all of one size; `first` and `second` are the moments.
        rate: learning rate.
        step: number of this step, from 1; corrects the moments' bias.
        epsilon: added to the root of the second moment.
    """
    keep1, keep2 = np.float32(beta1), np.float32(beta2)
    new1, new2 = np.float32(1 - beta1), np.float32(1 - beta2)
    scale = np.float32(rate / (1 - beta1**step))
    unbias = np.float32(1 / (1 - beta2**step))
    small = np.float32(epsilon)
    for i in numba.prange(values.size):
        gradient = gradients[i]
        m = keep1 * first[i] + new1 * gradient
        v = keep2 * second[i] + new2 * gradient * gradient
        first[i] = m
        second[i] = v
        values[i] -= scale * m / (np.sqrt(v * unbias) + small)
