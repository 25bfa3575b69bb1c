"""`radiograph`: differentiable X-ray projections of a GaussianSet."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from ..errors import SettingError
from ..gaussians import GaussianSet, Modality
from ..views import Detector
from .card import on_card

if TYPE_CHECKING:
    import torch

CUTOFF_SIGMAS = 5.3
"""Where the `cpu` and `cuda` kernels end a splat: exp(−5.3²/2) = 8e-7 of its peak."""


def radiograph(
    gaussians: GaussianSet,
    detector: Detector,
    kernel: str = "cpu",
    mode: str = "exact",
    cutoff_sigmas: float = CUTOFF_SIGMAS,
) -> torch.Tensor:
    """Line integrals of the attenuation Σ ρ·exp(−½(x−μ)ᵀΣ⁻¹(x−μ)) along the rays of all pixels.

    "exact" is the closed form on every ray: with e = S⁻¹Rᵀd, f = S⁻¹Rᵀ(μ − o), unit direction d, a ray gets
    ρ·√(2π)/‖e‖·exp(−½‖f × e‖²/‖e‖²). The line is infinite: what lies behind the source or the detector counts.
    "affine" is R2-Gaussian's approximation (arXiv 2405.20693): the projection is linearised at each centre, and
    splats behind the source are left out. For parallel beams both are the same.

    Splats of modality CLONE are left out: their attenuation is already there in what they were cloned from.

    Args:
        gaussians: torch tensors. Gradients go to means, quats, scales and density.
        detector: vectors that are torch tensors requiring a gradient (source, center, u, v) get one.
        kernel: "reference" (every splat on every ray, any device and dtype), "cpu" (Numba, float32 pixels) or
            "cuda" (NVIDIA Warp, float32 pixels, on a card; needs the extra `cuda`).
        mode: "exact" or "affine".
        cutoff_sigmas: the `cpu` and `cuda` kernels leave out what lies further than this from a centre. The error is
            at most exp(−cutoff²/2) of a splat's peak: 8e-7 at the default 5.3, 3e-4 at 4, 1.1e-2 at R2-Gaussian's 3;
            the time goes with the square of it.

    Returns:
        (height, width) line integrals without a unit (mm⁻¹ · mm), of the type and on the device of the means.

    Raises:
        SettingError: unknown kernel or mode, a detector without pixels, or a cutoff that is not positive.
    """
    if mode not in ("exact", "affine"):
        raise SettingError("mode is {mode}; choose 'exact' or 'affine'.", mode=repr(mode))
    if detector.width < 1 or detector.height < 1:
        raise SettingError(
            "A detector of {width} x {height} pixels has no projection; use 1 or more.",
            width=detector.width,
            height=detector.height,
        )
    if not cutoff_sigmas > 0:
        raise SettingError("cutoff_sigmas is {sigmas}; give a number above 0.", sigmas=cutoff_sigmas)
    density = xray_density(gaussians)
    if kernel == "reference":
        from .kernels.reference.radiograph import line_integrals

        return line_integrals(gaussians.means, gaussians.quats, gaussians.scales, density, detector, mode)
    if kernel == "cpu":
        from .kernels.cpu.radiograph import cpu_line_integrals

        return cpu_line_integrals(
            gaussians.means, gaussians.quats, gaussians.scales, density, detector, mode, cutoff_sigmas
        )
    if kernel == "cuda":
        from .kernels.cuda.radiograph import line_integrals as cuda_line_integrals

        drawn = on_card(replace(gaussians, density=density), "means", "quats", "scales", "density")
        image = cuda_line_integrals(
            drawn.means, drawn.quats, drawn.scales, drawn.density, detector, mode, cutoff_sigmas
        )
        return image.to(density.device)
    raise SettingError("kernel is {kernel}; choose 'reference', 'cpu' or 'cuda'.", kernel=repr(kernel))


def xray_density(gaussians: GaussianSet) -> Any:
    """`density` (N,) with 0 for clones, whose attenuation would count twice; numpy or torch as it comes."""
    clones = gaussians.modality == int(Modality.CLONE)
    return gaussians.density * ~clones if clones.any() else gaussians.density
