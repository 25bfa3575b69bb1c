"""The sheet of sections: the truth first, each row beside it, what differs under it."""

import numpy as np
import pytest
from PIL import Image

from insideout.core.compare.cells import decibels
from insideout.core.compare.pictures import Cut, draw_sections, load_cut, save_cut, telling_sections

SCALES = {"air": 0.01, "material": 0.05}


def section(height=60, width=40):
    values = np.zeros((height, width), np.float32)
    values[20:50, 10:30] = 0.05
    return values


@pytest.fixture
def drawn(tmp_path):
    """A row that has too much in its upper half, and too little in its lower one."""
    true = section()
    wrong = true.copy()
    wrong[20:35, 10:30] += 0.02
    wrong[35:50, 10:30] -= 0.02
    draw_sections(
        tmp_path / "sheet.png", Cut("truth", "", [true]), [Cut("a row", "20 dB", [wrong])], 0.05, 0.5, **SCALES
    )
    return np.asarray(Image.open(tmp_path / "sheet.png").convert("RGB")).astype(int)


def count(pixels, color):
    return int((np.abs(pixels - np.array(color)).max(axis=2) < 3).sum())


def test_what_is_too_much_is_orange_above_what_is_too_little_in_blue(drawn):
    blue, orange = ((np.abs(drawn - color).max(axis=2) < 3) for color in ([0, 114, 178], [213, 94, 0]))
    assert blue.sum() == orange.sum() > 1000
    assert np.flatnonzero(orange.any(axis=1)).max() < np.flatnonzero(blue.any(axis=1)).min()


def test_a_row_whose_sections_hardly_show_the_object_has_a_dash_for_its_psnr():
    assert [decibels(value) for value in (30.256, None)] == ["30.26 dB", "–"]


def test_the_object_fills_its_cell(drawn):
    """The picture is cut to the object and enlarged: 38 rows of it and of air come to 304 pixels."""
    black = (drawn[:, :180] < 3).all(axis=2)
    rows = np.flatnonzero(black.any(axis=1))
    assert rows.max() - rows.min() == 8 * 38 - 1


@pytest.mark.parametrize(("faint", "grey"), [(0.0005, 26), (0.003, 62), (0.02, 102)])
def test_plastic_beside_steel_can_be_seen(tmp_path, faint, grey):
    """Greys of what is at 0.01 or 0.06 of white go by the square root, those of what is at 0.4 do not."""
    true = section()
    true[20:40, 10:30] = faint
    scales = {"air": faint / 2, "material": faint}
    draw_sections(tmp_path / "sheet.png", Cut("", "", [true]), [Cut("", "", [true])], 0.05, 0.5, **scales)
    pixels = np.asarray(Image.open(tmp_path / "sheet.png").convert("RGB")).astype(int)
    # Eight pixels of the picture are one of the section along each side; letters have greys, too.
    assert count(pixels, [grey] * 3) == pytest.approx(2 * 20 * 20 * 64, rel=0.01)


@pytest.mark.parametrize(("pixel_mm", "shown"), [(0.5, 2), (0.01, 0.05)])
def test_the_scale_bar_is_as_long_as_it_says(tmp_path, pixel_mm, shown):
    draw_sections(tmp_path / "sheet.png", Cut("truth", "", [section()]), [], 0.05, pixel_mm, **SCALES)
    pixels = np.asarray(Image.open(tmp_path / "sheet.png").convert("RGB")).astype(int)
    ink = (np.abs(pixels - 20).max(axis=2) < 3).sum(axis=1)
    # A line of the bar has more ink than one of letters; eight pixels of the picture are one of the section.
    assert ink.max() - 1 == pytest.approx(8 * shown / pixel_mm, abs=1)


def test_the_section_with_the_most_edges_stands_for_its_kind():
    flat, walls = np.ones((9, 9)), np.indices((9, 9)).sum(axis=0) % 2.0
    assert telling_sections([flat, walls, walls, flat], ["axial", "axial", "coronal", "coronal"]) == [1, 2]


def test_a_kept_cut_comes_back(tmp_path):
    images = [section(), section(5, 7)]
    save_cut(tmp_path / "cut.npz", images)
    for found, image in zip(load_cut(tmp_path / "cut.npz"), images, strict=True):
        np.testing.assert_array_equal(found, image)
    assert load_cut(tmp_path / "none.npz") == []
    (tmp_path / "cut.npz").write_bytes((tmp_path / "cut.npz").read_bytes()[:100])
    assert load_cut(tmp_path / "cut.npz") == []


def test_an_empty_truth_is_shown_whole(tmp_path):
    empty = np.zeros((30, 20), np.float32)
    draw_sections(tmp_path / "sheet.png", Cut("truth", "", [empty]), [], 1.0, 1.0, **SCALES)
    assert count(np.asarray(Image.open(tmp_path / "sheet.png").convert("RGB")).astype(int), [0, 0, 0]) > 20 * 30
