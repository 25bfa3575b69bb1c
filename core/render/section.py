"""`section`: differentiable plane cuts and slabs of a GaussianSet."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

from ..errors import SettingError
from ..gaussians import GaussianSet
from ..spherical_harmonics import C0
from ..views import Plane
from .card import on_card
from .radiograph import CUTOFF_SIGMAS, xray_density

if TYPE_CHECKING:
    import torch

QUANTITIES = ("density", "occupancy", "color")
_COLOR_SIGMAS = math.sqrt(2 * math.log(100))


def section(
    gaussians: GaussianSet,
    plane: Plane,
    quantity: str = "density",
    kernel: str = "cpu",
    cutoff_sigmas: float = CUTOFF_SIGMAS,
) -> torch.Tensor:
    """The exact cut of the model by a plane; with `plane.thickness_mm` its mean over the slab.

    With w(x) = exp(−½(x−μ)ᵀΣ⁻¹(x−μ)) at a pixel's point x, of a slab the mean of w along the normal (exact, by
    the normal distribution function):

    - "density": Σ ρ·w in mm⁻¹, clones left out as in `radiograph`.
    - "occupancy": 1 − Π(1 − o·w) in 0..1, whatever the order of the splats; o·w is kept ≤ 1 − 1e-6.
    - "color": Σ o·w·c / max(Σ o·w, 0.01) with the view-independent colour c = max(0, SH DC), linear 0..1;
      black where there is nothing.

    Args:
        gaussians: torch tensors. Gradients go to means, quats, scales and density, opacities or sh.
        plane: numpy vectors; u and v need not have the same length.
        kernel: "reference", "cpu" or "cuda" (needs the extra `cuda`).
        cutoff_sigmas: as in `radiograph`, for the `cpu` and `cuda` kernels. Colours are a quotient by 0.01 at least,
            so they take splats to where they are a hundredth of that: 6.1 standard deviations for 5.3.

    Returns:
        (height, width), for "color" (height, width, 3), of the type and on the device of the means.

    Raises:
        SettingError: unknown quantity or kernel, a plane without pixels, or a cutoff that is not positive.
    """
    if quantity not in QUANTITIES:
        raise SettingError(
            "quantity is {quantity}; choose one of {known}.", quantity=repr(quantity), known=", ".join(QUANTITIES)
        )
    if plane.width < 1 or plane.height < 1:
        raise SettingError(
            "A section of {width} x {height} pixels cannot be cut; use 1 or more.",
            width=plane.width,
            height=plane.height,
        )
    if not cutoff_sigmas > 0:
        raise SettingError("cutoff_sigmas is {sigmas}; give a number above 0.", sigmas=cutoff_sigmas)
    shape = (gaussians.means, gaussians.quats, gaussians.scales)
    if quantity == "color":
        cutoff_sigmas = math.hypot(cutoff_sigmas, _COLOR_SIGMAS)
    if kernel == "reference":
        import torch

        from .kernels.reference.section import LEAST_WEIGHT, occupancy_on_plane, sum_on_plane

        if quantity == "density":
            density = xray_density(gaussians)
            return sum_on_plane(*shape, density, torch.ones_like(density)[:, None], plane)[..., 0]
        if quantity == "occupancy":
            return occupancy_on_plane(*shape, gaussians.opacities, plane)
        colors = dc_colors(gaussians.sh)
        values = torch.cat([colors, torch.ones_like(colors[:, :1])], dim=-1)
        total = sum_on_plane(*shape, gaussians.opacities, values, plane)
        return total[..., :3] / total[..., 3:].clamp(min=LEAST_WEIGHT)
    if kernel == "cpu":
        from .kernels.cpu.section import cpu_color, cpu_density, cpu_occupancy

        if quantity == "density":
            return cpu_density(*shape, xray_density(gaussians), plane, cutoff_sigmas)
        if quantity == "occupancy":
            return cpu_occupancy(*shape, gaussians.opacities, plane, cutoff_sigmas)
        return cpu_color(*shape, gaussians.opacities, dc_colors(gaussians.sh), plane, cutoff_sigmas)
    if kernel == "cuda":
        from .kernels.cuda import section as cuda

        home, amount = gaussians.means.device, "density" if quantity == "density" else "opacities"
        drawn = replace(gaussians, density=xray_density(gaussians)) if quantity == "density" else gaussians
        drawn = on_card(drawn, "means", "quats", "scales", amount, *(["sh"] if quantity == "color" else []))
        shape = (drawn.means, drawn.quats, drawn.scales)
        if quantity == "density":
            return cuda.density_on_plane(*shape, drawn.density, plane, cutoff_sigmas).to(home)
        if quantity == "occupancy":
            return cuda.occupancy_on_plane(*shape, drawn.opacities, plane, cutoff_sigmas).to(home)
        return cuda.color_on_plane(*shape, drawn.opacities, dc_colors(drawn.sh), plane, cutoff_sigmas).to(home)
    raise SettingError("kernel is {kernel}; choose 'reference', 'cpu' or 'cuda'.", kernel=repr(kernel))


def dc_colors(sh: torch.Tensor) -> torch.Tensor:
    """(N, 3) view-independent colours, clipped at 0, of SH coefficients (N, K, 3)."""
    return (sh[:, 0] * C0 + 0.5).clamp(min=0)
