"""A .ply of any program, chosen in the file browser."""

from __future__ import annotations

from types import SimpleNamespace

import bpy
import numpy as np
import pytest

from insideout.operators.import_file import INSIDEOUT_OT_import_file


def _browser(path):
    """A panel that draws what the operator draws beside the file browser."""

    class Browser:
        def draw(self, context):
            INSIDEOUT_OT_import_file.draw(SimpleNamespace(layout=self.layout, filepath=str(path)), context)

    return Browser


def test_a_file_without_density(blender, tmp_path):
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
    names += [f"scale_{i}" for i in range(3)] + [f"rot_{i}" for i in range(4)]
    header = ["ply", "format binary_little_endian 1.0", "element vertex 3"]
    header += [*(f"property float {name}" for name in names), "end_header", ""]
    table = np.ones((3, len(names)), "<f4")
    (tmp_path / "foreign.ply").write_bytes("\n".join(header).encode() + table.tobytes())
    assert bpy.ops.insideout.import_file(filepath=str(tmp_path / "foreign.ply")) == {"FINISHED"}
    model = bpy.context.scene.insideout.model
    assert (model.name, len(model.data.points)) == ("foreign", 3)


def test_a_file_beside_the_blend(blender, tmp_path, one_ball):
    one_ball.save(tmp_path / "ball.ply")
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    assert bpy.ops.insideout.import_file(filepath="//ball.ply") == {"FINISHED"}


def test_what_is_no_splats_is_told(blender, tmp_path):
    (tmp_path / "mesh.ply").write_text("ply\nformat ascii 1.0\n", "utf-8")
    with pytest.raises(RuntimeError, match=r"mesh\.ply: is an ascii \.ply; export it as binary"):
        bpy.ops.insideout.import_file(filepath=str(tmp_path / "mesh.ply"))
    with pytest.raises(RuntimeError, match="no such file"):
        bpy.ops.insideout.import_file(filepath=str(tmp_path / "none.ply"))
    assert len(bpy.data.objects) == 0


def test_the_file_browser_tells_the_memory(draw_panels, tmp_path, one_ball):
    one_ball.save(tmp_path / "ball.ply")
    drawn = draw_panels(classes=[_browser(tmp_path / "ball.ply")])
    assert "1 splats as ellipsoids" in drawn
    assert any(text.startswith("Memory ") for text in drawn)
    assert "Memory" not in " ".join(draw_panels(classes=[_browser(tmp_path)])), "no file is chosen yet"
