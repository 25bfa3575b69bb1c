"""Local and fine fitting step by step: each is tried, judged and kept or taken back, and none is made twice."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from ...evaluate.metrics import psnr
from ...gaussians import GaussianSet
from ...render.options import SplatOptions
from ...similarity import Similarity
from ...views import Camera
from ..context import StageContext
from .icp import two_way_score
from .local_fit import Moves, cluster_moves, normal_moves
from .surfaces import OuterSurface, ShellPoints

# Moves of splats that together cost the photos more than this (dB) are taken back, however well they fit.
_PHOTO_LOSS_DB = 0.5


@dataclass(frozen=True, eq=False)
class Judge:
    """What a step is judged by: the surface, and some training photos.

    Attributes:
        shell: the splats on the object, in mm; their places are looked up anew in each set.
        surface: what they should lie on.
        views: cameras in mm with photos (H, W, 3); none for no check.
        background: (3,) behind the object, black if None.
        kernel: of the renderer.
        options: how `surface` drew its photo splats.
    """

    shell: ShellPoints
    surface: OuterSurface
    views: Sequence[tuple[Camera, np.ndarray]]
    background: np.ndarray | None
    kernel: str
    options: SplatOptions = field(default_factory=SplatOptions)

    def distance_mm(self, gaussians: GaussianSet) -> float:
        """Two-way trimmed mean distance of the splats on the object and the surface."""
        at = replace(self.shell, points=gaussians.means[self.shell.index].astype(np.float64))
        return two_way_score(Similarity(), at, self.surface)[0]

    def photo_psnr(self, gaussians: GaussianSet) -> float | None:
        """Mean PSNR in dB over the photos, None when there are none."""
        if not self.views:
            return None
        import torch

        from ...render import splat

        tensors = gaussians.to_torch()
        behind = torch.as_tensor(np.zeros(3) if self.background is None else self.background, dtype=torch.float32)
        with torch.no_grad():
            drawn = [
                splat(tensors, camera, behind, kernel=self.kernel, **vars(self.options)) for camera, _ in self.views
            ]
        images = [image.color.numpy() for image in drawn]
        return float(np.mean([psnr(np.clip(a, 0, 1), b) for a, (_, b) in zip(images, self.views, strict=True)]))


def fit_locally(
    context: StageContext, aligned: GaussianSet, judge: Judge, limit: int, chamfer: dict[str, float]
) -> tuple[GaussianSet, list[dict[str, Any]], dict[str, float | None]]:
    """Three cluster levels and the fine step (paper, Alg. 1).

    Args:
        aligned: numpy set in mm.
        limit: at most this many splats and surface points are clustered.
        chamfer: filled in with the distance in mm after each step.

    Returns:
        The set, which steps were kept and why, and the photos' PSNR before and after.

    Raises:
        Cancelled: the user asked to stop; finished steps are kept as checkpoints.
    """
    members, surface = judge.shell.members, judge.surface
    makers: dict[str, Callable[[GaussianSet], Moves]] = {
        f"local_{level}": partial(
            cluster_moves, members=members, surface=surface, divisor=divisor, limit=limit, seed=context.seed + level
        )
        for level, divisor in enumerate((10, 2, 1), start=1)
    }
    makers["fine"] = partial(normal_moves, members=members, surface=surface)
    current, steps = aligned, []
    best, before = judge.distance_mm(current), judge.photo_psnr(current)
    for number, (name, make) in enumerate(makers.items()):
        context.progress("align", part=name, fraction=0.8 + 0.05 * number)
        attempt = partial(_attempt, make, current, best, before, judge, context.reporter.check)
        step = context.once("align", name, attempt)
        shift, turn = step.pop("shift", None), step.pop("turn", None)
        if step["kept"]:
            current = Moves(shift, turn, step["clusters"], step["matched"]).applied(current, step["strength"])
            best = step["distance_mm"]
        chamfer[name] = best
        steps.append({"step": name, **step})
    return current, steps, {"before": before, "after": judge.photo_psnr(current)}


def _attempt(
    make: Callable[[GaussianSet], Moves],
    current: GaussianSet,
    best_mm: float,
    psnr_before: float | None,
    judge: Judge,
    check: Callable[[], None],
) -> dict[str, Any]:
    """A step at full, half and quarter strength: the first that brings the splats nearer and spares the photos.

    Returns:
        `kept`, `reason`, `clusters`, `matched`; when kept `strength`, `distance_mm`, `photo_psnr`, and the moves'
        `shift` and `turn`, from which a resumed stage goes on.
    """
    moves = make(current)
    step: dict[str, Any] = {"clusters": moves.clusters, "matched": moves.matched, "kept": False}
    for strength in (1.0, 0.5, 0.25):
        check()
        candidate = moves.applied(current, strength)
        distance = judge.distance_mm(candidate)
        if not distance < best_mm:
            step["reason"] = f"taken back: the distance would grow from {best_mm:.3f} to {distance:.3f} mm"
            continue
        quality = judge.photo_psnr(candidate)
        if psnr_before is not None and quality is not None and quality < psnr_before - _PHOTO_LOSS_DB:
            step["reason"] = f"taken back: photos would fall to {quality:.2f} dB from {psnr_before:.2f} dB"
            continue
        kept = {"kept": True, "strength": strength, "distance_mm": distance, "photo_psnr": quality}
        return step | kept | {"reason": "kept: nearer to the surface", "shift": moves.shift, "turn": moves.turn}
    return step
