"""Bodies that have a formula, weighed from a volume and from splats, to 1 %."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from insideout.core.bench.bodies import BODIES, PMMA, scan, weight_by_formula
from insideout.core.errors import SettingError
from insideout.core.gaussians import GaussianSet, Modality
from insideout.core.mesh.cavities import find_cavities
from insideout.core.mesh.density_map import DensityCurve, curve_of_materials, curve_of_points, curve_of_water
from insideout.core.mesh.material_table import find_material
from insideout.core.mesh.walls import find_walls
from insideout.core.mesh.weight import mass_on_grid, save_weight, weigh

SPACING = 0.4


@pytest.mark.parametrize("name", BODIES)
def test_a_scanned_body_weighs_what_its_formula_says(name):
    volume, curve = scan(BODIES[name], 60, SPACING), curve_of_materials(["PMMA", "glass"], 60)
    expected = weight_by_formula(BODIES[name]).properties

    found = mass_on_grid(volume, find_walls(volume, curve.edge_mm_inv), curve)

    assert found.mass_g == pytest.approx(expected.mass_g, rel=0.01)
    np.testing.assert_allclose(found.center_mm, expected.center_mm, atol=0.01 * 9)
    np.testing.assert_allclose(found.inertia_g_mm2, expected.inertia_g_mm2, atol=0.01 * expected.inertia_g_mm2.max())


def test_cavities_of_scanned_bodies():
    (inside,) = find_cavities(scan(BODIES["hollow ball"], 60, SPACING), 0.5 * PMMA.attenuation(60))
    between, innermost = find_cavities(scan(BODIES["nested shells"], 60, SPACING), 0.5 * PMMA.attenuation(60))

    for cavity, expected in (
        (inside, 6.0**3),
        (between, 9.0**3 - 7.0**3),
        (innermost, 5.0**3),
    ):
        assert cavity.volume_mm3 == pytest.approx(4 / 3 * np.pi * expected, rel=0.01)
        np.testing.assert_allclose(cavity.center_mm, [3.0, -2.0, 1.0], atol=0.02)


def lattice(inside, attenuation, half=14):
    """Splats whose sum is `attenuation` to eight digits within a body, and in all that times its cubic millimetres.

    One of 1 mm stands on each whole millimetre inside. Their number is the body's volume in mm³.
    """
    axis = np.arange(-half, half + 1.0)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    points = points[inside(points)]
    return GaussianSet.create(points, 1.0, density=attenuation / (2 * np.pi) ** 1.5, modality=Modality.XRAY)


@pytest.fixture(scope="module")
def hollow():
    """A shell of 0.05 mm⁻¹ whose closed hollow lies off its middle, and that hollow's volume and centre."""
    center = np.array([1.0, 0.0, -1.0])

    def distance(points, place):
        return np.linalg.norm(points - place, axis=1)

    gaussians = lattice(lambda p: (distance(p, 0) < 13) & (distance(p, center) >= 6), 0.05)
    return gaussians, len(lattice(lambda p: distance(p, center) < 6, 1.0)), center


def test_splats_are_weighed_exactly_where_density_is_in_proportion(hollow):
    gaussians, _, _ = hollow
    weight = weigh(gaussians, curve_of_points((0, 0), (0.05, 1.2)), cavities=False)

    means, count = gaussians.means.astype(float), len(gaussians)
    offset = means - means.mean(axis=0)
    # Each splat is a cloud of 1 mm² variance along each axis.
    second = offset.T @ offset + count * np.eye(3)
    assert weight.properties.mass_g == pytest.approx(count * 1.2e-3, rel=1e-6)
    np.testing.assert_allclose(weight.properties.center_mm, means.mean(axis=0), atol=1e-6)
    expected = 1.2e-3 * (np.trace(second) * np.eye(3) - second)
    np.testing.assert_allclose(weight.properties.inertia_g_mm2, expected, rtol=1e-5, atol=1e-4)
    assert weight.cavities is None


@pytest.mark.parametrize("voxels", [0, 24, 48])
def test_the_hollow_of_splats_has_the_volume_of_those_that_are_missing(hollow, voxels):
    gaussians, volume_mm3, center = hollow
    weight = weigh(gaussians, curve_of_water(0.05), voxels=voxels)

    (cavity,) = weight.cavities
    assert cavity.volume_mm3 == pytest.approx(volume_mm3, rel=0.01)
    np.testing.assert_allclose(cavity.center_mm, center, atol=0.05)


