"""The most memory that a forward and backward pass needs, measured in a process of its own."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from ..errors import InsideOutError, SettingError
from .kernels import RENDERERS, Step
from .machine import machine
from .scenes import scene
from .stopwatch import Stopwatch

_STATUS = Path("/proc/self/status")


class MeasurementError(InsideOutError):
    """A process that was to be measured did not come back with a result."""


def measure_memory(renderer: str = "splat", splats: int = 1_000_000, side: int = 800, seed: int = 0) -> dict[str, Any]:
    """Starts a process that renders one scene forward and backward twice.

    Returns:
        `renderer`, `splats`, `width`, `height`; `peak_mb`, the most that the whole process had in memory, Python and
        its libraries included; `before_mb`, what it had with the scene in place; the machine.

    Raises:
        SettingError: this system does not tell how much memory a process had.
        MeasurementError: the process failed, with its own last words.
    """
    # Where a system does not tell it, no process need be started to find that out.
    peak_bytes()
    module = __spec__.name if __spec__ else __name__
    command = [sys.executable, "-m", module, renderer, str(splats), str(side), str(seed)]
    done = subprocess.run(command, capture_output=True, encoding="utf-8", check=False)
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["it was killed"])[-1]
        raise MeasurementError(
            f"bench memory: {splats} splats at {side} x {side} did not get through ({last}); choose fewer --splats."
        )
    return {**json.loads(done.stdout.splitlines()[-1]), **machine()}


def peak_bytes() -> int:
    """The most memory that this process has had resident since it started.

    Raises:
        SettingError: the system has neither /proc nor `getrusage`, as Windows.
    """
    if _STATUS.exists():
        for line in _STATUS.read_text(encoding="ascii", errors="replace").splitlines():
            if line.startswith("VmHWM:"):
                return 1024 * int(line.split()[1])
    try:
        import resource
    except ImportError as error:
        raise SettingError(
            "bench memory: this system does not tell how much memory a process had at most; run it on Linux or macOS."
        ) from error
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else 1024 * most


def _measure_here(renderer: str, splats: int, side: int, seed: int) -> dict[str, Any]:
    step = Step(renderer, "cpu", scene(splats, side, seed), "cpu")
    before = peak_bytes()
    for _ in range(2):
        step.run(Stopwatch())
    sizes = {"renderer": renderer, "kernel": "cpu", "splats": splats, "width": side, "height": side}
    return {**sizes, "before_mb": round(before / 1e6), "peak_mb": round(peak_bytes() / 1e6)}


if __name__ == "__main__":
    name, *numbers = sys.argv[1:]
    if name not in RENDERERS:
        raise SystemExit(f"there is no renderer {name}")
    print(json.dumps(_measure_here(name, *map(int, numbers))))
