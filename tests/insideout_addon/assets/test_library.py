"""The asset library: what is in it, that it works without the add-on, and that nothing of the user's changes."""

from __future__ import annotations

import errno
import os
import re

import bpy
import numpy as np
import pytest

import insideout
from insideout.core.errors import RunFolderError, SettingError
from insideout.core.spherical_harmonics import sh_to_rgb
from insideout.core.srgb import srgb_to_linear
from insideout.insideout_addon.assets.catalogs import FILE as CATALOGS
from insideout.insideout_addon.assets.catalogs import catalog_id
from insideout.insideout_addon.assets.library import ASSETS, add_to_asset_libraries, save_assets, save_in_steps
from insideout.insideout_addon.scene.display import PARTS, display_group, display_modifier, show_splats
from insideout.insideout_addon.scene.node_tree import STAMP_KEY, input_names, set_modifier_input
from insideout.insideout_addon.scene.splats import create_splats

pytestmark = pytest.mark.builds_groups

NAMES = {
    "node_groups": [asset.name for asset in ASSETS if asset.catalog.endswith("Node Groups")],
    "materials": [asset.name for asset in ASSETS if asset.catalog.endswith("Materials")],
}


@pytest.fixture
def library(blender, tmp_path):
    save_assets(tmp_path / "library" / "insideout.blend")
    return tmp_path / "library" / "insideout.blend"


def _append(path, kind, name):
    with bpy.data.libraries.load(str(path), assets_only=True) as (_, wanted):
        setattr(wanted, kind, [name])
    (block,) = getattr(wanted, kind)
    return block


def _native_splats(random_set):
    """A point cloud as Blender 5.3 imports one: without attributes of this add-on's."""
    splats = create_splats(random_set, "native", bpy.context)
    own = {"position", "scale", "rotation", "radiance:base"}
    for name in [attribute.name for attribute in splats.data.attributes]:
        if name not in own and not name.startswith("radiance:sh_") and not splats.data.attributes[name].is_required:
            splats.data.attributes.remove(splats.data.attributes[name])
    assert "display_color" not in splats.data.attributes
    return splats


def _evaluated(splats):
    depsgraph = bpy.context.evaluated_depsgraph_get()
    depsgraph.update()
    return splats.evaluated_get(depsgraph).evaluated_geometry()


def test_blender_finds_every_asset_in_it(library):
    with bpy.data.libraries.load(str(library), assets_only=True) as (found, _):
        assert {kind: sorted(getattr(found, kind)) for kind in NAMES} == {k: sorted(v) for k, v in NAMES.items()}
    assert [path.name for path in library.parent.iterdir() if path.name != CATALOGS] == [library.name]


def test_assets_say_what_they_are_and_who_made_them(library):
    for kind, names in NAMES.items():
        for name in names:
            block = _append(library, kind, name)
            data = block.asset_data
            assert re.fullmatch(r"[A-Z].{20,}[^.]", data.description)
            assert data.author == "InsideOut developers"
            assert {"InsideOut", f"InsideOut {insideout.__version__}"} <= set(data.tags.keys())
            assert data.catalog_id in {catalog_id(asset.catalog) for asset in ASSETS}
            assert len(block[STAMP_KEY]) == 12
            assert tuple(block.preview.image_size) == (192, 192)
            assert np.ptp(np.array(block.preview.image_pixels_float[:])) > 0.5


def test_catalogues_lie_beside_it(library):
    lines = (library.parent / CATALOGS).read_text("utf-8").splitlines()
    assert "VERSION 1" in lines
    assert f"{catalog_id('InsideOut/Materials')}:InsideOut/Materials:InsideOut-Materials" in lines


def test_catalogues_of_the_user_stay_and_ours_stay_where_they_were_moved(blender, tmp_path):
    mine = f"VERSION 1\n\n0a1b2c3d-0000-0000-0000-000000000000:Wood:Wood\n{catalog_id('InsideOut/Materials')}:Mine:Mine"
    (tmp_path / CATALOGS).write_text(mine, "utf-8")
    for _ in range(2):
        save_assets(tmp_path / "insideout.blend")
        text = (tmp_path / CATALOGS).read_text("utf-8")
        assert text.startswith(mine)
        assert text.count("InsideOut/Node Groups") == 1
        assert "InsideOut/Materials:" not in text