@pytest.mark.parametrize("air", [0.0, 0.01])
def test_splats_under_a_curve_keep_the_mass_of_their_blurred_edges(air):
    """A heavy core in a light ball."""
    place = np.array([2.0, 1.0, 0.0])

    def in_core(points):
        return np.linalg.norm(points - place, axis=1) < 4

    light = lattice(lambda p: (np.linalg.norm(p, axis=1) < 12) & ~in_core(p), 0.03)
    core = lattice(in_core, 0.1)
    haze = lattice(lambda p: np.ones(len(p), bool), air, half=18)
    curve = curve_of_points((0.03, 0.7), (0.1, 7.9))
    if air:
        curve = DensityCurve(curve.attenuations_mm_inv + air, curve.densities_g_cm3, "")

    found = weigh(GaussianSet.concatenate([light, core, *([haze] if air else [])]), curve, cavities=False).properties

    masses = np.append(np.full(len(light), 0.7e-3), np.full(len(core), 7.9e-3))
    center = masses @ np.concatenate([light.means, core.means]) / masses.sum()
    assert found.mass_g == pytest.approx(masses.sum(), rel=0.005)
    np.testing.assert_allclose(found.center_mm, center, atol=0.02)


@pytest.mark.parametrize("name", ["iron", "aluminium"])
def test_a_blurred_edge_is_not_taken_for_a_lighter_material(name):
    """Half in metal and half in air, voxels attenuate like wood: counted as such they would add 6 % and more."""
    curve, metal = curve_of_materials(["pine wood", name], 60), find_material(name)
    ball = lattice(lambda p: np.linalg.norm(p, axis=1) < 12, metal.attenuation(60))

    found = weigh(ball, curve, cavities=False).properties

    assert found.mass_g == pytest.approx(len(ball) * metal.density_g_cm3 * 1e-3, rel=0.01)


def test_a_flat_or_tiny_model_has_figures_and_no_cavities():
    flat = GaussianSet.create([[0, 0, 0], [10, 0, 0]], [[3, 3, 1e-4]], density=0.05, modality=Modality.XRAY)
    for curve in (curve_of_water(0.02), curve_of_materials(["PMMA", "iron"], 60)):
        weight = weigh(flat, curve)
        assert weight.cavities == ()
        assert np.isfinite(weight.properties.inertia_g_mm2).all()
        np.testing.assert_allclose(weight.properties.center_mm, [5, 0, 0], atol=1e-3)


def test_splats_without_density_or_sense_are_told_or_left_out(hollow):
    gaussians, _, _ = hollow
    curve = curve_of_water(0.05)
    photos = GaussianSet.create(np.zeros((3, 3)), 1.0)
    for nothing in (photos, GaussianSet.empty()):
        with pytest.raises(SettingError, match="no splats with density"):
            weigh(nothing, curve)
    broken = GaussianSet.create([[np.nan, 0, 0], [0, 0, 0]], [[1, 1, 1], [np.inf, 1, 1]], density=1.0)

    with_broken = weigh(GaussianSet.concatenate([gaussians, broken]), curve, cavities=False)

    assert with_broken.properties.mass_g == weigh(gaussians, curve, cavities=False).properties.mass_g


def test_a_threshold_above_all_of_the_model_leaves_no_mass():
    splat = GaussianSet.create([[0, 0, 0]], 3.0, density=0.08, modality=Modality.XRAY)
    with pytest.raises(SettingError, match="mass comes out as 0 g"):
        weigh(splat, curve_of_points((0.5, 0.0), (0.6, 2.0)))


def test_the_table_as_a_file_and_as_a_line(tmp_path, hollow):
    gaussians, volume_mm3, _ = hollow
    weight = weigh(gaussians, curve_of_points((0, 0), (0.05, 1.2)))

    save_weight(tmp_path / "mass.csv", weight)

    with open(tmp_path / "mass.csv", encoding="utf-8", newline="") as stream:
        header, *rows = csv.reader(stream)
    assert header == ["quantity", "value", "unit"]
    table = {quantity: value for quantity, value, _ in rows}
    assert float(table["mass"]) == pytest.approx(weight.properties.mass_g, rel=1e-5)
    assert float(table["inertia xy"]) == pytest.approx(weight.properties.inertia_g_mm2[0, 1], rel=1e-4, abs=1e-9)
    assert float(table["cavity 1 volume"]) == pytest.approx(volume_mm3, rel=0.01)
    assert table["calibration"] == "two points: 0 mm⁻¹ is 0 g/cm³, 0.05 mm⁻¹ is 1.2 g/cm³"
    assert {unit for _, _, unit in rows} == {"g", "mm", "g mm²", "mm³", ""}


def test_the_table_has_a_note_where_there_is_something_to_note(tmp_path, hollow):
    gaussians, _, _ = hollow
    weight = weigh(gaussians, curve_of_points((0, 0), (0.05, 1.2)), cavities=False)
    rows = []
    for note in ("", "A guess"):
        save_weight(tmp_path / "mass.csv", weight, note)
        with open(tmp_path / "mass.csv", encoding="utf-8", newline="") as stream:
            rows.append([*csv.reader(stream)])
    assert rows[1] == [*rows[0], ["note", "A guess", ""]]
