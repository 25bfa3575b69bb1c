"""The file that a model is from: relative to the .blend on the disk, found again when it has moved."""

from __future__ import annotations

import errno
import ntpath
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import bpy
import pytest

from insideout.core.errors import CaptureError, GaussianFileError, MeshFileError
from insideout.core.steps import run_through
from insideout.insideout_addon.physics.whole import mesh_path
from insideout.insideout_addon.scene import paths, sources
from insideout.insideout_addon.scene.ct_volume import has_volume, volume_path
from insideout.insideout_addon.scene.importing import import_splats
from insideout.insideout_addon.scene.sources import (
    SOURCE_KEY,
    OtherModelError,
    relink,
    relink_in_steps,
    run_of,
    source_name,
    source_path,
)


@pytest.fixture
def project(blender, tmp_path, random_set):
    """A folder with a run, a .blend beside it that shows the run's model, and a capture and a run as settings."""
    folder = tmp_path / "project"
    random_set.save(folder / "run" / "fused.ply")
    import_splats(folder / "run" / "fused.ply", "model", bpy.context)
    bpy.context.scene.insideout.run = str(folder / "run")
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "a.blend"))
    return folder


def _model():
    return bpy.data.objects["model"]


def _in_the_file(blend):
    """(source, run) as a .blend has them, read by a Blender without the add-on."""
    code = (
        "import bpy, sys; bpy.ops.wm.open_mainfile(filepath=sys.argv[1]);"
        "scene = bpy.context.scene;"
        "system = scene.bl_system_properties_get() if hasattr(scene, 'bl_system_properties_get') else scene;"
        f"print('found:', bpy.data.objects['model']['{SOURCE_KEY}'], system['insideout']['run'], sep='|')"
    )
    answer = subprocess.run([sys.executable, "-c", code, str(blend)], capture_output=True, text=True, check=True)
    line = next(line for line in answer.stdout.splitlines() if line.startswith("found:"))
    return tuple(line.split("|")[1:])


def test_the_blend_and_its_run_can_be_moved_together(project, tmp_path):
    project.rename(tmp_path / "moved")
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "moved" / "a.blend"))
    assert source_path(_model()) == tmp_path / "moved" / "run" / "fused.ply"
    assert bpy.context.scene.insideout.run == "//run"


def test_the_file_has_relative_paths(project):
    assert _in_the_file(project / "a.blend") == ("//run/fused.ply", "//run")


@pytest.mark.parametrize("times", [1, 2])
def test_saved_elsewhere_the_paths_still_lead_there(project, tmp_path, times):
    for number in range(times):
        place = tmp_path / f"else{number}" / "where"
        place.mkdir(parents=True)
        bpy.ops.wm.save_as_mainfile(filepath=str(place / "b.blend"))
    assert source_path(_model()) == project / "run" / "fused.ply"
    assert Path(bpy.path.abspath(bpy.context.scene.insideout.run)).resolve() == project / "run"
    bpy.ops.wm.open_mainfile(filepath=str(place / "b.blend"))
    assert source_path(_model()) == project / "run" / "fused.ply"
    assert bpy.context.scene.insideout.run == "//../../project/run"


def test_a_copy_saved_elsewhere_leaves_the_open_file_as_it_is(project, tmp_path):
    (tmp_path / "deep" / "er").mkdir(parents=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "deep" / "er" / "copy.blend"), copy=True)
    assert bpy.context.scene.insideout.run == "//run"
    assert source_path(_model()) == project / "run" / "fused.ply"
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "deep" / "er" / "copy.blend"))
    assert bpy.context.scene.insideout.run == "//../../project/run"
    assert source_path(_model()) == project / "run" / "fused.ply"


def test_absolute_paths_stay_if_the_user_wants_them(project, tmp_path):
    files = bpy.context.preferences.filepaths
    files.use_relative_paths = False
    try:
        bpy.context.scene.insideout.run = str(project / "run")
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "b.blend"))
        assert bpy.context.scene.insideout.run == str(project / "run")
        bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "b.blend"))
        assert source_path(_model()) == project / "run" / "fused.ply"
    finally:
        files.use_relative_paths = True


def test_a_model_of_a_library_is_seen_from_there(project, tmp_path):
    bpy.ops.wm.read_homefile(use_empty=True)
    with bpy.data.libraries.load(str(project / "a.blend"), link=True) as (_, wanted):
        wanted.objects = ["model"]
    bpy.context.scene.collection.objects.link(wanted.objects[0])
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "b.blend"))
    assert source_path(wanted.objects[0]) == project / "run" / "fused.ply"


