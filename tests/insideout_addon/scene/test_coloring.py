"""What the colours of splats stand for."""

from __future__ import annotations

from dataclasses import replace

import bpy
import numpy as np
import pytest

from insideout.core.colormap import COLOR_MAPS, density_colors
from insideout.core.gaussians import Modality
from insideout.core.residual_file import save_residuals
from insideout.core.srgb import srgb_to_linear
from insideout.insideout_addon.scene import coloring
from insideout.insideout_addon.scene.coloring import MODALITY_COLORS
from insideout.insideout_addon.scene.importing import import_splats
from insideout.insideout_addon.scene.section import automatic_window
from insideout.insideout_addon.scene.splats import (
    DENSITY_HERE,
    DEPTH,
    RESIDUAL,
    read_values,
    write_values,
)


def test_by_density_they_are_those_of_the_section(shells):
    shells.settings.low, shells.settings.high, shells.settings.colors = 0.002, 0.03, "VIRIDIS"
    shells.settings.color_by = "DENSITY"
    expected = density_colors(read_values(shells.model, DENSITY_HERE), 0.002, 0.03, "viridis")
    np.testing.assert_allclose(shells.colors()[:, :3], srgb_to_linear(expected), atol=2e-3)


def test_window_and_colours_of_the_section_are_followed(shells):
    shells.settings.low, shells.settings.high = 0.0, 0.03
    shells.settings.color_by = "DENSITY"
    before = shells.colors()
    shells.settings.high = 0.06
    assert shells.colors()[:, :3].sum() < 0.7 * before[:, :3].sum()
    shells.settings.high, shells.settings.colors = 0.03, "GREY"
    grey = shells.colors()[:, :3]
    np.testing.assert_allclose(grey.max(axis=1), grey.min(axis=1), atol=1e-6)


def test_without_a_window_it_is_the_one_that_a_section_would_get(shells):
    shells.settings.color_by = "DENSITY"
    found = shells.settings.low, shells.settings.high
    bpy.ops.insideout.section_window()
    assert found == (shells.settings.low, shells.settings.high) == pytest.approx((0.0, shells.DENSITY), rel=0.1)


def test_their_own_come_back_exactly(shells):
    before = shells.colors()
    for kind in ("DENSITY", "MODALITY"):
        shells.settings.color_by = kind
        assert not np.array_equal(shells.colors(), before)
    shells.settings.color_by = "PHOTOS"
    np.testing.assert_array_equal(shells.colors(), before)


@pytest.mark.parametrize("kind", ["DENSITY", "MODALITY"])
def test_a_duplicate_that_shares_the_points_leaves_the_colours(shells, kind):
    twin = shells.model.copy()
    bpy.context.collection.objects.link(twin)
    before = shells.colors()
    shells.settings.color_by = kind
    colored = shells.colors()
    assert not np.array_equal(colored, before)
    shells.settings.model = twin
    np.testing.assert_array_equal(shells.colors(), colored)
    shells.settings.color_by = "PHOTOS"
    np.testing.assert_array_equal(shells.colors(), before)


def test_opacity_stays(shells):
    shells.settings.color_by = "DENSITY"
    np.testing.assert_allclose(shells.colors()[:, 3], shells.gaussians.opacities)


def test_by_modality(shells):
    shells.settings.color_by = "MODALITY"
    for modality in Modality:
        shown = shells.colors()[shells.are(modality), :3]
        expected = srgb_to_linear(np.array(MODALITY_COLORS[modality]))
        np.testing.assert_allclose(shown, np.broadcast_to(expected, shown.shape), atol=1e-6)


@pytest.mark.parametrize("blind", ["protan", "deutan", "tritan"])
def test_the_colours_of_modalities_differ_to_colour_blind_eyes(blind):
    """By the matrices of Machado, Oliveira and Fernandes (IEEE TVCG 15(6), 2009), severity 1, in linear light."""
    matrix = {
        "protan": [[0.1523, 1.0526, -0.2049], [0.1145, 0.7863, 0.0992], [-0.0039, -0.0481, 1.0520]],
        "deutan": [[0.3673, 0.8606, -0.2280], [0.2801, 0.6725, 0.0474], [-0.0118, 0.0429, 0.9689]],
        "tritan": [[1.2555, -0.0767, -0.1788], [-0.0784, 0.9308, 0.1476], [0.0047, 0.6914, 0.3039]],
    }[blind]
    seen = srgb_to_linear(np.array(list(MODALITY_COLORS.values()))) @ np.array(matrix).T
    lightness = np.clip(seen @ [0.2126, 0.7152, 0.0722], 0, 1) ** (1 / 3)
    assert np.diff(np.sort(lightness)).min() > 0.1


