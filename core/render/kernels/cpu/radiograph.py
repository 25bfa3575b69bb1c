"""`radiograph` on the CPU: projection, pixel loops and gradients in Numba behind one autograd function."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ....views import Detector
from ..reference.radiograph import detector_pixels, detector_tensors
from .bands import list_bands, padded_width
from .radiograph_geometry import AFFINE, CONE, PARALLEL, project
from .radiograph_raster import rasterize, rasterize_backward


def cpu_line_integrals(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    density: Tensor,
    detector: Detector,
    mode: str,
    cutoff_sigmas: float,
) -> Tensor:
    """(height, width) line integrals; see `core.render.radiograph`."""
    geometry = torch.zeros((), dtype=torch.float64)
    source, center, u, v = detector_tensors(detector, geometry)
    kind = PARALLEL if detector.parallel else AFFINE if mode == "affine" else CONE
    size = (detector.width, detector.height)
    image = _Rasterize.apply(means, quats, scales, density, source, center, u, v, size, kind, cutoff_sigmas)
    if kind == CONE:
        # The pixel loop works with rays of the pixels' own length; see `radiograph_geometry`.
        length = (detector_pixels(detector, center, u, v) - source).norm(dim=-1)
        image = image * length.reshape(image.shape).to(image.dtype)
    return image


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        density: Tensor,
        source: Tensor,
        center: Tensor,
        u: Tensor,
        v: Tensor,
        size: tuple[int, int],
        kind: int,
        cutoff_sigmas: float,
    ) -> Tensor:
        width, height = size
        k2 = float(cutoff_sigmas) ** 2
        splats = tuple(_array(value) for value in (means, quats, scales, density))
        view = np.stack([_array(value) for value in (source, center, u, v)])
        table, boxes = project(*splats, view, width, height, kind, k2, ctx.needs_input_grad[3])
        image = rasterize(table, *list_bands(boxes, height), k2, width, height, kind != CONE)
        ctx.kept = (*splats, view, table, boxes, k2, width, height, kind)
        ctx.dtypes = [value.dtype for value in (means, quats, scales, density, source, center, u, v)]
        return torch.from_numpy(np.ascontiguousarray(image[:, :width])).to(means.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Any, ...]:  # type: ignore[override]
        width, height = ctx.kept[8:10]
        padded = np.zeros((height, padded_width(width)), np.float32)
        padded[:, :width] = grad.detach().numpy()
        want_view = any(ctx.needs_input_grad[4:8])
        *of_splats, of_views = rasterize_backward(padded, *ctx.kept, want_view)
        of_view = of_views.sum(axis=0)
        grads = [
            torch.from_numpy(value).to(dtype) if needed else None
            for value, dtype, needed in zip([*of_splats, *of_view], ctx.dtypes, ctx.needs_input_grad[:8], strict=True)
        ]
        return (*grads, None, None, None)


def _array(value: Tensor) -> np.ndarray:
    return np.ascontiguousarray(value.detach().numpy(), np.float64)
