"""A .blend on a machine without the add-on: the model, its section and where it is from are all in the file."""

from __future__ import annotations

import json
import subprocess
import sys

import bpy
import pytest

_LOOK = """
import bpy, json, sys
bpy.ops.wm.open_mainfile(filepath=sys.argv[1])
model = bpy.data.objects["model"]
depsgraph = bpy.context.evaluated_depsgraph_get()
evaluated = model.evaluated_get(depsgraph)
modifier = model.modifiers[0]
drivers = [d for block in bpy.data.user_map() for d in getattr(getattr(block, "animation_data", None), "drivers", ())]
print("found:" + json.dumps({
    "add-on": hasattr(bpy.types.Scene, "insideout") or "insideout" in sys.modules,
    "instances": sum(i.is_instance and i.parent.original == model for i in depsgraph.object_instances),
    "points": len(evaluated.data.points),
    "group": modifier.node_group.name,
    "materials": sorted(m.name for m in bpy.data.materials if m.name.startswith("InsideOut")),
    "attributes": sorted(a.name for a in model.data.attributes),
    "libraries": len(bpy.data.libraries),
    "drivers": len(drivers),
    "texts": len(bpy.data.texts),
    "outside": [i.name for i in bpy.data.images if i.users and i.type == "IMAGE" and not i.packed_file],
    "provenance": json.loads(model["insideout_provenance"])["file"]["name"],
    "lengths": bpy.context.scene.unit_settings.length_unit,
}))
"""


def _look(blend):
    answer = subprocess.run([sys.executable, "-c", _LOOK, str(blend)], capture_output=True, text=True, check=False)
    assert answer.returncode == 0, answer.stderr
    return json.loads(next(line for line in answer.stdout.splitlines() if line.startswith("found:"))[6:])


def _shown(model):
    """(instances, points) that this Blender, with the add-on, shows."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    instances = sum(i.is_instance and i.parent.original == model for i in depsgraph.object_instances)
    return instances, len(model.evaluated_get(depsgraph).data.points)


@pytest.mark.parametrize("display", ["ELLIPSOIDS", "POINTS"])
def test_it_still_shows_the_model(blender, tmp_path, random_set, display):
    random_set.save(tmp_path / "fused.ply")
    settings = bpy.context.scene.insideout
    settings.display = display
    bpy.ops.insideout.import_run(filepath=str(tmp_path / "fused.ply"))
    settings.model.name = "model"
    bpy.ops.insideout.section_add()
    settings.sections[0].cut = False
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    (tmp_path / "fused.ply").unlink()
    shown = _shown(settings.model)
    found = _look(tmp_path / "a.blend")
    assert not found["add-on"]
    assert (found["instances"], found["points"]) == shown
    assert max(shown) > 150
    assert (shown[0] > 0) == (display == "ELLIPSOIDS")
    assert found["group"].startswith("InsideOut Splats")
    assert "InsideOut Splats" in found["materials"]
    assert {"position", "scale", "rotation", "radiance:base", "density", "display_color"} <= set(found["attributes"])
    assert (found["libraries"], found["drivers"], found["texts"], found["outside"]) == (0, 0, 0, [])
    assert found["provenance"] == "fused.ply"
    assert found["lengths"] == "MILLIMETERS"
