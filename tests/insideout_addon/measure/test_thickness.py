"""Wall thickness: shapes whose inscribed circles are known."""

from __future__ import annotations

import numpy as np
import pytest

from insideout.core.views import Plane
from insideout.insideout_addon.measure.thickness import (
    ThicknessFigures,
    thickness_figures,
    thickness_in_steps,
    wall_thickness,
)
from insideout.insideout_addon.scene.section_image import section_contours

LEVEL = 0.02


def _plane(width=200, height=200, pixel=0.25):
    """Its middle is at (0, 0, 3), x to the right, z down."""
    return Plane([-0.5 * width * pixel, 0, 3 - 0.5 * height * pixel], [pixel, 0, 0], [0, 0, pixel], width, height)


def _measure(inside_mm, plane=None):
    """Contours and thickness of a shape given by the distance in mm from its edge, positive inside."""
    plane = plane or _plane()
    x, _, z = np.moveaxis(plane.points(), -1, 0)
    values = LEVEL + 0.004 * inside_mm(x, z - 3)
    contours = section_contours(values, plane, LEVEL)
    return contours, wall_thickness(values, plane, contours)


def _box(x, y, half_x, half_y):
    return np.minimum(half_x - np.abs(x), half_y - np.abs(y))


def test_a_ring_is_equally_thick_all_around():
    contours, thickness = _measure(lambda x, y: 2.0 - np.abs(np.hypot(x, y) - 15.0))
    assert len(contours) == 2
    for line in thickness:
        np.testing.assert_allclose(line, 4.0, atol=0.01)


def test_a_ring_of_two_pixels_is_measured_too():
    _, thickness = _measure(lambda x, y: 0.25 - np.abs(np.hypot(x, y) - 15.0))
    for line in thickness:
        assert np.nanmedian(line) == pytest.approx(0.5, abs=0.03)


def test_walls_that_are_not_parallel_have_their_inscribed_circles():
    """Between circles of 20 and 10 mm whose middles are 6 mm apart, seen from outside and from inside."""
    outer, inner, apart = 20.0, 10.0, 6.0
    contours, (around, hole) = _measure(lambda x, y: np.minimum(outer - np.hypot(x, y), np.hypot(x - apart, y) - inner))
    from_middle = contours[0].model_mm - [0, 0, 3]
    cosine = from_middle[:, 0] / outer
    exact = (outer**2 - 2 * outer * apart * cosine + apart**2 - inner**2) / (outer + inner - apart * cosine)
    np.testing.assert_allclose(around, exact, atol=0.03)
    for line in (around, hole):
        assert [line.min(), line.max()] == pytest.approx([outer - inner - apart, outer - inner + apart], abs=0.02)


def test_a_wedge_is_thicker_away_from_its_tip():
    """Two walls at 40°: 2·tan 20° for each mm from the tip, from either side."""
    slope = np.tan(np.radians(20.0))

    def inside(x, y):
        return np.minimum((slope * (x + 24) - np.abs(y)) * np.cos(np.radians(20.0)), 20.0 - x)

    (contour,), (line,) = _measure(inside)
    place = contour.model_mm - [0, 0, 3]
    from_tip = np.hypot(place[:, 0] + 24, place[:, 2])
    middle = (place[:, 0] < 0) & (from_tip > 4)
    np.testing.assert_allclose(line[middle], 2 * slope * from_tip[middle], atol=0.05)
    assert np.isnan(line[place[:, 0] > 19.9]).mean() > 0.5, "its base has no wall opposite"


def test_a_frame_is_as_thick_as_its_walls_and_thicker_in_its_corners():
    wall = 3.0

    def inside(x, y):
        return np.minimum(_box(x, y, 18, 12), -_box(x, y, 18 - wall, 12 - wall))

    contours, thickness = _measure(inside)
    figures = thickness_figures(contours, thickness)
    assert [figures.least_mm, figures.p5_mm, figures.median_mm] == pytest.approx([wall] * 3, abs=0.03)
    # The circle that touches both outer walls and the inner corner: r = wall·√2 / (1 + √2).
    assert figures.most_mm == pytest.approx(2 * wall * np.sqrt(2) / (1 + np.sqrt(2)), abs=0.05)
    assert 0.85 < figures.measured < 1, "the outer corners have no wall opposite"


