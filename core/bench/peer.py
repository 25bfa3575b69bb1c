"""gsplat (Ye et al., arXiv 2409.06765), the splat renderer that others compare with on a card, on our scenes."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

from ..gaussians import GaussianSet
from ..views import Camera


def is_installed() -> bool:
    return find_spec("gsplat") is not None


def splat_color(gaussians: GaussianSet, camera: Camera) -> Any:
    """What `core.render.splat` gives as `color`, (H, W, 3), on black; drawn by gsplat on the device of `gaussians`.

    Args:
        gaussians: torch set.
        camera: perspective.
    """
    import torch
    from gsplat import rasterization

    device = gaussians.means.device
    focus = torch.tensor([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]], device=device)
    pose = torch.as_tensor(camera.world_to_camera, dtype=torch.float32, device=device)
    colors, _, _ = rasterization(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        gaussians.sh,
        pose[None],
        focus[None],
        camera.width,
        camera.height,
        near_plane=camera.near,
        sh_degree=gaussians.sh_degree,
        packed=False,
    )
    return colors[0]
