"""What the renderers take, from raw parameters, and its gradient straight into the parameters' flat buffer."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..threads import loops_only

# Splats a task copies.
_CHUNK = 2048


def activate(scales: Tensor, opacities: Tensor, sh_dc: Tensor, sh_rest: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Scales (N, 3), opacities (N,) and colour coefficients (N, K, 3) of log scales, logits, and two parts of K.

    Args:
        scales, opacities, sh_dc, sh_rest: float32 on the processor. Those that require a gradient have a `grad`, to
            which the gradient is added in one pass; autograd alone would first make it and then add it.
    """
    return _Activation.apply(scales, opacities, sh_dc, sh_rest)


class _Activation(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, scales: Tensor, opacities: Tensor, sh_dc: Tensor, sh_rest: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        sh = np.empty((len(sh_dc), 1 + sh_rest.shape[1], 3), np.float32)
        join_coefficients(sh_dc.detach().numpy(), sh_rest.detach().numpy(), sh)
        activated = scales.exp(), torch.sigmoid(opacities)
        ctx.gradients = [raw.grad for raw in (scales, opacities, sh_dc, sh_rest)]
        ctx.save_for_backward(*activated)
        ctx.set_materialize_grads(False)
        return *activated, torch.from_numpy(sh)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, to_scales: Tensor | None, to_opacities: Tensor | None, to_sh: Tensor | None) -> Any:  # type: ignore[override]
        scales, opacities = ctx.saved_tensors
        of_scales, of_opacities, of_dc, of_rest = ctx.gradients
        if to_scales is not None and of_scales is not None:
            of_scales.addcmul_(to_scales, scales)
        if to_opacities is not None and of_opacities is not None:
            of_opacities.addcmul_(to_opacities, opacities * (1 - opacities))
        if to_sh is not None:
            nothing = np.zeros((0, 0, 3), np.float32)
            parts = (nothing if part is None else part.numpy() for part in (of_dc, of_rest))
            add_coefficients(np.ascontiguousarray(to_sh.numpy()), *parts)
        return None, None, None, None


@numba.njit(parallel=loops_only(), cache=True)
def join_coefficients(first, rest, whole):  # type: ignore[no-untyped-def]
    """Coefficients (N, 1, 3) and (N, K − 1, 3) side by side."""
    for chunk in numba.prange((len(whole) + _CHUNK - 1) // _CHUNK):
        for i in range(np.uint64(chunk * _CHUNK), np.uint64(min((chunk + 1) * _CHUNK, len(whole)))):
            for c in range(3):
                whole[i, 0, c] = first[i, 0, c]
            for band in range(np.uint64(rest.shape[1])):
                for c in range(3):
                    whole[i, band + np.uint64(1), c] = rest[i, band, c]


@numba.njit(parallel=loops_only(), cache=True)
def add_coefficients(whole, first, rest):  # type: ignore[no-untyped-def]
    """Adds coefficients (N, K, 3) to their parts (N, 1, 3) and (N, K − 1, 3); a part without rows is left out."""
    for chunk in numba.prange((len(whole) + _CHUNK - 1) // _CHUNK):
        for i in range(np.uint64(chunk * _CHUNK), np.uint64(min((chunk + 1) * _CHUNK, len(whole)))):
            if len(first):
                for c in range(3):
                    first[i, 0, c] += whole[i, 0, c]
            if len(rest):
                for band in range(np.uint64(rest.shape[1])):
                    for c in range(3):
                        rest[i, band, c] += whole[i, band + np.uint64(1), c]
