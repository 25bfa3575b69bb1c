"""Measurements are read in terminals of any width, and in files."""

from io import StringIO

import pytest
from rich.console import Console

from insideout.core.bench.tables import Column, Table, number, weights_table


@pytest.mark.parametrize("width", [20, 80, 300])
def test_no_cell_is_cut_off_however_narrow_the_terminal_is(width):
    columns = [Column(f"a long heading {k}", number("value", ".6f")) for k in range(6)]
    told = StringIO()
    Table("Measured", columns, [{"value": 123.456789}]).show(Console(file=told, width=width))
    assert "…" not in told.getvalue()
    (line,) = (line for line in told.getvalue().splitlines() if "123" in line)
    assert line.split() == ["123.456789"] * 6


def test_a_body_s_two_rows_say_what_they_were_weighed_from():
    row = {"body": "solid ball", "mass_g": 1.0, "found_g": 1.0, "off": 0.0, "center_off_mm": 0.0, "inertia_off": 0.0}
    told = StringIO()
    weights_table([row | {"weighed": kind} for kind in ("voxels", "splats")]).show(Console(file=told, width=80))
    assert "voxels" in told.getvalue()
    assert "splats" in told.getvalue()
