"""Weighing, as a script or a button does it, and its panel."""

from __future__ import annotations

import csv
from types import SimpleNamespace

import bpy
import numpy as np
import pytest

from insideout.core.gaussians import GaussianSet, Modality
from insideout.core.mesh.material_table import MATERIALS, find_material
from insideout.insideout_addon.scene.weighing import CENTER_NAME, kept_weight
from insideout.insideout_addon.scene.weight_text import GUESS, cavities_text
from insideout.operators.weigh import INSIDEOUT_OT_weigh
from insideout.panels.physics import INSIDEOUT_PT_physics
from insideout.panels.weigh import INSIDEOUT_PT_weigh

MASS_OF_WATER = (2 * np.pi) ** 1.5 * 5**3 * 1e-3


@pytest.fixture
def shell(blender, tmp_path):
    """A hollow ball of splats a millimetre apart, each a millimetre wide."""
    axis = np.arange(-12, 13.0)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    radius = np.linalg.norm(points, axis=1)
    points = points[(radius < 12) & (radius >= 6)]
    density = 0.04 / (2 * np.pi) ** 1.5
    GaussianSet.create(points, 1.0, density=density, modality=Modality.XRAY).save(tmp_path / "shell.ply")
    bpy.ops.insideout.import_run(filepath=str(tmp_path / "shell.ply"))
    return bpy.context.scene.insideout.model


def test_by_water(model):
    assert bpy.ops.insideout.weigh(water=0.04) == {"FINISHED"}

    weight = kept_weight(model)
    assert weight.properties.mass_g == pytest.approx(MASS_OF_WATER, rel=1e-4)
    assert weight.calibration == "water at 0.04 mm⁻¹"


def test_the_scan_s_own_water_counts_unless_another_is_given(model):
    bpy.context.scene.insideout.water = 0.04
    bpy.ops.insideout.weigh()
    assert kept_weight(model).calibration == "water at 0.04 mm⁻¹"
    assert kept_weight(model).properties.mass_g == pytest.approx(MASS_OF_WATER, rel=1e-4)
    bpy.ops.insideout.weigh(water=0.02)
    assert kept_weight(model).calibration == "water at 0.02 mm⁻¹"


def test_the_dialog_starts_with_the_scan_s_own_water(model):
    bpy.context.scene.insideout.water = 0.04
    dialog = SimpleNamespace(invoke_props_dialog=lambda *_, **__: {"RUNNING_MODAL"})
    window = SimpleNamespace(window_manager=dialog, scene=bpy.context.scene)
    for given, water in ((set(), 0.04), ({"water"}, 0.03)):
        properties = SimpleNamespace(is_property_set=given.__contains__)
        operator = SimpleNamespace(water=0.03, properties=properties)
        assert INSIDEOUT_OT_weigh.ask(operator, window) == {"RUNNING_MODAL"}
        assert operator.water == pytest.approx(water)
    assert bpy.ops.insideout.weigh.get_rna_type().properties["water"].is_skip_save, "of the next model it is another's"


def test_by_two_points(model):
    bpy.ops.insideout.weigh(calibration="POINTS", second_attenuation=0.04, second_density=2.5)

    assert kept_weight(model).properties.mass_g == pytest.approx(2.5 * MASS_OF_WATER, rel=1e-4)


def test_by_materials(model):
    bpy.ops.insideout.weigh(calibration="MATERIALS", materials={"CORTICAL_BONE"}, energy_kev=70)

    bone = find_material("cortical bone")
    expected = MASS_OF_WATER * bone.density_g_cm3 * 0.04 / bone.attenuation(70)
    assert kept_weight(model).properties.mass_g == pytest.approx(expected, rel=1e-3)
    bpy.ops.insideout.weigh(calibration="MATERIALS", materials={"CORTICAL_BONE", "SOFT_TISSUE"}, energy_kev=70)
    assert kept_weight(model).calibration == "soft tissue, cortical bone at 70 keV"


def test_by_materials_where_hounsfield_units_were_converted_with_another_water(model):
    """What is water in the scan weighs as water, at whatever energy."""
    model["insideout_water"] = 0.04
    for energy in (35, 60, 120):
        bpy.ops.insideout.weigh(calibration="MATERIALS", materials={"WATER"}, energy_kev=energy)
        assert kept_weight(model).properties.mass_g == pytest.approx(MASS_OF_WATER, rel=1e-3)
    assert kept_weight(model).calibration == "water at 120 keV, with water at 0.04 mm⁻¹"


