"""Node groups are shared in a file, and built anew where another version of the add-on built them."""

from __future__ import annotations

import ast
from pathlib import Path

import bpy

from insideout.insideout_addon.scene import node_tree
from insideout.insideout_addon.scene.cutting import cut_group
from insideout.insideout_addon.scene.display import display_group, display_modifier, show_splats
from insideout.insideout_addon.scene.splats import create_splats


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
