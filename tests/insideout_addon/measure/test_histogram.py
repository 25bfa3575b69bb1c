"""How much there is of which density."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from insideout.core.gaussians import GaussianSet, Modality
from insideout.core.render.section_numpy import SectionSplats
from insideout.core.steps import run_through
from insideout.core.views import Plane
from insideout.insideout_addon.measure.histogram import (
    density_histogram,
    draw_histogram,
    save_histogram_csv,
    section_histogram,
    volume_histogram_in_steps,
)
from insideout.insideout_addon.measure.look import Look
from insideout.insideout_addon.measure.page import Outline, Shape
from insideout.insideout_addon.scene.section_image import Window, hounsfield


def _letter(text):
    return Outline([np.array([(0, 0), (1, 0), (1, -0.7), (0, -0.7)])], 0.5 * len(text))


def _above(histogram, density):
    """Amount that is at least as dense, its class taken in part."""
    left = np.clip((histogram.edges[1:] - density) / np.diff(histogram.edges), 0, 1)
    return float((histogram.amounts * left).sum()) + histogram.above


def test_areas_of_a_section_add_up():
    values = np.zeros((40, 50))
    values[:10, :20], values[20:30, :10] = 0.02, 0.05
    histogram = section_histogram(values, Plane([0, 0, 0], [0.5, 0, 0], [0, 0, 0.2], 50, 40))
    assert histogram.unit == "mm²"
    assert histogram.amounts.sum() + histogram.above == pytest.approx(25 * 8)
    assert histogram.amounts[0] == pytest.approx(0.1 * (2000 - 300))
    assert _above(histogram, 0.01) == pytest.approx(0.1 * 300)
    assert _above(histogram, 0.04) == pytest.approx(0.1 * 100)


def test_volume_of_a_ball_is_that_inside_its_isosurfaces():
    """A Gaussian ball of σ 5 mm is denser than ρ within r = σ·√(2 ln(0.04 / ρ))."""
    splats = SectionSplats(GaussianSet.create([[1.0, 2, 3]], 5.0, density=0.04, modality=Modality.XRAY))
    box = np.array([[-21.0, -18, -13], [23, 22, 19]])
    histogram = run_through(volume_histogram_in_steps(splats, box))
    assert histogram.unit == "mm³"
    assert histogram.amounts.sum() + histogram.above == pytest.approx(44 * 40 * 32)
    for density in (0.01, 0.02, 0.03):
        radius = 5 * np.sqrt(2 * np.log(0.04 / density))
        assert _above(histogram, density) == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.02)


def test_a_few_dense_places_do_not_squeeze_the_rest():
    values = np.concatenate([np.random.default_rng(0).uniform(0, 0.05, 100_000), [3.0] * 10])
    histogram = density_histogram(values, 1.0, "mm³")
    assert histogram.edges[-1] < 0.08
    assert histogram.above == 10
    assert histogram.amounts.sum() == 100_000


def test_what_is_no_density_is_air():
    histogram = density_histogram(np.array([-0.01, np.nan, 0.02]), 2.0, "mm²")
    assert histogram.amounts[0] == 4
    assert histogram.amounts.sum() + histogram.above == 6


def test_numbers_can_be_read_back(tmp_path):
    values = np.concatenate([np.linspace(0, 0.05, 1000), [1.0] * 1])
    histogram = density_histogram(values, 0.25, "mm²")
    save_histogram_csv(tmp_path / "h.csv", histogram)
    with open(tmp_path / "h.csv", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == len(histogram.amounts) + 1
    assert sum(float(row["area_mm2"]) for row in rows) == pytest.approx(1001 * 0.25)
    assert sum(float(row["share"]) for row in rows) == pytest.approx(1.0, rel=1e-6)
    assert float(rows[-1]["density_to_per_mm"]) == np.inf
    assert [float(row["density_from_per_mm"]) for row in rows[1:]] == pytest.approx(histogram.edges[1:], rel=1e-6)


def test_numbers_of_relative_densities_claim_no_unit(tmp_path):
    save_histogram_csv(tmp_path / "h.csv", density_histogram(np.linspace(0, 0.05, 9), 1.0, "mm³"), relative=True)
    header = (tmp_path / "h.csv").read_text("utf-8").splitlines()[0]
    assert header == "density_from_relative,density_to_relative,volume_mm3,share"


def test_the_picture_has_a_bar_for_each_class_that_is_not_empty():
    values = np.zeros((100, 100))
    values[:10], values[50:51, :5] = 0.03, 0.05
    plane = Plane([0, 0, 0], [1, 0, 0], [0, 1, 0], 100, 100)
    histogram = section_histogram(values, plane, 0.015)
    page = draw_histogram(histogram, Look(Window(0, 0.05)), "Jar", _letter)
    texts = [part.text for part in page.parts if isinstance(part, Shape) and part.text]
    assert {"Jar", "density, mm⁻¹", "contour 0.015", "0.00", "0.02", "1", "10 000"} <= set(texts)
    base = 110 - 20
    bars = [part.loops[0] for part in page.parts if isinstance(part, Shape) and not part.text]
    step = (180 - 24 - 10) / len(histogram.amounts)
    tall = sorted(
        (float(bar[:, 0].min()), base - float(bar[:, 1].min()))
        for bar in bars
        if np.ptp(bar[:, 0]) == pytest.approx(step) and bar[:, 1].max() == pytest.approx(base)
    )
    # 8995, 1000 and 5 mm² on four decades of 70 mm.
    assert [height for _, height in tall] == pytest.approx([70 * np.log10(n) / 4 for n in (8995, 1000, 5)], abs=0.01)
    assert tall[0][0] == pytest.approx(24)


def test_an_empty_section_has_a_histogram_too():
    histogram = density_histogram(np.zeros((8, 8)), 1.0, "mm²")
    assert histogram.amounts[0] == 64
    draw_histogram(histogram, Look(Window(0, 0.05)), "Jar", _letter)


def test_its_axis_is_in_the_unit_of_the_sections():
    histogram = density_histogram(np.linspace(0, 0.04, 1000), 1.0, "mm²", 0.03)
    page = draw_histogram(histogram, Look(Window(0, 0.04), unit=hounsfield(0.02)), "Jar", _letter)
    texts = [part.text for part in page.parts if isinstance(part, Shape) and part.text]
    assert {"density, HU", "-1000", "0", "1000", "contour 500"} <= set(texts)
