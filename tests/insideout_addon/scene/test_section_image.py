"""Sections as pictures and files: window, colour bar, calibrated values, millimetres."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from insideout.core.colormap import density_colors
from insideout.core.render.section_numpy import section_density
from insideout.core.views import Plane
from insideout.insideout_addon.scene.lettering import lettering
from insideout.insideout_addon.scene.section_image import (
    PER_MM,
    RELATIVE_UNIT,
    Picture,
    Window,
    difference_rgba,
    hounsfield,
    pixel_mm,
    save_figures,
    save_values,
    section_contours,
    section_rgba,
    size_mm,
    ticks,
    with_bar,
    with_caption,
)

WINDOW = Window(0.0, 0.05)


def _plane(pixels=80, side_mm=40.0, z=1.0):
    step = side_mm / pixels
    return Plane(np.array([3 - side_mm / 2, -2 + side_mm / 2, z]), [step, 0, 0], [0, -step, 0], pixels, pixels)


def _picture(values):
    return Picture(section_rgba(values, WINDOW), WINDOW)


def test_colours_are_those_of_the_density():
    values = np.array([[0.0, 0.025, 0.05, 0.2]])
    rgba = section_rgba(values, WINDOW)
    np.testing.assert_allclose(rgba[..., :3], density_colors(values, 0.0, 0.05), atol=2e-3)


def test_air_is_transparent_and_material_is_not():
    assert section_rgba(np.array([[0.0, 0.001, 0.03]]), WINDOW)[0, :, 3].tolist() == [0, 0, 1]


def test_what_is_no_number_is_air_and_what_is_endless_is_material():
    rgba = section_rgba(np.array([[np.nan, -np.inf, np.inf]]), WINDOW)
    assert rgba[0, :, 3].tolist() == [0, 0, 1]
    np.testing.assert_array_equal(rgba[0, 2], section_rgba(np.array([[0.05]]), WINDOW)[0, 0])


def test_material_below_the_window_is_darkest_and_no_hole():
    rgba = section_rgba(np.array([[0.0, 0.015, 0.03]]), Window(0.02, 0.04))
    assert rgba[0, :, 3].tolist() == [0, 1, 1]
    np.testing.assert_allclose(rgba[0, 1, :3], density_colors(np.array(0.0), 0.0, 1.0), atol=2e-3)
    differences = difference_rgba(np.array([[0.0, 0.005]]), np.array([[0.0, 0.015]]), Window(0.02, 0.04))
    assert differences[0, :, 3].tolist() == [0, 1]


@pytest.mark.parametrize("unit", [PER_MM, RELATIVE_UNIT, hounsfield(0.02)])
def test_every_unit_can_be_written_into_pictures(unit):
    assert all(lettering(character).any() for character in unit.label)


def test_ticks_span_the_window():
    assert ticks(WINDOW, 3) == [(0.0, "0.0000"), (0.5, "0.0250"), (1.0, "0.0500")]
    assert [text for _, text in ticks(Window(0, 2), 2)] == ["0.00", "2.00"]


def test_the_figure_holds_the_section_and_a_bar_from_bright_to_dark():
    values = np.full((200, 100), 0.05)
    picture = with_bar(_picture(values))
    assert picture.shape[0] == 200
    assert picture.shape[1] > 130
    brightest = np.rint(density_colors(np.array(0.05), 0, 0.05) * 255)
    assert (picture[:, :100] == brightest).all()
    bar = picture[:, 100:].astype(float)
    colored = bar.max(axis=2) - bar.min(axis=2) > 30
    column = np.flatnonzero(colored.any(axis=0))[0] + 2
    shades = bar[colored[:, column], column].mean(axis=1)
    assert shades[0] > 170
    assert shades[-1] < 60


@pytest.mark.parametrize("name", ["Model", "CT", "Difference (model - CT)"])
@pytest.mark.parametrize("unit", [PER_MM, RELATIVE_UNIT, hounsfield(0.02)])
@pytest.mark.parametrize("pixels", [80, 512])
def test_a_caption_over_a_picture_is_written_whole(name, unit, pixels):
    """Wider than a small picture; at the size that the colour bar's letters have."""
    picture = replace(_picture(np.zeros((pixels, pixels))), name=name, unit=unit)
    figure, bare = with_caption(picture), with_bar(picture)
    np.testing.assert_array_equal(figure[-bare.shape[0] :, : bare.shape[1]], bare)
    text = f"{name}, {unit.label}"
    assert all(lettering(letter).any() for letter in text.replace(" ", ""))
    size = 1 if pixels == 80 else 2
    letters = lettering(text, size)
    margin = 6 * size
    ink = figure[: -bare.shape[0], :, 0] < 128
    np.testing.assert_array_equal(ink[margin:-margin, margin : margin + letters.shape[1]], letters)
    assert ink.sum() == letters.sum()


