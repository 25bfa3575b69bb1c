"""Residuals beside a .ply: those of another one are never taken for its own."""

import shutil

import numpy as np
import pytest

from insideout.core.errors import RunFolderError
from insideout.core.residual_file import RESIDUAL_FILE, load_residuals, save_residuals

PERCENT = np.linspace(0, 5, 200, dtype=np.float32)


@pytest.fixture
def ply(tmp_path, random_set):
    random_set.save(tmp_path / "fused.ply")
    save_residuals(tmp_path, PERCENT, tmp_path / "fused.ply")
    return tmp_path / "fused.ply"


def test_they_come_back_as_they_were(tmp_path, ply):
    np.testing.assert_array_equal(load_residuals(tmp_path, ply, 200), PERCENT)


def test_a_place_without_rays_stays_one(tmp_path, ply):
    save_residuals(tmp_path, np.where(PERCENT > 4, np.nan, PERCENT), ply)
    assert np.isnan(load_residuals(tmp_path, ply, 200)).sum() == (PERCENT > 4).sum()


def test_a_copy_of_the_ply_has_them_too(tmp_path, ply):
    shutil.copy(ply, tmp_path / "copy.ply")
    assert load_residuals(tmp_path, tmp_path / "copy.ply", 200) is not None


def test_splats_of_a_later_run_have_none(tmp_path, ply, random_set):
    random_set.density[7] *= 1.01
    random_set.save(ply)
    assert load_residuals(tmp_path, ply, 200) is None


def test_nor_has_what_is_of_another_length(tmp_path, ply):
    assert load_residuals(tmp_path, ply, 199) is None


@pytest.mark.parametrize("content", [b"", b"nothing", "half"])
def test_a_damaged_file_is_as_good_as_none(tmp_path, ply, content):
    whole = (tmp_path / RESIDUAL_FILE).read_bytes()
    (tmp_path / RESIDUAL_FILE).write_bytes(whole[: len(whole) // 2] if content == "half" else content)
    assert load_residuals(tmp_path, ply, 200) is None


def test_without_a_file_there_are_none(tmp_path, random_set):
    random_set.save(tmp_path / "fused.ply")
    assert load_residuals(tmp_path, tmp_path / "fused.ply", 200) is None


def test_those_of_another_definition_do_not_count(tmp_path, ply, monkeypatch):
    monkeypatch.setattr("insideout.core.residual_file._DEFINITION", 2)
    assert load_residuals(tmp_path, ply, 200) is None


def test_a_place_that_cannot_be_written_is_named(tmp_path, ply):
    (tmp_path / "file").touch()
    with pytest.raises(RunFolderError, match="cannot be written"):
        save_residuals(tmp_path / "file", PERCENT, ply)
