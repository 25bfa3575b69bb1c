"""A process that speaks JSON lines. No bpy: a thread reads, whoever polls stays responsive."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ...core.errors import InsideOutError
from ...core.processes import KILLED, NO_CONSOLE

Message = dict[str, Any]
# After the polite "cancel" the engine has this long to write its checkpoint before it is ended.
CANCEL_GRACE_S = 0.5
_KILL_GRACE_S = 0.1
# What the engine has started may keep its standard output open when it is gone; nobody waits for that.
_ORPHAN_GRACE_S = 0.5
# The engine works on every core; what the user clicks comes first. 19 leaves it a sixtieth of a core that both want.
_NICENESS = 19
_LAST_WORDS = ("done", "error", "cancelled", "version")


class EngineCrashError(InsideOutError):
    """The engine has ended without a last word."""


class EngineProcess:
    """Starts a command and collects the messages that it prints, one JSON object a line.

    `poll` never waits. Progress that arrives faster than it is polled is dropped but for the newest, so that a
    flood of it costs the user interface nothing; what was measured of views that were kept back is never dropped. A
    process that ends without a last word gets one: an error with the end of its standard error, also as an
    `EngineCrashError`, or `cancelled` if it was asked to stop.

    Args:
        command: program and arguments.
        log: where standard error goes; when None a temporary file, which stays only if the process fails.
        variables: of the environment, beside ours.

    Raises:
        OSError: the program cannot be started.
    """

    def __init__(
        self, command: Sequence[str], log: Path | None = None, variables: Mapping[str, str] | None = None
    ) -> None:
        self._temporary = log is None
        self.log = _temporary_log() if log is None else log
        self.log.parent.mkdir(parents=True, exist_ok=True)
        self._messages: queue.SimpleQueue[Message] = queue.SimpleQueue()
        self._newest_progress: Message | None = None
        self._finished = False
        self._last_word = ""
        self._cancel_started: float | None = None
        self._ended_at: float | None = None
        try:
            self._process = self._start(command, variables or {})
        except OSError:
            self._drop_log()
            raise
        _step_back(self._process)
        self._reader = threading.Thread(target=self._read, name="insideout engine reader", daemon=True)
        self._reader.start()

    @property
    def finished(self) -> bool:
        """Whether the process has ended and its last message has been polled."""
        return self._finished

    def poll(self, limit: int = 100) -> list[Message]:
        """At most `limit` messages since the last call, in order; the newest progress comes last."""
        self._enforce_cancel()
        ended = self._process.poll() is not None and (not self._reader.is_alive() or self._abandon_children())
        messages: list[Message] = []
        while len(messages) < limit:
            try:
                messages.append(self._messages.get_nowait())
            except queue.Empty:
                break
        progress, self._newest_progress = self._newest_progress, None
        last_word = bool(messages) and messages[-1]["type"] in _LAST_WORDS
        if last_word:
            self._last_word = messages[-1]["type"]
        if progress is not None:
            messages.insert(len(messages) - last_word, progress)
        if ended and not self._finished and self._messages.empty():
            self._finished = True
            self._close()
            if not self._last_word:
                messages.append(self._obituary())
                self._last_word = messages[-1]["type"]
            if self._last_word != "error":
                self._drop_log()
        return messages

    def cancel(self) -> None:
        """Asks the process to stop; `poll` ends it, with all it started, if it does not within 0.5 s."""
        if self._cancel_started is not None or self._process.poll() is not None:
            return
        self._cancel_started = time.monotonic()
        with contextlib.suppress(OSError, ValueError):
            self._process.stdin.write(b"cancel\n")
            self._process.stdin.flush()
            self._process.stdin.close()

    def kill(self) -> None:
        """Ends the process and all it started, now."""
        _signal_group(self._process, "SIGKILL")
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(1.0)

    def stop(self) -> None:
        """Asks the process to stop and ends it, with all it started, half a second later at the latest."""
        self.cancel()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(CANCEL_GRACE_S)
        self.kill()
        self._drop_log()

    def wait(self, listener: Callable[[Message], None] | None = None, interval_s: float = 0.05) -> Message:
        """Blocks until the process ends and returns its last message (background mode has no timers)."""
        last: Message = {}
        try:
            while not self.finished:
                for message in self.poll():
                    last = message
                    if listener is not None:
                        listener(message)
                time.sleep(interval_s)
        except BaseException:
            self.kill()
            raise
        return last

    def _start(self, command: Sequence[str], variables: Mapping[str, str]) -> subprocess.Popen[bytes]:
        with open(self.log, "wb") as errors:
            return subprocess.Popen(
                list(command),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                # Not the user's folder, which would be in use as long.
                cwd=tempfile.gettempdir(),
                env={**_clean_environment(), **variables},
                **_own_group(),
            )

    def _read(self) -> None:
        for line in self._process.stdout:
            try:
                message = json.loads(line)
                kind = message["type"]
            except (ValueError, KeyError, TypeError):
                continue
            if kind == "progress" and "heldout" not in message:
                self._newest_progress = message
            elif kind == "progress":
                # What came before is older news, and would be told after it.
                self._newest_progress = None
                self._messages.put(message)
            else:
                self._messages.put(message)

    def _abandon_children(self) -> bool:
        """Ends what outlives the dead process and holds its output; whether it is time to go without it."""
        now = time.monotonic()
        if self._ended_at is None:
            self._ended_at = now
        waited = now - self._ended_at
        if waited > _ORPHAN_GRACE_S:
            _signal_group(self._process, "SIGKILL")
        return waited > _ORPHAN_GRACE_S + _KILL_GRACE_S

    def _enforce_cancel(self) -> None:
        if self._cancel_started is None or self._process.poll() is not None:
            return
        waited = time.monotonic() - self._cancel_started
        if waited > CANCEL_GRACE_S + _KILL_GRACE_S:
            _signal_group(self._process, "SIGKILL")
        elif waited > CANCEL_GRACE_S:
            _signal_group(self._process, "SIGTERM")

    def _obituary(self) -> Message:
        if self._cancel_started is not None:
            return {"type": "cancelled"}
        lines: list[str] = []
        with contextlib.suppress(OSError):
            lines = self.log.read_text("utf-8", "replace").strip().splitlines()
        code = self._process.returncode
        if code in KILLED:
            crash = EngineCrashError(
                "The system ended the engine, most likely because the memory ran out; close other programs, or choose "
                "a faster preset or fewer photos, then run again. The log is in {log}.",
                log=self.log,
            )
        elif lines:
            crash = EngineCrashError(
                "The engine ended unexpectedly (exit code {code}): {words}. The whole log is in {log}.",
                code=code,
                words=" | ".join(line.strip() for line in lines[-3:]),
                log=self.log,
            )
        else:
            crash = EngineCrashError(
                "The engine ended unexpectedly (exit code {code}): it left no message. The whole log is in {log}.",
                code=code,
                log=self.log,
            )
        return {"type": "error", "kind": "EngineCrash", "message": str(crash), "crash": crash}

    def _close(self) -> None:
        # Closing what another thread still reads from would wait for that thread.
        reading = self._reader.is_alive()
        for stream in (self._process.stdin, *(() if reading else (self._process.stdout,))):
            with contextlib.suppress(OSError, ValueError):
                stream.close()

    def _drop_log(self) -> None:
        if self._temporary:
            with contextlib.suppress(OSError):
                self.log.unlink()


def _temporary_log() -> Path:
    handle, path = tempfile.mkstemp(prefix="insideout-", suffix=".log")
    os.close(handle)
    return Path(path)


def _clean_environment() -> dict[str, str]:
    """Ours, without what Blender's own Python would impose on another Python.

    And with nothing imported from the working folder: it is one of temporary files, where anyone's torch.py may lie.
    """
    dropped = ("PYTHONHOME", "PYTHONPATH", "PYTHONSTARTUP", "VIRTUAL_ENV", "__PYVENV_LAUNCHER__")
    kept = {name: value for name, value in os.environ.items() if name not in dropped}
    return {**kept, "PYTHONUNBUFFERED": "1", "PYTHONUTF8": "1", "PYTHONNOUSERSITE": "1", "PYTHONSAFEPATH": "1"}


def _own_group() -> dict[str, Any]:
    if os.name == "nt":
        return {
            "creationflags": subprocess.CREATE_NEW_PROCESS_GROUP
            | subprocess.CREATE_NO_WINDOW
            | subprocess.BELOW_NORMAL_PRIORITY_CLASS
        }
    return {"start_new_session": True}


def _step_back(process: subprocess.Popen[bytes]) -> None:
    if os.name != "nt":
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, process.pid, os.getpriority(os.PRIO_PROCESS, 0) + _NICENESS)


def _signal_group(process: subprocess.Popen[bytes], name: str) -> None:
    if os.name == "nt":
        subprocess.run(
            ["taskkill", "/T", "/F", "/PID", str(process.pid)], capture_output=True, check=False, **NO_CONSOLE
        )
        return
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, getattr(signal, name))
