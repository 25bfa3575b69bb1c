"""What the threads of the kernels share and how they wait. Import before numba and torch load their OpenMP runtimes."""

from __future__ import annotations

import os


def wait_without_spinning() -> None:
    """Lets idle OpenMP threads sleep instead of spin, unless the user's OMP_WAIT_POLICY says otherwise.

    Spinning gains microseconds on an idle machine. Beside any other program (Blender, a second run) a spinning thread
    keeps the core from the one it waits for: a step of training on two busy cores took 4 times as long.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


def usable_cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def loops_only() -> dict[str, bool]:
    """Numba's option `parallel` for functions where nothing but the loops over `prange` is shared out among threads.

    With `parallel=True` every `np.zeros`, sum and array expression becomes a parallel loop too, each of which wakes
    all threads: up to 45 µs, a few numbers or many. A new dictionary for each function, because Numba empties it.
    """
    others = ("comprehension", "reduction", "inplace_binop", "setitem", "numpy", "stencil", "fusion")
    return {"prange": True, **dict.fromkeys(others, False)}


class Alone:
    """`with Alone(size < limit): kernel(...)`: where it holds, the kernel's loops run on the calling thread only.

    Waking the sleeping threads and waiting for them takes some 45 µs; a shorter loop has ended by then. The loops'
    tasks are the same, and so are the results.
    """

    __slots__ = ("_before", "_wanted")

    def __init__(self, wanted: bool) -> None:
        self._wanted, self._before = wanted, 0

    def __enter__(self) -> None:
        if self._wanted:
            import numba

            self._before = numba.get_num_threads()
            numba.set_num_threads(1)

    def __exit__(self, *_: object) -> None:
        if self._wanted:
            import numba

            numba.set_num_threads(self._before)
