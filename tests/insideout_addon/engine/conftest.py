"""Blender's main loop as the add-on meets it in a window."""

from __future__ import annotations

import gc
import time
from pathlib import Path

import bpy
import numpy as np
import pytest

from insideout.insideout_addon import in_work
from insideout.insideout_addon.engine import commands, job
from insideout.panels import CLASSES

# What the window may wait for us; Blender's own redrawing comes on top. On a machine of its own every call keeps within
# the first: the longest, one node group of an import, takes 25 to 40 ms. Where others use memory and disk, one call in
# a hundred may take longer.
_LONGEST_S = 0.1
_LONGEST_EVER_S = 0.25
_SCHEDULE = Path("/proc/thread-self/schedstat")


class _Window:
    """Stands for Blender's main loop: fires timers and draws, and notes how long each call of ours takes.

    `busy` is the time of this thread alone, so that other work on the machine does not count. `gaps` are from one
    turn to the next, with what waits for the disk, the engine or a lock, and without what waits for a core.
    """

    def __init__(self, draw):
        self.timers, self.busy, self.gaps = [], [], []
        self.draw = draw

    def register(self, function, first_interval=0.0, persistent=False):
        self.timers.append([time.monotonic() + first_interval, function])

    def is_registered(self, function):
        return any(known == function for _, known in self.timers)

    def unregister(self, function):
        self.timers = [entry for entry in self.timers if entry[1] != function]

    def run(self, until, within_s):
        deadline = time.monotonic() + within_s
        while not until():
            assert time.monotonic() < deadline
            self.turns(1)

    def turns(self, count):
        for _ in range(count):
            began = _clock()
            for entry in [entry for entry in self.timers if entry[0] <= time.monotonic()]:
                self.timers.remove(entry)
                again = self._timed(entry[1])
                if again is not None:
                    self.register(entry[1], again)
            self._timed(lambda: [cls.poll(bpy.context) for cls in CLASSES if hasattr(cls, "poll")])
            self._timed(self.draw)
            time.sleep(0.01)
            self.gaps.append(_clock() - began)

    def _timed(self, function):
        began = time.thread_time()
        try:
            return function()
        finally:
            self.busy.append(time.thread_time() - began)

    def check(self):
        assert len(self.busy) > 100
        for what, seconds in (("call", self.busy), ("turn", self.gaps)):
            assert np.quantile(seconds, 0.99) < _LONGEST_S, f"one {what} of a hundred"
            assert max(seconds) < _LONGEST_EVER_S, f"{what} {np.argmax(seconds)} of {len(seconds)}"


def _clock():
    """Seconds, without those in which this thread was ready and had no core (Linux tells them)."""
    now = time.perf_counter()
    try:
        return now - int(_SCHEDULE.read_text("ascii").split()[1]) / 1e9
    except OSError:
        return now


@pytest.fixture
def window(draw_panels, monkeypatch):
    """Timers run as in a window; every turn of the loop draws the whole sidebar."""
    loop = _Window(draw_panels)

    class App:
        background = False
        online_access = False
        timers = loop

    class Bpy:
        app = App
        context = bpy.context
        types = bpy.types
        data = bpy.data
        ops = bpy.ops
        path = bpy.path

    for module in (job, commands, in_work):
        monkeypatch.setattr(module, "bpy", Bpy)
    # Torch and pytest, which Blender has not, are 200,000 objects: some 80 ms of a call in which they are collected.
    gc.collect()
    gc.freeze()
    yield loop
    gc.unfreeze()
    job.abandon_job()
