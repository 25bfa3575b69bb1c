"""The splat renderer in plain torch: the truth the fast kernels are tested against, on any device and dtype.

Pixels are in the dtype of the set, the geometry of splats always in float64: a float32 covariance overflows for
scales of 1e15 and a float32 pose loses what coordinates of 1e6 mm cancel against.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ....gaussians import GaussianSet
from ....rotations import quats_to_matrices
from ....spherical_harmonics import C0, C1, C2, C3
from ....views import Camera
from ...splat import PUBLISHED_LOW_PASS, SplatInfo
from . import pixel_integral

ALPHA_MAX = 0.99
ALPHA_MIN = 1.0 / 255.0
TRANSMITTANCE_MIN = 1e-4
QUAT_MIN = 1e-12

# Splats times pixels blended at once: bounds the memory of a dense (splats, pixels) block to tens of MB.
_BLOCK = 1 << 21


@dataclass(frozen=True)
class Projected:
    """The drawable splats on the screen, nearest first.

    Attributes:
        index: (M,) rows of the set.
        centers: (M, 2) pixels.
        factors: (M, 3) l1, k, l2 of the upper triangular B = [[l1, k], [0, l2]] with BᵀB = Σ'⁻¹.
        cov: (M, 4) Σ' as xx, xy, yy in squared pixels, and its determinant.
        z: (M,) camera z.
        integral: (M, 4) of `pixel_integral.integral`; None where α is taken at pixel centres.
        shares: (M,) of their opacities that they are drawn with; None for all.
    """

    index: Tensor
    centers: Tensor
    factors: Tensor
    cov: Tensor
    z: Tensor
    integral: Tensor | None = None
    shares: Tensor | None = None

    def drawn(self, opacities: Tensor) -> Tensor:
        """The opacities that splats (M,) are drawn with."""
        return opacities if self.shares is None else opacities * self.shares.to(opacities)


def render(
    gaussians: GaussianSet,
    camera: Camera,
    background: Any,
    degree: int,
    masks: Tensor | None = None,
    pixel_integration: bool = False,
    low_pass: float = PUBLISHED_LOW_PASS,
    mip_filter: bool = False,
) -> tuple[Tensor, Tensor, Tensor, SplatInfo]:
    """Colour (H, W, 3), alpha (H, W), depth (H, W) and info; see `core.render.splat`."""
    gaussians = replace(gaussians, sh=gaussians.sh[:, : (degree + 1) ** 2])
    like = gaussians.means
    pose = torch.as_tensor(camera.world_to_camera).to(like.device, torch.float64)
    projected = project(gaussians, camera, pose, pixel_integration, low_pass, mip_filter)
    chosen = projected.index
    colors = view_colors(gaussians.means[chosen].double(), gaussians.sh[chosen].double(), camera, pose, degree).to(like)
    opacities = projected.drawn(gaussians.opacities[chosen])

    info = _info(projected, opacities, camera, len(gaussians))
    if projected.centers.requires_grad:
        projected.centers.register_hook(lambda grad: _keep_screen_grad(info, chosen, grad))

    # The last feature counts what is covered: one less what is left has no digits where a pixel is faint.
    features = torch.cat([colors, projected.z[:, None].to(like), torch.ones_like(colors[:, :1])], dim=1)
    ys, xs = torch.meshgrid(
        torch.arange(camera.height, device=like.device, dtype=like.dtype) + 0.5,
        torch.arange(camera.width, device=like.device, dtype=like.dtype) + 0.5,
        indexing="ij",
    )
    pixels = torch.stack([xs.reshape(-1), ys.reshape(-1)], dim=1)
    block = max(1, _BLOCK // max(1, len(chosen)))
    kept = None if masks is None else masks.to(like)[chosen]
    parts = [blend(projected, opacities, features, part, kept) for part in pixels.split(block)]
    blended = torch.cat(parts).reshape(camera.height, camera.width, 5)

    alpha = blended[..., 4]
    back = torch.zeros(3) if background is None else torch.as_tensor(background)
    color = blended[..., :3] + (1 - alpha[..., None]) * back.to(like)
    depth = torch.where(alpha > 0, blended[..., 3] / torch.where(alpha > 0, alpha, 1.0), 0.0)
    return color, alpha, depth, info


def project(
    gaussians: GaussianSet,
    camera: Camera,
    pose: Tensor,
    pixel_integration: bool = False,
    low_pass: float = PUBLISHED_LOW_PASS,
    mip_filter: bool = False,
) -> Projected:
    """Screen centres and covariances by the local affine approximation (EWA; 3DGS eq. 5)."""
    low_pass, mip_filter = (0.0, False) if pixel_integration else (low_pass, mip_filter)
    with torch.no_grad():
        z = gaussians.means.double() @ pose[2, :3] + pose[2, 3]
        drawable = _finite_rows(gaussians) & (z > camera.near) & (gaussians.opacities >= ALPHA_MIN)
        index = torch.nonzero(drawable).squeeze(1)
        index = index[torch.argsort(z[index], stable=True)]
        trial = _project_rows(gaussians, camera, pose, index, low_pass, mip_filter)
        numbers = torch.cat([trial.centers, trial.factors, trial.cov], dim=1)
        usable = torch.isfinite(numbers).all(1)
        if pixel_integration:
            integral = pixel_integral.integral(trial.cov)
            usable &= pixel_integral.largest(integral, gaussians.opacities[index].double()) >= ALPHA_MIN
        usable &= trial.drawn(gaussians.opacities[index].double()) >= ALPHA_MIN
    projected = _project_rows(gaussians, camera, pose, index[usable], low_pass, mip_filter)
    return replace(projected, integral=pixel_integral.integral(projected.cov)) if pixel_integration else projected


def _project_rows(
    gaussians: GaussianSet, camera: Camera, pose: Tensor, index: Tensor, low_pass: float, mip_filter: bool
) -> Projected:
    local = gaussians.means[index].double() @ pose[:3, :3].T + pose[:3, 3]
    centers, jacobian = _screen(local, camera)
    axes = jacobian @ pose[:3, :3] @ quats_to_matrices(_unit_quats(gaussians.quats[index].double()))
    scales = gaussians.scales[index].double()
    spread = axes * scales[:, None, :]
    xx = spread[:, 0].square().sum(1) + low_pass
    yy = spread[:, 1].square().sum(1) + low_pass
    xy = (spread[:, 0] * spread[:, 1]).sum(1)
    slope, variance = _Regression.apply(axes, scales, low_pass)
    # det(M Mᵀ + εI) by Cauchy-Binet: a sum of squares, where xx·yy − xy² of a needle is lost to rounding.
    minors = torch.linalg.cross(axes[:, 0], axes[:, 1], dim=1) * scales[:, [1, 0, 0]] * scales[:, [2, 2, 1]]
    narrow = minors.square().sum(1)
    det = narrow + low_pass * (xx + yy - low_pass)
    shares = torch.sqrt(narrow / det) if mip_filter else None
    l1 = variance.rsqrt()
    factors = torch.stack([l1, -l1 * slope, yy.rsqrt()], dim=1)
    cov = torch.stack([xx, xy, yy, det], dim=1)
    return Projected(index, centers, factors, cov, local[:, 2], shares=shares)


class _Regression(torch.autograd.Function):
    """The slope t = Σ'_xy / Σ'_yy (M,) of x on y, and the variance Σ'_xx − t·Σ'_xy (M,) of x that it leaves.

    Of axes (M, 2, 3) x_j, y_j with scales (M, 3) s_j, and a low pass ε. With ρ_j = x_j − t·y_j the variance is
    Σ s_j²ρ_j² + ε(1 + t²), of which t is the minimum: it moves the variance by nothing. Where one scale is far larger
    than the others its ρ_j vanishes, and what the scale does to either is a product with ρ_j. A derivative of the
    usual expressions takes a difference there that has no digits: from a length of 1e6 on a needle's own was lost. So
    ρ_j is a sum of minors of the axes, and the derivatives are written out.
    """

    @staticmethod
    def forward(ctx: Any, axes: Tensor, scales: Tensor, low_pass: float) -> tuple[Tensor, Tensor]:
        x, y = axes.unbind(1)
        squared = scales.square()
        yy = (squared * y * y).sum(1) + low_pass
        slope = (squared * x * y).sum(1) / yy
        minors = x[:, :, None] * y[:, None, :] - y[:, :, None] * x[:, None, :]
        rest = ((minors * (squared * y)[:, None, :]).sum(2) + low_pass * x) / yy[:, None]
        ctx.save_for_backward(y, scales, yy, slope, rest)
        return slope, (scales * rest).square().sum(1) + low_pass * (1 + slope.square())

    @staticmethod
    def backward(ctx: Any, by_slope: Tensor, by_variance: Tensor) -> tuple[Tensor, Tensor, None]:  # type: ignore[override]
        y, scales, yy, slope, rest = ctx.saved_tensors
        slope, by_slope, by_variance = slope[:, None], (by_slope / yy)[:, None], by_variance[:, None]
        squared = scales.square()
        by_x = squared * (2 * by_variance * rest + by_slope * y)
        by_y = squared * (by_slope * (rest - slope * y) - 2 * by_variance * rest * slope)
        by_scales = 2 * scales * rest * (by_variance * rest + by_slope * y)
        return torch.stack([by_x, by_y], dim=1), by_scales, None


def view_colors(means: Tensor, sh: Tensor, camera: Camera, pose: Tensor, degree: int) -> Tensor:
    """(M, 3) colours max(0, SH + 0.5) in the direction from the camera to each splat."""
    if camera.orthographic:
        directions = pose[2, :3].expand_as(means)
    else:
        directions = means + pose[:3, 3] @ pose[:3, :3]
    directions = directions / directions.norm(dim=1, keepdim=True).clamp_min(QUAT_MIN)
    basis = sh_basis(directions, degree)
    return ((basis[:, :, None] * sh[:, : basis.shape[1]]).sum(1) + 0.5).clamp_min(0)


def blend(
    projected: Projected, opacities: Tensor, features: Tensor, pixels: Tensor, masks: Tensor | None = None
) -> Tensor:
    """Σ fᵢ mᵢ αᵢ Tᵢ (P, F) at pixel centres (P, 2); mᵢ of `masks` (M,), else 1."""
    offset = pixels[None] - projected.centers[:, None].to(pixels)
    if projected.integral is None:
        l1, k, l2 = (factor[:, None] for factor in projected.factors.to(pixels).unbind(1))
        u = l1 * offset[..., 0] + k * offset[..., 1]
        v = l2 * offset[..., 1]
        share = torch.exp(-0.5 * (u * u + v * v))
    else:
        inverse_y, inverse_x, k, ratio = (number[:, None] for number in projected.integral.to(pixels).unbind(1))
        share = ratio * pixel_integral.window(offset[..., 1], inverse_y)
        share = share * pixel_integral.window(offset[..., 0] - k * offset[..., 1], inverse_x)
    alpha = (opacities[:, None] * share).clamp(max=ALPHA_MAX)
    alpha = torch.where(alpha >= ALPHA_MIN, alpha, 0.0)
    if masks is not None:
        alpha = masks[:, None] * alpha
    # Without the stop T only falls, so "the splat would take T under the limit" holds for it and all behind it.
    alpha = torch.where(torch.cumprod(1 - alpha, dim=0) >= TRANSMITTANCE_MIN, alpha, 0.0)
    through = torch.cumprod(1 - alpha, dim=0)
    before = torch.cat([torch.ones_like(through[:1]), through[:-1]])
    return (alpha * before).T @ features


def sh_basis(directions: Tensor, degree: int) -> Tensor:
    """`core.spherical_harmonics.sh_basis` for torch: (N, (degree + 1)²) at unit directions (N, 3)."""
    x, y, z = directions.unbind(1)
    columns = [torch.full_like(x, C0)]
    if degree >= 1:
        columns += [-C1 * y, C1 * z, -C1 * x]
    if degree >= 2:
        columns += [
            C2[0] * x * y,
            C2[1] * y * z,
            C2[2] * (2 * z * z - x * x - y * y),
            C2[3] * x * z,
            C2[4] * (x * x - y * y),
        ]
    if degree >= 3:
        columns += [
            C3[0] * y * (3 * x * x - y * y),
            C3[1] * x * y * z,
            C3[2] * y * (4 * z * z - x * x - y * y),
            C3[3] * z * (2 * z * z - 3 * x * x - 3 * y * y),
            C3[4] * x * (4 * z * z - x * x - y * y),
            C3[5] * z * (x * x - y * y),
            C3[6] * x * (x * x - 3 * y * y),
        ]
    return torch.stack(columns, dim=1)


def frustum_limits(camera: Camera) -> tuple[float, float, float, float]:
    """Smallest and largest x/z and y/z at which the Jacobian is taken: the field of view and 30 % around it."""
    return camera.field_of_view()


def _screen(local: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Pixel positions (M, 2) of camera-frame points (M, 3) and the Jacobians (M, 2, 3) of the projection."""
    x, y, z = local.unbind(1)
    zero = torch.zeros_like(z)
    if camera.orthographic:
        centers = torch.stack([camera.fx * x + camera.cx, camera.fy * y + camera.cy], dim=1)
        rows = [zero + camera.fx, zero, zero, zero, zero + camera.fy, zero]
        return centers, torch.stack(rows, dim=1).reshape(-1, 2, 3)
    centers = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], dim=1)
    left, right, top, bottom = frustum_limits(camera)
    slope_x, slope_y = (x / z).clamp(left, right), (y / z).clamp(top, bottom)
    rows = [camera.fx / z, zero, -camera.fx * slope_x / z, zero, camera.fy / z, -camera.fy * slope_y / z]
    return centers, torch.stack(rows, dim=1).reshape(-1, 2, 3)


