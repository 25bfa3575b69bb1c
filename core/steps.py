"""Work in steps, between which something else may happen."""

from __future__ import annotations

from collections.abc import Callable, Generator
from typing import TypeVar

Step = TypeVar("Step")
Result = TypeVar("Result")


def run_through(steps: Generator[Step, None, Result], tick: Callable[[Step], object] | None = None) -> Result:
    """What a generator returns, all its steps made at once.

    Args:
        tick: called with what each step yields; may raise to stop, and the generator is closed then.
    """
    try:
        while True:
            step = next(steps)
            if tick is not None:
                tick(step)
    except StopIteration as end:
        return end.value
    finally:
        steps.close()


def part_of_work(steps: Generator[float, None, Result], first: float, last: float) -> Generator[float, None, Result]:
    """A part of some work, for `yield from`: what it yields, 0 to 1, as shares of the whole from `first` to `last`."""
    try:
        while True:
            yield first + next(steps) * (last - first)
    except StopIteration as end:
        return end.value
    finally:
        steps.close()