def test_every_material_of_the_table_can_be_chosen(blender):
    names = bpy.ops.insideout.weigh.get_rna_type().properties["materials"].enum_items.keys()

    assert [find_material(name).name for name in names] == [m.name for m in MATERIALS if m.name != "air"]


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"calibration": "MATERIALS"}, "choose at least one"),
        ({"calibration": "POINTS", "second_attenuation": 0.0}, "Both calibration points have 0 mm"),
        ({"water": 0.0}, "above 0"),
        (
            {"calibration": "POINTS", "first_attenuation": 0.5, "second_attenuation": 0.6},
            "comes out as 0 g; choose a calibration",
        ),
        ({"voxels": 3}, "give 8 to 512, or 0"),
    ],
)
def test_an_error_is_a_sentence_and_changes_nothing(model, settings, words):
    with pytest.raises(RuntimeError, match=words) as caught:
        bpy.ops.insideout.weigh(**settings)

    assert "Traceback" not in str(caught.value)
    assert kept_weight(model) is None


def test_the_centre_of_mass_as_an_empty(model):
    assert not bpy.ops.insideout.weigh_center.poll()
    bpy.ops.insideout.weigh()
    bpy.ops.insideout.weigh_center()

    marker = bpy.data.objects[CENTER_NAME]
    assert marker.parent == model
    np.testing.assert_allclose(marker.location, [3, -2, 1], atol=1e-5)


def test_of_splats_that_have_lost_an_attribute_it_is_told_and_no_empty_is_left(model):
    bpy.ops.insideout.weigh(cavities=False)
    model.data.attributes.remove(model.data.attributes["modality"])
    with pytest.raises(RuntimeError, match=r"^Error: .*has lost the attribute") as caught:
        bpy.ops.insideout.weigh_center()
    assert "Traceback" not in str(caught.value)
    assert CENTER_NAME not in bpy.data.objects


def test_the_table_as_a_file(shell, tmp_path):
    bpy.ops.insideout.weigh(water=0.04)
    bpy.ops.insideout.weigh_save(filepath=str(tmp_path / "mass.csv"))

    with open(tmp_path / "mass.csv", encoding="utf-8", newline="") as stream:
        table = {row["quantity"]: row["value"] for row in csv.DictReader(stream)}
    assert float(table["mass"]) == pytest.approx(kept_weight(shell).properties.mass_g, rel=1e-5)
    assert float(table["cavity 1 volume"]) == pytest.approx(kept_weight(shell).cavities[0].volume_mm3, rel=1e-5)
    with pytest.raises(RuntimeError, match="is a folder"):
        bpy.ops.insideout.weigh_save(filepath=str(tmp_path))


def test_photos_alone_cannot_be_weighed(draw_panels, photo_run):
    bpy.context.scene.insideout.run = str(photo_run)
    bpy.ops.insideout.import_run()

    assert not bpy.ops.insideout.weigh.poll()
    assert draw_panels(600, [INSIDEOUT_PT_weigh]) == ["Photos alone have no density to weigh"]


def test_the_panel_tells_what_to_do_then_what_was_found(draw_panels, shell):
    def drawn():
        return draw_panels(600, [INSIDEOUT_PT_weigh])

    texts = drawn()
    assert texts[0] == "Weigh..."
    assert any(text.startswith("Choose what attenuation means in g/cm³") for text in texts)
    bpy.ops.insideout.weigh(water=0.04)
    texts = drawn()
    weight = kept_weight(shell)
    assert f"{weight.properties.mass_g:.4g} g" in texts
    assert "0.0 / 0.0 / 0.0 mm" in texts
    assert cavities_text(weight.cavities) in texts
    assert {"Attenuation read as mass density by water at 0.04 mm⁻¹", "Center of Mass", "Save Table..."} <= set(texts)


def test_the_panel_without_a_model(draw_panels):
    assert draw_panels(600, [INSIDEOUT_PT_weigh]) == ["Import a model first, under Model"]


