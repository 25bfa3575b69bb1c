"""How far float32 kernels are from the reference in float64, by renderer and parameter, on one random scene.

An error is ‖found − truth‖ / ‖truth‖: of the image, and of the gradient of a random weighting of the image by each
parameter of the splats and by the pose of camera (a matrix) or detector (its four vectors). Where a gradient cancels to
nothing, a millionth of the scene's largest counts as 1e-3.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from ..gaussians import GaussianSet
from ..rotations import normalize_quats, quats_to_matrices
from ..views import Camera, Detector, Plane

SIZES = ((1, 1), (3, 17), (31, 45), (64, 48), (17, 5), (16, 16), (1, 40), (50, 33))
COUNTS = (1, 5, 40, 120, 250)
DETECTORS = ("cone", "parallel", "offset", "tilted", "tilted parallel", "free")
QUANTITIES = ("density", "occupancy", "color")
_UNDECIDED = 1e-4
# What is left in float64 where a gradient cancels: some 1e-16 of its terms; what is there by right is far more.
_ROUNDING = 1e-12
_RAYS = ("source", "center", "u", "v")


def scene_errors(
    renderer: str, seed: int, kernel: str = "cpu", device: Any = "cpu", mode: str = "exact"
) -> dict[str, float]:
    """Relative errors of the image and of every gradient, of `kernel` in float32 against the reference in float64.

    Args:
        renderer: "splat", "radiograph" or "section".
        seed: the scene's number: all that is in it follows from it.
        device: of the kernel's tensors; the reference runs on the CPU.
        mode: of radiographs; see `core.render.radiograph`.
    """
    rng = np.random.default_rng([seed, ("splat", "radiograph", "section").index(renderer)])
    draw: Callable[[np.random.Generator, int, str], Any] = {
        "splat": _splat_scene,
        "radiograph": _radiograph_scene,
        "section": _section_scene,
    }[renderer]
    render = draw(rng, seed, mode)
    truth, true_gradients = render("reference", "float64", "cpu")
    found, gradients = render(kernel, "float32", device)
    largest = max(float(np.linalg.norm(expected)) for expected in true_gradients.values())
    errors = {"image": _relative(found, truth)}
    return errors | {name: _relative(gradients[name], expected, largest) for name, expected in true_gradients.items()}


def random_set(rng: np.random.Generator, count: int, spread: float, size: float, degree: int = 0) -> GaussianSet:
    """`count` splats around the origin, axes log-normal about `size`, colours of a degree."""
    return GaussianSet.create(
        rng.normal(size=(count, 3)) * spread,
        np.exp(rng.normal(size=(count, 3)) * 0.6) * size,
        quats=rng.normal(size=(count, 4)),
        opacities=rng.uniform(0.02, 1.0, count),
        sh=rng.normal(size=(count, (degree + 1) ** 2, 3)) * 0.4,
        density=rng.uniform(0.05, 1.0, count),
    )


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    """(3, 3), uniform."""
    matrix: np.ndarray = quats_to_matrices(normalize_quats(rng.normal(size=(1, 4))))[0]
    return matrix


def random_camera(rng: np.random.Generator, width: int, height: int, orthographic: bool) -> Camera:
    """A camera about three units from the origin that sees what lies within one."""
    pose = np.eye(4)
    pose[:3, :3] = random_rotation(rng)
    pose[:3, 3] = [*rng.normal(size=2) * 0.2, rng.uniform(2.2, 4.0)]
    focal = max(width, height) * (0.35 if orthographic else rng.uniform(0.7, 1.3))
    cx, cy = 0.5 * width + rng.normal() * 0.1 * width, 0.5 * height + rng.normal() * 0.1 * height
    return Camera(width, height, focal, 1.1 * focal, cx, cy, pose, orthographic=orthographic, near=0.1)


def random_detector(rng: np.random.Generator, width: int, height: int, kind: str) -> Detector:
    """A detector of a kind of `DETECTORS`, about 180 mm from the source, that shows some 40 mm around the origin."""
    pixel = 80.0 / max(width, height)
    source, center = np.array([100.0, 0, 0]), np.array([-80.0, 0, 0])
    u, v = np.array([0, pixel, 0]), np.array([0, 0, -pixel])
    if kind == "offset":
        center = center + np.array([0, *rng.normal(size=2) * 12])
        source = source + np.array([0, *rng.normal(size=2) * 5])
    if "tilted" in kind:
        u, v = u + rng.normal(size=3) * 0.3 * pixel, v + rng.normal(size=3) * 0.3 * pixel
    if kind == "free":
        turn = random_rotation(rng)
        source, center, u, v = (turn @ vector for vector in (source + rng.normal(size=3) * 5, center, u, v))
        center = center + rng.normal(size=3) * 5
    if "parallel" in kind:
        direction = np.array([-1.0, 0, 0]) + rng.normal(size=3) * (0.2 if "tilted" in kind else 0.0)
        return Detector(width, height, direction, center, u, v, True)
    return Detector(width, height, source, center, u, v)


def random_plane(rng: np.random.Generator, width: int, height: int, thickness: float) -> Plane:
    """A plane some 25 mm wide through the neighbourhood of the origin."""
    turn = random_rotation(rng)
    u, v = turn[0] * 25 / max(width, height), turn[1] * rng.uniform(0.7, 1.3) * 25 / max(width, height)
    origin = -0.5 * (width * u + height * v) + turn[2] * rng.normal() * 1.5
    return Plane(origin, u, v, width, height, thickness)


def _splat_scene(rng: np.random.Generator, seed: int, mode: str) -> Any:
    import torch

    from . import splat

    width, height = SIZES[seed % len(SIZES)]
    gaussians = random_set(rng, COUNTS[seed % len(COUNTS)], 0.5, 0.12, degree=seed % 4)
    camera = random_camera(rng, width, height, orthographic=seed // 4 % 2 == 1)
    # As 3DGS draws them, and as presets do.
    options: dict[str, Any] = {"low_pass": 1 / 12, "mip_filter": True} if seed // 8 % 2 else {}
    keep = decided_pixels(gaussians, camera, **options)[..., None]
    background = rng.uniform(size=3)
    weights = torch.from_numpy(rng.normal(size=(height, width, 5))) * keep

    def render(kernel: str, dtype: str, device: Any) -> Any:
        scene, leaves = _leaves(gaussians, ("means", "quats", "scales", "opacities", "sh"), dtype, device)
        leaves["pose"] = torch.tensor(camera.world_to_camera, requires_grad=True)
        view = replace(camera, world_to_camera=leaves["pose"])
        seen = splat(scene, view, background, kernel, **options)
        image = torch.cat([seen.color, seen.alpha[..., None], seen.depth[..., None]], dim=-1)
        return _differentiated(image * keep.to(image), weights, leaves)

    return render


def decided_pixels(gaussians: GaussianSet, camera: Camera, **options: Any) -> Any:
    """(H, W) bool tensor: pixels in which no α is within 1e-4 of 1/255 and no transmittance of its limit.

    Both limits are steps: on which side a pixel falls is up to rounding, in either kernel. Told from the reference.

    Args:
        options: low_pass and mip_filter of `splat`.
    """
    import torch

    from .kernels.reference import splat as reference

    scene = gaussians.to_torch(torch.float64)
    projected = reference.project(scene, camera, torch.as_tensor(camera.world_to_camera), **options)
    rows, columns = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    pixels = torch.stack([columns, rows], dim=-1).reshape(-1, 2).double() + 0.5
    offset = pixels[None] - projected.centers[:, None]
    l1, k, l2 = (factor[:, None] for factor in projected.factors.unbind(1))
    power = (l1 * offset[..., 0] + k * offset[..., 1]) ** 2 + (l2 * offset[..., 1]) ** 2
    raw = projected.drawn(scene.opacities[projected.index])[:, None] * torch.exp(-0.5 * power)
    undecided = (raw / reference.ALPHA_MIN - 1).abs() < _UNDECIDED
    undecided |= (raw / reference.ALPHA_MAX - 1).abs() < _UNDECIDED
    alpha = torch.where(raw >= reference.ALPHA_MIN, raw.clamp(max=reference.ALPHA_MAX), 0.0)
    left = torch.cumprod(1 - alpha, dim=0)
    undecided |= (left / reference.TRANSMITTANCE_MIN - 1).abs() < 100 * _UNDECIDED
    return ~undecided.any(0).reshape(camera.height, camera.width)


def _radiograph_scene(rng: np.random.Generator, seed: int, mode: str) -> Any:
    import torch

    from . import radiograph

    width, height = SIZES[seed % len(SIZES)]
    detector = random_detector(rng, width, height, DETECTORS[seed % len(DETECTORS)])
    origin, direction = (part[height // 2, width // 2] for part in detector.rays())
    gaussians = random_set(rng, COUNTS[seed % len(COUNTS)], 5.0, 2.0)
    gaussians = _first_near(gaussians, origin - (origin @ direction) * direction, rng)
    weights = torch.from_numpy(rng.normal(size=(height, width)))

    def render(kernel: str, dtype: str, device: Any) -> Any:
        scene, leaves = _leaves(gaussians, ("means", "quats", "scales", "density"), dtype, device)
        vectors: dict[str, Any] = {name: torch.tensor(getattr(detector, name), requires_grad=True) for name in _RAYS}
        image = radiograph(scene, replace(detector, **vectors), kernel, mode)
        image, grads = _differentiated(image, weights, leaves | vectors)
        # One parameter: by itself a step along a row has no effect on an image of one column.
        grads["pose"] = np.concatenate([grads.pop(name) for name in _RAYS])
        return image, grads

    return render


def _section_scene(rng: np.random.Generator, seed: int, mode: str) -> Any:
    import torch

    from . import section

    width, height = SIZES[seed % len(SIZES)]
    plane = random_plane(rng, width, height, (0.0, 0.05, 0.8, 6.0)[seed // 3 % 4])
    gaussians = random_set(rng, COUNTS[seed % len(COUNTS)], 4.0, 2.0)
    gaussians = _first_near(gaussians, plane.points()[rng.integers(height), rng.integers(width)], rng)
    quantity = QUANTITIES[seed % 3]
    shape = (height, width, 3) if quantity == "color" else (height, width)
    weights = torch.from_numpy(rng.normal(size=shape))
    used = {"density": ("density",), "occupancy": ("opacities",), "color": ("opacities", "sh")}[quantity]

    def render(kernel: str, dtype: str, device: Any) -> Any:
        scene, leaves = _leaves(gaussians, ("means", "quats", "scales", *used), dtype, device)
        return _differentiated(section(scene, plane, quantity, kernel), weights, leaves)

    return render


def _first_near(gaussians: GaussianSet, point: np.ndarray, rng: np.random.Generator) -> GaussianSet:
    """The set moved so that its first splat is 1 mm or so from a point: a lone one would else be in no pixel at all.

    An image of nothing but the tails that the fast kernels cut off has no relative error.
    """
    shift = point + rng.normal(size=3) - gaussians.means[0]
    return replace(gaussians, means=(gaussians.means + shift).astype(np.float32))


def _leaves(gaussians: GaussianSet, fields: tuple[str, ...], dtype: str, device: Any) -> Any:
    import torch

    scene = gaussians.to_torch(getattr(torch, dtype), device)
    leaves = {name: getattr(scene, name).detach().clone().requires_grad_() for name in fields}
    return replace(scene, **leaves), leaves


def _differentiated(image: Any, weights: Any, leaves: dict[str, Any]) -> Any:
    (image * weights.to(image)).sum().backward()
    grads = {name: leaf.grad.cpu().double().numpy() for name, leaf in leaves.items() if leaf.grad is not None}
    return image.detach().cpu().double().numpy(), grads


def _relative(found: np.ndarray, truth: np.ndarray, largest: float = 0.0) -> float:
    """‖found − truth‖ / ‖truth‖; less strict where the truth is but rounding.

    A lone splat's colour on a section is its own, however it lies: all gradients but that by `sh` are nothing. Found
    may then be what float32 rounds of the largest: it counts as if the truth were a thousandth of that.
    """
    size = float(np.linalg.norm(truth))
    return float(np.linalg.norm(found - truth)) / max(size if size > _ROUNDING * largest else 1e-3 * largest, 1e-12)