def test_catalogues_of_another_format_are_refused(blender, tmp_path):
    (tmp_path / CATALOGS).write_text("VERSION 9\n", "utf-8")
    with pytest.raises(SettingError, match="choose another folder"):
        save_assets(tmp_path / "insideout.blend")
    assert (tmp_path / CATALOGS).read_text("utf-8") == "VERSION 9\n"


@pytest.mark.parametrize("ellipsoids", [True, False])
def test_the_display_shows_splats_that_blender_imported(library, random_set, ellipsoids):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    group = _append(library, "node_groups", "InsideOut Splats")
    assert group.is_modifier
    splats = _native_splats(random_set)
    modifier = splats.modifiers.new("splats", "NODES")
    modifier.node_group = group
    set_modifier_input(modifier, "Ellipsoids", ellipsoids)
    set_modifier_input(modifier, "Minimum Opacity", 0.0)
    geometry = _evaluated(splats)
    points = geometry.instances_pointcloud() if ellipsoids else geometry.pointcloud
    assert len(points.points) == 200
    colors = np.empty(800, np.float32)
    points.attributes["display_color"].data.foreach_get("color", colors)
    expected = np.column_stack([srgb_to_linear(sh_to_rgb(random_set.sh[:, 0])), random_set.opacities])
    np.testing.assert_allclose(colors.reshape(-1, 4), expected, atol=1e-5)
    if not ellipsoids:
        radii = np.empty(200, np.float32)
        points.attributes["radius"].data.foreach_get("value", radii)
        np.testing.assert_allclose(radii, 1.6 * random_set.scales.mean(axis=1), rtol=1e-5)


def test_colours_that_splats_have_stay(blender, random_set):
    splats = create_splats(random_set, "model", bpy.context)
    blue = np.tile(np.array([0, 0, 1, 1], np.float32), 200)
    splats.data.attributes["display_color"].data.foreach_set("color", blue)
    set_modifier_input(show_splats(splats, False), "Minimum Opacity", 0.0)
    colors = np.empty(800, np.float32)
    geometry = _evaluated(splats)
    geometry.pointcloud.attributes["display_color"].data.foreach_get("color", colors)
    np.testing.assert_array_equal(colors, blue)


def test_a_section_cut_from_the_library_cuts_them(library, random_set, cut_ellipsoids):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    splats = _native_splats(random_set)
    plane = bpy.data.objects.new("plane", None)
    bpy.context.collection.objects.link(plane)
    for name, given in (("InsideOut Section Cut", {"Section": plane}), ("InsideOut Splats", {"Cut": True})):
        modifier = splats.modifiers.new(name, "NODES")
        modifier.node_group = _append(library, "node_groups", name)
        for key, value in given.items():
            set_modifier_input(modifier, key, value)
    cut = cut_ellipsoids(splats)
    assert max(vertex.co.z for vertex in cut.verts) == pytest.approx(0.0, abs=2e-3)


def test_the_open_file_is_as_it_was(blender, tmp_path, random_set):
    show_splats(create_splats(random_set, "model", bpy.context), True)
    display_group().use_fake_user = True

    def state():
        kinds = (bpy.data.node_groups, bpy.data.materials, bpy.data.images, bpy.data.libraries)
        return [(b.name, b.users, b.use_fake_user, b.asset_data is not None) for kind in kinds for b in kind]

    before = state()
    save_assets(tmp_path / "insideout.blend")
    assert state() == before


def test_a_group_of_an_earlier_version_in_the_file_is_not_what_is_saved(blender, tmp_path):
    old = bpy.data.node_groups.new("InsideOut Splats", "GeometryNodeTree")
    new = display_group()
    assert new.name == "InsideOut Splats.001"
    save_assets(tmp_path / "insideout.blend")
    assert (old.name, new.name) == ("InsideOut Splats", "InsideOut Splats.001")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    assert "Ellipsoids" in input_names(_append(tmp_path / "insideout.blend", "node_groups", "InsideOut Splats"))


def test_what_the_user_has_marked_keeps_their_words(blender, tmp_path):
    group = display_group()
    group.asset_mark()
    group.asset_data.description = "Mine"
    save_assets(tmp_path / "insideout.blend")
    assert group.asset_data.description == "Mine"


