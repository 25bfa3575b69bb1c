"""Work in steps, between which something else may happen. No bpy."""

from __future__ import annotations

from collections.abc import Callable, Generator
from typing import TypeVar

Step = TypeVar("Step")
Result = TypeVar("Result")


def run_through(steps: Generator[Step, None, Result], tick: Callable[[Step], object] | None = None) -> Result:
    """What a generator returns, all its steps made at once.

    Args:
        tick: called with what each step yields; may raise to stop.
    """
    try:
        while True:
            step = next(steps)
            if tick is not None:
                tick(step)
    except StopIteration as end:
        return end.value
