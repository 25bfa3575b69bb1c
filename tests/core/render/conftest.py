"""Random splats, cameras that look at them, and how renders and gradients are compared."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import torch

from insideout.core.gaussians import GaussianSet
from insideout.core.render import SplatImage, radiograph, section, splat
from insideout.core.views import Camera, Detector, Plane

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


@dataclass(frozen=True)
class Kernel:
    """A renderer's kernel, the type and place of its numbers, and the relative error allowed against a closed form."""

    name: str
    dtype: torch.dtype
    device: str
    rtol: float

    @property
    def single(self) -> bool:
        return self.dtype == torch.float32


EXACT = Kernel("reference", torch.float64, "cpu", 1e-9)


@dataclass(frozen=True)
class Rendered:
    """Images and gradients as float64 numpy arrays, whatever kernel they came from."""

    images: dict[str, np.ndarray]
    grads: dict[str, np.ndarray]
    info: Any = None

    def __getitem__(self, name: str) -> np.ndarray:
        return self.images[name]


@pytest.fixture(params=["reference-float64", "reference-float32", "cpu", "cuda"])
def kernel(request) -> Kernel:
    """Each kernel in turn; `cuda` runs on a card, else on Warp's CPU device, and is skipped without Warp."""
    if request.param == "cuda":
        pytest.importorskip("warp")
        return Kernel("cuda", torch.float32, "cuda" if torch.cuda.is_available() else "cpu", 1e-5)
    if request.param == "reference-float64":
        return EXACT
    return Kernel(request.param.partition("-")[0], torch.float32, "cpu", 1e-5)


@pytest.fixture
def photograph(kernel: Kernel) -> Callable[..., Rendered]:
    """`splat` of a set and its gradients, all finite; of float32 kernels also close to the reference in float64."""

    def render(
        kernel: Kernel, gaussians: GaussianSet, camera: Camera, background: Any = None, **options: Any
    ) -> Rendered:
        leaves = _leaves(gaussians, PARAMETERS, kernel)
        leaves["pose"] = torch.tensor(np.asarray(camera.world_to_camera), dtype=torch.float64, requires_grad=True)
        scene = replace(gaussians.to_torch(kernel.dtype, kernel.device), **{name: leaves[name] for name in PARAMETERS})
        view = replace(camera, world_to_camera=leaves["pose"])
        image = splat(scene, view, background=background, kernel=kernel.name, **options)
        parts = {name: getattr(image, name) for name in ("color", "alpha", "depth")}
        rendered = _differentiated(parts, leaves, image.info)
        assert torch.isfinite(image.info.radii_px).all()
        return rendered

    return _checked(render, kernel)


@pytest.fixture
def expose(kernel: Kernel) -> Callable[..., Rendered]:
    """`radiograph` of a set and its gradients, checked as by `photograph`."""

    def render(kernel: Kernel, gaussians: GaussianSet, detector: Detector, **options: Any) -> Rendered:
        fields = ("means", "quats", "scales", "density")
        leaves = _leaves(gaussians, fields, kernel)
        scene = replace(gaussians.to_torch(kernel.dtype, kernel.device), **leaves)
        vectors = {
            name: torch.tensor(np.asarray(getattr(detector, name)), dtype=torch.float64, requires_grad=True)
            for name in ("source", "center", "u", "v")
        }
        image = radiograph(scene, replace(detector, **vectors), kernel.name, **options)
        return _differentiated({"image": image}, {**leaves, **vectors})

    return _checked(render, kernel)


@pytest.fixture
def cut(kernel: Kernel) -> Callable[..., Rendered]:
    """`section` of a set and its gradients, checked as by `photograph`."""

    def render(
        kernel: Kernel, gaussians: GaussianSet, plane: Plane, quantity: str = "density", **options: Any
    ) -> Rendered:
        leaves = _leaves(gaussians, (*PARAMETERS, "density"), kernel)
        scene = replace(gaussians.to_torch(kernel.dtype, kernel.device), **leaves)
        return _differentiated({"image": section(scene, plane, quantity, kernel.name, **options)}, leaves)

    return _checked(render, kernel)


def _checked(render: Callable[..., Rendered], kernel: Kernel) -> Callable[..., Rendered]:
    """`render` by this kernel, its gradients held against those of the reference in float64."""

    def run(
        gaussians: GaussianSet, view: Any, *extra: Any, gradient_rtol: float | None = 1e-3, **options: Any
    ) -> Rendered:
        found = render(kernel, gaussians, view, *extra, **options)
        if kernel.single and gradient_rtol is not None:
            truth = render(EXACT, gaussians, view, *extra, **options)
            # What cancels to nothing in float64 leaves the rounding of the terms in float32.
            floor = 1e-3 + 1e-6 * max((np.linalg.norm(grad) for grad in truth.grads.values()), default=0.0)
            for name, expected in truth.grads.items():
                error, size = np.linalg.norm(found.grads[name] - expected), np.linalg.norm(expected)
                assert error <= gradient_rtol * size + floor, f"gradient of {name}: {error:.3g} of {size:.3g}"
        return found

    return run


def _leaves(gaussians: GaussianSet, fields: tuple[str, ...], kernel: Kernel) -> dict[str, torch.Tensor]:
    scene = gaussians.to_torch(kernel.dtype, kernel.device)
    return {name: getattr(scene, name).detach().clone().requires_grad_() for name in fields}


def _differentiated(images: dict[str, torch.Tensor], leaves: dict[str, torch.Tensor], info: Any = None) -> Rendered:
    """The gradients of a weighting of all pixels that no symmetry of a scene cancels."""
    loss = torch.zeros((), dtype=torch.float64)
    for image in images.values():
        weights = torch.linspace(0.5, 1.5, max(image.numel(), 1), dtype=torch.float64)[: image.numel()]
        loss = loss + (image.double().cpu().reshape(-1) * weights).sum()
    loss.backward()
    grads = {name: torch.zeros_like(leaf) if leaf.grad is None else leaf.grad for name, leaf in leaves.items()}
    for name, values in {**images, **grads}.items():
        assert torch.isfinite(values).all(), name
    return Rendered(
        {name: image.detach().cpu().double().numpy() for name, image in images.items()},
        {name: grad.cpu().double().numpy() for name, grad in grads.items()},
        info,
    )


@pytest.fixture
def all_but_flips():
    """Where two `SplatImage`s are compared: (H, W) mask without the one pixel in 5,000 where depths differ most.

    α < 1/255 is a discontinuity: where rounding puts a pixel on the other side of it, a faint splat is seen or not.
    """

    def mask(image, truth) -> torch.Tensor:
        error = (image.depth.cpu() - truth.depth).abs().flatten()
        keep = torch.ones(len(error), dtype=torch.bool)
        keep[error.argsort(descending=True)[: len(error) // 5000]] = False
        return keep.reshape(image.depth.shape)

    return mask