@pytest.fixture
def fetch(project, tmp_path, random_set):
    """`fetch(link)`: the project's model in a .blend of another run, which has a file of the same name."""

    def fetch(link):
        bpy.ops.wm.read_homefile(use_empty=True)
        random_set.select(slice(9)).save(tmp_path / "other" / "run" / "fused.ply")
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "other" / "b.blend"))
        with bpy.data.libraries.load(str(project / "a.blend"), link=link) as (_, wanted):
            wanted.objects = ["model"]
        bpy.context.scene.collection.objects.link(wanted.objects[0])
        return wanted.objects[0]

    return fetch


def test_an_appended_model_keeps_its_own_run(project, tmp_path, fetch):
    assert source_path(fetch(link=False)) == project / "run" / "fused.ply"
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "other" / "b.blend"))
    assert source_path(_model()) == project / "run" / "fused.ply"


def test_a_model_that_is_appended_with_its_collection_keeps_its_own_run(project, tmp_path):
    bpy.context.scene.collection.children.link(bpy.data.collections.new("Both"))
    bpy.data.collections["Both"].objects.link(_model())
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.read_homefile(use_empty=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "b.blend"))
    bpy.ops.wm.append(directory=str(project / "a.blend" / "Collection"), filename="Both")
    assert source_path(_model()) == project / "run" / "fused.ply"


def test_an_appended_scene_keeps_the_run_and_capture_that_it_had_chosen(project, tmp_path, random_set):
    """Beside the open file there are others of the same names."""
    bpy.context.scene.name = "Vase"
    bpy.context.scene.insideout.capture = str(project / "capture")
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.read_homefile(use_empty=True)
    random_set.select(slice(9)).save(tmp_path / "other" / "run" / "fused.ply")
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "other" / "b.blend"))
    bpy.ops.wm.append(directory=str(project / "a.blend" / "Scene"), filename="Vase")
    settings = bpy.data.scenes["Vase"].insideout
    assert (settings.run, settings.capture) == (str(project / "run"), str(project / "capture"))
    bpy.ops.wm.save_mainfile()
    assert Path(bpy.path.abspath(settings.run)).resolve() == project / "run"


class TestARunThatMayNotBeEntered:
    """That of a colleague's, say: it counts as one that is not there."""

    @pytest.fixture
    def locked(self, project, monkeypatch):
        asked, folder = os.stat, str(project / "run")

        def stat(path, *options, **more):
            if os.fspath(path).startswith(folder):
                raise PermissionError(errno.EACCES, "Permission denied", os.fspath(path))
            return asked(path, *options, **more)

        monkeypatch.setattr(os, "stat", stat)
        return project / "run"

    def test_panels_draw_and_offer_to_relink(self, locked, draw_panels):
        assert any("is missing" in text for text in draw_panels())

    def test_it_has_no_mesh_and_no_volume(self, locked):
        with pytest.raises(MeshFileError, match=r"mesh\.glb: is not there"):
            mesh_path(_model())
        with pytest.raises(CaptureError, match="its run has no CT volume here"):
            volume_path(_model())
        assert not has_volume(_model())

    def test_a_copy_takes_its_place(self, locked, tmp_path, random_set):
        random_set.save(tmp_path / "copy" / "run" / "fused.ply")
        bpy.ops.insideout.relink(filepath=str(tmp_path / "copy" / "run"))
        assert source_path(_model()) == tmp_path / "copy" / "run" / "fused.ply"


def test_a_linked_model_that_is_made_local_keeps_its_own_run(project, fetch):
    assert source_path(fetch(link=True).make_local()) == project / "run" / "fused.ply"


def test_it_keeps_it_in_a_file_that_was_opened_again(project, fetch, tmp_path):
    fetch(link=True)
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "other" / "b.blend"))
    (linked,) = [thing for thing in bpy.data.objects if thing.library is not None]
    assert source_path(linked.make_local()) == project / "run" / "fused.ply"


def test_a_path_of_windows_has_a_name_everywhere(project):
    _model()[SOURCE_KEY] = "C:\\runs\\doll\\fused.ply"
    assert source_name(_model()) == "fused.ply"


def test_a_network_share_of_windows_stays_one(blender, monkeypatch):
    """Its two backslashes were made two slashes, by which Blender tells what lies beside the .blend."""
    import bpy.path as blender_path

    for module, name in ((sources, "os"), (paths, "os"), (blender_path, "_os")):
        monkeypatch.setattr(module, name, SimpleNamespace(path=ntpath))
    folder, share = Path("C:\\work"), "\\\\nas\\scans\\run\\fused.ply"
    assert sources._for_the_file(share, folder, folder) == share
    assert sources._seen_from(share, folder, None) == share
    assert sources._seen_from("C:\\work\\run\\fused.ply", folder, folder) == "//run/fused.ply"


