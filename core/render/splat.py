"""`splat`: a GaussianSet as a camera sees it, by front-to-back alpha blending."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ..errors import SettingError
from ..gaussians import GaussianSet
from ..views import Camera
from .card import on_card

PUBLISHED_LOW_PASS = 0.3
"""px², of 3DGS and of viewers of its files."""
# Less, and needles that no pixel's centre meets have no gradient; nor is more known to be of use.
_LEAST_LOW_PASS = 0.01


@dataclass(eq=False)
class SplatInfo:
    """What the renderer knows about each of the N splats; densification and pruning read it.

    Attributes:
        visible: (N,) bool tensor, drawn: beyond the near plane, opaque enough, and reaching into the image.
        radii_px: (N,) three standard deviations of the projected splat's longer axis in pixels; 0 if not visible.
        screen_grad: (N, 2) gradient of the loss with respect to the projected centres in pixels, 0 where not
            visible; None until `backward()` has run. 3DGS's threshold of 2e-4 is for normalised device
            coordinates: multiply by (width / 2, height / 2) to compare.
    """

    visible: Any
    radii_px: Any
    screen_grad: Any = None


@dataclass(frozen=True, eq=False)
class SplatImage:
    """A rendered photo.

    Attributes:
        color: (H, W, 3), linear, the background composited; ≥ 0 and not clipped above 1.
        alpha: (H, W) coverage in 0..1.
        depth: (H, W) mean camera z of what is seen, weighted by its share of the pixel; 0 where nothing is.
        info: per-splat by-products.
    """

    color: Any
    alpha: Any
    depth: Any
    info: SplatInfo


def splat(
    gaussians: GaussianSet,
    camera: Camera,
    background: Any = None,
    kernel: str = "cpu",
    sh_degree: int | None = None,
    masks: Any = None,
    pixel_integration: bool = False,
    low_pass: float = PUBLISHED_LOW_PASS,
    mip_filter: bool = False,
) -> SplatImage:
    """Renders `gaussians` as `camera` sees them; differentiable.

    3D Gaussian Splatting (Kerbl et al. 2023, arXiv 2308.04079): C = Σ cᵢ αᵢ Tᵢ from front to back with
    α = min(0.99, o·exp(−½ dᵀ Σ'⁻¹ d)) and Σ' = J W Σ Wᵀ Jᵀ + ε I (EWA, Zwicker et al. 2001); α under 1/255 is
    skipped and a pixel is finished before T would fall under 1e-4. Colours are max(0, SH(direction) + 0.5).
    Splats with a non-finite parameter are not drawn and get no gradient; a zero quaternion means no rotation.

    Args:
        gaussians: torch set. Gradients reach means, quats, scales, opacities and sh, and
            `camera.world_to_camera` when that is a tensor that requires them.
        camera: perspective or orthographic. In an orthographic view colours are looked up along the camera axis.
        background: (3,) linear colour, black if None; only "reference" leads a gradient back to it.
        kernel: "cpu" (Numba, float32), "cuda" (NVIDIA Warp, float32, on a card; needs the extra `cuda`; masks and
            pixel integration are left to "cpu") or "reference" (plain torch, dtype and device of `gaussians`). The
            image is on the device of `gaussians`, whichever drew it.
        sh_degree: highest degree of the colour functions to use; all that `gaussians` has if None.
        masks: (N,) tensor in 0..1 that every splat's α is multiplied by, none if None. A splat masked by 0 is not seen
            and still gets the gradient ∂C/∂m = α T (c − C_behind) (MaskGaussian, arXiv 2412.20522).
        pixel_integration: α is a splat's mean over the pixel instead of its value at the centre of it; no low-pass is
            added, and nothing becomes fainter (Analytic-Splatting, arXiv 2403.11056); see
            `kernels.reference.pixel_integral`.
        low_pass: ε above in px², 0.3 in 3DGS. It keeps splats from falling between pixels, and blurs what is finer: a
            pixel itself, a box of one by one, has a variance of 1/12.
        mip_filter: what the low-pass makes wider becomes fainter, o·√(|Σ' − εI| / |Σ'|) in place of o, so that a splat
            brings as much to an image however far away it is (the 2D filter of Mip-Splatting, arXiv 2311.16493); what
            has no width is not drawn. Without it a splat much smaller than a pixel is as bright as one of its size.

    Raises:
        SettingError: unknown kernel, an image without pixels, not as many masks as splats, or a low-pass that is not
            within 0.01 to 0.3.
    """
    if camera.width < 1 or camera.height < 1:
        raise SettingError(
            "An image of {width} x {height} pixels cannot be rendered; use 1 or more.",
            width=camera.width,
            height=camera.height,
        )
    if masks is not None and tuple(masks.shape) != (len(gaussians),):
        raise SettingError(
            "The masks are of shape {shape}; give one for each of {count} splats.",
            shape=tuple(masks.shape),
            count=len(gaussians),
        )
    if not _LEAST_LOW_PASS <= low_pass <= PUBLISHED_LOW_PASS:
        raise SettingError(
            "A low-pass of {low_pass:g} px² cannot be; choose {least:g} to {most:g}.",
            low_pass=low_pass,
            least=_LEAST_LOW_PASS,
            most=PUBLISHED_LOW_PASS,
        )
    degree = gaussians.sh_degree if sh_degree is None else max(0, min(sh_degree, gaussians.sh_degree))
    plain, options = masks is None and not pixel_integration, (low_pass, mip_filter)
    if kernel == "reference":
        from .kernels.reference.splat import render as render_reference

        return SplatImage(*render_reference(gaussians, camera, background, degree, masks, pixel_integration, *options))
    if kernel not in ("cpu", "cuda"):
        raise SettingError("There is no splat kernel '{kernel}'; choose cpu, cuda or reference.", kernel=kernel)
    if not plain:
        from .kernels.cpu.splat_effects import render as render_with_effects

        return SplatImage(
            *render_with_effects(gaussians, camera, background, degree, masks, pixel_integration, *options)
        )
    if kernel == "cpu":
        from .kernels.cpu.splat import render

        return SplatImage(*render(gaussians, camera, background, degree, *options))
    from .kernels.cuda.splat import render as render_on_card

    home, drawn = gaussians.means.device, on_card(gaussians, "means", "quats", "scales", "opacities", "sh")
    color, alpha, depth, info = render_on_card(drawn, camera, background, degree, *options)
    info.visible, info.radii_px = info.visible.to(home), info.radii_px.to(home)
    return SplatImage(color.to(home), alpha.to(home), depth.to(home), info)
