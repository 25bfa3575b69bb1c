"""What a measurement was made on."""

from __future__ import annotations

import os
import platform
import re
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from ..threads import usable_cores


def machine() -> dict[str, Any]:
    """Date (UTC), processor, cores that may be used, load, versions, and the card if there is one."""
    import numba
    import torch

    facts: dict[str, Any] = {
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "cpu": _processor(),
        "cores": usable_cores(),
        "threads": numba.config.NUMBA_NUM_THREADS,
        "load": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "versions": {name: version(name) for name in ("numpy", "numba", "llvmlite", "torch")},
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
    }
    return facts


def summary(facts: dict[str, Any]) -> str:
    """One line of `machine()`."""
    return f"{facts['date']}, {where(facts)}; load at the start {facts['load']}"


def where(facts: dict[str, Any]) -> str:
    """The machine and its versions, without when and how busy it was."""
    versions = ", ".join(f"{name} {number}" for name, number in facts["versions"].items())
    card = f", {facts['gpu']}" if facts["gpu"] else ""
    cores = "1 core" if facts["cores"] == 1 else f"{facts['cores']} cores"
    if facts.get("threads", facts["cores"]) != facts["cores"]:
        cores += f" ({facts['threads']} used)"
    return f"{facts['cpu']}, {cores}{card}, {facts['system']}, Python {facts['python']}, {versions}"


def _processor() -> str:
    listing = Path("/proc/cpuinfo")
    if listing.exists():
        found = _first_processor(listing.read_text(encoding="utf-8", errors="replace"))
        if found:
            return found
    return platform.processor() or platform.machine()


def _first_processor(listing: str) -> str:
    """Its name in /proc/cpuinfo, "" if it has none. Virtual machines call all of a maker's alike: family and model
    tell those apart that have no number in their names."""
    facts: dict[str, str] = {}
    for line in listing.splitlines():
        name, _, value = line.partition(":")
        facts.setdefault(name.strip(), " ".join(value.split()))
    name = facts.get("model name", "")
    if name and not re.search(r"\d", name) and "cpu family" in facts and "model" in facts:
        return f"{name} (family {facts['cpu family']}, model {facts['model']})"
    return name
