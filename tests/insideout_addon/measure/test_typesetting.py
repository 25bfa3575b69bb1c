"""Lettering by Blender's font."""

from __future__ import annotations

import numpy as np
import pytest

from insideout.insideout_addon.measure.page import coverage
from insideout.insideout_addon.measure.typesetting import typesetter


@pytest.fixture
def letter(blender):
    with typesetter() as letter:
        yield letter


def _ink(outline, size=60):
    return coverage([loop * size + (0, size) for loop in outline.loops], int(outline.width * size) + 1, int(1.4 * size))


def test_letters_stand_on_the_baseline(letter):
    outline = letter("H")
    points = np.concatenate(outline.loops)
    assert points[:, 1].max() == pytest.approx(0.0, abs=0.01)
    assert 0.6 < -points[:, 1].min() < 0.8
    assert points[:, 0].min() == pytest.approx(0.0, abs=1e-6)
    assert points[:, 0].max() == pytest.approx(outline.width)


def test_a_letter_with_a_hole_has_the_hole(letter):
    ink = _ink(letter("O"))
    rows, columns = np.nonzero(ink > 0.5)
    assert ink[(rows.min() + rows.max()) // 2, (columns.min() + columns.max()) // 2] < 1e-6
    assert 0.2 < ink.sum() / (np.ptp(rows) * np.ptp(columns)) < 0.6


def test_units_and_other_languages_have_letters(letter):
    for text in ("⁻", "¹", "²", "°", "µ", "ä", "·"):
        assert _ink(letter(text)).sum() > 5, text
    assert letter("mm⁻¹").width > letter("mm").width
    shapes = [_ink(letter(text)).tobytes() for text in ("1", "7", "ä", "a")]
    assert len(set(shapes)) == 4


def test_nothing_is_left_in_the_file(blender):
    with typesetter() as letter:
        letter("x")
        assert letter(" ").loops == []
        assert letter("").width == 0
    assert not blender.data.objects
    assert not blender.data.curves
    assert not blender.data.meshes