def test_values_are_saved_calibrated(tmp_path, one_ball, read_png):
    plane = _plane()
    values = section_density(one_ball, plane)
    save_values(tmp_path / "s.png", values, WINDOW, plane)
    pixels, per_metre, texts = read_png(tmp_path / "s.png")
    low, high = float(texts["Density low (1/mm)"]), float(texts["Density high (1/mm)"])
    np.testing.assert_allclose(low + pixels / 65535 * (high - low), values, atol=0.05 / 65535)
    assert pixels.max() / 65535 * high == pytest.approx(0.04, rel=0.01)
    assert per_metre == 2000


def test_relative_values_are_saved_without_a_unit(tmp_path, one_ball, read_png):
    plane = _plane()
    values = section_density(one_ball, plane)
    save_values(tmp_path / "values.png", values, WINDOW, plane, relative=True)
    save_figures(tmp_path / "figure.png", [replace(_picture(values), unit=RELATIVE_UNIT)], WINDOW, plane)
    for name in ("values.png", "figure.png"):
        texts = read_png(tmp_path / name)[2]
        assert float(texts["Density high (relative)"]) == pytest.approx(WINDOW.high)
        assert not any("1/mm" in text for text in texts)


def test_the_picture_is_saved_in_real_size(tmp_path, one_ball, read_png):
    plane = _plane()
    pictures = [replace(_picture(section_density(one_ball, plane)), name=name) for name in ("Model", "CT")]
    save_figures(tmp_path / "s.png", pictures, WINDOW, plane)
    pixels, per_metre, texts = read_png(tmp_path / "s.png")
    assert pixels.shape[2] == 3
    left, right = (with_caption(picture) for picture in pictures)
    figure = np.concatenate([left, right], axis=1)
    np.testing.assert_array_equal(pixels[: len(figure)], figure, "pictures stand side by side")
    letters = lettering("z = 1.00 mm", 1)
    np.testing.assert_array_equal(pixels[-6 - len(letters) : -6, 6 : 6 + letters.shape[1], 0] < 128, letters)
    assert (pixels[len(figure) :] < 128).all(axis=2).sum() == letters.sum(), "nothing else stands below them"
    assert per_metre == 2000
    assert (texts["Position"], texts["Plane u (mm per pixel)"]) == ("z = 1.00 mm", "0.5 0 0")
    assert texts["Pictures"] == "Model, CT"


def test_where_the_section_lies_is_written_whole_under_a_small_picture(tmp_path, read_png):
    u, v = 0.5 * np.array([0.8, 0.0, -0.6]), np.array([0.0, -0.5, 0.0])
    plane = Plane(np.array([6.0, 0, 8.0]) - 4 * u - 4 * v, u, v, 8, 8)
    save_figures(tmp_path / "s.png", [_picture(np.zeros((8, 8)))], WINDOW, plane)
    letters = lettering("10.000 mm along (0.60, 0.00, 0.80)", 1)
    pixels, *_ = read_png(tmp_path / "s.png")
    np.testing.assert_array_equal(pixels[-6 - len(letters) : -6, 6 : 6 + letters.shape[1], 0] < 128, letters)


def test_contours_of_a_ball_have_its_radius_in_mm(one_ball):
    """At a distance r from the centre a splat of 5 mm has the density 0.04·exp(-r²/50)."""
    radius = 6.0
    (contour,) = section_contours(section_density(one_ball, _plane()), _plane(), 0.04 * np.exp(-(radius**2) / 50))
    distance = np.linalg.norm(contour.model_mm - [3, -2, 1], axis=1)
    np.testing.assert_allclose(distance, radius, atol=0.01)
    assert contour.area_mm2 == pytest.approx(np.pi * radius**2, rel=5e-3)
    assert contour.length_mm == pytest.approx(2 * np.pi * radius, rel=5e-3)
    np.testing.assert_allclose(contour.section_mm.mean(axis=0), 20.0, atol=0.1)


def test_contours_off_the_middle_are_smaller(one_ball):
    level, z = 0.04 * np.exp(-36 / 50), 1.0 + 3.0
    (contour,) = section_contours(section_density(one_ball, _plane(z=z)), _plane(z=z), level)
    assert contour.area_mm2 == pytest.approx(np.pi * (36 - 9), rel=1e-2)


def test_pixels_that_are_not_square_keep_their_size(one_ball):
    """The same circle on pixels of 1 mm by 0.5 mm."""
    plane = Plane(np.array([-17.0, 18.0, 1.0]), [1.0, 0, 0], [0, -0.5, 0], 40, 80)
    assert (pixel_mm(plane), size_mm(plane)) == ((1.0, 0.5), (40.0, 40.0))
    (contour,) = section_contours(section_density(one_ball, plane), plane, 0.04 * np.exp(-36 / 50))
    np.testing.assert_allclose(np.linalg.norm(contour.section_mm - 20.0, axis=1), 6.0, atol=0.05)
    assert contour.area_mm2 == pytest.approx(np.pi * 36, rel=1e-2)
