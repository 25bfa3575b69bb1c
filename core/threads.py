"""How the threads of the kernels wait. Import before numba and torch load their OpenMP runtimes."""

from __future__ import annotations

import os


def wait_without_spinning() -> None:
    """Lets idle OpenMP threads sleep instead of spin, unless the user's OMP_WAIT_POLICY says otherwise.

    Spinning gains microseconds on an idle machine. Beside any other program (Blender, a second run) a spinning thread
    keeps the core from the one it waits for: a step of training on two busy cores took 4 times as long.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
