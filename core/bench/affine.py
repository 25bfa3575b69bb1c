"""What the radiograph's affine mode (R2-Gaussian, arXiv 2405.20693) saves in time and loses in accuracy."""

from __future__ import annotations

import statistics
from typing import Any

import numpy as np

from ..gaussians import GaussianSet
from ..views import Detector
from .scenes import Scene
from .stopwatch import Stopwatch

MODES = ("exact", "affine")
SIGMAS = (0.001, 0.004, 0.01, 0.04, 0.1)
"""Standard deviations of a ball in shares of its distance from the source: half a millimetre and more at 0.5 m."""
PLACES = (0.0, 0.2)
"""Distances of a ball from the axis of the beam, in shares of its distance from the source: 0 and 11 degrees."""

_SIDE = 201


def measure_errors() -> list[dict[str, Any]]:
    """How far a ball's affine radiograph is from the exact one, by its size and place; `reference` in float64.

    Returns:
        `sigma` and `place` in shares of the distance from the source; `peak_error`, the largest of any pixel in
        shares of the brightest; `total_error`, how much of the ball's whole attenuation is missing or in excess, in
        shares of it.
    """
    rows = []
    for sigma in SIGMAS:
        for place in PLACES:
            exact, affine = (_ball(sigma, place, mode) for mode in MODES)
            error, total = np.abs(affine - exact).max() / exact.max(), affine.sum() / exact.sum() - 1
            rows.append({"sigma": sigma, "place": place, "peak_error": float(error), "total_error": float(total)})
    return rows


def _ball(sigma: float, place: float, mode: str) -> np.ndarray:
    import torch

    from ..render import radiograph

    # The detector as far behind the ball as the source is before it; six standard deviations to each side.
    step = 24 * sigma / _SIDE
    detector = Detector(
        _SIDE,
        _SIDE,
        np.array([1.0, 0, 0]),
        np.array([-1.0, 2 * place, 0]),
        np.array([0, step, 0]),
        np.array([0, 0, -step]),
    )
    ball = GaussianSet.create(np.array([[0.0, place, 0.0]]), sigma, density=1.0).to_torch(torch.float64)
    return np.asarray(radiograph(ball, detector, "reference", mode))


def measure_times(case: Scene, repeats: int = 9) -> list[dict[str, Any]]:
    """A step of the `cpu` kernel in both modes, in turn; medians.

    Returns:
        A row for each mode: `mode`, `splats`, `width`, `height`, `forward_ms`, `backward_ms`, `step_ms`; `image_error`,
        how far the image is from the exact one, root mean square in shares of the exact one's.
    """
    from .kernels import Step

    steps = {mode: Step("radiograph", "cpu", case, "cpu", mode) for mode in MODES}
    times: dict[str, dict[str, list[float]]] = {mode: {"forward": [], "backward": []} for mode in MODES}
    for repeat in range(repeats + 2):
        for mode, step in steps.items():
            watch = Stopwatch()
            step.run(watch)
            if repeat >= 2:
                for part, seconds in times[mode].items():
                    seconds.append(watch.seconds[part])
    images = {mode: step.render().detach().numpy().astype(np.float64) for mode, step in steps.items()}
    exact = images["exact"]
    rows = []
    for mode in MODES:
        forward, backward = (1e3 * statistics.median(times[mode][part]) for part in ("forward", "backward"))
        rows.append(
            {
                "mode": mode,
                "splats": len(case.gaussians),
                "width": case.detector.width,
                "height": case.detector.height,
                "forward_ms": round(forward, 4),
                "backward_ms": round(backward, 4),
                "step_ms": round(forward + backward, 4),
                "image_error": float(np.linalg.norm(images[mode] - exact) / np.linalg.norm(exact)),
            }
        )
    return rows
