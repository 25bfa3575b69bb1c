"""What the renderers take, from raw parameters, and its gradient straight into the parameters' flat buffer."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..compiled import njit, prange
from ..threads import Alone, loops_only

# Splats a task works through.
_CHUNK = 2048
# Fewer coefficients are passed on before other threads are awake.
_FEW = 300_000
_NOTHING, _NO_BANDS = np.zeros(0, np.float32), np.zeros((0, 0, 3), np.float32)


def activate(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, sh_dc: Tensor, sh_rest: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Means (N, 3), quats (N, 4), scales (N, 3), opacities (N,) and colour coefficients (N, K, 3).

    Args:
        means, quats: passed on.
        scales, opacities, sh_dc, sh_rest: log scales, logits, and two parts of K.

    All are float32 on the processor. Those that require a gradient have a `grad`, to which the gradient is added in
    one pass; autograd alone would first make it and then add it.

    Raises:
        ValueError: one that requires a gradient has no `grad`.
    """
    for part in (means, quats, scales, opacities, sh_dc, sh_rest):
        if part.requires_grad and part.grad is None:
            raise ValueError("a raw parameter has lost its `grad`, a view of the flat buffer; set it to 0, not to None")
    return _Activation.apply(means, quats, scales, opacities, sh_dc, sh_rest)


class _Activation(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *raw: Tensor) -> tuple[Tensor, ...]:
        means, quats, *rows = raw
        arrays = [part.detach().numpy() for part in rows]
        count, bands = len(means), arrays[3].shape[1]
        scales, opacities = np.empty((count, 3), np.float32), np.empty(count, np.float32)
        sh = np.empty((count, 1 + bands, 3), np.float32)
        with Alone(sh.size < _FEW):
            activate_rows(*arrays, scales, opacities, sh)
        ctx.activated, ctx.gradients = (scales, opacities), [part.grad for part in raw]
        ctx.set_materialize_grads(False)
        results = (means.detach(), quats.detach(), *(torch.from_numpy(part) for part in (scales, opacities, sh)))
        trained = [part.requires_grad for part in raw]
        trained[4:] = [trained[4] or trained[5]]
        ctx.mark_non_differentiable(*(part for part, moves in zip(results, trained, strict=True) if not moves))
        return results

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> Any:  # type: ignore[override]
        *flat, to_sh = gradients
        *of_flat, of_dc, of_rest = ctx.gradients
        given, added = [], []
        for gradient, total in zip(flat, of_flat, strict=True):
            if gradient is None or total is None:
                pair = _NOTHING, _NOTHING
            else:
                pair = np.ascontiguousarray(gradient.numpy()).reshape(-1), total.numpy().reshape(-1)
            given.append(pair[0])
            added.append(pair[1])
        sh = _NO_BANDS if to_sh is None else np.ascontiguousarray(to_sh.numpy())
        parts = [_NO_BANDS if total is None or to_sh is None else total.numpy() for total in (of_dc, of_rest)]
        with Alone(sh.size < _FEW):
            add_gradients(*given, sh, *ctx.activated, *added, *parts)
        return (None,) * 6


# For exp: ln 2 in two parts, the first so short that whole numbers times it are exact (Cody and Waite), and the
# coefficients of Cephes' `expf`.
_LOG2_E, _LN2, _LN2_REST = np.float32(1.4426950408889634), np.float32(0.693359375), np.float32(-2.12194440e-4)
_ROUNDING = np.float32(1.5 * 2**23)
_MOST = np.float32(87.0)


