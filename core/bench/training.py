"""A whole training on photos of a simple object whose truth is known: seconds, held-out PSNR, where the time goes."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ..capture.model import Photo
from ..gaussians import GaussianSet
from ..phantoms.distance_grid import DistanceGrid
from ..phantoms.model import Phantom
from ..phantoms.photos import BACKGROUND, render_photo
from ..phantoms.shapes import ellipsoid, smooth_union, sphere
from ..phantoms.shots import camera_ring
from ..render.card import require_card
from ..spherical_harmonics import rgb_to_sh
from .machine import machine
from .stopwatch import Stopwatch, Watched


@dataclass(frozen=True)
class TrainingCase:
    """What is trained.

    Attributes:
        splats: from the start to the end; none are added or dropped.
        side: pixels of the square photos.
        photos: to train on; as many more, from other places, are held out.
        iterations: photos shown.
        seed: of cameras, start and order.
        kernel: "cpu", or "cuda": photos are drawn on a card, the rest of a step stays on the processor.
    """

    splats: int = 10_000
    side: int = 200
    photos: int = 40
    iterations: int = 2000
    seed: int = 0
    kernel: str = "cpu"


def snowman() -> Phantom:
    """Two balls grown into one another with an egg for a nose, in bands of colour; 60 mm tall."""

    def surface(points: np.ndarray) -> np.ndarray:
        body = sphere(points, np.array([0.0, 0.0, -9.0]), 20.0)
        head = sphere(points, np.array([0.0, 0.0, 15.0]), 14.0)
        nose = ellipsoid(points, np.array([0.0, -15.0, 16.0]), np.eye(3), (3.0, 7.0, 3.0))
        return np.minimum(smooth_union(body, head, 4.0), nose)

    def color(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        x, y, z = points.T
        around = np.sin(6 * np.arctan2(y, x)) * np.sin(0.45 * z)
        bands = 0.5 + 0.5 * np.tanh(6 * around)
        base = np.stack([0.25 + 0.6 * bands, 0.35 + 0.3 * np.cos(0.2 * z), 0.75 - 0.5 * bands], axis=-1)
        return np.clip(base, 0.05, 0.95)

    return Phantom("snowman", (), surface, color, (44.0, 46.0, 62.0), energy_kev=60.0)


def train(case: TrainingCase, tell: Callable[[str], None] | None = None) -> dict[str, Any]:
    """Trains with the settings of the surface stage and no densification.

    Returns:
        The case; `seconds` of the training alone, `step_ms`, `heldout_psnr` (dB, mean over the held-out photos),
        `share` of the time by label ("project", "sort", "blend", "blend_backward", "project_backward", "loss",
        "activation", "adam", and "rest"; drawing on a card is in "rest"), `kernel_share` (all but "rest"); the machine.

    Raises:
        SettingError: the kernel is "cuda" and there is no card, or no Warp.
    """
    from ..render.kernels.cpu import warm_up

    if case.kernel == "cuda":
        require_card()
    tell = tell or (lambda _: None)
    facts = machine()
    with tempfile.TemporaryDirectory(prefix="insideout-bench-") as folder:
        tell(f"taking {2 * case.photos} photos")
        photos, grid = _take_photos(case, Path(folder))
        trainer = _trainer(case, photos, grid)
        tell("compiling kernels, once")
        if case.kernel == "cpu":
            warm_up()
        _trainer(replace(case, iterations=3), photos, grid).step(0)
        tell(f"training, {case.iterations} iterations")
        watch = Stopwatch()
        with watch.watching(_watched(case.kernel)):
            begin = time.perf_counter()
            for iteration in range(case.iterations):
                trainer.step(iteration)
            seconds = time.perf_counter() - begin
        quality = _heldout_psnr(trainer, case.photos)
    share = {label: value / seconds for label, value in watch.seconds.items()}
    inside = sum(share.values())
    return {
        "kernel": case.kernel,
        "splats": case.splats,
        "side": case.side,
        "photos": case.photos,
        "iterations": case.iterations,
        "seconds": seconds,
        "step_ms": 1e3 * seconds / case.iterations,
        "heldout_psnr": quality,
        "kernel_share": inside,
        "share": {**share, "rest": 1 - inside},
        **facts,
    }


def _take_photos(case: TrainingCase, folder: Path) -> tuple[list[Photo], DistanceGrid]:
    """Twice `case.photos`, every second one held out."""
    phantom = snowman()
    grid = DistanceGrid.bake(phantom.surface, np.array(phantom.size_mm), 0.5)
    rng = np.random.default_rng([case.seed, 1])
    photos = []
    for index, camera in enumerate(camera_ring(2 * case.photos, max(phantom.size_mm), case.side, case.side, rng)):
        path = folder / f"{index:03d}.png"
        Image.fromarray(np.round(255 * render_photo(phantom, grid, camera)).astype(np.uint8)).save(path)
        photos.append(Photo(path, camera, held_out=index % 2 == 1))
    return photos, grid


def _trainer(case: TrainingCase, photos: list[Photo], grid: DistanceGrid) -> Any:
    from ..stages.surface.photos import TrainingPhotos
    from ..stages.surface.rgb import RgbSettings, RgbTrainer
    from ..train.strategy import DefaultStrategy

    settings = RgbSettings(
        iterations=case.iterations, long_side=case.side, strategy=DefaultStrategy(start=1.0, stop=0.0)
    )
    background = np.array(BACKGROUND)
    training = TrainingPhotos([photo for photo in photos if not photo.held_out], case.side, background)
    heldout = TrainingPhotos([photo for photo in photos if photo.held_out], case.side, background)
    return RgbTrainer(_start(case, grid), training, heldout, background, settings, case.seed, case.kernel)


def _start(case: TrainingCase, grid: DistanceGrid) -> GaussianSet:
    """Points as structure from motion leaves them: on the surface to within half a millimetre, coloured."""
    from ..stages.initialize.photos import neighbour_distance

    rng = np.random.default_rng([case.seed, 2])
    phantom = snowman()
    outward = rng.normal(size=(case.splats, 3))
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    reach = 2 * max(phantom.size_mm)
    aim = rng.uniform(-0.5, 0.5, (case.splats, 3)) * np.array(phantom.size_mm)
    distance = grid.first_hits(aim + reach * outward, -outward)
    hit = np.isfinite(distance)
    while not hit.all():
        aim[~hit] *= 0.5
        distance[~hit] = grid.first_hits((aim + reach * outward)[~hit], -outward[~hit])
        hit = np.isfinite(distance)
    points = aim + (reach - distance[:, None]) * outward
    colors = phantom.color(points, outward)
    points = points + 0.5 * rng.normal(size=points.shape)
    sh = rgb_to_sh(colors).astype(np.float32)[:, None, :]
    return GaussianSet.create(points, neighbour_distance(points)[:, None], opacities=0.1, sh=sh)


def _heldout_psnr(trainer: Any, photos: int) -> float:
    import torch

    from ..evaluate.metrics import psnr
    from ..render import splat

    final = trainer.parameters.to_set().to_torch()
    background, values = torch.tensor(BACKGROUND, dtype=torch.float32), []
    for index in range(photos):
        camera, target, _ = trainer.heldout.read(index)
        with torch.no_grad():
            image = splat(final, camera, background).color.clamp(0, 1)
        values.append(psnr(image.numpy(), target.numpy(), 1.0))
    return float(np.mean([value for value in values if value is not None]))


def _watched(kernel: str) -> list[Watched]:
    from ..render.kernels.cpu import splat
    from ..train import activation, losses, parameters, ssim

    drawing = [
        (splat, "project", "project"),
        (splat, "depth_order", "sort"),
        (splat, "bin_ellipses", "sort"),
        (splat, "pairs_of_slots", "sort"),
        (splat, "rasterize", "blend"),
        (splat, "rasterize_backward", "blend_backward"),
        (splat, "project_backward", "project_backward"),
    ]
    return [
        *(drawing if kernel == "cpu" else ()),
        (ssim, "compare_rows", "loss"),
        (losses, "difference", "loss"),
        (activation, "activate_rows", "activation"),
        (activation, "add_gradients", "activation"),
        (parameters, "all_finite", "adam"),
        (parameters, "adam_step", "adam"),
    ]
