"""pycolmap, imported only where it is needed: it is large, and takes a signal for itself."""

from __future__ import annotations

import signal
import threading
from types import ModuleType


def load_pycolmap() -> ModuleType:
    """pycolmap, with SIGTERM left to whoever handled it before, if this is the main thread.

    Its import installs a handler of its own, unknown to Python, that prints a stack trace and ends the process at once:
    a run that the system asks to end would lose its steps since the last checkpoint.
    """
    import pycolmap

    if threading.current_thread() is threading.main_thread():
        handler = signal.getsignal(signal.SIGTERM)
        # None is a handler that was not installed from Python, which cannot put it back.
        if handler is not None:
            signal.signal(signal.SIGTERM, handler)
    return pycolmap
