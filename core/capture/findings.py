"""How reading a capture tells the user what it found and what is wrong."""

from __future__ import annotations

from ..errors import CaptureError
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
        super().__init__(f"{{subject}}: {message}; {advice}.", subject=subject, **values)
        self.finding = Finding("error", str(subject), message.format(**values), advice.format(**values))


def info(subject: object, message: str) -> Finding:
    """A line that says what was found."""
    return Finding("info", str(subject), message)


def warning(subject: object, message: str, advice: str) -> Finding:
    """A line about something that makes the result worse but does not stop a run."""
    return Finding("warning", str(subject), message, advice)


def name_some(names: list[str], limit: int = 5) -> str:
    """The first few names, and how many more there are."""
    more = len(names) - limit
    return ", ".join(names[:limit]) + (f" and {more} more" if more > 0 else "")
