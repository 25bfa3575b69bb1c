"""How panels write figures."""

from __future__ import annotations

import pytest

pytest.importorskip("bpy")

from insideout.panels.layout import bytes_text, duration


@pytest.mark.parametrize(("seconds", "text"), [(0.4, "0 s"), (45, "45 s"), (200, "3 min 20 s"), (7500, "2 h 5 min")])
def test_durations(seconds, text):
    assert duration(seconds) == text


@pytest.mark.parametrize(("count", "text"), [(17_000_000, "17 MB"), (2_310_000_000, "2.3 GB")])
def test_bytes(count, text):
    assert bytes_text(count) == text
