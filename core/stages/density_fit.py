"""All densities of a set by one factor, so that whole splats agree with the projections."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..capture.model import Projections
from ..gaussians import GaussianSet
from ..render import radiograph

_VIEWS = 8


def fit_to_projections(splats: GaussianSet, projections: Projections) -> tuple[GaussianSet, float]:
    """The splats with all densities times the one factor that fits the training projections best (least squares).

    The volume's own total will not do: an FDK without its negative values has too much (12 % on the sample, 24 % with
    the plain ramp), and the splats blur edges and fill streaks. A user's volume may be off by any factor.

    Returns:
        The set and the factor; 1 when the splats and the projections share nothing.
    """
    training = np.flatnonzero(~projections.held_out)
    some = training[np.unique(np.linspace(0, len(training), _VIEWS, endpoint=False).astype(int))]
    tensors = splats.to_torch()
    shown = np.stack([radiograph(tensors, projections.detectors[i]).numpy() for i in some]).astype(np.float64)
    factor = float((shown * projections.images[some]).sum() / max(float((shown**2).sum()), 1e-30))
    factor = factor if factor > 0 else 1.0
    return replace(splats, density=(factor * splats.density).astype(np.float32)), factor