def test_an_older_library_stays_until_the_new_one_is_written(blender, tmp_path, monkeypatch):
    path = tmp_path / "insideout.blend"
    path.write_bytes(b"old")

    replace = os.replace

    def refuse(source, target):
        if target == path:
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        replace(source, target)

    monkeypatch.setattr("os.replace", refuse)
    with pytest.raises(RunFolderError, match="choose another place"):
        save_assets(path)
    assert path.read_bytes() == b"old"
    assert sorted(other.name for other in tmp_path.iterdir()) == [CATALOGS, "insideout.blend"]


def test_a_library_that_cannot_be_written_gets_no_catalogues(blender, tmp_path, monkeypatch):
    def full(*args, **options):
        raise RuntimeError("No space left on device")

    monkeypatch.setattr(bpy.types.BlendDataLibraries, "write", full)
    with pytest.raises(RunFolderError, match="cannot be written"):
        save_assets(tmp_path / "insideout.blend")
    assert list(tmp_path.iterdir()) == []


def test_the_open_file_is_not_overwritten(blender, tmp_path):
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "mine.blend"))
    with pytest.raises(SettingError, match="is the open file"):
        save_assets(tmp_path / "mine.blend")


def test_a_folder_becomes_a_library_of_the_preferences_once(blender, tmp_path):
    libraries = bpy.context.preferences.filepaths.asset_libraries
    before = len(libraries)
    assert add_to_asset_libraries(tmp_path)
    try:
        assert not add_to_asset_libraries(tmp_path)
        assert len(libraries) == before + 1
    finally:
        libraries.remove(libraries[before])


def test_a_linked_group_is_not_what_an_import_uses(library, random_set):
    """The file would depend on the library then."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    with bpy.data.libraries.load(str(library), link=True, assets_only=True) as (_, wanted):
        wanted.node_groups, wanted.materials = ["InsideOut Splats"], ["InsideOut Solid Splats"]
    assert wanted.node_groups[0].library is not None
    splats = create_splats(random_set, "model", bpy.context)
    group = show_splats(splats, True).node_group
    assert group.library is None
    assert all(material.library is None for material in _materials_of(group))


def test_every_asset_has_its_picture():
    assert all(asset.picture.is_file() for asset in ASSETS)


def _materials_of(tree):
    for node in tree.nodes:
        if getattr(node, "node_tree", None) is not None:
            yield from _materials_of(node.node_tree)
        yield from (s.default_value for s in node.inputs if s.type == "MATERIAL" and s.default_value is not None)


def _blocks():
    kinds = (bpy.data.node_groups, bpy.data.materials, bpy.data.images)
    return [(block.name, block.users, block.asset_data is not None) for kind in kinds for block in kind]


def test_ended_between_any_two_steps_nothing_stays(blender, tmp_path):
    whole = sum(1 for _ in save_in_steps(tmp_path / "whole" / "a.blend"))
    # All of the display's; of the others every fifth.
    for count in [*range(1, len(PARTS) + 1), *range(len(PARTS) + 5, whole, 5), whole]:
        steps = save_in_steps(tmp_path / "new" / "a.blend")
        shares = [next(steps) for _ in range(count)]
        steps.close()
        assert _blocks() == [], f"after {count} of {whole} steps"
        assert not (tmp_path / "new").exists()
    assert whole > 20
    assert shares == sorted(shares)
    assert 0 <= shares[0] <= shares[-1] == 1


@pytest.mark.parametrize("taken", ["half", "all"])
def test_what_is_taken_away_in_a_break_is_saved_all_the_same(blender, tmp_path, taken):
    """As an undo or a purge does."""
    steps = save_in_steps(tmp_path / "a.blend")
    shares = [next(steps)]
    while shares[-1] < (0.05 if taken == "half" else 1.0):
        shares.append(next(steps))
    bpy.data.orphans_purge(do_recursive=True)
    assert len(bpy.data.node_groups) == 0
    list(steps)
    assert _blocks() == []
    with bpy.data.libraries.load(str(tmp_path / "a.blend"), assets_only=True) as (found, _):
        names = {*found.node_groups, *found.materials}
    assert names == {asset.name for asset in ASSETS}


def test_what_is_made_of_them_in_a_break_stays(blender, tmp_path, random_set):
    steps = save_in_steps(tmp_path / "a.blend")
    while next(steps) < 0.3:
        pass
    model = show_splats(create_splats(random_set, "model", bpy.context), True).id_data
    list(steps)
    assert display_modifier(model).node_group == display_group()
