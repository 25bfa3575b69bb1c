"""What is ours and nothing uses: what is ended early, or removed, leaves none of it behind."""

from __future__ import annotations

import bpy

_OURS = "InsideOut"


def known_looks() -> set[int]:
    """Those of the whole file, by their `session_uid`."""
    return {block.session_uid for block in _looks()}


def remove_unused_looks(before: set[int], names: tuple[str, ...] = (_OURS,)) -> None:
    """Takes away those that nothing uses and that were not there before.

    Args:
        names: that theirs begin with one of.
    """
    # Groups use each other.
    while unused := [block for block in _looks(names) if block.users == 0 and block.session_uid not in before]:
        bpy.data.batch_remove(unused)


def remove_unused_pictures(name: str) -> None:
    """Takes away materials of this name that show images, and these images, where nothing else uses them.

    Images make a .blend large, and Blender saves those of a material's even where no object has that. Materials without
    any stay for the next that asks for them, in the colours that somebody gave them meanwhile.
    """
    named = [each for each in bpy.data.materials if each.name.startswith(name) and each.library is None]
    unused = [each for each in named if each.users == 0 and _images(each)]
    images = {image for each in unused for image in _images(each)}
    bpy.data.batch_remove(unused)
    bpy.data.batch_remove([image for image in images if image.users == 0 and image.name.startswith(name)])


def _images(material: bpy.types.Material) -> list[bpy.types.Image]:
    nodes = () if material.node_tree is None else material.node_tree.nodes
    return [node.image for node in nodes if node.bl_idname == "ShaderNodeTexImage" and node.image is not None]


def _looks(names: tuple[str, ...] = (_OURS,)) -> list[bpy.types.ID]:
    """What models are shown by; what the user makes in a break is not among it."""
    blocks = (*bpy.data.node_groups, *bpy.data.materials)
    return [block for block in blocks if block.name.startswith(names) and block.library is None]
