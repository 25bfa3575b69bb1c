"""Node groups that are built once for all tests of a process: Blender takes a third of a second for the display's."""

from __future__ import annotations

import re
from pathlib import Path

import bpy

from insideout.insideout_addon.scene import cutting, display, node_tree
from insideout.insideout_addon.scene.node_tree import STAMP_KEY, builders_stamp, group_there, shared_in_steps


class KeptGroups:
    """Before `shared_in_steps` looks for a group, or builds it: one that an earlier test has built is put there.

    It comes from a file in `folder`, by its name, its inputs and the version of the add-on.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._files: dict[tuple, Path] = {}

    def in_place_of(self, patch) -> None:
        """Has the add-on ask here, by pytest's `monkeypatch`."""
        for module in (node_tree, cutting):
            patch.setattr(module, "shared_in_steps", self._shared)
        # Built part by part it would come part by part.
        patch.setattr(display, "PARTS", (display.display_group,))

    def _shared(self, name, inputs, build, outputs=node_tree.GEOMETRY, modifier=False):
        key = name, frozenset(name for name, *_ in inputs), builders_stamp()
        new = group_there(name, inputs) is None
        if new and key in self._files:
            _append(self._files[key], name)
        group = yield from shared_in_steps(name, inputs, build, outputs, modifier)
        # One with a number at its name stands beside another, which is no part of other tests.
        if new and key not in self._files and group.name == name:
            self._files[key] = self._folder / f"{len(self._files)}.blend"
            bpy.data.libraries.write(str(self._files[key]), {group})
        return group


def _append(path: Path, name: str) -> None:
    """Brings the group, with those groups and materials in it that the file has already."""
    kinds = (bpy.data.node_groups, bpy.data.materials)
    before, libraries = [set(kind) for kind in kinds], set(bpy.data.libraries)
    with bpy.data.libraries.load(str(path)) as (_, wanted):
        wanted.node_groups = [name]
    (group,) = wanted.node_groups
    for kind, known in zip(kinds, before, strict=True):
        for block in set(kind) - known - {group}:
            own = next((one for one in known if _stands_for(one, block)), None)
            if own is not None:
                block.user_remap(own)
                kind.remove(block)
    for library in set(bpy.data.libraries) - libraries:
        bpy.data.libraries.remove(library)


def _stands_for(one: bpy.types.ID, other: bpy.types.ID) -> bool:
    alike = one.library is None and one.get(STAMP_KEY) == other.get(STAMP_KEY)
    return alike and _numberless(one.name) == _numberless(other.name)


def _numberless(name: str) -> str:
    return re.sub(r"\.\d+$", "", name)
