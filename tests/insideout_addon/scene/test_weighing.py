"""The model on the scales: what is kept on it, and the mark at its centre of mass."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from mathutils import Matrix

from insideout.core.errors import SettingError
from insideout.core.gaussians import GaussianSet, Modality
from insideout.core.mesh.density_map import curve_of_materials, curve_of_points
from insideout.insideout_addon.measure.marks import marks_on
from insideout.insideout_addon.scene.placement import apply_transform
from insideout.insideout_addon.scene.splats import create_splats
from insideout.insideout_addon.scene.weighing import (
    CENTER_NAME,
    add_center_marker,
    center_marker,
    kept_weight,
    weigh_model,
)

CURVE = curve_of_points((0, 0), (0.04, 1.0))


@pytest.fixture
def ball(blender, one_ball):
    """A round splat of 5 mm and 0.04 mm⁻¹ at (3, -2, 1), shown in metres and turned."""
    model = create_splats(one_ball, "ball", bpy.context)
    model.matrix_world = Matrix.LocRotScale((1, 2, 3), Matrix.Rotation(0.5, 3, "Y"), (0.001,) * 3)
    bpy.context.view_layer.update()
    return model


@pytest.fixture
def shell(blender):
    """A hollow ball of splats a millimetre apart, each a millimetre wide, and the number of those it lacks."""
    axis = np.arange(-12, 13.0)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    radius = np.linalg.norm(points, axis=1)
    wall = points[(radius < 12) & (radius >= 6)]
    gaussians = GaussianSet.create(wall, 1.0, density=0.04 / (2 * np.pi) ** 1.5, modality=Modality.XRAY)
    return create_splats(gaussians, "shell", bpy.context), np.count_nonzero(radius < 6)


def test_lengths_in_the_models_own_frame_are_millimetres(ball):
    weight = weigh_model(ball, CURVE)

    mass = (2 * np.pi) ** 1.5 * 5**3 * 1e-3
    assert weight.properties.mass_g == pytest.approx(mass, rel=1e-5)
    np.testing.assert_allclose(weight.properties.center_mm, [3, -2, 1], atol=1e-5)
    np.testing.assert_allclose(weight.properties.inertia_g_mm2, 2 * 25 * mass * np.eye(3), rtol=1e-4, atol=1e-3)
    assert weight.cavities == ()


def test_figures_stay_on_the_model(shell, tmp_path):
    model, missing = shell
    assert kept_weight(model) is None

    found = weigh_model(model, curve_of_materials(["PMMA"], 60), edge_mm_inv=0.02)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "weighed.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "weighed.blend"))
    kept = kept_weight(bpy.data.objects["shell"])

    assert kept.properties.mass_g == found.properties.mass_g
    np.testing.assert_array_equal(kept.properties.center_mm, found.properties.center_mm)
    np.testing.assert_array_equal(kept.properties.inertia_g_mm2, found.properties.inertia_g_mm2)
    (cavity,) = kept.cavities
    assert cavity.volume_mm3 == pytest.approx(missing, rel=0.01)
    np.testing.assert_allclose(cavity.center_mm, 0, atol=0.01)
    assert kept.calibration == "PMMA at 60 keV"


def test_what_was_not_looked_for_is_not_told(shell):
    model, _ = shell
    weigh_model(model, CURVE)
    assert len(kept_weight(model).cavities) == 1
    weigh_model(model, CURVE, cavities=False)
    assert kept_weight(model).cavities is None


def test_edits_count(shell):
    model, _ = shell
    before = weigh_model(model, CURVE, cavities=False)
    values = np.empty(len(model.data.points), np.float32)
    model.data.attributes["density"].data.foreach_get("value", values)
    model.data.attributes["density"].data.foreach_set("value", 2 * values)

    assert weigh_model(model, CURVE, cavities=False).properties.mass_g == pytest.approx(2 * before.properties.mass_g)


def test_the_mark_follows_the_model_and_the_next_weighing(ball):
    weigh_model(ball, CURVE)
    marker = add_center_marker(ball, bpy.context)
    bpy.context.view_layer.update()

    assert marker.name == CENTER_NAME
    np.testing.assert_allclose(
        marker.matrix_world.translation, ball.matrix_world @ Matrix.Translation((3, -2, 1)).translation, atol=1e-6
    )
    ball.data.attributes["position"].data.foreach_set("vector", [4.0, 0.0, 0.0])
    weigh_model(ball, CURVE)
    assert add_center_marker(ball, bpy.context) == marker == center_marker(ball)
    np.testing.assert_allclose(marker.location, [4, 0, 0], atol=1e-6)
    assert sum(thing.name.startswith(CENTER_NAME) for thing in bpy.data.objects) == 1


def test_the_mark_is_known_by_any_name(ball):
    weigh_model(ball, CURVE)
    marker = add_center_marker(ball, bpy.context)
    marker.name = "CoM of the vase"
    ball.data.attributes["position"].data.foreach_set("vector", [4.0, 0.0, 0.0])
    weigh_model(ball, CURVE)
    np.testing.assert_allclose(marker.location, [4, 0, 0], atol=1e-6)
    assert add_center_marker(ball, bpy.context) == marker
    assert marker in marks_on(ball)


def test_the_mark_of_an_older_file_is_known_by_its_name(ball):
    weigh_model(ball, CURVE)
    marker = add_center_marker(ball, bpy.context)
    for key in list(marker.keys()):
        del marker[key]
    assert center_marker(ball) == marker
    assert marker in marks_on(ball)


def test_of_a_model_that_was_stretched_since_no_weight_is_told(ball):
    """Twice as large it would weigh eight times as much, and balance elsewhere."""
    weigh_model(ball, CURVE)
    before = kept_weight(ball).properties
    add_center_marker(ball, bpy.context)
    ball.scale = (0.002,) * 3
    bpy.context.view_layer.update()
    assert kept_weight(ball) is not None
    apply_transform(ball)
    assert kept_weight(ball) is None

    scale = 0.002
    after = weigh_model(ball, CURVE).properties
    bpy.context.view_layer.update()
    assert after.mass_g == pytest.approx(before.mass_g * scale**3, rel=1e-4)
    np.testing.assert_allclose(center_marker(ball).matrix_world.translation, after.center_mm, rtol=1e-4)


@pytest.mark.parametrize("older", [False, True])
def test_of_a_model_that_blender_itself_moved_since_no_weight_is_told(ball, older):
    """Its centre of mass would be where the model was; files from before this was looked for show what they did."""
    weigh_model(ball, CURVE)
    if older:
        ball["insideout_weighed"] = list(ball["insideout_weighed"])[:13]
    bpy.context.view_layer.objects.active = ball
    ball.select_set(True)
    assert kept_weight(ball) is not None
    bpy.ops.object.transform_apply()
    assert (kept_weight(ball) is None) != older


def test_of_a_model_that_lost_splats_since_no_weight_is_told(shell):
    model, _ = shell
    weigh_model(model, CURVE, cavities=False)
    half = GaussianSet.create(np.eye(3), 1.0, density=0.1, modality=Modality.XRAY)
    model.data = create_splats(half, "half", bpy.context).data
    assert kept_weight(model) is None


def test_no_mark_without_a_weight(ball):
    with pytest.raises(SettingError, match="was not weighed yet"):
        add_center_marker(ball, bpy.context)


def test_photos_alone_have_no_weight_and_what_was_kept_stays(blender, ball):
    weigh_model(ball, CURVE)
    kept = kept_weight(ball).properties.mass_g
    with pytest.raises(SettingError, match="mass comes out as 0 g"):
        weigh_model(ball, curve_of_points((1.0, 0.0), (2.0, 1.0)))
    assert kept_weight(ball).properties.mass_g == kept

    photos = create_splats(GaussianSet.create(np.eye(3), 0.1), "photos", bpy.context)
    with pytest.raises(SettingError, match="photos is of photos alone"):
        weigh_model(photos, CURVE)
    assert kept_weight(photos) is None
