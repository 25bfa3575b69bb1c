"""`insideout check`: what a capture folder holds and what is wrong with it."""

from __future__ import annotations

from pathlib import Path

from .model import Finding
from .read import examine


def check_capture(path: Path) -> list[Finding]:
    """Everything that was found in a capture folder: first what there is, then what is wrong.

    Never raises for a mistake in the capture: each one becomes a finding of level "error". Nothing is changed.
    """
    capture, _ = examine(Path(path))
    return sorted(capture.findings, key=lambda finding: ("info", "warning", "error").index(finding.level))