def _unit_quats(quats: Tensor) -> Tensor:
    norms = quats.norm(dim=1, keepdim=True)
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=quats.dtype, device=quats.device)
    usable = norms > QUAT_MIN
    return torch.where(usable, quats / torch.where(usable, norms, 1.0), identity)


def _finite_rows(gaussians: GaussianSet) -> Tensor:
    parts = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
    finite = [torch.isfinite(part.unsqueeze(-1)).flatten(1).all(1) for part in parts]
    return torch.stack(finite).all(0)


def _info(projected: Projected, opacities: Tensor, camera: Camera, count: int) -> SplatInfo:
    """Which splats reach a pixel at α = 1/255, judged by the box around that ellipse, and their radii."""
    with torch.no_grad():
        xx, xy, yy, _ = projected.cov.unbind(1)
        if projected.integral is None:
            reach = torch.sqrt(2 * torch.log(opacities.double() / ALPHA_MIN).clamp_min(0))[:, None]
            half = reach * projected.cov[:, [0, 2]].sqrt()
        else:
            half = pixel_integral.half_extents(projected.integral, opacities.double(), ALPHA_MIN)
        size = torch.tensor([camera.width, camera.height], device=half.device)
        first = torch.ceil(projected.centers - half - 0.5).clamp_min(0)
        last = torch.minimum(torch.floor(projected.centers + half - 0.5), size - 1)
        inside = (first <= last).all(1)
        longest = 0.5 * (xx + yy) + torch.hypot(0.5 * (xx - yy), xy)
        visible = torch.zeros(count, dtype=torch.bool, device=half.device)
        radii = torch.zeros(count, dtype=opacities.dtype, device=half.device)
        visible[projected.index] = inside
        largest = torch.finfo(opacities.dtype).max
        radii[projected.index] = torch.where(inside, 3 * longest.sqrt(), 0.0).clamp_max(largest).to(opacities.dtype)
    return SplatInfo(visible, radii)


def _keep_screen_grad(info: SplatInfo, index: Tensor, grad: Tensor | None) -> None:
    if grad is None:
        return
    if info.screen_grad is None:
        info.screen_grad = torch.zeros(len(info.visible), 2, dtype=info.radii_px.dtype, device=grad.device)
    info.screen_grad[index] += grad.detach().to(info.radii_px.dtype)
