"""Node groups that are built once for all tests of a process: Blender takes a third of a second for the display's."""

from __future__ import annotations

import re
from pathlib import Path

import bpy

from insideout.core.steps import run_through
from insideout.insideout_addon.scene import cutting, display, node_tree
from insideout.insideout_addon.scene.node_tree import STAMP_KEY, builders_stamp, group_there, shared_in_steps


class KeptGroups:
    """What stands in for `shared_in_steps`: a group that an earlier test has built comes from a file in `folder`.

    As that does, it goes by a group's name, its inputs and the version of the add-on.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._files: dict[tuple, tuple[Path, str]] = {}

    def in_place_of(self, patch) -> None:
        """Has the add-on ask here, by pytest's `monkeypatch`."""
        for module in (node_tree, cutting):
            patch.setattr(module, "shared_in_steps", self._shared)
        # Built part by part it would come part by part.
        patch.setattr(display, "PARTS", (display.display_group,))

    def _shared(self, name, inputs, build, outputs=node_tree.GEOMETRY, modifier=False):
        yield from ()
        found = group_there(name, inputs)
        if found is not None:
            return found
        key = name, frozenset(name for name, *_ in inputs), builders_stamp()
        if key in self._files:
            return _appended(*self._files[key])
        group = run_through(shared_in_steps(name, inputs, build, outputs, modifier))
        path = self._folder / f"{len(self._files)}.blend"
        bpy.data.libraries.write(str(path), {group})
        self._files[key] = path, group.name
        return group


def _appended(path: Path, name: str) -> bpy.types.NodeTree:
    """The group, with those groups and materials in it that the file has already."""
    kinds = (bpy.data.node_groups, bpy.data.materials)
    before, libraries = [set(kind) for kind in kinds], set(bpy.data.libraries)
    with bpy.data.libraries.load(str(path)) as (_, wanted):
        wanted.node_groups = [name]
    for kind, known in zip(kinds, before, strict=True):
        for block in set(kind) - known:
            own = next((one for one in known if _stands_for(one, block)), None)
            if own is not None:
                block.user_remap(own)
                kind.remove(block)
    for library in set(bpy.data.libraries) - libraries:
        bpy.data.libraries.remove(library)
    return wanted.node_groups[0]


def _stands_for(one: bpy.types.ID, other: bpy.types.ID) -> bool:
    alike = one.library is None and one.get(STAMP_KEY) == other.get(STAMP_KEY)
    return alike and _numberless(one.name) == _numberless(other.name)


def _numberless(name: str) -> str:
    return re.sub(r"\.\d+$", "", name)
