"""How panels write figures."""

from __future__ import annotations

import pytest

pytest.importorskip("bpy")

from insideout.panels.layout import bytes_text, shortened


@pytest.mark.parametrize(("count", "text"), [(17_000_000, "17 MB"), (2_310_000_000, "2.3 GB")])
def test_bytes(count, text):
    assert bytes_text(count) == text


def test_a_long_text_keeps_its_start_and_its_end():
    text = "photos/: " + "x" * 5000 + "; choose another folder."
    short = shortened(text)
    assert len(short) < 500
    assert short.startswith("photos/: x")
    assert short.endswith("x; choose another folder.")
    assert shortened("short") == "short"
