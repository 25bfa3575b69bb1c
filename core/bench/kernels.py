"""How long the renderers take: projecting, sorting, forward and backward, and their share of the machine's peak."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from ..errors import SettingError
from ..render import KERNELS
from ..render.card import require_card
from . import peer
from .machine import machine
from .scenes import Scene, scene
from .stopwatch import Stopwatch, Watched

RENDERERS = ("splat", "radiograph", "section")
_TRAINED = ("means", "quats", "scales", "opacities", "sh", "density")
# The reference keeps every pixel of every splat: 100 bytes and more for each in a backward pass.
_REFERENCE_PAIRS = 10_000_000


@dataclass(frozen=True)
class Grid:
    """What is measured.

    Attributes:
        renderers, kernel: names.
        splats, sides: every number of splats at every image side (pixels) on all threads.
        threads: `middle` is measured on each of these as well; all cores if empty.
        middle: (splats, side) for `threads`.
        repeats: steps timed after two that are not.
        seed: of the scenes.
    """

    renderers: tuple[str, ...] = RENDERERS
    kernel: str = "cpu"
    splats: tuple[int, ...] = (10_000, 50_000, 200_000, 1_000_000)
    sides: tuple[int, ...] = (200, 400, 800)
    threads: tuple[int, ...] = ()
    middle: tuple[int, int] = (50_000, 400)
    repeats: int = 7
    seed: int = 0

    @classmethod
    def quick(cls) -> Grid:
        """Under a minute: the smallest size and the middle one."""
        return cls(splats=(10_000, 50_000), sides=(200, 400), repeats=3)

    def check(self) -> None:
        """Raises SettingError for a name or number that cannot be measured."""
        for renderer in self.renderers:
            if renderer not in RENDERERS:
                raise SettingError(f"--renderer {renderer}: there is no such renderer; choose {', '.join(RENDERERS)}.")
        if self.kernel not in KERNELS:
            raise SettingError(f"--kernel {self.kernel}: there is no such kernel; choose {', '.join(KERNELS)}.")
        for name, numbers in (("splats", self.splats), ("sizes", self.sides), ("repeats", (self.repeats,))):
            if not numbers or min(numbers) < 1:
                raise SettingError(f"--{name}: give whole numbers of at least 1.")
        most = available_threads()
        if self.threads and not 1 <= min(self.threads) <= max(self.threads) <= most:
            raise SettingError(f"--threads: give numbers from 1 to {most}, as many as this machine has.")

    def cases(self) -> Iterator[tuple[str, int, int, int]]:
        """(renderer, splats, side, threads) of each row."""
        most = available_threads()
        seen = set()
        for renderer in self.renderers:
            grid = [(splats, side, most) for splats in self.splats for side in self.sides]
            grid += [(*self.middle, count) for count in self.threads]
            for case in grid:
                if (renderer, *case) not in seen and not self._too_large(*case[:2]):
                    seen.add((renderer, *case))
                    yield (renderer, *case)

    def _too_large(self, splats: int, side: int) -> bool:
        return self.kernel == "reference" and splats * side * side > _REFERENCE_PAIRS


def available_threads() -> int:
    import numba

    return int(numba.config.NUMBA_NUM_THREADS)


def measure(grid: Grid, tell: Callable[[str], None] | None = None) -> list[dict[str, Any]]:
    """One row for each case of the grid; see `measure_case`. Each row says what machine it was measured on.

    Args:
        tell: told in a few words what is measured next.

    Raises:
        SettingError: the grid cannot be measured here.
    """
    grid.check()
    facts, rows = machine(), []
    cases = list(grid.cases())
    if not cases:
        raise SettingError(
            f"--kernel reference keeps every pixel of every splat in memory; choose --splats and --sizes with "
            f"splats · size² of at most {_REFERENCE_PAIRS:.0e}."
        )
    for renderer, splats, side, threads in cases:
        if tell:
            tell(f"{renderer}, {splats} splats, {side} x {side}, {threads} threads")
        for kernel in (grid.kernel, *_peers(renderer, grid.kernel)):
            row = measure_case(renderer, kernel, scene(splats, side, grid.seed), threads, grid.repeats)
            rows.append({**row, **facts, "threads": threads})
    return rows


def _peers(renderer: str, kernel: str) -> tuple[str, ...]:
    """What else the same case is measured with: gsplat beside `cuda`, where it is installed."""
    return ("gsplat",) if (renderer, kernel) == ("splat", "cuda") and peer.is_installed() else ()


def measure_case(renderer: str, kernel: str, case: Scene, threads: int, repeats: int) -> dict[str, Any]:
    """The row of one case; medians over the repeats, wall time.

    Args:
        kernel: one of KERNELS, or "gsplat" for that library's `splat`.

    Returns:
        `renderer`, `kernel`, `splats`, `width`, `height`, `threads`; `project_ms`, `sort_ms` (depth order and
        binning), `forward_ms` (the rest of the forward pass), `backward_ms` (the whole backward pass), `step_ms`
        (their sum) and `cpu_ms` (processor time of a step, over all threads). For the cpu kernel also
        `pixel_splats` (evaluated in one pass), `pixel_splats_per_s` (both passes over their time), `peak_gflops`
        (this machine's multiply-adds, measured before each repeat) and `peak_share` (of the loops over pixels:
        their operations over their time over that peak, see `work`); None for the others.
    """
    import numba
    import torch

    before = numba.get_num_threads(), torch.get_num_threads()
    numba.set_num_threads(threads)
    torch.set_num_threads(threads)
    try:
        return _measure(renderer, kernel, case, threads, repeats)
    finally:
        numba.set_num_threads(before[0])
        torch.set_num_threads(before[1])


def _measure(renderer: str, kernel: str, case: Scene, threads: int, repeats: int) -> dict[str, Any]:
    from .peak import measure_peak
    from .work import OPERATIONS, evaluated_pixels

    device = _device(kernel)
    watch = Stopwatch(_synchronize(device))
    step = Step(renderer, kernel, case, device)
    times: dict[str, list[float]] = {}
    pixels = None
    with watch.watching(_watched(renderer) if kernel == "cpu" else ()):
        for repeat in range(repeats + 2):
            watch.clear()
            peak = measure_peak() if kernel == "cpu" else None
            processor = time.process_time()
            step.run(watch)
            seconds = dict(watch.seconds)
            seconds["cpu"] = time.process_time() - processor
            if kernel == "cpu" and pixels is None:
                pixels = evaluated_pixels(renderer, watch.calls)
            if repeat < 2:
                continue
            if peak is not None and pixels is not None:
                operations = OPERATIONS[renderer]
                blending = seconds["blend"] + seconds["blend_backward"]
                seconds["peak"] = peak
                seconds["share"] = pixels * sum(operations) / blending / peak
            for label, value in seconds.items():
                times.setdefault(label, []).append(value)
    middle = {label: statistics.median(values) for label, values in times.items()}
    own = kernel == "cpu"
    project, sort = middle.get("project", 0.0), middle.get("sort", 0.0)
    forward = middle["forward"] - project - sort
    row: dict[str, Any] = {
        "renderer": renderer,
        "kernel": kernel,
        "splats": len(case.gaussians),
        "width": case.camera.width,
        "height": case.camera.height,
        "threads": threads,
        "project_ms": 1e3 * project if own else None,
        "sort_ms": 1e3 * sort if own else None,
        "forward_ms": 1e3 * forward,
        "backward_ms": 1e3 * middle["backward"],
        "step_ms": 1e3 * (middle["forward"] + middle["backward"]),
        "cpu_ms": 1e3 * middle["cpu"],
        "pixel_splats": pixels,
        "pixel_splats_per_s": 2 * pixels / (forward + middle["backward"]) if pixels is not None else None,
        "peak_gflops": 1e-9 * middle["peak"] if own else None,
        "peak_share": middle["share"] if own else None,
    }
    return {key: round(value, 4) if isinstance(value, float) else value for key, value in row.items()}


class Step:
    """One render and its backward pass through the public functions, with a random gradient of the image.

    Args:
        mode: of the radiograph.
    """

    def __init__(self, renderer: str, kernel: str, case: Scene, device: str, mode: str = "exact") -> None:
        import torch

        self._renderer, self._kernel, self._case, self._mode = renderer, kernel, case, mode
        gaussians = case.gaussians.to_torch(torch.float32, device)
        trained = {name: getattr(gaussians, name).requires_grad_() for name in _TRAINED}
        self._gaussians = replace(gaussians, **trained)
        self._trained = list(trained.values())
        side = case.camera.width
        shape = (side, side, 3) if renderer == "splat" else (side, side)
        gradient = np.random.default_rng(side).standard_normal(shape, np.float32)
        self._gradient = torch.from_numpy(gradient).to(device)

    def run(self, watch: Stopwatch) -> None:
        for parameter in self._trained:
            parameter.grad = None
        image = watch.time("forward", self.render)
        watch.time("backward", image.backward, self._gradient)

    def render(self) -> Any:
        """The image, a tensor."""
        from ..render import radiograph, section, splat

        if self._kernel == "gsplat":
            return peer.splat_color(self._gaussians, self._case.camera)
        if self._renderer == "splat":
            return splat(self._gaussians, self._case.camera, kernel=self._kernel).color
        if self._renderer == "radiograph":
            return radiograph(self._gaussians, self._case.detector, self._kernel, self._mode)
        return section(self._gaussians, self._case.plane, "density", kernel=self._kernel)


def _watched(renderer: str) -> list[Watched]:
    from ..render.kernels.cpu import radiograph, section, splat

    module = {"splat": splat, "radiograph": radiograph, "section": section}[renderer]
    sorting = ("depth_order", "bin_ellipses") if renderer == "splat" else ("list_bands",)
    return [
        (module, "project", "project"),
        *[(module, name, "sort") for name in sorting],
        (module, "rasterize", "blend"),
        (module, "rasterize_backward", "blend_backward"),
    ]


def _device(kernel: str) -> str:
    if kernel not in ("cuda", "gsplat"):
        return "cpu"
    require_card()
    return "cuda"


def _synchronize(device: str) -> Callable[[], None] | None:
    import torch

    return torch.cuda.synchronize if device == "cuda" else None


def growth(rows: list[dict[str, Any]], middle: tuple[int, int] = Grid.middle) -> list[dict[str, Any]]:
    """How the time of a step grows with splats, pixels and threads, each with the others as in `middle`.

    Returns:
        `renderer`, `by` ("splats", "pixels", "threads"), `low`, `high`, `times` (step at `high` over step at `low`).
    """
    splats, side = middle
    most = max((row["threads"] for row in rows), default=1)
    found = []
    for renderer in dict.fromkeys(row["renderer"] for row in rows):
        own = [row for row in rows if row["renderer"] == renderer]
        lines = {
            "splats": [row for row in own if row["width"] == side and row["threads"] == most],
            "pixels": [row for row in own if row["splats"] == splats and row["threads"] == most],
            "threads": [row for row in own if (row["splats"], row["width"]) == middle],
        }
        for by, line in lines.items():
            sizes = [row["width"] * row["height"] if by == "pixels" else row[by] for row in line]
            ordered = sorted(zip(sizes, (row["step_ms"] for row in line), strict=True))
            for (low, before), (high, after) in pairwise(ordered):
                found.append({"renderer": renderer, "by": by, "low": low, "high": high, "times": after / before})
    return found
