"""How far the float32 kernels are from the reference in float64: errors over many random scenes, against two bars."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ..errors import SettingError
from ..progress import Progress, Reporter
from ..render import KERNELS
from ..render.agreement import scene_errors
from ..render.card import require_warp
from .kernels import RENDERERS

VALUE_BAR, GRADIENT_BAR = 1e-4, 1e-3


@dataclass(frozen=True)
class Row:
    """Relative errors of one parameter over many scenes; one that is not finite counts as infinite.

    Attributes:
        renderer: "splat", "radiograph" or "section".
        parameter: "image" (the error is in value), or what the gradient is by.
        scenes: how many scenes have it.
        largest, median, percentile95: of the errors; the last is the least that 95 % of them do not exceed.
        over_value_bar, over_gradient_bar: how many scenes exceed 1e-4 and 1e-3.
        worst_scene: number of the scene with the largest error.
    """

    renderer: str
    parameter: str
    scenes: int
    largest: float
    median: float
    percentile95: float
    over_value_bar: int
    over_gradient_bar: int
    worst_scene: int

    @classmethod
    def of(cls, renderer: str, parameter: str, errors: dict[int, float]) -> Row:
        """From errors by scene."""
        known = {scene: error if math.isfinite(error) else math.inf for scene, error in errors.items()}
        worst = max(known, key=lambda scene: known[scene])
        values = np.array(list(known.values()))
        return cls(
            renderer,
            parameter,
            len(known),
            known[worst],
            float(np.median(values)),
            float(np.percentile(values, 95, method="inverted_cdf")),
            int((values > VALUE_BAR).sum()),
            int((values > GRADIENT_BAR).sum()),
            worst,
        )

    @property
    def bar(self) -> float:
        """What the largest error must not exceed."""
        return VALUE_BAR if self.parameter == "image" else GRADIENT_BAR

    @property
    def over_bar(self) -> int:
        """How many scenes exceed it."""
        return self.over_value_bar if self.parameter == "image" else self.over_gradient_bar

    @property
    def complaint(self) -> str:
        """What is wrong, with the call that draws the worst scene again; "" where nothing is."""
        if not self.over_bar:
            return ""
        what = "image" if self.parameter == "image" else f"gradient by {self.parameter}"
        return (
            f"{self.renderer}: the {what} errs by {self.largest:.1e} in scene {self.worst_scene} (bar {self.bar:.0e}, "
            f"{self.over_bar} of {self.scenes} scenes over it); core.render.agreement."
            f"scene_errors({self.renderer!r}, {self.worst_scene}) renders that scene again."
        )

    def to_json(self) -> dict[str, Any]:
        return {**asdict(self), "bar": self.bar, "over_bar": self.over_bar}


def compare(
    renderer: str,
    scenes: Iterable[int],
    kernel: str = "cpu",
    device: Any = "cpu",
    mode: str = "exact",
    reporter: Reporter | None = None,
) -> list[Row]:
    """Errors of `kernel` in float32 against the reference in float64.

    Args:
        renderer: "splat", "radiograph" or "section".
        scenes: their numbers, from which everything in them is drawn.
        device: of the kernel's tensors; the reference runs on the CPU.
        mode: of radiographs; see `core.render.radiograph`.

    Raises:
        Cancelled: the user asked to stop.
    """
    reporter, numbers = reporter or Reporter(), list(scenes)
    errors: dict[str, dict[int, float]] = {}
    for done, scene in enumerate(numbers):
        reporter.update(
            Progress("agreement", renderer, done / len(numbers), iteration=done + 1, iterations=len(numbers))
        )
        for parameter, error in scene_errors(renderer, scene, kernel, device, mode).items():
            errors.setdefault(parameter, {})[scene] = error
    return [Row.of(renderer, parameter, found) for parameter, found in errors.items()]


def measure_agreement(
    scenes: int = 200,
    seed: int = 0,
    renderers: Iterable[str] = RENDERERS,
    kernel: str = "cpu",
    reporter: Reporter | None = None,
) -> list[Row]:
    """The rows of all renderers over the scenes `seed` to `seed + scenes − 1`.

    Raises:
        SettingError: there is no such renderer or kernel, the kernel is not installed, no scene, or a negative seed.
        Cancelled: the user asked to stop.
    """
    names = tuple(renderers)
    if scenes < 1:
        raise SettingError(f"--scenes {scenes}: there is nothing to compare; give 1 or more.")
    if seed < 0:
        raise SettingError(f"--seed {seed}: is below 0; choose 0 or any positive whole number.")
    for name in names:
        if name not in RENDERERS:
            raise SettingError(f"--renderer {name}: there is no such renderer; choose {', '.join(RENDERERS)}.")
    if kernel not in KERNELS:
        raise SettingError(f"--kernel {kernel}: there is no such kernel; choose {', '.join(KERNELS)}.")
    numbers, device = range(seed, seed + scenes), _device(kernel)
    return [row for name in names for row in compare(name, numbers, kernel, device, reporter=reporter)]


def _device(kernel: str) -> str:
    """Where the kernel's tensors lie: on a card only for `cuda` where there is one (Warp also runs on a CPU)."""
    import torch

    if kernel != "cuda":
        return "cpu"
    require_warp()
    return "cuda" if torch.cuda.is_available() else "cpu"
