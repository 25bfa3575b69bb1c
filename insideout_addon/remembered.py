"""Answers that panels ask for at every redraw, and that a slow or sleeping disk must not be asked for each time."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

Answer = TypeVar("Answer")
SECONDS = 2.0
_MOST = 64
_answers: dict[tuple[Any, ...], tuple[float, Any]] = {}


def remembered(ask: Callable[..., Answer]) -> Callable[..., Answer]:
    """Asks again only after 2 s or `forget`; arguments must be hashable. Raised errors are not kept."""

    @wraps(ask)
    def answer(*arguments: Any) -> Answer:
        key, now = (ask, *arguments), time.monotonic()
        known = _answers.get(key)
        if known is not None and now - known[0] < SECONDS:
            return known[1]
        if len(_answers) >= _MOST:
            _answers.clear()
        value = ask(*arguments)
        _answers[key] = (now, value)
        return value

    return answer


def forget() -> None:
    """Makes the next question of each kind a real one: the files have just changed."""
    _answers.clear()
