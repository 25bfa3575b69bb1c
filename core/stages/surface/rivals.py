"""Published ways of fitting splats to projections, as settings of the stages `initialize` and `surface`."""

from __future__ import annotations

from ...train.schedule import Decay
from ...train.strategy import DefaultStrategy
from ..initialize.stage import InitializeSettings
from .xray import XraySettings


def r2_gaussian(iterations: int = 30_000) -> tuple[InitializeSettings, XraySettings]:
    """R2-Gaussian (Zha et al. 2024, arXiv 2405.20693), its published numbers.

    R2-Gaussian works in a scene scaled so that the box's longest side is 2, on attenuations of about 1 at most, with
    line integrals in those units. Its numbers hold here because the same units are made elsewhere:

    - lengths: rates of means count in the box's longest half side, as do `clone_size` (a tenth of the whole side
      there, so 0.2); limits of scales in the whole side;
    - attenuation: raw densities, `prune_density` and the total variation are in the density unit, the
      larger attenuations of the first volume, where R2-Gaussian's volumes have their largest value 1;
    - line integrals: `full_scale="box"` divides them by density unit times half side before the loss, so that the
      threshold of 5e-5 on gradients in normalised device coordinates means the same.

    It differs in three points. Scales are clamped to their limits, not pressed between them by a sigmoid: far from
    the limits one step of Adam is the same. A splat ends 3 standard deviations from its centre along each of its
    axes, not 3 times the largest one all around. ITK-RTK's FDK with the plain ramp stands in for TIGRE's.

    Args:
        iterations: fewer than its 30,000 scale where densification ends, not its pause of 100 nor, up to a tenth of
            the iterations, the 500 before the first.
    """
    start = InitializeSettings(start="fdk", xray_splats=50_000, fdk_window="ramp", density_factor=0.15)
    strategy = DefaultStrategy(
        start=_first(iterations),
        stop=0.5,
        every=100,
        gradient=5e-5,
        clone_size=0.2,
        split="drawn",
        split_factor=1.6,
        prune_opacity=0.0,
        prune_density=1e-5,
        most=500_000,
        halve_density=True,
    )
    fit = XraySettings(
        model="additive",
        mode="affine",
        full_scale="box",
        iterations=iterations,
        structure_weight=0.25,
        smooth_weight=0.05,
        smooth_voxels=32,
        smooth_every=1,
        cutoff_sigmas=3.0,
        least_scale=0.0005,
        least_pixels=0.0,
        most_scale=0.5,
        means_rate=Decay(2e-4, 2e-5),
        density_rate=Decay(0.01, 0.001),
        scale_rate=Decay(0.005, 0.0005),
        rotation_rate=Decay(0.001, 0.0001),
        strategy=strategy,
    )
    return start, fit


def x_gaussian(iterations: int = 20_000) -> tuple[InitializeSettings, XraySettings]:
    """X-Gaussian (Cai et al. 2024, arXiv 2403.04116) with its numbers for the chest; see `.x_gaussian`.

    Its pruning by size on the screen (20 pixels) is left out, as in this project's 3DGS.

    Args:
        iterations: fewer than its 20,000 scale the end and the pause of the densification (200, not below 100) and
            the resets of opacity (4000), not, up to a tenth of the iterations, the 500 before the first.
    """
    share = iterations / 20_000
    strategy = DefaultStrategy(
        start=_first(iterations),
        stop=0.4,
        every=min(200, max(100, round(200 * share))),
        gradient=2.6e-5,
        clone_size=0.01,
        split="drawn",
        split_factor=1.6,
        prune_opacity=0.005,
        prune_size=0.1,
        reset_every=max(1, round(4000 * share)),
        reset_opacity=0.01,
    )
    fit = XraySettings(
        model="x_gaussian",
        iterations=iterations,
        structure_weight=0.2,
        means_rate=Decay(1.9e-4, 1.9e-6),
        scale_rate=Decay(0.005),
        rotation_rate=Decay(0.001),
        opacity_rate=0.008,
        intensity_rate=0.002,
        strategy=strategy,
    )
    return InitializeSettings(start="acui", acui_stride=8, acui_scale=1.0), fit


def _first(iterations: int) -> float:
    """Where densification starts, as a fraction: after 500 iterations, since splats far off would split all at once."""
    return min(500 / iterations, 0.1)