def test_a_disc_is_as_thick_as_it_is_wide():
    contours, (line,) = _measure(lambda x, y: 9.0 - np.hypot(x - 1, y + 2))
    np.testing.assert_allclose(line, 18.0, atol=0.03)
    figures = thickness_figures(contours, [line])
    assert figures.mean_mm == pytest.approx(18.0, abs=0.02)
    assert figures.measured == 1.0


def test_pixels_need_not_be_square():
    pixels = Plane([-25, 0, 3 - 20], [0.25, 0, 0], [0, 0, 0.2], 200, 200)
    contours, thickness = _measure(lambda x, y: 2.0 - np.abs(np.hypot(x, y) - 12.0), pixels)
    figures = thickness_figures(contours, thickness)
    assert [figures.least_mm, figures.most_mm] == pytest.approx([4.0, 4.0], abs=0.02)


def test_a_wall_that_leaves_the_section_is_measured_as_far_as_circles_fit():
    contours, thickness = _measure(lambda x, y: 4.0 - np.abs(y))
    for contour, line in zip(contours, thickness, strict=True):
        place = contour.model_mm[:, 0]
        np.testing.assert_allclose(line[np.abs(place) < 20.5], 8.0, atol=0.01)
        assert np.isnan(line[np.abs(place) > 21.5]).all()


def test_material_without_another_side_has_no_thickness():
    contours, thickness = _measure(lambda x, y: -y)
    assert np.isnan(thickness[0]).all()
    assert thickness_figures(contours, thickness) is None
    assert thickness_figures([], []) is None


def test_roughness_below_a_pixel_does_not_make_walls_thin():
    rng = np.random.default_rng(0)
    rough = rng.normal(0, 0.03, (200, 200))
    contours, thickness = _measure(lambda x, y: 5.0 - np.abs(np.hypot(x, y) - 15.0) + rough)
    figures = thickness_figures(contours, thickness)
    assert figures.median_mm == pytest.approx(10.0, abs=0.1)
    assert figures.p5_mm > 9.6
    assert figures.measured > 0.9


def test_figures_count_places_by_the_length_they_stand_for():
    """A contour with most of its points in one short stretch."""
    contours, thickness = _measure(lambda x, y: np.minimum(20.0 - np.hypot(x, y), np.hypot(x - 6, y) - 10.0))
    figures = thickness_figures(contours, thickness)
    assert (figures.least_mm, figures.most_mm) == pytest.approx((4.0, 16.0), abs=0.03)
    assert figures.least_mm < figures.p5_mm < figures.median_mm < figures.p95_mm < figures.most_mm
    lengths = [np.linalg.norm(np.diff(contour.section_mm, axis=0), axis=1) for contour in contours]
    between = [0.5 * (line[:-1] + line[1:]) for line in thickness]
    exact = sum((a * b).sum() for a, b in zip(lengths, between, strict=True)) / sum(part.sum() for part in lengths)
    assert figures.mean_mm == pytest.approx(exact, rel=1e-6)
    x, _, z = np.subtract(figures.thinnest_mm, [0, 0, 3])
    assert 15.9 < x < 20.1, "the walls come nearest where the inner circle is nearest to the outer one"
    assert abs(z) < 2


def test_thin_walls_are_told_with_more_decimals():
    thick, thin = (ThicknessFigures(least, *[1.0] * 5, 1.0, (0.0, 0.0, 0.0)).texts() for least in (4.0, 0.0344))
    assert (thick["least"], thick["mean"]) == ("4.00", "1.00")
    assert (thin["least"], thin["mean"], thin["p5"]) == ("0.0344", "1.0000", "1.0000")
    assert set(thin) == {"least", "p5", "median", "mean", "p95", "most"}


def test_it_tells_how_far_it_is():
    plane = _plane()
    x, _, z = np.moveaxis(plane.points(), -1, 0)
    values = LEVEL + 0.004 * (9.0 - np.hypot(x, z - 3))
    shares = list(thickness_in_steps(values, plane, section_contours(values, plane, LEVEL)))
    assert len(shares) > 3
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
