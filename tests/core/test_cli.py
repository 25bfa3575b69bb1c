"""The command line: a user's mistake gets one sentence and exit code 2, and changes nothing of theirs."""

import os
import signal
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from insideout.core.cli import _stop_signal


def insideout(*arguments):
    command = [sys.executable, "-m", "insideout.core.cli", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, encoding="utf-8", timeout=120)


def snapshot(folder):
    return {p: p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def one_photo(folder):
    (folder / "photos").mkdir(parents=True)
    Image.fromarray(np.zeros((32, 32, 3), np.uint8)).save(folder / "photos" / "only.png")


def truncated_photo(folder):
    one_photo(folder)
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)
    for name in ("a.jpg", "b.jpg", "c.jpg"):
        Image.fromarray(noise).save(folder / "photos" / name)
    whole = (folder / "photos" / "b.jpg").read_bytes()
    (folder / "photos" / "b.jpg").write_bytes(whole[: len(whole) // 3])


def missing_keys(folder):
    (folder / "xray").mkdir(parents=True)
    (folder / "xray" / "meta_data.json").write_text('{"scanner": {"mode": "cone"}}')


@pytest.mark.skipif(sys.platform != "linux", reason="file systems elsewhere have names of characters alone")
def test_a_name_that_is_no_text_is_told(tmp_path):
    truncated_photo(tmp_path)
    photos = os.fsencode(tmp_path / "photos")
    os.rename(photos + b"/b.jpg", photos + b"/B\xfcste.jpg")
    ran = insideout("check", tmp_path)
    assert "Traceback" not in ran.stderr
    assert r"B\udcfcste.jpg" in ran.stdout


def volume_without_voxel_size(folder):
    (folder / "xray").mkdir(parents=True)
    np.save(folder / "xray" / "volume.npy", np.zeros((4, 4, 4), np.float32))


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda folder: folder.mkdir(parents=True), "capture"),
        (one_photo, "photo"),
        (truncated_photo, "b.jpg"),
        (missing_keys, "meta_data.json"),
        (volume_without_voxel_size, "volume.npy"),
    ],
    ids=["empty folder", "one photo", "truncated photo", "missing keys", "no voxel size"],
)
def test_a_bad_capture_is_named_and_left_alone(make, named, tmp_path):
    capture = tmp_path / "capture"
    make(capture)
    before = snapshot(tmp_path)
    ran = insideout("run", capture, "--out", tmp_path / "run", "--preset", "draft")
    assert ran.returncode == 2, ran.stderr
    assert named in ran.stderr
    assert "Traceback" not in ran.stderr
    assert snapshot(capture) == {p: c for p, c in before.items() if p.is_relative_to(capture)}


def test_a_capture_that_is_not_there_is_named(tmp_path):
    ran = insideout("run", tmp_path / "nowhere", "--out", tmp_path / "run")
    assert ran.returncode == 2
    assert "nowhere" in ran.stderr


@pytest.mark.parametrize(
    "option",
    [("--preset", "best"), ("--stage", "polish"), ("--kernel", "abacus"), ("--refine", "alone")],
    ids=lambda o: o[0],
)
def test_an_unknown_choice_lists_the_known_ones(option, tmp_path):
    ran = insideout("run", tmp_path, "--out", tmp_path / "run", *option)
    assert ran.returncode == 2
    assert option[1] in ran.stderr
    assert "choose" in ran.stderr
    assert not (tmp_path / "run").exists()


def test_check_exits_with_2_when_something_is_wrong(tmp_path):
    missing_keys(tmp_path / "capture")
    ran = insideout("check", tmp_path / "capture")
    assert ran.returncode == 2
    assert "meta_data.json" in ran.stdout


def test_a_wrong_option_exits_with_2(tmp_path):
    assert insideout("run", tmp_path, "--outt", "x").returncode == 2


def test_version_is_one_line():
    import insideout as package

    assert insideout("version").stdout.strip() == package.__version__


def test_an_unknown_phantom_lists_the_known_ones(tmp_path):
    ran = insideout("phantom", "unicorn", "--out", tmp_path / "capture", "--photos-by", "rays")
    assert ran.returncode == 2
    assert "skull" in ran.stderr
    assert not (tmp_path / "capture").exists()


def test_the_textbook_head_is_a_phantom_without_photos(tmp_path):
    ran = insideout("phantom", "shepp_logan", "--out", tmp_path / "head", "--angles", 3)
    assert ran.returncode == 0, ran.stderr
    checked = insideout("check", tmp_path / "head")
    assert checked.returncode == 0, checked.stdout
    assert "9 projections" in checked.stdout


def test_a_scan_is_made_smaller(tmp_path):
    assert insideout("phantom", "shepp_logan", "--out", tmp_path / "head", "--angles", 4).returncode == 0
    ran = insideout("bin", tmp_path / "head", "--out", tmp_path / "object" / "xray", "--by", 8, "--every", 2)
    assert ran.returncode == 0, ran.stderr
    assert "5 projections of 32 x 32 pixels, 16 x 16 x 16 voxels" in ran.stdout
    checked = insideout("check", tmp_path / "object")
    assert "5 projections of 32 x 32 pixels" in checked.stdout
    again = insideout("bin", tmp_path / "head", "--out", tmp_path / "object" / "xray")
    assert again.returncode == 2
    assert "is not empty" in again.stderr


@pytest.mark.skipif(os.name == "nt", reason="Windows ends a process without a signal")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_and_kill_ask_to_stop_and_only_a_second_one_ends_the_process(number):
    before = signal.getsignal(number)
    with _stop_signal() as stopped:
        os.kill(os.getpid(), number)
        assert stopped.wait(5)
        assert signal.getsignal(number) == signal.SIG_DFL
    assert signal.getsignal(number) == before
