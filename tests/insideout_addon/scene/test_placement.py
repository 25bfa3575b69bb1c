"""What the user has done to a model as an object since it was imported, in whatever unit its scene is."""

from __future__ import annotations

import bpy
import numpy as np
import pytest

from insideout.core.gaussians import GaussianSet
from insideout.insideout_addon.scene.importing import import_splats
from insideout.insideout_addon.scene.placement import apply_transform, is_scaled, moved_since_import
from insideout.insideout_addon.scene.splats import read_splats


@pytest.fixture
def brought(blender, tmp_path):
    """`brought(density)`: a model imported where a unit is a millimetre, appended to a scene in metres."""

    def bring(density=0.02):
        rng = np.random.default_rng(0)
        model = GaussianSet.create(rng.uniform(-10, 10, (200, 3)), 1.0, density=density, opacities=0.5)
        model.save(tmp_path / "model.ply")
        import_splats(tmp_path / "model.ply", "model", bpy.context)
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
        bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
        with bpy.data.libraries.load(str(tmp_path / "a.blend")) as (_, wanted):
            wanted.objects = ["model"]
        bpy.context.scene.collection.objects.link(wanted.objects[0])
        assert bpy.context.scene.unit_settings.scale_length == 1.0
        return wanted.objects[0]

    return bring


def test_brought_to_its_true_size_in_a_scene_in_metres_it_is_not_scaled(brought):
    """It arrives a thousand times too large, and mm in its own frame stay mm."""
    model = brought()
    before = read_splats(model)
    assert not is_scaled(model)
    model.scale = (0.001,) * 3
    model.rotation_euler.z = 0.5
    bpy.context.view_layer.update()
    assert not is_scaled(model)
    np.testing.assert_allclose(np.linalg.svd(moved_since_import(model).linear)[1], 1.0, rtol=1e-5)
    apply_transform(model)
    after = read_splats(model)
    np.testing.assert_allclose(np.linalg.norm(after.means, axis=1), np.linalg.norm(before.means, axis=1), rtol=1e-4)
    np.testing.assert_allclose(after.density, before.density, rtol=1e-5)
    np.testing.assert_allclose(model.scale, 0.001, rtol=1e-5)
    assert not is_scaled(model)


@pytest.mark.parametrize(
    ("size", "times"),
    [((0.002,) * 3, (2, 2, 2)), ((0.001, 0.001, 0.002), (2, 1, 1)), ((2.0,) * 3, (2, 2, 2)), ((0.5,) * 3, (0.5,) * 3)],
)
def test_of_another_size_it_is_scaled_from_the_one_that_it_is_nearer_to(brought, size, times):
    """As large as it was in mm, or as the import would have made it in metres."""
    model = brought()
    model.scale = size
    bpy.context.view_layer.update()
    assert is_scaled(model)
    np.testing.assert_allclose(np.linalg.svd(moved_since_import(model).linear)[1], times, rtol=1e-5)


def test_lengths_in_no_unit_have_no_true_size(brought):
    model = brought(density=0.0)
    model.scale = (0.001,) * 3
    bpy.context.view_layer.update()
    assert is_scaled(model)
