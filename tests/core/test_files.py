"""Atomic writes: the old file or the whole new one."""

import errno
import json
import os
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from insideout.core.errors import DiskFullError, RunFolderError
from insideout.core.files import atomic_folder, atomic_write, plain, synced_in_steps, write_json


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")

    def write_and_fail():
        with atomic_write(path, "w") as stream:
            stream.write("new")
            raise RuntimeError("in the middle")

    with pytest.raises(RuntimeError, match="middle"):
        write_and_fail()
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_json_takes_numpy_and_has_no_nan(tmp_path):
    write_json(tmp_path / "a.json", {"x": np.float32(0.5), "y": np.arange(2), "z": float("nan"), "p": tmp_path})
    assert json.loads((tmp_path / "a.json").read_text()) == {"x": 0.5, "y": [0, 1], "z": None, "p": str(tmp_path)}


def test_plain_leaves_plain_things_alone():
    assert plain({"a": [1, "b", None, True]}) == {"a": [1, "b", None, True]}


def test_a_folder_that_is_a_file_is_named(tmp_path):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(RunFolderError, match="choose another place"):
        write_json(tmp_path / "file" / "a.json", {})
    assert (tmp_path / "file").read_text() == "mine"


def test_a_full_disk_says_what_to_do(tmp_path, monkeypatch):
    path = tmp_path / "a.txt"
    path.write_text("old")

    def no_space(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", no_space)
    with pytest.raises(DiskFullError, match=r"a\.txt: the disk is full; free some space"):
        write_json(path, {})
    assert path.read_text() == "old"


def refused_as(number, windows=None):
    error = OSError(number, "odd")
    # Which only Windows gives it.
    error.winerror = windows

    def refuse(*_, **__):
        raise error

    return refuse


@pytest.mark.parametrize(
    ("number", "windows"),
    [
        (errno.EINVAL, 123),
        (errno.EINVAL, None),
        (errno.EIO, None),
        (errno.ENOENT, 3),
        (errno.ENOENT, 161),
        (errno.ENOENT, 206),
    ],
)
def test_a_name_that_cannot_be_is_told(tmp_path, monkeypatch, number, windows):
    """A question mark in it, a drive that is not there, more than 260 characters."""
    monkeypatch.setattr(Path, "mkdir", refused_as(number, windows))
    for write in (atomic_write, atomic_folder):
        says = pytest.raises(RunFolderError, match=r"new: cannot be written \(odd\); choose another place")
        with says, write(tmp_path / "deep" / "new"):
            pass


@pytest.mark.parametrize("windows", [None, 2])
def test_a_missing_file_is_still_one(tmp_path, windows):
    with pytest.raises(FileNotFoundError), atomic_write(tmp_path / "new"):
        refused_as(errno.ENOENT, windows)()


_ON_A_TINY_DISK = """
import sys, pathlib
from insideout.core.errors import DiskFullError
from insideout.core.files import atomic_write
folder = pathlib.Path(sys.argv[1])
try:
    with atomic_write(folder / "big.bin") as stream:
        stream.write(bytes(4 << 20))
except DiskFullError:
    print("full", [p.name for p in folder.iterdir()])
"""


def test_a_really_full_disk(tmp_path):
    mount = ["unshare", "-rm", "sh", "-c", 'mount -t tmpfs -o size=1m tmpfs "$1" && exec "$2" -c "$3" "$1"', "sh"]
    ran = subprocess.run([*mount, tmp_path, sys.executable, _ON_A_TINY_DISK], capture_output=True, text=True)
    if "unshare" in ran.stderr or "mount" in ran.stderr:
        pytest.skip("this machine lets nobody mount a small disk")
    assert ran.stdout.strip() == "full []", ran.stderr


def test_a_folder_that_fails_leaves_nothing(tmp_path):
    def half(path):
        with atomic_folder(path) as unfinished:
            (unfinished / "deep").mkdir()
            (unfinished / "deep" / "a.txt").write_text("a")
            assert not path.exists() or not any(path.iterdir())
            raise KeyboardInterrupt

    (tmp_path / "there").mkdir()
    for name in ("new", "there"):
        with pytest.raises(KeyboardInterrupt):
            half(tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == ["there"]
    assert not any((tmp_path / "there").iterdir())


def test_a_folder_appears_whole_and_an_empty_one_stays_the_same(tmp_path, monkeypatch):
    (tmp_path / "there").mkdir()
    monkeypatch.chdir(tmp_path / "there")
    for path in (tmp_path / "new" / "deep", Path(".")):
        with atomic_folder(path) as unfinished:
            (unfinished / "sub").mkdir()
            (unfinished / "sub" / "a.txt").write_text("a")
        assert (path / "sub" / "a.txt").read_text() == "a"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["new", "there"]


@pytest.mark.parametrize("beside", ["another disk", "forbidden"])
def test_a_folder_beside_which_nothing_may_lie_is_filled_from_within(tmp_path, monkeypatch, beside):
    """A disk of its own has the space that was meant; what holds its mount point may be small, or not writable."""
    path = tmp_path / "big"
    path.mkdir()
    if beside == "another disk":
        monkeypatch.setattr("os.path.ismount", lambda place: Path(place) == path)
    else:
        monkeypatch.setattr("os.access", lambda place, _: Path(place) != tmp_path)

    def half():
        with atomic_folder(path) as unfinished:
            (unfinished / "a.txt").write_text("a")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        half()
    assert [place.name for place in tmp_path.rglob("*")] == ["big"]
    with atomic_folder(path) as unfinished:
        assert unfinished.parent == path
        (unfinished / "sub").mkdir()
        (unfinished / "sub" / "a.txt").write_text("a")
    assert [place.relative_to(path).as_posix() for place in sorted(path.rglob("*"))] == ["sub", "sub/a.txt"]
    with pytest.raises(RunFolderError, match="meanwhile"), atomic_folder(path):
        pass


def test_what_came_into_a_folder_meanwhile_stays_alone_there(tmp_path):
    def two_at_once(path):
        with atomic_folder(path) as unfinished:
            (unfinished / "sub").mkdir()
            (path / "sub").mkdir(parents=True)

    with pytest.raises(RunFolderError, match="meanwhile"):
        two_at_once(tmp_path / "new")
    assert [path.name for path in tmp_path.rglob("*")] == ["new", "sub"]


def test_what_goes_wrong_elsewhere_is_not_blamed_on_the_folder(tmp_path):
    with pytest.raises(PermissionError, match="elsewhere"), atomic_folder(tmp_path / "new"):
        raise PermissionError(errno.EACCES, "denied", "elsewhere")


def test_a_folder_inside_a_file_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(RunFolderError, match="file"), atomic_folder(tmp_path / "file" / "new"):
        pass


@pytest.fixture
def slow_disk(monkeypatch):
    """`os.fsync` waits until the event is set; `done` tells which files it has brought onto the disk."""
    go, done, sync = threading.Event(), [], os.fsync

    def wait(number):
        assert go.wait(20)
        done.append(os.fstat(number).st_ino)
        sync(number)

    monkeypatch.setattr(os, "fsync", wait)
    return go, done


def _written(path):
    with atomic_write(path, "w") as stream:
        stream.write("new")
        yield from synced_in_steps(stream)


def test_what_waits_for_the_disk_has_breaks(tmp_path, slow_disk):
    go, done = slow_disk
    steps = _written(tmp_path / "a.txt")
    assert [next(steps) for _ in range(3)] == [0.0] * 3
    assert not (tmp_path / "a.txt").exists()
    assert done == []
    go.set()
    assert set(steps) <= {0.0}
    assert (tmp_path / "a.txt").read_text() == "new"
    assert done[0] == (tmp_path / "a.txt").stat().st_ino


@pytest.mark.skipif(os.name == "nt", reason="Windows deletes no file that is open, and waits")
def test_ended_while_the_disk_works_the_older_file_stays(tmp_path, slow_disk):
    go, done = slow_disk
    (tmp_path / "a.txt").write_text("old")
    steps = _written(tmp_path / "a.txt")
    next(steps)
    steps.close()
    assert done == []
    assert os.listdir(tmp_path) == ["a.txt"]
    assert (tmp_path / "a.txt").read_text() == "old"
    go.set()


def test_a_disk_that_is_full_in_the_end_is_told(tmp_path, monkeypatch):
    def no_space(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", no_space)
    with pytest.raises(DiskFullError, match=r"a\.txt: the disk is full"):
        list(_written(tmp_path / "a.txt"))
    assert os.listdir(tmp_path) == []
