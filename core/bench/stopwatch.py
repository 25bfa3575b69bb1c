"""Where the time of a call goes: named functions of a module are timed while a block runs."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any

Watched = tuple[ModuleType, str, str]
"""Module, name of the function in it, and the label its time is added to."""


class Stopwatch:
    """Adds up the wall time of watched functions by label.

    Attributes:
        seconds: by label, since the last `clear`.
        calls: the arguments of the last call, by label.
        synchronize: called around every watched call, for work that a device goes on with.
    """

    def __init__(self, synchronize: Callable[[], None] | None = None) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self.calls: dict[str, tuple[Any, ...]] = {}
        self.synchronize = synchronize or (lambda: None)

    def clear(self) -> None:
        self.seconds.clear()
        self.calls.clear()

    @contextmanager
    def watching(self, functions: Iterable[Watched]) -> Iterator[Stopwatch]:
        """Puts timed versions in the functions' places while the block runs."""
        originals = [(module, name, getattr(module, name), label) for module, name, label in functions]
        try:
            for module, name, function, label in originals:
                setattr(module, name, self._timed(function, label))
            yield self
        finally:
            for module, name, function, _ in originals:
                setattr(module, name, function)

    def time(self, label: str, function: Callable[..., Any], *args: Any) -> Any:
        """Calls a function and adds its time to a label."""
        return self._timed(function, label)(*args)

    def _timed(self, function: Callable[..., Any], label: str) -> Callable[..., Any]:
        def call(*args: Any) -> Any:
            self.synchronize()
            begin = time.perf_counter()
            try:
                return function(*args)
            finally:
                self.synchronize()
                self.seconds[label] += time.perf_counter() - begin
                self.calls[label] = args

        return call
