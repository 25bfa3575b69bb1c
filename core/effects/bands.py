"""One image in bands of rows, each seen from a pose of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..gaussians import GaussianSet
from ..render.splat import PUBLISHED_LOW_PASS, SplatImage, SplatInfo
from ..threads import Alone
from ..views import Camera
from .imaging import Draw

# √(2 ln 255): an opaque splat falls under 1/255, where it is no longer drawn, at this many standard deviations.
_REACH = 3.33
# Bands with fewer splats are drawn before other threads are awake.
_FEW = 5000
_NAMES = tuple(field.name for field in fields(GaussianSet) if field.name != "modality")


@dataclass(frozen=True, eq=False)
class Band:
    """Some rows of an image and what may be seen in them.

    Attributes:
        camera: of these rows alone; its pose is not used.
        which: (M,) indices of splats, those left out do not reach into it.
    """

    camera: Camera
    which: Tensor


def draw_bands(
    draw: Draw, gaussians: GaussianSet, bands: Sequence[Band], poses: Tensor, *per_splat: Tensor
) -> SplatImage:
    """The bands of an image below each other; gradients reach the splats, `per_splat` and the poses.

    Args:
        gaussians: N splats.
        poses: (B, 4, 4) world to camera of each band.
        per_splat: tensors with N rows that `draw` takes too.

    Returns:
        An image whose `info` is of all bands: screen gradients are sums.
    """
    info = SplatInfo(None, None)
    tensors = [poses, *(getattr(gaussians, name) for name in _NAMES), *per_splat]
    if not torch.is_grad_enabled():
        # Which a torch function cannot see from within; it would keep graphs that nobody walks.
        tensors = [tensor.detach() for tensor in tensors]
    color, alpha, depth = _Bands.apply(draw, bands, gaussians.modality, info, *tensors)
    return SplatImage(color, alpha, depth, info)


class _Bands(torch.autograd.Function):
    """Every band is a graph of its own on the splats it may show.

    Autograd alone would make a gradient as long as the whole set for each band.
    """

    @staticmethod
    def forward(
        ctx: Any,
        draw: Draw,
        bands: Sequence[Band],
        modality: Tensor,
        info: SplatInfo,
        poses: Tensor,
        *tensors: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        wanted = ctx.needs_input_grad[5:]
        count, ctx.drawn = len(tensors[0]), []
        info.visible, info.radii_px = torch.zeros(count, dtype=torch.bool), torch.zeros(count, dtype=tensors[0].dtype)
        for band, matrix in zip(bands, poses, strict=True):
            pose = matrix.detach().clone().requires_grad_(ctx.needs_input_grad[4])
            leaves = [
                tensor.detach()[band.which].requires_grad_(moves) for tensor, moves in zip(tensors, wanted, strict=True)
            ]
            some = GaussianSet(**dict(zip(_NAMES, leaves, strict=False)), modality=modality[band.which])
            with torch.set_grad_enabled(any(ctx.needs_input_grad)), Alone(len(band.which) < _FEW):
                image = draw(some, replace(band.camera, world_to_camera=pose), *leaves[len(_NAMES) :])
            ctx.drawn.append((pose, leaves, image))
            info.visible[band.which] |= image.info.visible
            info.radii_px[band.which] = torch.maximum(info.radii_px[band.which], image.info.radii_px)
        ctx.info, ctx.bands, ctx.like = info, bands, [tensor.detach() for tensor in tensors]
        images = [image for _, _, image in ctx.drawn]
        results = [
            torch.cat([getattr(image, name).detach() for image in images]) for name in ("color", "alpha", "depth")
        ]
        return results[0], results[1], results[2]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *by_images: Tensor) -> Any:  # type: ignore[override]
        wanted = ctx.needs_input_grad[5:]
        totals = [torch.zeros_like(like) if moves else None for like, moves in zip(ctx.like, wanted, strict=True)]
        screen = torch.zeros(len(ctx.like[0]), 2, dtype=ctx.like[0].dtype)
        by_poses, row = [], 0
        for band, (pose, leaves, image) in zip(ctx.bands, ctx.drawn, strict=True):
            rows = slice(row, row + band.camera.height)
            row = rows.stop
            with Alone(len(band.which) < _FEW):
                torch.autograd.backward((image.color, image.alpha, image.depth), [given[rows] for given in by_images])
            by_poses.append(torch.zeros_like(pose) if pose.grad is None else pose.grad)
            for total, leaf in zip(totals, leaves, strict=True):
                if total is not None and leaf.grad is not None:
                    total.index_add_(0, band.which, leaf.grad)
            if image.info.screen_grad is not None:
                screen.index_add_(0, band.which, image.info.screen_grad)
        ctx.info.screen_grad, ctx.drawn = screen, []
        return (None, None, None, None, torch.stack(by_poses) if ctx.needs_input_grad[4] else None, *totals)


def members(gaussians: GaussianSet, cameras: Sequence[Camera], edges: Sequence[int]) -> list[Tensor]:
    """Indices of the splats that may reach into the rows from edges[i] up to before edges[i + 1], for each i.

    Args:
        cameras: the first and the last pose of the whole image; rows that a splat takes in between lie between
            those it takes there, but for a tenth of the way and a pixel.
    """
    tops, bottoms = zip(*(_rows(gaussians, camera) for camera in cameras), strict=True)
    top, bottom = torch.stack(tops).amin(0), torch.stack(bottoms).amax(0)
    slack = 1 + 0.1 * (tops[0] - tops[-1]).abs().nan_to_num(nan=0.0, posinf=0.0)
    top, bottom = top - slack, bottom + slack
    return [torch.nonzero((bottom >= first) & (top <= stop)).squeeze(1) for first, stop in pairwise(edges)]


def _rows(gaussians: GaussianSet, camera: Camera) -> tuple[Tensor, Tensor]:
    """(N,) first and last row that a splat can reach; all rows for one too near to tell."""
    pose = torch.as_tensor(camera.world_to_camera).detach().to(gaussians.means.device, torch.float64)
    local = gaussians.means.detach().double() @ pose[:3, :3].T + pose[:3, 3]
    largest = gaussians.scales.detach().double().amax(dim=1)
    if camera.orthographic:
        center, spread = camera.fy * local[:, 1] + camera.cy, camera.fy * largest
    else:
        depth = local[:, 2]
        slope = local[:, 1] / depth
        limits = camera.field_of_view()
        steepest = max(abs(limits[2]), abs(limits[3]))
        center = camera.fy * slope + camera.cy
        spread = camera.fy * largest / depth * (1 + steepest**2) ** 0.5
        near = depth <= camera.near
        center, spread = center.masked_fill(near, 0.0), spread.masked_fill(near, torch.inf)
    reach = _REACH * (spread.square() + PUBLISHED_LOW_PASS).sqrt()
    return center - reach, center + reach
