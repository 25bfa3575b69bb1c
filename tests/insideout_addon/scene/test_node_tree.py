"""Node groups are shared in a file, and built anew where another version of the add-on built them."""

from __future__ import annotations

import ast
from pathlib import Path

import bpy
import pytest

from insideout.insideout_addon.scene import node_tree
from insideout.insideout_addon.scene.cutting import cut_group
from insideout.insideout_addon.scene.display import display_group, display_modifier, show_splats
from insideout.insideout_addon.scene.materials import splat_material
from insideout.insideout_addon.scene.splats import create_splats

pytestmark = pytest.mark.builds_groups


def test_a_group_is_built_once(blender):
    assert display_group() == display_group()
    assert cut_group() != display_group()


def test_a_group_of_another_version_is_left_to_its_models(blender, one_ball):
    model = create_splats(one_ball, "model", bpy.context)
    show_splats(model, True)
    old = display_group()
    old[node_tree.STAMP_KEY] = "another"
    new = display_group()
    assert new != old
    assert display_modifier(model).node_group == old
    assert display_group() == new


def test_every_file_that_builds_groups_counts_for_the_stamp():
    folder = Path(node_tree.__file__).parent
    for path in folder.glob("*.py"):
        names = {node.id for node in ast.walk(ast.parse(path.read_text("utf-8"))) if isinstance(node, ast.Name)}
        if names & {"shared_group", "TreeBuilder"} and path.name not in ("color_bar.py",):
            assert path.name in node_tree._BUILDERS, path.name


def test_a_material_is_built_once_and_one_of_another_version_left_alone(blender):
    old = splat_material("Splats")
    assert splat_material("Splats") == old
    assert splat_material("Solid Splats") != old
    old[node_tree.STAMP_KEY] = "another"
    new = splat_material("Splats")
    assert (old.name, new.name) == ("InsideOut Splats", "InsideOut Splats.001")
    assert splat_material("Splats") == new


def test_what_the_user_changed_of_a_material_stays(blender):
    splat_material("Splats").roughness = 0.1
    assert splat_material("Splats").roughness == pytest.approx(0.1)


def test_materials_that_several_objects_show_are_stamped():
    """Only what is made for one object, or one scene, is made anew each time."""
    folder = Path(node_tree.__file__).parents[1]
    own = {"section_face.py", "showcase.py", "studio.py", "node_tree.py"}
    making = {path.name for path in folder.rglob("*.py") if "bpy.data.materials.new(" in path.read_text("utf-8")}
    assert making == own