@pytest.mark.parametrize(
    ("calibration", "shown"), [("WATER", "Water (mm⁻¹)"), ("POINTS", "First (g/cm³)"), ("MATERIALS", "Energy (keV)")]
)
def test_the_dialog_asks_for_what_the_calibration_needs(draw_panels, calibration, shown):
    layout_class = draw_panels.__closure__[0].cell_contents.Layout
    texts = []
    rna = bpy.ops.insideout.weigh.get_rna_type()
    operator = SimpleNamespace(layout=layout_class(texts), calibration=calibration, cavities=True, bl_rna=rna)

    INSIDEOUT_OT_weigh.draw(operator, bpy.context)

    assert {shown, "Calibration", "Cavities", "Edge (mm⁻¹)", "Smallest (mm³)", "Voxels"} <= set(texts)
    assert ("Materials" in texts) == (calibration == "MATERIALS")


@pytest.mark.parametrize("calibration", ["WATER", "POINTS", "MATERIALS"])
def test_the_dialog_does_not_ask_for_attenuations_where_grey_values_were_only_scaled(draw_panels, model, calibration):
    model["insideout_warnings"] = "volume.tif: has grey values; 900 was taken for 0.05 mm⁻¹, so densities are relative"
    texts = []
    operator = SimpleNamespace(
        layout=draw_panels.__closure__[0].cell_contents.Layout(texts), calibration=calibration, cavities=True,
        bl_rna=bpy.ops.insideout.weigh.get_rna_type(),
    )  # fmt: skip

    INSIDEOUT_OT_weigh.draw(operator, bpy.context)

    asked = {"WATER": {"Water (relative)"}, "POINTS": {"First (relative)", "Second (relative)"}, "MATERIALS": set()}
    assert asked[calibration] | {"Edge (relative)"} <= set(texts)
    assert [text for text in texts if "mm⁻¹" in text] == []
    hint = "Densities are relative: grams need two points you know"
    assert (hint in texts) == (calibration != "POINTS")


@pytest.mark.parametrize("calibration", ["WATER", "POINTS"])
def test_a_calibration_of_relative_densities_claims_no_unit(model, calibration):
    model["insideout_warnings"] = "volume.tif: has grey values; 900 was taken for 0.05 mm⁻¹, so densities are relative"
    bpy.ops.insideout.weigh(calibration=calibration, water=0.04, second_attenuation=0.04, second_density=1.0)
    assert "0.04 rel" in kept_weight(model).calibration
    assert "mm⁻¹" not in kept_weight(model).calibration


def test_no_table_of_materials_makes_grams_of_relative_densities(model):
    model["insideout_warnings"] = "volume.tif: has grey values; 900 was taken for 0.05 mm⁻¹, so densities are relative"
    with pytest.raises(RuntimeError, match="choose Two Points, with two attenuations whose density you know"):
        bpy.ops.insideout.weigh(calibration="MATERIALS", materials={"PMMA"})
    assert kept_weight(model) is None


@pytest.mark.parametrize(
    ("settings", "guessed"),
    [
        ({}, True),
        ({"calibration": "POINTS"}, True),
        ({"water": 0.04}, False),
        ({"calibration": "POINTS", "second_attenuation": 0.04}, False),
    ],
)
@pytest.mark.parametrize("relative", [True, False])
def test_grams_of_relative_densities_are_a_guess_until_something_is_known(
    draw_panels, model, capsys, tmp_path, settings, guessed, relative
):
    if relative:
        model["insideout_warnings"] = "volume.tif: so densities are relative"
    bpy.ops.insideout.weigh(**settings)
    assert (GUESS in capsys.readouterr().out) == (guessed and relative)
    for panel in (INSIDEOUT_PT_weigh, INSIDEOUT_PT_physics):
        assert (GUESS in draw_panels(3000, [panel])) == (guessed and relative)
    bpy.ops.insideout.weigh_save(filepath=str(tmp_path / "mass.csv"))
    assert (GUESS in (tmp_path / "mass.csv").read_text("utf-8")) == (guessed and relative)


def test_relative_densities_know_nothing_of_another_scan_s_water(model):
    bpy.context.scene.insideout.water = 0.04
    model["insideout_warnings"] = "volume.tif: has grey values; 900 was taken for 0.05 mm⁻¹, so densities are relative"
    bpy.ops.insideout.weigh()
    assert kept_weight(model).calibration == "water at 0.0195 rel"
