"""What pictures of the CT are written in, whose densities may be in other than the model's."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from mathutils import Matrix

from insideout.core.affine import Kept
from insideout.core.capture.volumes import RELATIVE
from insideout.core.densities import Densities
from insideout.core.errors import SettingError
from insideout.core.volume import Volume
from insideout.insideout_addon.scene import section, section_picture, sections
from insideout.insideout_addon.scene.importing import WARNINGS_KEY
from insideout.insideout_addon.scene.placement import apply_transform
from insideout.insideout_addon.scene.section_beside import beside_parts
from insideout.insideout_addon.scene.section_image import PER_MM, RELATIVE_UNIT, Window, difference_rgba, hounsfield
from insideout.insideout_addon.scene.splats import WATER_KEY

# Of the model, as the projections show it, and what the volume's Hounsfield units were converted with.
WATER, OWN_WATER = 0.025, 0.0195


@pytest.fixture
def give_ct(scanned, tmp_path):
    """`give_ct(densities)`: what those of the volume are in."""

    def give(densities):
        path = tmp_path / "initialize" / "volume.npz"
        Volume.load(path).save(path, densities)

    return give


@pytest.mark.parametrize("own", [OWN_WATER, None])
@pytest.mark.parametrize("size", [1.0, 2.0])
def test_in_hounsfield_units_the_ct_has_those_of_its_own_water(scanned, give_ct, own, size):
    """Also where the scan's size was corrected. A run of before kept none, and its CT goes by the model's."""
    give_ct(Densities(water_per_mm=own))
    scene, plane = bpy.context.scene, sections.add_section_plane(scanned, bpy.context)
    scanned[WATER_KEY] = scene.insideout.water = WATER
    for thing in (scanned, plane):
        thing.matrix_world = Matrix.Scale(size, 4) @ thing.matrix_world
    bpy.context.view_layer.update()
    apply_transform(scanned, Kept.LINE_INTEGRALS)
    bpy.context.view_layer.update()
    scene.insideout.low, scene.insideout.high = 0.0, 0.05 / size
    _, view = section.sample_section(scene)
    scanned_values = section_picture.scan_on(view, scanned)

    def picture(kind, values):
        return section_picture.picture_of(values, view, scene, kind)

    scene.insideout.unit = "HU"
    alike = scanned_values * np.float32(WATER / (own or WATER))
    assert picture("CT", alike).unit == hounsfield(scene.insideout.water)
    assert scene.insideout.water == pytest.approx(WATER / size)
    np.testing.assert_allclose(picture("CT", alike).rgba, picture("MODEL", alike).rgba, atol=0.01)
    none = difference_rgba(np.zeros_like(alike), alike, Window(0.0, 0.05 / size))
    np.testing.assert_allclose(picture("DIFFERENCE", alike).rgba, none, atol=0.01)
    scene.insideout.unit = "PER_MM"
    np.testing.assert_allclose(
        picture("CT", alike).rgba, picture("MODEL", scanned_values).rgba, atol=0.01, err_msg="as its file has them"
    )


def test_a_ct_of_gray_values_beside_a_model_in_mm_has_no_unit(scanned, give_ct):
    give_ct(Densities(relative=True))
    scene = bpy.context.scene
    plane = sections.add_section_plane(scanned, bpy.context)
    values, view = section.sample_section(scene)
    units = [section_picture.picture_of(values, view, scene, kind).unit for kind in ("MODEL", "CT")]
    assert units == [PER_MM, RELATIVE_UNIT]
    with pytest.raises(SettingError, match="no difference between them and mm⁻¹; show the CT alone"):
        section_picture.picture_of(values, view, scene, "DIFFERENCE")
    scene.insideout.sections[0].beside = "BOTH"
    section_picture.refresh_sections(scene)
    texts = {part.data.body for part in beside_parts(plane) if part.type == "FONT"}
    assert texts == {"Model", "CT, rel"}, "under the colour bar's mm⁻¹"


def test_a_comparison_with_gray_values_is_saved_without_a_difference(scanned, give_ct, tmp_path):
    give_ct(Densities(relative=True))
    sections.add_section_plane(scanned, bpy.context)
    path = tmp_path / "s.png"
    assert bpy.ops.insideout.section_save(filepath=str(path), content="COMPARISON") == {"FINISHED"}
    assert b"Model, CT" in path.read_bytes()
    assert b"Difference" not in path.read_bytes()


def test_a_difference_of_gray_values_is_one(scanned, give_ct):
    """Of a model that was made of them alone."""
    give_ct(Densities(relative=True))
    scanned[WARNINGS_KEY] = f"volume.tif: so {RELATIVE}"
    sections.add_section_plane(scanned, bpy.context)
    values, view = section.sample_section(bpy.context.scene)
    assert section_picture.picture_of(values, view, bpy.context.scene, "DIFFERENCE").unit == RELATIVE_UNIT


def test_the_panel_says_why_there_is_no_difference(scanned, give_ct, draw_panels):
    told = "Gray values of the CT have no unit: no difference to the model is shown"
    sections.add_section_plane(scanned, bpy.context)
    bpy.context.scene.insideout.sections[0].beside = "BOTH"
    assert told not in draw_panels(2000)
    give_ct(Densities(relative=True))
    assert told in draw_panels(2000)
    bpy.context.scene.insideout.sections[0].beside = "NONE"
    assert told not in draw_panels(2000)
