"""A .ply of any program, chosen in the file browser."""

from __future__ import annotations

import errno
import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import bpy
import numpy as np
import pytest

from insideout.core.gaussians import GaussianSet
from insideout.insideout_addon.remembered import forget
from insideout.insideout_addon.scene.importing import available_sets
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


def test_a_run_that_cannot_be_read_is_told(draw_panels, tmp_path, monkeypatch):
    """As the folder of another user, or one on a disk that is broken; by the panel too, which looks there."""
    run, settings = tmp_path / "run", bpy.context.scene.insideout
    run.mkdir()
    is_dir = Path.is_dir

    def refuse(path):
        if path == run:
            raise PermissionError(errno.EACCES, "Permission denied", str(run))
        return is_dir(path)

    monkeypatch.setattr(Path, "is_dir", refuse)
    settings.run = str(run)
    with pytest.raises(RuntimeError, match="run: permission denied; choose another file or folder"):
        bpy.ops.insideout.import_run()
    forget()
    assert any("run: permission denied; choose another file or folder" in text for text in draw_panels(5000))
    assert available_sets(run) == []


def test_the_file_browser_tells_the_memory(draw_panels, tmp_path, one_ball):
    one_ball.save(tmp_path / "ball.ply")
    drawn = draw_panels(classes=[_browser(tmp_path / "ball.ply")])
    assert "1 splats as ellipsoids" in drawn
    assert any(text.startswith("Memory ") for text in drawn)
    assert "Memory" not in " ".join(draw_panels(classes=[_browser(tmp_path)])), "no file is chosen yet"


# In a Blender of its own: the memory that another one has freed would be used again, and not be seen.
_IMPORT = """
import json, os, sys
from pathlib import Path
import bpy
import insideout

def memory_mb(name):
    (line,) = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(name + ":"))
    return 1024 * int(line.split()[1]) / 1e6

insideout.register()
bpy.context.scene.insideout.display = "POINTS"
bpy.context.scene.insideout.view_dependent = sys.argv[2] == "True"
before = memory_mb("VmRSS")
bpy.ops.insideout.import_file(filepath=sys.argv[1])
model = bpy.context.scene.insideout.model
print(json.dumps({"splats": len(model.data.points), "more_mb": memory_mb("VmHWM") - before}), flush=True)
# As a Python module Blender may hang at its end.
os._exit(0)
"""


@pytest.fixture(scope="module")
def a_million_splats(tmp_path_factory):
    """A .ply of degree 3, as other programs write it; what is shown of some too faint to be seen is a copy."""
    rng, count = np.random.default_rng(0), 1_000_000
    path = tmp_path_factory.mktemp("large") / "million.ply"
    GaussianSet.create(
        rng.uniform(-50, 50, (count, 3)),
        rng.uniform(0.05, 0.2, (count, 3)),
        quats=rng.normal(size=(count, 4)),
        opacities=rng.uniform(0.0, 1.0, count),
        sh=rng.normal(0, 0.3, (count, 16, 3)),
    ).save(path)
    return path


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="only Linux tells a process's memory there")
@pytest.mark.parametrize("view_dependent", [False, True])
def test_a_million_splats_take_the_file_and_400_mb(a_million_splats, view_dependent):
    command = [sys.executable, "-c", _IMPORT, str(a_million_splats), str(view_dependent)]
    answer = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)
    assert answer.returncode == 0, answer.stderr
    told = json.loads(answer.stdout.splitlines()[-1])
    assert told["splats"] == 1_000_000
    assert told["more_mb"] <= a_million_splats.stat().st_size / 1e6 + 400


def test_a_collection_that_overrides_one_of_another_file_takes_none(linked_collection, tmp_path, random_set):
    context = bpy.context
    linked_collection.override_hierarchy_create(context.scene, context.view_layer)
    layers = context.view_layer.layer_collection.children
    context.view_layer.active_layer_collection = next(
        layer for layer in layers if layer.collection.override_library is not None
    )
    random_set.save(tmp_path / "fused.ply")
    assert bpy.ops.insideout.import_file(filepath=str(tmp_path / "fused.ply")) == {"FINISHED"}
    assert context.scene.insideout.model.name in context.scene.collection.objects