@pytest.mark.skipif(os.name == "nt", reason="there it leads somewhere")
def test_a_path_of_windows_is_kept_for_windows(blender, tmp_path):
    assert sources._seen_from("D:\\scans\\fused.ply", tmp_path, tmp_path) == "D:\\scans\\fused.ply"
    assert sources._seen_from("D:\\scans\\fused.ply", tmp_path, None) == "D:\\scans\\fused.ply"


@pytest.mark.parametrize("new_scene", [False, True])
def test_after_saving_elsewhere_an_undo_and_a_redo_leave_the_run_where_it_is(blender, tmp_path, new_scene):
    """It brings back a path that was seen from the folder of before."""
    for name in ("a/run", "a/scan", "b"):
        (tmp_path / name).mkdir(parents=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a" / "x.blend"))
    if new_scene:
        bpy.ops.scene.new(type="NEW")
    settings = bpy.context.scene.insideout
    settings.run, settings.capture = "//run/", str(tmp_path / "a" / "scan")
    bpy.ops.ed.undo_push(message="chosen")
    bpy.ops.object.empty_add()
    bpy.ops.ed.undo_push(message="empty")
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "b" / "x.blend"))
    for step in (None, bpy.ops.ed.undo, bpy.ops.ed.redo):
        if step is not None:
            step()
        settings = bpy.context.scene.insideout
        places = [Path(bpy.path.abspath(path)).resolve() for path in (settings.run, settings.capture)]
        assert places == [tmp_path / "a" / "run", tmp_path / "a" / "scan"]


def test_the_file_says_nothing_of_the_folder_that_it_was_in(project):
    code = "import bpy, sys; bpy.ops.wm.open_mainfile(filepath=sys.argv[1]); print(list(bpy.context.scene.keys()))"
    told = subprocess.run([sys.executable, "-c", code, project / "a.blend"], capture_output=True, text=True, check=True)
    assert "seen_from" not in told.stdout
    assert "insideout_seen_from" in bpy.context.scene


def test_what_was_not_imported_has_no_source(blender):
    bpy.ops.object.empty_add()
    assert source_path(bpy.context.object) is None
    assert source_name(bpy.context.object) == ""


class TestRelink:
    """The run has moved: its folder, or the file, is chosen."""

    @pytest.fixture
    def moved(self, project):
        """Where the run is now."""
        return (project / "run").rename(project / "archive")

    @pytest.mark.parametrize("chosen", ["", "fused.ply"])
    def test_to_the_same_model(self, moved, chosen):
        assert relink(_model(), moved / chosen) == moved / "fused.ply"
        assert source_path(_model()) == moved / "fused.ply"

    def test_to_the_folder_around_a_stage(self, project, random_set):
        random_set.save(project / "old" / "surface" / "xray.ply")
        model = import_splats(project / "old" / "surface" / "xray.ply", "x", bpy.context)
        (project / "old").rename(project / "new")
        assert relink(model, project / "new") == project / "new" / "surface" / "xray.ply"

    @pytest.mark.parametrize(
        ("change", "words"),
        [
            (lambda splats: splats.select(slice(7)), "holds another model than model: 7 splats, not 200"),
            (lambda splats: replace(splats, density=splats.density * 2), "as many splats, 200, but with other values"),
        ],
    )
    def test_another_model_is_told(self, moved, random_set, change, words):
        change(random_set).save(moved / "fused.ply")
        before = _model()[SOURCE_KEY]
        with pytest.raises(OtherModelError, match=words):
            relink(_model(), moved)
        assert _model()[SOURCE_KEY] == before
        assert relink(_model(), moved, other_model=True) == moved / "fused.ply"

    def test_a_folder_without_it_is_told(self, moved, tmp_path):
        with pytest.raises(GaussianFileError, match=r"holds no fused\.ply"):
            relink(_model(), tmp_path)

    def test_others_of_the_run_follow_and_those_that_are_there_stay(self, project, random_set):
        random_set.select(slice(50)).save(project / "run" / "rgb.ply")
        random_set.select(slice(20)).save(project / "rgb.ply")
        gone = import_splats(project / "run" / "rgb.ply", "gone", bpy.context)
        there = import_splats(project / "rgb.ply", "there", bpy.context)
        archive = (project / "run").rename(project / "archive")
        assert run_through(relink_in_steps(_model(), archive)) == (archive / "fused.ply", 1)
        assert source_path(gone) == archive / "rgb.ply"
        assert source_path(there) == project / "rgb.ply"


def test_the_run_around_a_file():
    assert run_of(Path("/a/run/fused.ply")) == run_of(Path("/a/run/surface/xray.ply")) == Path("/a/run")
