"""A short fit to projections, for what has to be told from one before the model is made; that has nothing of it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ..capture.model import Projections
from ..progress import Progress
from ..render.kernels.cpu import announce
from ..threshold import large_attenuation
from ..volume import Volume
from .context import StageContext
from .density_fit import fit_to_projections
from .initialize.xray import first_splats
from .surface.stage import PRESETS
from .surface.xray import XraySettings, XrayTrainer

if TYPE_CHECKING:
    from ..effects.ring_offsets import RingOffsets

FIRST_SPLATS, MOST_SPLATS = 2500, 8000
"""Of a fit, at the beginning and in the end."""
# Of the total variation with which it was measured what trials differ by anyway (`.effect_gains`).
_SMOOTH_WEIGHT = 0.01


def short_settings(iterations: int, most_splats: int = MOST_SPLATS) -> XraySettings:
    """Those of `draft`, with fewer splats, and edges smoothed as all else."""
    draft = PRESETS["draft"].xray
    fewer = replace(draft.strategy, most=most_splats)
    return replace(draft, iterations=iterations, strategy=fewer, smooth_weight=_SMOOTH_WEIGHT, smooth_edge=None)


def short_trainer(
    context: StageContext,
    projections: Projections,
    reconstructed: Volume,
    settings: XraySettings,
    here: Progress,
    offsets: RingOffsets | None = None,
) -> XrayTrainer:
    """A trainer that starts from an FDK, coarsely.

    Args:
        projections: those that are not held out are trained on.
        reconstructed: of these; negative values are cut.
        here: where the run is; kernels that have to be compiled first are announced there.
        offsets: see `XrayTrainer`.
    """
    volume = Volume(np.maximum(reconstructed.values, 0.0), reconstructed.spacing_mm, reconstructed.origin_mm)
    announce(context.reporter, here, context.compiled("radiograph"))
    # Cells follow from their number; the stride is that of another start.
    start, _ = fit_to_projections(first_splats(volume, "coarse", FIRST_SPLATS, 1, context.seed), projections)
    voxel_mm, unit = float(np.mean(volume.spacing_mm)), max(large_attenuation(volume.values), 1e-9)
    return XrayTrainer(start, projections, voxel_mm, unit, settings, context.seed, context.kernel, offsets)
