"""Files of volumes: written in pieces, so that who cancels is heard, and compressed when that costs nothing else."""

from __future__ import annotations

import itertools
import zipfile

import numpy as np
import pytest

from insideout.core import report
from insideout.core import volume as volume_module
from insideout.core.densities import Densities
from insideout.core.errors import Cancelled, CaptureError
from insideout.core.gaussians import GaussianSet, Modality
from insideout.core.run_folder import RunFolder
from insideout.core.volume import Volume, compress, densities_of


@pytest.fixture
def volume():
    values = np.zeros((24, 40, 50), np.float32)
    values[:, 10:30, 10:30] = np.random.default_rng(0).random((24, 20, 20), np.float32)
    return Volume.centered(values, np.array([0.5, 1.0, 2.0]))


@pytest.fixture
def pieces(monkeypatch):
    """So small that there are dozens."""
    monkeypatch.setattr(volume_module, "_PRESSED", 5000)


@pytest.fixture
def after():
    """`after(calls)`: a tick that stops with that call."""

    def after(calls):
        left = itertools.count(calls - 1, -1)

        def tick():
            if next(left) <= 0:
                raise Cancelled

        return tick

    return after


def ways_of(path):
    with zipfile.ZipFile(path) as archive:
        return {entry.compress_type for entry in archive.infolist()}


@pytest.mark.parametrize("compressed", [True, False])
def test_in_pieces_a_file_is_what_numpy_writes(volume, pieces, tmp_path, compressed):
    ticks = []
    turned = Volume(volume.values.transpose(2, 1, 0), volume.spacing_mm[::-1], volume.origin_mm[::-1])
    for one in (volume, turned):
        one.save(tmp_path / "v.npz", Densities(water_per_mm=0.02), lambda: ticks.append(1), compressed)
        with np.load(tmp_path / "v.npz", allow_pickle=False) as archive:
            assert set(archive.files) == {"volume", "spacing_mm_zyx", "origin_mm_zyx", "unit", "water_per_mm"}
            assert archive["volume"].dtype == np.float32
            np.testing.assert_array_equal(archive["volume"], one.values)
            assert (str(archive["unit"]), float(archive["water_per_mm"])) == ("1/mm", 0.02)
        np.testing.assert_array_equal(Volume.load(tmp_path / "v.npz").origin_mm, one.origin_mm)
    assert len(ticks) > 2 * volume.values.nbytes / 5000
    assert ways_of(tmp_path / "v.npz") == {zipfile.ZIP_DEFLATED if compressed else zipfile.ZIP_STORED}


@pytest.mark.parametrize("calls", [1, 2, 20, 39])
def test_broken_off_the_file_is_the_one_before(volume, pieces, after, tmp_path, calls):
    with pytest.raises(Cancelled):
        volume.save(tmp_path / "v.npz", tick=after(calls))
    assert not list(tmp_path.iterdir())
    volume.save(tmp_path / "v.npz")
    before = (tmp_path / "v.npz").read_bytes()
    with pytest.raises(Cancelled):
        Volume(2 * volume.values, volume.spacing_mm, volume.origin_mm).save(tmp_path / "v.npz", tick=after(calls))
    assert [path.name for path in tmp_path.iterdir()] == ["v.npz"]
    assert (tmp_path / "v.npz").read_bytes() == before


def test_compressed_later_a_file_is_smaller_and_the_same(volume, pieces, after, tmp_path):
    path = tmp_path / "v.npz"
    volume.save(path, Densities(relative=True), compressed=False)
    stored = path.read_bytes()
    for calls in (1, 20, 39):
        with pytest.raises(Cancelled):
            compress(path, after(calls))
        assert [one.name for one in tmp_path.iterdir()] == ["v.npz"]
        assert path.read_bytes() == stored
    compress(path)
    assert path.stat().st_size < 0.5 * len(stored)
    assert ways_of(path) == {zipfile.ZIP_DEFLATED}
    assert densities_of(path) == Densities(relative=True)
    np.testing.assert_array_equal(Volume.load(path).values, volume.values)


def test_what_is_compressed_is_left_alone(volume, tmp_path, after):
    path = tmp_path / "v.npz"
    volume.save(path)
    before = path.read_bytes()
    compress(path, after(1))
    assert path.read_bytes() == before


def test_a_damaged_file_is_not_compressed(volume, tmp_path):
    path = tmp_path / "v.npz"
    volume.save(path, compressed=False)
    whole = bytearray(path.read_bytes())
    whole[2000] ^= 1
    for content in (bytes(whole), bytes(whole[:3000]), b"PK"):
        path.write_bytes(content)
        with pytest.raises(CaptureError, match=r"v\.npz: cannot be read as \.npz"):
            compress(path)
        assert path.read_bytes() == content
    path.unlink()
    with pytest.raises(CaptureError, match=r"v\.npz: cannot be read as \.npz"):
        compress(path)


def test_the_report_s_volume_can_be_broken_off(volume, pieces, after, tmp_path):
    run = RunFolder(tmp_path)
    run.write_set("surface", "xray", GaussianSet.create([[0.0, 0, 0]], 1.0, density=0.1, modality=Modality.XRAY))
    volume.save(run.stage("initialize") / "volume.npz")
    with pytest.raises(Cancelled):
        report._export(run, [], after(5), lambda *_: volume)
    assert not (tmp_path / "volume.npz").exists()
