"""The scene that `make demo` saves."""

from __future__ import annotations

import json

import bpy
import numpy as np
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector

from insideout.insideout_addon.scene import showcase
from insideout.insideout_addon.scene.splats import read_splats


def test_the_blend_opens_anywhere_with_all_in_it(blender, tmp_path, random_set):
    run = tmp_path / "run"
    random_set.save(run / "fused.ply")
    showcase.build_showcase(run, bpy.context)
    showcase.save_blend(bpy.context.scene, tmp_path / "demo" / "insideout.blend", run)
    (tmp_path / "demo").rename(tmp_path / "moved")
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "moved" / "insideout.blend"))
    settings = bpy.context.scene.insideout
    assert settings.run == "//../run"
    assert len(settings.model.data.points) == 200
    assert len(settings.sections) == 1
    assert bpy.context.scene.camera is not None
    assert all(image.packed_file for image in bpy.data.images if image.users and image.source == "GENERATED")
    assert sum(o.type == "LIGHT" for o in bpy.data.objects) == 3
    assert [p.name for p in (tmp_path / "moved").iterdir()] == ["insideout.blend"]


def test_photos_alone_stay_whole_upright_and_fill_the_picture(blender, photo_run):
    """The camera that took the photos was turned on its side."""
    camera = {"world_to_camera": [[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 5], [0, 0, 0, 1]]}
    (photo_run / "initialize").mkdir()
    (photo_run / "initialize" / "photos.json").write_text(json.dumps({"photos": [{"camera": camera}]}), "utf-8")
    splats = showcase.build_showcase(photo_run, bpy.context)
    scene = bpy.context.scene
    assert len(scene.insideout.sections) == 0
    assert [o.name for o in bpy.data.objects if "Bar" in o.name] == []
    np.testing.assert_allclose(splats.matrix_world.to_3x3() @ Vector((1, 0, 0)), (0, 0, 1), atol=1e-5)
    showcase.render_settings(scene, 100, 1)
    bpy.context.view_layer.update()
    points = read_splats(splats).means[:1000]
    seen = np.array([world_to_camera_view(scene, scene.camera, splats.matrix_world @ Vector(p)) for p in points])
    assert seen[:, :2].min() > 0
    assert seen[:, :2].max() < 1
    assert np.ptp(seen[:, :2], axis=0).min() > 0.45


def test_the_model_and_the_colour_bar_are_in_the_picture(blender, tmp_path, random_set):
    random_set.save(tmp_path / "fused.ply")
    splats = showcase.build_showcase(tmp_path, bpy.context)
    scene = bpy.context.scene
    showcase.render_settings(scene, 100, 1)
    bpy.context.view_layer.update()
    low, high = random_set.means.min(0), random_set.means.max(0)
    corners = [Vector((x, y, z)) for x in (low[0], high[0]) for y in (0, high[1]) for z in (low[2], high[2])]
    bar = next(c for c in scene.insideout.sections[0].object.children if c.type == "MESH")
    corners += [bar.matrix_world @ v.co for v in bar.data.vertices]
    seen = np.array([world_to_camera_view(scene, scene.camera, corner) for corner in corners])
    assert splats.type == "POINTCLOUD"
    assert seen[:, :2].min() > 0.0
    assert seen[:, :2].max() < 1.0


def test_it_renders(blender, tmp_path, one_ball):
    one_ball.save(tmp_path / "fused.ply")
    showcase.build_showcase(tmp_path, bpy.context)
    scene = bpy.context.scene
    showcase.render_settings(scene, 64, 2)
    scene.render.filepath = str(tmp_path / "a.png")
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(str(tmp_path / "a.png"))
    pixels = np.array(image.pixels[:]).reshape(64, 64, 4)
    assert pixels[..., :3].std() > 0.05
    # The section's colours: dark rim to bright middle, warm against the grey backdrop.
    assert (pixels[..., 0] - pixels[..., 2]).max() > 0.3
