"""A volume of the user's own, X-rayed anew."""

from dataclasses import replace

import numpy as np
import pytest

from insideout.core.capture.detectors import CircularScan
from insideout.core.capture.projections import read_projections
from insideout.core.errors import Cancelled, CaptureError, SettingError
from insideout.core.fdk_process import fdk
from insideout.core.forward_projection import forward_project
from insideout.core.phantoms.scanned import ScanSettings, _object_and_truth, make_scanned, scan_of
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
    folder = tmp_path_factory.mktemp("new") / "capture"
    assert "Hounsfield" in make_scanned(head, folder, FEW)[0].message
    return folder


def test_the_truth_is_what_blocks_of_voxels_hold_on_average(head, made):
    truth = read_truth(made)
    with np.load(head) as stored:
        attenuation = 0.0195 * (1 + stored["volume"].astype(np.float64) / 1000)
    between = Volume.centered(np.pad(np.maximum(attenuation, 0)[:, :, :70], 1), np.array([1.25, 1.5, 2.0]))
    # Linear between voxel centres: four points a voxel along each axis, none of them where the slope changes.
    fine = [(np.arange(4 * n) - 0.5 * (4 * n - 1)) / 4 * step for n, step in ((70, 1.25), (66, 1.5), (40, 2.0))]
    means = np.zeros(truth.volume.values.shape)
    for layer in range(len(means)):
        z = fine[2][4 * layer : 4 * layer + 4]
        points = np.stack(np.meshgrid(z, fine[1], fine[0], indexing="ij")[::-1], axis=-1)
        means[layer] = between.sample(points).reshape(4, 33, 8, 35, 8).mean(axis=(0, 2, 4))
    assert truth.volume.values == pytest.approx(means, abs=2e-5)
    assert truth.volume.spacing_mm == pytest.approx([2.5, 3.0, 2.0])
    assert truth.photo_to_world is None
    assert not truth.at_centers


@pytest.mark.parametrize("count", [12, 31, 32, 45, 49, 65, 81])
def test_volume_and_truth_have_the_same_middle_and_box(count):
    whole, truth = _object_and_truth(Volume.centered(np.ones((9, count, 16), np.float32), np.ones(3)), 16)
    assert truth.box_mm == pytest.approx(whole.box_mm)
    assert truth.box_mm.sum(axis=0) == pytest.approx(0.0, abs=1e-9)
    assert truth.values.shape[1] <= 24


def test_what_was_projected_is_what_is_true():
    """Sheets a voxel thin across every axis: projections of the truth's own mass are those that were made."""
    values = np.zeros((32, 32, 32), np.float32)
    values[16, 8:24, 8:24] = values[8:24, 12, 8:24] = values[8:24, 8:24, 20] = 0.02
    whole, truth = _object_and_truth(Volume.centered(values, np.ones(3)), 32)
    assert truth.values.sum() == pytest.approx(values.sum(), rel=1e-5)
    assert truth.values[16, 8:11, 9:15] == pytest.approx(0.75 * 0.02, rel=0.2)
    far = CircularScan(1, 1, (1.0, 1.0), 1e5, 1.5e5)
    through = forward_project(whole, [far.detector(0.0)])[0, 0, 0]
    assert through == pytest.approx(values[15:17, 15:17].mean(axis=(0, 1)).sum(), rel=0.01)


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
        make_scanned(head, tmp_path / name, replace(few, seed=seed))
        return read_projections(tmp_path / name / "xray" / "meta_data.json").projections.images

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
    (tmp_path / "empty").mkdir()
    with pytest.raises(SettingError, match="holds no CT volume"):
        make_scanned(tmp_path / "empty", new, FEW)
    np.savez(tmp_path / "air.npz", volume=air, spacing_mm_zyx=[1.0, 1, 1])
    (tmp_path / "air.json").write_text('{"unit": "HU"}')
    with pytest.raises(SettingError, match="no attenuation"):
        make_scanned(tmp_path / "air.npz", new, FEW)
    np.savez(tmp_path / "lead.npz", volume=40.0 * (air + 1024), spacing_mm_zyx=[1.0, 1, 1])
    (tmp_path / "lead.json").write_text('{"unit": "1/mm"}')
    with pytest.raises(SettingError, match="no photon"):
        make_scanned(tmp_path / "lead.npz", new, replace(FEW, noise=True))
    asked = []
    with pytest.raises(Cancelled):
        make_scanned(head, new, FEW, Reporter(is_cancelled=lambda: len(asked) > 2 or asked.append(1)))
    assert not new.exists()
    new.mkdir()
    (new / "note.txt").write_text("mine")
    with pytest.raises(SettingError, match="not empty"):
        make_scanned(head, new, FEW)


def test_a_slab_has_rows_enough_to_be_read(tmp_path):
    values = np.zeros((3, 60, 60), np.float32)
    values[1, 20:40, 20:40] = 0.05
    np.savez(tmp_path / "slab.npz", volume=values, spacing_mm_zyx=[1.0, 1, 1])
    make_scanned(tmp_path / "slab.npz", tmp_path / "new", replace(FEW, angles=3))
    read = read_projections(tmp_path / "new" / "xray" / "meta_data.json").projections
    assert read.images.shape[1] == 8
    assert read.images.max() > 0
