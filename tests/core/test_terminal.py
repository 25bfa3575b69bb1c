"""What the command line shows while it works."""

import io

import pytest
from rich.console import Console

from insideout.core.progress import Progress
from insideout.core.terminal import Bars, run_table


@pytest.mark.parametrize("width", [60, 80, 120])
def test_a_long_name_leaves_room_for_what_is_being_done(width):
    """In a comparison a row's name took all of it, and what was said of the row stood upright, a letter a line."""
    shown = io.StringIO()
    with Bars(Console(file=shown, width=width)) as bars:
        stage = "matryoshka, R²-Gaussian at our rates, 4500 iterations"
        bars.progress(Progress(stage, "surface xray", 0.25, iteration=2234, iterations=4500, splats=87_714, loss=0.003))
    lines = shown.getvalue().splitlines()
    assert max(map(len, lines)) <= width
    assert any("matryoshka" in line and "25%" in line for line in lines)
    for word in ("surface", "2234/4500", "87714", "0.0030"):
        assert any(word in line for line in lines)


@pytest.mark.parametrize(("scale", "told"), [(0.0123456, "0.01235"), (1.0, "1.000"), (250.0, "250.000")])
def test_a_small_photo_frame_has_as_many_digits(scale, told):
    shown = io.StringIO()
    Console(file=shown, width=80).print(run_table({"similarity": {"scale": scale}}))
    assert f"1 unit = {told} mm" in shown.getvalue()
