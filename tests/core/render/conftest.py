"""Random splats, cameras that look at them, and how renders and gradients are compared."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from insideout.core.gaussians import GaussianSet
from insideout.core.render import SplatImage, splat
from insideout.core.views import Camera

PARAMETERS = ("means", "quats", "scales", "opacities", "sh")


@pytest.fixture
def make_scene() -> Callable[..., GaussianSet]:
    """`count` random splats around the origin, as leaves that want gradients."""

    def make(
        count: int = 60, seed: int = 0, degree: int = 3, dtype: torch.dtype = torch.float64, **fields: Any
    ) -> GaussianSet:
        rng = np.random.default_rng(seed)
        numpy_set = GaussianSet.create(
            rng.normal(size=(count, 3)) * 0.5,
            np.exp(rng.normal(size=(count, 3)) * 0.5) * 0.1,
            quats=rng.normal(size=(count, 4)),
            opacities=rng.uniform(0.02, 1.0, count),
            sh=rng.normal(size=(count, (degree + 1) ** 2, 3)) * 0.3,
        )
        scene = replace(numpy_set, **{name: np.asarray(value, np.float64) for name, value in fields.items()})
        return trainable(scene.to_torch(dtype))

    return make


@pytest.fixture
def make_camera() -> Callable[..., Camera]:
    """A camera `distance` from the origin, turned at random by `seed`; three units show all of `make_scene`."""

    def make(
        width: int = 45,
        height: int = 37,
        seed: int | None = None,
        orthographic: bool = False,
        near: float = 0.1,
        trainable_pose: bool = False,
        distance: float = 3.0,
    ) -> Camera:
        pose = np.eye(4)
        pose[2, 3] = distance
        if seed is not None:
            pose[:3, :3] = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
            pose[0, :3] *= np.sign(np.linalg.det(pose[:3, :3]))
        focal = 0.35 * width if orthographic else 0.9 * width
        return Camera(
            width,
            height,
            focal,
            1.1 * focal,
            0.5 * width + 2.3,
            0.5 * height - 1.2,
            torch.tensor(pose, requires_grad=True) if trainable_pose else pose,
            orthographic=orthographic,
            near=near,
        )

    return make


@pytest.fixture
def render_and_differentiate() -> Callable[..., tuple[SplatImage, dict[str, torch.Tensor]]]:
    """Renders, and differentiates a random weighting of colour, alpha and depth of the pixels that `keep` allows."""

    def run(
        scene: GaussianSet, camera: Camera, keep: torch.Tensor | None = None, **options: Any
    ) -> tuple[SplatImage, dict[str, torch.Tensor]]:
        image = splat(scene, camera, **options)
        rng = np.random.default_rng(5)
        loss = torch.zeros(())
        for part in (image.color, image.alpha, image.depth):
            weights = torch.from_numpy(rng.normal(size=tuple(part.shape))).to(part)
            if keep is not None:
                weights[~keep] = 0.0
            loss = loss + (part * weights).sum()
        loss.backward()
        grads = {name: getattr(scene, name).grad for name in PARAMETERS}
        grads["screen"] = image.info.screen_grad
        if isinstance(camera.world_to_camera, torch.Tensor):
            grads["pose"] = camera.world_to_camera.grad
        return image, {name: grad.double() for name, grad in grads.items()}

    return run


@pytest.fixture
def relative_error() -> Callable[[torch.Tensor, torch.Tensor], float]:
    """‖found − truth‖ / ‖truth‖."""

    def error(found: torch.Tensor, truth: torch.Tensor) -> float:
        found, truth = found.detach().double(), truth.detach().double()
        return float((found - truth).norm() / truth.norm().clamp_min(1e-30))

    return error


def trainable(scene: GaussianSet) -> GaussianSet:
    return replace(scene, **{name: getattr(scene, name).detach().clone().requires_grad_() for name in PARAMETERS})
