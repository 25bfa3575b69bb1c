"""What those who start other processes need to know about the system. Python alone."""

from __future__ import annotations

import subprocess
from typing import Any

NO_CONSOLE: dict[str, Any] = {"creationflags": getattr(subprocess, "CREATE_NO_WINDOW", 0)}
"""For `subprocess`: on Windows each console program would flash a window; elsewhere it changes nothing."""

KILLED = (-9, 137)
"""Exit codes of a program that the system ended for want of memory, as Python says it and as a shell does."""