@njit(fastmath={"contract"}, error_model="numpy", forceinline=True)
def exponential(x):  # type: ignore[no-untyped-def]
    """exp(x) of float32, relative error under 1e-7, as LLVM turns it into vector code; NaN gives NaN.

    2ⁿ·exp(r) with |r| ≤ ½ ln 2. x is kept within ±87, where n is an exponent of normal numbers.
    """
    x = _MOST if x > _MOST else x
    x = -_MOST if x < -_MOST else x
    # A number of the size of `_ROUNDING` has no places after the point, and n in its lowest bits.
    shifted = x * _LOG2_E + _ROUNDING
    n = shifted - _ROUNDING
    r = x - n * _LN2
    r = r - n * _LN2_REST
    p = np.float32(1.9875691500e-4)
    p = p * r + np.float32(1.3981999507e-3)
    p = p * r + np.float32(8.3334519073e-3)
    p = p * r + np.float32(4.1665795894e-2)
    p = p * r + np.float32(1.6666665459e-1)
    p = p * r + np.float32(5.0000001201e-1)
    p = p * (r * r) + r + np.float32(1.0)
    bits = np.int32((np.float32(shifted).view(np.int32) + np.int32(127)) << np.int32(23))
    return p * np.int32(bits).view(np.float32)


@njit(parallel=loops_only(), cache=True, error_model="numpy")
def activate_rows(log_scales, logits, first, rest, scales, opacities, whole):  # type: ignore[no-untyped-def]
    """Scales (N, 3), opacities (N,) and coefficients (N, K, 3) of what `activate` is given."""
    flat, flat_scales = log_scales.reshape(-1), scales.reshape(-1)
    size = np.uint64(3 * rest.shape[1])
    rows, tails = whole.reshape((len(whole), 3 * whole.shape[1])), rest.reshape((len(rest), 3 * rest.shape[1]))
    for chunk in prange((len(whole) + _CHUNK - 1) // _CHUNK):
        start, stop = np.uint64(chunk * _CHUNK), np.uint64(min((chunk + 1) * _CHUNK, len(whole)))
        for i in range(np.uint64(3) * start, np.uint64(3) * stop):
            flat_scales[i] = exponential(flat[i])
        for i in range(start, stop):
            opacities[i] = np.float32(1.0) / (np.float32(1.0) + exponential(-logits[i]))
        for i in range(start, stop):
            for c in range(3):
                whole[i, 0, c] = first[i, 0, c]
            for k in range(size):
                rows[i, k + np.uint64(3)] = tails[i, k]


@njit(parallel=loops_only(), cache=True, error_model="numpy")
def add_gradients(
    means, quats, scales, opacities, whole, now_scales, now_opacities, to_means, to_quats, to_scales, to_opacities,
    first, rest,
):  # type: ignore[no-untyped-def]  # fmt: skip
    """Adds gradients by what `activate` returns to those by what it is given; parts without numbers are left out.

    Args:
        means, quats, scales, opacities: flat; whole: (N, K, 3).
        now_scales, now_opacities: what `activate` returned.
        to_means, to_quats, to_scales, to_opacities, first, rest: added to; flat, (N, 1, 3) and (N, K − 1, 3).
    """
    count, factors = len(now_opacities), now_scales.reshape(-1)
    size = np.uint64(3 * rest.shape[1])
    rows, tails = whole.reshape((len(whole), 3 * whole.shape[1])), rest.reshape((len(rest), 3 * rest.shape[1]))
    for chunk in prange((count + _CHUNK - 1) // _CHUNK):
        start, stop = np.uint64(chunk * _CHUNK), np.uint64(min((chunk + 1) * _CHUNK, count))
        if len(to_means):
            for i in range(np.uint64(3) * start, np.uint64(3) * stop):
                to_means[i] += means[i]
        if len(to_quats):
            for i in range(np.uint64(4) * start, np.uint64(4) * stop):
                to_quats[i] += quats[i]
        if len(to_scales):
            for i in range(np.uint64(3) * start, np.uint64(3) * stop):
                to_scales[i] += scales[i] * factors[i]
        if len(to_opacities):
            for i in range(start, stop):
                to_opacities[i] += opacities[i] * (now_opacities[i] * (np.float32(1.0) - now_opacities[i]))
        for i in range(start, stop):
            if len(first):
                for c in range(3):
                    first[i, 0, c] += whole[i, 0, c]
            if len(rest):
                for k in range(size):
                    tails[i, k] += rows[i, k + np.uint64(3)]
