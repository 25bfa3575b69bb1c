"""How reading a capture tells the user what it found and what is wrong."""

from __future__ import annotations

from collections.abc import Sequence

from ..errors import CaptureError
from ..told import Told
from .model import Finding


class CaptureProblem(CaptureError):
    """A CaptureError that `insideout check` can also show as a line of its own.

    Args:
        subject: the file it is about.
        message: what is wrong, with places in braces where there are values for them.
        advice: what to do; as `message`.
        values: what is put into the places of both.

    Attributes:
        finding: level "error", with all three.
    """

    def __init__(self, subject: object, message: str, advice: str, /, **values: object) -> None:
        # With a value at hand both are filled in, so that braces are doubled in all of them.
        wrong, mend = (Told(text, subject=str(subject), **values) for text in (message, advice))
        super().__init__("{subject}: {message}; {advice}.", subject=subject, message=wrong, advice=mend)
        self.finding = Finding("error", str(subject), wrong, mend)


def info(subject: object, message: str, /, **values: object) -> Finding:
    """A line that says what was found; `message` and `values` as of `CaptureProblem`."""
    return Finding("info", str(subject), Told(message, **values))


def warning(subject: object, message: str, advice: str, /, **values: object) -> Finding:
    """A line about something that makes the result worse but does not stop a run."""
    return Finding("warning", str(subject), Told(message, **values), Told(advice, **values))


def name_some(names: list[str], limit: int = 5) -> str:
    """The first few names, and how many more there are: `Told` then."""
    some, more = ", ".join(names[:limit]), len(names) - limit
    return Told("{names} and {more} more", names=some, more=more) if more > 0 else some


def last_line(error: Exception) -> str:
    """Of what a library says at length, the end, which tells what is wrong."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1] if lines else type(error).__name__


def joined(texts: Sequence[Told]) -> Told:
    """One text or more with commas between them, each of which is translated by itself."""
    one, *others = texts
    return Told("{one}, {others}", one=one, others=joined(others)) if others else one
