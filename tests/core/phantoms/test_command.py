"""`insideout phantom` makes what its options say."""

from __future__ import annotations

import re

import numpy as np
import pytest
from typer.testing import CliRunner

from insideout.core.capture.projections import read_projections
from insideout.core.capture.read import read_capture
from insideout.core.cli import app
from insideout.core.errors import Cancelled, SettingError
from insideout.core.phantoms import make, shepp_logan
from insideout.core.phantoms.make import PHANTOMS, CaptureSettings, sized
from insideout.core.phantoms.truth import read_truth


def phantom(*arguments):
    result = CliRunner().invoke(app, ["phantom", *map(str, arguments)])
    if result.exception is not None:
        raise result.exception
    return result


def unstyled(output):
    return re.sub(r"\x1b\[[0-9;]*m", "", output)


@pytest.mark.usefixtures("only_ball")
def test_options_reach_the_capture(tmp_path):
    out = tmp_path / "capture"

    phantom(
        *("ball", "--out", out, "--views", 3, "--angles", 9, "--size", 40, "--photos-by", "rays", "--seed", 4),
        *("--effects", "beam_hardening,noise, beam_hardening", "--voxel-mm", 4, "--surface-mm", 2),
    )

    capture, truth = read_capture(out), read_truth(out)
    assert len(capture.photos.photos) == 3
    assert (capture.photos.photos[0].camera.width, capture.photos.photos[0].camera.height) == (40, 40)
    assert capture.projections.images.shape == (10, 20, 20)
    assert capture.projections.held_out.sum() == 1
    assert truth.effects == ("beam_hardening", "noise")
    np.testing.assert_allclose(truth.volume.spacing_mm, 4.0)


@pytest.mark.usefixtures("only_ball")
def test_rays_alone_have_noise_and_no_table(tmp_path):
    phantom("ball", "--out", tmp_path / "new", "--views", 1, "--angles", 1, "--size", 16, "--photos-by", "rays")
    assert read_truth(tmp_path / "new").effects == ("noise",)


def test_mistakes_are_named(tmp_path):
    with pytest.raises(SettingError, match="'teapot' is not known, and there is no such file; choose one of"):
        phantom("teapot", "--out", tmp_path / "new")
    with pytest.raises(SettingError, match="size is 3"):
        phantom("matryoshka", "--out", tmp_path / "new", "--size", 3)
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("option", "value"), [("--views", 0), ("--angles", 0), ("--seed", -1), ("--shells", 0), ("--shells", 10)]
)
def test_an_option_out_of_range_is_named(tmp_path, option, value):
    arguments = ["phantom", "matryoshka", "--out", str(tmp_path / "new"), "--photos-by", "rays", option, str(value)]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 2
    assert option in unstyled(result.output)
    assert not (tmp_path / "new").exists()


def test_the_file_of_a_volume_is_scanned_anew(tmp_path):
    values = np.full((12, 14, 16), -1000, np.int16)
    values[3:9, 4:10, 5:11] = 200
    np.savez(tmp_path / "scan.npz", volume=values, spacing_mm_zyx=[1.0, 1.0, 1.0])
    phantom(tmp_path / "scan.npz", "--out", tmp_path / "new", "--angles", 9, "--size", 64, "--effects", "")
    read = read_projections(tmp_path / "new" / "xray" / "meta_data.json").projections
    assert read.held_out.tolist() == [False] * 9 + [True]
    assert max(read.images.shape[1:]) == 37
    assert read_truth(tmp_path / "new").effects == ()
    with pytest.raises(SettingError, match="noise alone"):
        phantom(tmp_path / "scan.npz", "--out", tmp_path / "other", "--effects", "scatter")
    with pytest.raises(SettingError, match="--voxel-mm: is not for the volume"):
        phantom(tmp_path / "scan.npz", "--out", tmp_path / "other", "--voxel-mm", 1.0)
    with pytest.raises(SettingError, match="size is 5"):
        phantom(tmp_path / "scan.npz", "--out", tmp_path / "other", "--size", 5)
    with pytest.raises(SettingError, match="there is no such file"):
        phantom(tmp_path / "missing.npz", "--out", tmp_path / "other")


@pytest.mark.parametrize("name", ["make_capture", "make_shepp_logan"])
def test_who_stops_it_is_told_that_nothing_was_kept(tmp_path, monkeypatch, name):
    def stop(*_, **__):
        raise Cancelled

    object_name, module = ("matryoshka", make) if name == "make_capture" else ("shepp_logan", shepp_logan)
    monkeypatch.setattr(module, name, stop)
    with pytest.raises(Cancelled, match="starts over"):
        phantom(object_name, "--out", tmp_path / "new", "--seed", 1)


@pytest.mark.parametrize(
    "given",
    [
        ("--size", 64),
        ("--effects", "noise"),
        ("--views", 3),
        ("--photos-by", "rays"),
        ("--voxel-mm", 1.0),
        ("--surface-mm", 1.0),
        ("--shells", 5),
        ("--no-landmarks",),
    ],
)
def test_the_head_refuses_what_its_protocol_fixes(tmp_path, monkeypatch, given):
    monkeypatch.setattr(shepp_logan, "make_shepp_logan", lambda *_, **__: None)
    with pytest.raises(SettingError, match=f"{given[0].replace('--no', '-')}: is not for shepp_logan; leave it out"):
        phantom("shepp_logan", "--out", tmp_path / "new", *given)


def test_the_head_takes_its_angles_seed_and_fdk(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(shepp_logan, "make_shepp_logan", lambda out, **options: made.append(options))
    for options in ((), ("--angles", 9, "--seed", 2, "--fdk")):
        phantom("shepp_logan", "--out", tmp_path / "new", *options)
    assert [(one["scan"].angles, one["scan"].seed, one["with_fdk"]) for one in made] == [(75, 0, False), (9, 2, True)]


def test_help_lists_the_phantoms():
    shown = unstyled(CliRunner().invoke(app, ["phantom", "--help"]).output)
    assert all(name in shown for name in (*PHANTOMS, "shepp_logan"))


def test_the_matryoshka_has_the_sizes_it_always_had():
    sizes = sized("matryoshka", 256, CaptureSettings())
    assert (sizes.photo_width, sizes.photo_height) == (192, 256)
    assert (sizes.detector_width, sizes.detector_height) == (120, 148)
