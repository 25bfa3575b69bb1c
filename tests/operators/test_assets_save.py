"""Saving assets, as a script or the menu does it."""

from __future__ import annotations

import errno

import bpy
import pytest

from insideout.insideout_addon.assets.library import FILE
from insideout.insideout_addon.error_text import sentence


def test_they_are_saved_where_the_user_says(blender, tmp_path):
    assert bpy.ops.insideout.assets_save(filepath=str(tmp_path / FILE)) == {"FINISHED"}
    with bpy.data.libraries.load(str(tmp_path / FILE), assets_only=True) as (found, _):
        assert "InsideOut Splats" in found.node_groups
    libraries = bpy.context.preferences.filepaths.asset_libraries
    assert str(tmp_path) not in [library.path for library in libraries]


def test_they_are_listed_in_the_preferences_if_asked(blender, tmp_path):
    libraries = bpy.context.preferences.filepaths.asset_libraries
    before = len(libraries)
    bpy.ops.insideout.assets_save(filepath=str(tmp_path / FILE), use_library=True)
    assert len(libraries) == before + 1
    try:
        assert libraries[before].name == "InsideOut"
        assert libraries[before].path.rstrip("/") == str(tmp_path)
    finally:
        libraries.remove(libraries[before])


def test_a_folder_that_cannot_be_written_is_told_in_a_sentence(blender, tmp_path):
    (tmp_path / "file").write_text("", "utf-8")
    with pytest.raises(RuntimeError, match="choose another place"):
        bpy.ops.insideout.assets_save(filepath=str(tmp_path / "file" / FILE))


def test_an_error_of_the_system_that_names_no_file_is_a_sentence_too():
    """As of a disk that breaks, or is full, while a file that is open is written."""
    told = sentence(OSError(errno.EIO, "Input/output error"))
    assert told == "The file cannot be used: input/output error; choose another file or folder."
