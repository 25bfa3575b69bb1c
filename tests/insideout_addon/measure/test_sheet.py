"""Sheets of sections: where they lie in the model and on the paper."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from insideout.core.errors import SettingError
from insideout.core.gaussians import GaussianSet, Modality
from insideout.core.render.section_numpy import SectionSplats
from insideout.core.steps import run_through
from insideout.core.views import Plane
from insideout.insideout_addon.measure.look import Look
from insideout.insideout_addon.measure.page import Outline, Picture, Shape
from insideout.insideout_addon.measure.sheet import (
    PAPERS,
    SCALES,
    arrange,
    axis_series,
    draw_sheet_in_steps,
    plane_series,
)
from insideout.insideout_addon.scene.section_image import Window, hounsfield

BOX = np.array([[-10.0, -20.0, 0.0], [30.0, 20.0, 60.0]])


def _letter(text):
    return Outline([np.array([(0, 0), (1, 0), (1, -0.7), (0, -0.7)]) * (0.5 * len(text), 1)], 0.5 * len(text))


def _texts(page):
    return [part.text for part in page.parts if isinstance(part, Shape) and part.text]


def _pictures(page):
    """The overview, then the sections; not the colour bar."""
    return [part for part in page.parts if isinstance(part, Picture)][1:]


class TestSeries:
    def test_sections_are_in_the_middle_of_equal_parts(self):
        series = axis_series(BOX, "Z", 4)
        assert series.positions.tolist() == [7.5, 22.5, 37.5, 52.5]
        assert series.step == 15.0
        assert series.label(1) == "2  z = 22.5 mm"

    def test_sections_that_are_near_each_other_have_labels_of_their_own(self):
        series = axis_series(BOX / 300, "Z", 4)
        assert [series.label(index) for index in range(2)] == ["1  z = 0.025 mm", "2  z = 0.075 mm"]

    @pytest.mark.parametrize(
        ("axis", "normal", "right", "up"), [("X", 0, 1, 2), ("Y", 1, 0, 2), ("Z", 2, 0, 1)], ids=str
    )
    def test_a_section_sees_the_box_upright(self, axis, normal, right, up):
        series = axis_series(BOX, axis, 3)
        points = series.plane(float(series.positions[0]), 0.5).points()
        np.testing.assert_allclose(points[..., normal], BOX[0, normal] + (BOX[1] - BOX[0])[normal] / 6)
        assert points[0, 0, right] < points[0, -1, right]
        assert points[0, 0, up] > points[-1, 0, up]
        for side in (right, up):
            assert points[..., side].min() == pytest.approx(BOX[0, side] - 0.03 * 60 + 0.25, abs=0.05)
            assert points[..., side].max() == pytest.approx(BOX[1, side] + 0.03 * 60 - 0.25, abs=0.05)

    def test_parallel_to_a_plane_positions_are_told_from_it(self):
        turned = Plane([10, 0, 30], [0.3, 0, -0.4], [0, -0.5, 0], 8, 8)
        series = plane_series(BOX, turned, 5)
        towards = np.array([0.8, 0, 0.6])
        np.testing.assert_allclose(series.along, towards, atol=1e-12)
        corners = (BOX - [10, 0, 30]) @ towards
        assert series.positions[0] == pytest.approx(corners[0] + 0.1 * (corners[1] - corners[0]))
        plane = series.plane(3.0, 0.5)
        np.testing.assert_allclose((plane.points() - [10, 0, 30]) @ towards, 3.0, atol=1e-9)
        assert series.label(4).startswith("5  +")
        assert series.label(0).startswith("1  −")

    def test_a_sheet_of_nothing_is_refused(self):
        with pytest.raises(SettingError, match="at least 1"):
            axis_series(BOX, "X", 0)


class TestArrangement:
    @pytest.mark.parametrize("count", [1, 2, 7, 12, 40])
    @pytest.mark.parametrize("size", [(80.0, 60.0), (3.0, 9.0), (900.0, 200.0)])
    def test_all_sections_fit_on_a4(self, count, size):
        way = arrange(count, size, (50.0, size[1]), real_size=False)
        assert sorted((way.width, way.height)) == list(PAPERS["A4"])
        assert way.columns * way.rows >= count
        assert way.columns * size[0] * way.enlarged < way.width - 24
        assert way.rows * size[1] * way.enlarged < way.height - 24

    def test_the_next_larger_scale_would_not_fit(self):
        assert arrange(12, (84.0, 84.0), (84.0, 112.0), real_size=False).scale == (1, 2)
        assert arrange(12, (63.0, 63.0), (63.0, 84.0), real_size=False).scale == (2, 3)
        assert arrange(12, (42.0, 42.0), (42.0, 56.0), real_size=False).scale == (1, 1)

    def test_real_size_takes_larger_paper(self):
        way = arrange(12, (80.0, 80.0), (80.0, 100.0), real_size=True)
        assert way.scale == (1, 1)
        assert way.paper == "A2"

    def test_what_no_paper_holds_is_told(self):
        with pytest.raises(SettingError, match="do not fit on A0"):
            arrange(12, (800.0, 800.0), (80.0, 800.0), real_size=True)

    def test_scales_are_those_of_drawings(self):
        shares = [paper / model for paper, model in SCALES]
        assert shares == sorted(shares, reverse=True)
        assert {(2, 1), (1, 1), (2, 3), (1, 2), (1, 10)} <= set(SCALES)


LOOK = Look(Window(0.0, 0.04))


@pytest.fixture(scope="module")
def ball():
    """0.04 mm⁻¹ and 5 mm at (10, 0, 30)."""
    return SectionSplats(GaussianSet.create([[10.0, 0, 30]], 5.0, density=0.04, modality=Modality.XRAY))


@pytest.fixture(scope="module")
def page(ball):
    return run_through(draw_sheet_in_steps(ball, axis_series(BOX, "Z", 5), LOOK, "Jar", _letter, dots_per_inch=50))


class TestSheet:
    def test_it_says_what_it_shows(self, page):
        texts = _texts(page)
        assert "Jar" in texts
        assert "Sections at right angles to z, every 12 mm  ·  scale 1:1 on A4" in texts
        assert [text for text in texts if "z = " in text] == [
            f"{number}  z = {position} mm" for number, position in enumerate(("6.0", "18.0", "30.0", "42.0", "54.0"), 1)
        ]
        assert "density, mm⁻¹" in texts
        assert {"0.00", "0.01", "0.04"} <= set(texts)

    def test_sections_are_to_scale_and_inside_the_margins(self, page):
        overview, *sections = _pictures(page)
        assert len(sections) == 5
        for part in sections:
            assert (part.width, part.height) == pytest.approx((40 + 3.6, 40 + 3.6))
        assert (overview.width, overview.height) == pytest.approx((40 + 3.6, 60 + 3.6))
        for part in (overview, *sections):
            assert part.left >= 12 - 1e-9
            assert part.top >= 12
            assert part.left + part.width <= page.width - 12
            assert part.top + part.height <= page.height - 12
        for one, other in itertools.pairwise(sections):
            assert other.left >= one.left + one.width + 4 - 1e-9 or other.top >= one.top + one.height + 4

    def test_the_ball_is_on_the_middle_section_alone(self, page):
        """Its Gaussian has 6 % of its density at 12 mm and is white there."""
        shown = [int((part.pixels.min(axis=2) < 200).sum()) for part in _pictures(page)[1:]]
        assert shown[2] > 100
        assert shown[:2] == shown[3:] == [0, 0]
        dark = np.argwhere(_pictures(page)[3].pixels.min(axis=2) < 200)
        size = np.array(_pictures(page)[3].pixels.shape[:2])
        np.testing.assert_allclose(dark.mean(axis=0), 0.5 * size - 0.5, atol=0.7)

    def test_the_overview_has_a_line_where_each_section_is(self, page):
        overview = _pictures(page)[0]
        lines = [part for part in page.parts if isinstance(part, Shape) and part.color == (0.0, 0.45, 0.75)]
        heights = [part.loops[0][:, 1].mean() for part in lines if not part.text]
        assert [overview.top + overview.height - height for height in heights] == pytest.approx(
            1.8 + np.array([6, 18, 30, 42, 54])
        )
        assert [part.text for part in lines if part.text] == ["1", "2", "3", "4", "5"]

    def test_of_a_series_downward_the_overview_stands_upright_too(self):
        ball = SectionSplats(GaussianSet.create([[10.0, 0, 45]], 5.0, density=0.04, modality=Modality.XRAY))
        seen_from_below = Plane([0, 0, 20], [-0.5, 0, 0], [0, -0.5, 0], 8, 8)
        page = run_through(
            draw_sheet_in_steps(ball, plane_series(BOX, seen_from_below, 5), LOOK, "Jar", _letter, dots_per_inch=50)
        )
        overview, *sections = _pictures(page)
        assert (overview.width, overview.height) == pytest.approx((43.6, 63.6))
        row, _ = np.argwhere(overview.pixels.min(axis=2) < 200).mean(axis=0) / overview.pixels.shape[0]
        assert row == pytest.approx((1.8 + 60 - 45) / 63.6, abs=0.02)
        assert int(np.argmin([part.pixels.mean() for part in sections])) == 1
        lines = [part for part in page.parts if isinstance(part, Shape) and part.color == (0.0, 0.45, 0.75)]
        heights = [part.loops[0][:, 1].mean() for part in lines if not part.text]
        assert [height - overview.top for height in heights] == pytest.approx(1.8 + np.array([6, 18, 30, 42, 54]))

    def test_its_scale_bar_is_as_long_as_it_says(self, page):
        (label,) = [part for part in page.parts if isinstance(part, Shape) and part.text == "20 mm"]
        bars = [
            part.loops[0] for part in page.parts if isinstance(part, Shape) and len(part.loops) == 1 and not part.text
        ]
        black = next(bar for bar in bars if np.ptp(bar[:, 1]) == pytest.approx(1.2))
        assert np.ptp(black[:, 0]) == pytest.approx(20.0)
        assert label.place[0] + 0.5 * label.width == pytest.approx(black[:, 0].max())

    @pytest.mark.parametrize("axis", ["X", "Y"])
    def test_the_overview_lies_along_the_other_axes_too(self, ball, axis):
        page = run_through(draw_sheet_in_steps(ball, axis_series(BOX, axis, 4), LOOK, "Jar", _letter, dots_per_inch=50))
        overview = _pictures(page)[0]
        assert (overview.width, overview.height) == pytest.approx((43.6, 63.6))
        lines = [part for part in page.parts if isinstance(part, Shape) and part.color == (0.0, 0.45, 0.75)]
        places = [part.loops[0][:, 0].mean() - overview.left for part in lines if not part.text]
        assert places == pytest.approx(1.8 + np.array([5, 15, 25, 35]))
        dark = np.argwhere(overview.pixels.min(axis=2) < 200).mean(axis=0)
        size = np.array(overview.pixels.shape[:2])
        np.testing.assert_allclose(dark, 0.5 * size - 0.5, atol=0.7)

    def test_numbers_are_in_the_unit_of_the_sections(self, ball):
        look = Look(Window(0.0, 0.04), "grey", hounsfield(0.02))
        page = run_through(draw_sheet_in_steps(ball, axis_series(BOX, "Z", 2), look, "Jar", _letter, dots_per_inch=50))
        assert {"density, HU", "-1000", "0", "1000"} <= set(_texts(page))
        assert all(np.ptp(part.pixels.astype(int), axis=2).max() <= 1 for part in _pictures(page))
