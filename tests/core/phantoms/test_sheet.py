"""The contact sheet: a row for each phantom, four cells with something in each."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from insideout.core.errors import SettingError
from insideout.core.phantoms.sheet import contact_sheet


def test_each_row_shows_the_object_four_times(tmp_path, only_ball):
    path = contact_sheet(tmp_path / "sheet.jpg", ["ball", "ball"], photos_by="rays")

    image = np.asarray(Image.open(path)).astype(float)
    rows, columns = 2, 4
    assert image.shape[1] == columns * 300 + (columns + 1) * 12
    height = (image.shape[0] - 26) // rows
    for row in range(rows):
        for column in range(columns):
            top, left = 26 + row * height + 26, 12 + column * 312
            cell = image[top : top + 300, left : left + 300, 1]
            assert cell.std() > 20
            # The ball is 30 of 32 mm wide; a cell shows 6 % more than that, a photo 30 %.
            # Beside the ticks of the radiograph.
            across = np.ptp(np.flatnonzero(np.abs(np.diff(cell[140])) > 10))
            assert across == pytest.approx(300 * 30 / 32 / (1.3 if column == 0 else 1.06), rel=0.04)


def test_ticks_beside_the_radiograph_say_where_the_axial_section_lies(tmp_path, only_ball):
    """Half way: there a ball has most to see."""
    image = np.asarray(Image.open(contact_sheet(tmp_path / "sheet.jpg", ["ball"], photos_by="rays"))).astype(int)
    radiograph = image[52:352, 12 + 312 : 12 + 612]
    orange = (radiograph[..., 0] - radiograph[..., 2] > 100).any(axis=1)
    assert np.flatnonzero(orange).mean() == pytest.approx(150, abs=2)


def test_an_unknown_name_is_said_before_anything_is_made(tmp_path):
    with pytest.raises(SettingError, match="'teapot' is not known; choose any of: matryoshka"):
        contact_sheet(tmp_path / "sheet.jpg", ["matryoshka", "teapot"], photos_by="rays")
    assert not any(tmp_path.iterdir())
