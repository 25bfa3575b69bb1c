"""A volume of the user's own, X-rayed anew."""

from dataclasses import replace

import numpy as np
import pytest

from insideout.core.capture.projections import read_projections
from insideout.core.errors import Cancelled, CaptureError, SettingError
from insideout.core.fdk_process import fdk
from insideout.core.forward_projection import forward_project
from insideout.core.phantoms.scanned import ScanSettings, make_scanned, scan_of
from insideout.core.phantoms.truth import read_truth
from insideout.core.progress import Reporter
from insideout.core.volume import Volume

FEW = ScanSettings(angles=40, heldout=3, size=48, voxels=32, noise=False)


@pytest.fixture(scope="module")
def head(tmp_path_factory):
    """Hounsfield units: a skull with brain and a lump to one side, in air; more voxels than the truth has."""
    z, y, x = np.meshgrid(*(np.arange(n) - 0.5 * (n - 1) for n in (40, 66, 70)), indexing="ij")
    radius = np.sqrt((x / 30) ** 2 + (y / 28) ** 2 + (z / 17) ** 2)
    values = np.where(radius < 1, np.where(radius < 0.85, 30.0, 900.0), -1000.0)
    values[(x - 12) ** 2 + (y + 8) ** 2 + (z - 4) ** 2 < 25] = 300.0
    path = tmp_path_factory.mktemp("ct") / "head.npz"
    np.savez(path, volume=values.astype(np.int16), spacing_mm_zyx=[2.0, 1.5, 1.25])
    return path


@pytest.fixture(scope="module")
def made(head, tmp_path_factory):
    return make_scanned(head, tmp_path_factory.mktemp("new") / "capture", FEW)


def test_the_truth_is_the_volume_averaged_over_whole_blocks(head, made):
    truth = read_truth(made)
    with np.load(head) as stored:
        attenuation = 0.0195 * (1 + stored["volume"].astype(np.float64) / 1000)
    blocks = np.maximum(attenuation, 0)[:, :, :69].reshape(20, 2, 22, 3, 23, 3).mean(axis=(1, 3, 5))
    assert truth.volume.values == pytest.approx(blocks, abs=3e-5)
    assert truth.volume.spacing_mm == pytest.approx([3.75, 4.5, 4.0])
    assert truth.volume.box_mm.sum(axis=0) == pytest.approx(0.0, abs=1e-9)
    assert truth.photo_to_world is None
    assert not truth.at_centers


def test_the_scan_reads_back_and_sees_all_of_the_volume(made):
    read = read_projections(made / "xray" / "meta_data.json").projections
    assert read.held_out.tolist() == [False] * 40 + [True] * 3
    assert max(read.images.shape[1:]) == 48
    truth = read_truth(made).volume
    assert read.voxels == truth.values.shape[::-1]
    assert read.box_mm == pytest.approx(truth.box_mm)
    full = Volume.centered(np.ones((20, 20, 20), np.float32), truth.spacing_mm * np.array(read.voxels) / 20)
    scan = scan_of(full, 48)
    wider = replace(scan, width=scan.width + 8, height=scan.height + 8)
    shadow = forward_project(full, wider.detectors(np.linspace(0, 2 * np.pi, 13)))
    assert shadow[:, :3].max() == shadow[:, -3:].max() == shadow[:, :, :3].max() == shadow[:, :, -3:].max() == 0
    assert shadow[:, 6].max() > 0
    assert shadow[:, :, 5].max() > 0


def test_its_projections_bring_the_volume_back(made):
    truth = read_truth(made).volume
    found = fdk(read_projections(made / "xray" / "meta_data.json").projections, window="hann")
    peak = truth.values.max()
    assert np.corrcoef(found.values.ravel(), truth.values.ravel())[0, 1] > 0.9
    # The lump tells left from right, front from back, top from bottom.
    lump = np.array([12 * 1.25, -8 * 1.5, 4 * 2.0])
    mirrored = [lump * np.where(np.arange(3) == axis, -1, 1) for axis in range(3)]
    at, elsewhere = found.sample(lump), found.sample(np.array(mirrored))
    assert (at - elsewhere > 0.05 * peak).all()


def test_noise_is_drawn_by_the_seed(head, tmp_path):
    few = ScanSettings(angles=2, heldout=1, size=16, voxels=16)

    def images(name, seed):
        folder = make_scanned(head, tmp_path / name, ScanSettings(**{**vars(few), "seed": seed}))
        return read_projections(folder / "xray" / "meta_data.json").projections.images

    first, again, other = images("first", 0), images("again", 0), images("other", 1)
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def test_mistakes_leave_nothing(head, tmp_path):
    new = tmp_path / "new"
    with pytest.raises(SettingError, match="angles is 0"):
        make_scanned(head, new, ScanSettings(angles=0))
    with pytest.raises(CaptureError, match=r"nothing\.npz"):
        make_scanned(tmp_path / "nothing.npz", new, FEW)
    air = np.full((8, 8, 8), -1000, np.int16)
    air[0] = -1024
    np.savez(tmp_path / "air.npz", volume=air, spacing_mm_zyx=[1.0, 1, 1])
    (tmp_path / "air.json").write_text('{"unit": "HU"}')
    with pytest.raises(SettingError, match="no attenuation"):
        make_scanned(tmp_path / "air.npz", new, FEW)
    asked = []
    with pytest.raises(Cancelled):
        make_scanned(head, new, FEW, Reporter(is_cancelled=lambda: len(asked) > 2 or asked.append(1)))
    assert not new.exists()
    new.mkdir()
    (new / "note.txt").write_text("mine")
    with pytest.raises(SettingError, match="not empty"):
        make_scanned(head, new, FEW)