def test_without_residuals_it_is_said_how_to_get_them(shells):
    before = shells.colors()
    shells.settings.color_by = "RESIDUAL"
    assert "press Reconstruct again" in shells.settings.look_problem
    np.testing.assert_array_equal(shells.colors(), before)
    shells.settings.color_by = "PHOTOS"
    assert shells.settings.look_problem == ""


@pytest.mark.parametrize("kind", ["DENSITY", "RESIDUAL"])
def test_photos_alone_are_told_that_they_have_none(shells, kind):
    shells.painted()
    shells.settings.color_by = kind
    assert "photos is of photos alone" in shells.settings.look_problem


def test_photos_alone_leave_the_window_to_the_next_model(shells):
    shells.painted()
    shells.settings.color_by = "DENSITY"
    assert not shells.settings.is_property_set("high")
    shells.settings.model = shells.model
    assert shells.settings.high == pytest.approx(shells.DENSITY, rel=0.1)


def test_another_model_gets_a_window_of_its_own(shells, tmp_path, monkeypatch):
    """What was found in the one before is no number of the user's."""
    found = []

    def find(*of):
        found.append(automatic_window(*of))
        return found[-1]

    monkeypatch.setattr(coloring, "automatic_window", find)
    settings = shells.settings
    settings.color_by = "DENSITY"
    replace(shells.gaussians, density=10 * shells.gaussians.density).save(tmp_path / "denser.ply")
    denser = import_splats(tmp_path / "denser.ply", "denser", bpy.context)
    for model, dense in ((denser, 10), (shells.model, 1)):
        settings.model = model
        assert settings.low == 0
        assert settings.high == pytest.approx(dense * shells.DENSITY, rel=0.1)
    assert len(found) == 3
    settings.peel_mm = 1.0
    assert len(found) == 3, "each setting of Look would find it again"
    settings.high = 0.07
    settings.model = denser
    assert settings.high == pytest.approx(0.07), "the user's own"


def test_by_residual(shells):
    percent = np.linspace(0, 4, len(shells), dtype=np.float32)
    percent[:10] = np.nan
    write_values(shells.model, RESIDUAL, percent)
    shells.settings.residual_high = 2.0
    shells.settings.color_by = "RESIDUAL"
    shown = shells.colors()[:, :3]
    brightest = srgb_to_linear(COLOR_MAPS["inferno"][-1])
    np.testing.assert_allclose(shown[percent > 2], np.broadcast_to(brightest, shown[percent > 2].shape), atol=2e-3)
    np.testing.assert_allclose(shown[:10], srgb_to_linear(np.full((10, 3), 0.45)), atol=1e-6)
    shells.settings.residual_high = 0.0
    assert (shells.colors()[:, :3] > 0.98 * brightest).all(axis=1).mean() == pytest.approx(0.01, abs=0.004)


def test_a_model_keeps_the_residuals_of_its_run(shells, tmp_path):
    shells.gaussians.save(tmp_path / "fused.ply")
    percent = np.linspace(0, 4, len(shells), dtype=np.float32)
    save_residuals(tmp_path, percent, tmp_path / "fused.ply")
    found = import_splats(tmp_path / "fused.ply", "model", bpy.context)
    np.testing.assert_array_equal(read_values(found, RESIDUAL), percent)


def test_those_of_other_splats_are_not_taken(shells, tmp_path):
    shells.gaussians.save(tmp_path / "fused.ply")
    save_residuals(tmp_path, np.ones(len(shells)), tmp_path / "fused.ply")
    replace(shells.gaussians, density=2 * shells.gaussians.density).save(tmp_path / "fused.ply")
    assert read_values(import_splats(tmp_path / "fused.ply", "model", bpy.context), RESIDUAL) is None


def test_a_transform_that_is_applied_keeps_colours_and_moves_depths(shells):
    shells.settings.low, shells.settings.high = 0.0, 0.03
    shells.settings.color_by, shells.settings.peel_mm = "DENSITY", 10.0
    before = shells.colors()
    shells.model.scale = (2.0, 2.0, 2.0)
    bpy.context.view_layer.objects.active = shells.model
    assert bpy.ops.insideout.apply_transform() == {"FINISHED"}
    assert read_values(shells.model, DEPTH).max() == pytest.approx(2 * shells.OUTER, abs=1.0)
    np.testing.assert_allclose(shells.colors(), before, atol=0.05)
    assert shells.shown().max() < 2 * shells.INNER
