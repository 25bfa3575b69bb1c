"""Where a model disagrees with its projections, splat by splat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from ..capture.model import Projections
from ..gaussians import GaussianSet, Modality
from ..progress import Tick
from ..render import radiograph
from ..render.radiograph import xray_density
from .heldout import projection_peak

# More views, evenly taken, would change a residual by less than the noise of the projections does.
MOST_VIEWS = 64
_UNIT = "% of the largest line integral"


def splat_residuals(
    gaussians: GaussianSet,
    projections: Projections,
    kernel: str,
    tick: Tick,
    views: Sequence[int] | None = None,
) -> np.ndarray:
    """Mean absolute difference between measured and rendered line integrals on the rays through each splat.

    A radiograph is linear in the densities: the line integral along ray r is p_r = Σ_i w_ri ρ_i, where w_ri is that of
    splat i with density 1, in mm. With the measured m_r,

        residual_i = Σ_r w_ri |m_r − p_r| / Σ_r w_ri,

    over the rays of all views. Both sums are products with the transpose of w, that is gradients with respect to ρ, of
    Σ_r |m_r − p_r| p_r, its first factor held fast, and of Σ_r p_r: two backward passes a view, exact, whatever a
    renderer makes of w. It is the unfiltered back-projection of the differences, so an error in one place shows there
    most and fades along the rays around; noise of the projections is in it, too.

    All splats have one, those without density as well: it tells of their place. The rendering itself leaves clones
    out.

    Args:
        gaussians: numpy set in mm, N splats.
        tick: called between views; may raise to stop.
        views: indices of the projections; up to 64 of all, held-out ones among them, if None. Pixels that are not
            finite count for nothing.

    Returns:
        (N,) float32 in % of the largest line integral (`heldout.projection_peak`); NaN where no ray passes.
    """
    model = gaussians.to_torch()
    density = xray_density(model).detach().requires_grad_()
    # Of what does not attenuate the kernels leave out nothing then: its place has a residual, too.
    shapes = replace(model, density=density, modality=torch.full_like(model.modality, int(Modality.XRAY)))
    above, below = np.zeros(len(gaussians)), np.zeros(len(gaussians))
    for view in _spread(len(projections.images)) if views is None else views:
        tick()
        measured = torch.from_numpy(projections.images[view])
        known = torch.isfinite(measured)
        lines = radiograph(shapes, projections.detectors[view], kernel)
        apart = (measured - lines.detach()).abs()
        for total, weights in ((above, torch.where(known, apart, 0.0)), (below, known.to(lines.dtype))):
            (gradient,) = torch.autograd.grad(lines, density, weights.to(lines.dtype), retain_graph=True)
            total += gradient.double().numpy()
    seen = below > 0
    share = np.divide(above, below, out=np.full(len(below), np.nan), where=seen)
    return (100 * share / projection_peak(projections)).astype(np.float32)


def residual_figures(percent: np.ndarray, gaussians: GaussianSet) -> dict[str, Any]:
    """What a report tells: over the splats with density, each counting by its share of the attenuation.

    Returns:
        `mean`, `p95` (a twentieth of the attenuation has a larger one), `unit`.
    """
    known = np.isfinite(percent) & (gaussians.density > 0)
    if not known.any():
        return {"mean": None, "p95": None, "unit": _UNIT}
    values, weights = percent[known], gaussians.integrals()[known]
    order = np.argsort(values)
    share = np.cumsum(weights[order]) / weights.sum()
    return {
        "mean": float(np.average(values, weights=weights)),
        "p95": float(values[order[min(int(np.searchsorted(share, 0.95)), len(order) - 1)]]),
        "unit": _UNIT,
    }


def _spread(count: int) -> list[int]:
    """At most `MOST_VIEWS` of so many views at even steps."""
    return np.unique(np.linspace(0, count - 1, min(count, MOST_VIEWS)).round().astype(int)).tolist()
