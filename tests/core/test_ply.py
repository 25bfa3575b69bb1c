"""Gaussian .ply files: what goes out comes back, and what is wrong is named."""

import numpy as np
import pytest

from insideout.core.errors import GaussianFileError
from insideout.core.gaussians import GaussianSet, Modality
from insideout.core.ply import read_header


@pytest.fixture
def gaussians():
    rng = np.random.default_rng(3)
    return GaussianSet.create(
        rng.normal(size=(11, 3)) * 40,
        rng.uniform(1e-3, 5.0, (11, 3)),
        quats=rng.normal(size=(11, 4)),
        opacities=rng.uniform(0, 1, 11),
        sh=rng.normal(size=(11, 9, 3)),
        density=rng.uniform(0, 0.2, 11),
        modality=np.full(11, Modality.CLONE),
    )


def test_a_round_trip_keeps_every_field(gaussians, tmp_path):
    gaussians.save(tmp_path / "a.ply")
    back = GaussianSet.load(tmp_path / "a.ply")
    for name in ("means", "sh", "density", "modality"):
        np.testing.assert_array_equal(getattr(back, name), getattr(gaussians, name))
    for name in ("quats", "scales", "opacities"):
        np.testing.assert_allclose(getattr(back, name), getattr(gaussians, name), rtol=1e-5, atol=1e-6)


def test_fully_clear_and_fully_opaque_splats_come_back_finite(tmp_path):
    GaussianSet.create(np.zeros((2, 3)), 0.0, opacities=np.array([0.0, 1.0])).save(tmp_path / "a.ply")
    back = GaussianSet.load(tmp_path / "a.ply")
    np.testing.assert_allclose(back.opacities, [0, 1], atol=1e-6)
    assert np.all(np.isfinite(back.scales))


def test_an_empty_set_can_be_saved(tmp_path):
    GaussianSet.empty(degree=2).save(tmp_path / "a.ply")
    assert len(GaussianSet.load(tmp_path / "a.ply")) == 0


def test_rest_coefficients_are_written_channel_by_channel_as_3dgs_does(gaussians, tmp_path):
    gaussians.save(tmp_path / "a.ply")
    count, record, start = read_header(tmp_path / "a.ply")
    table = np.fromfile(tmp_path / "a.ply", record, count, offset=start)
    np.testing.assert_array_equal(table["f_rest_1"], gaussians.sh[:, 2, 0])
    np.testing.assert_array_equal(table["f_rest_8"], gaussians.sh[:, 1, 1])


def test_a_point_cloud_is_refused_with_the_fields_it_lacks(tmp_path):
    path = tmp_path / "points.ply"
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 1\n"
    header += "property float x\nproperty float y\nproperty float z\nend_header\n"
    path.write_bytes(header.encode() + bytes(12))
    with pytest.raises(GaussianFileError, match=r"points\.ply.*opacity.*f_dc_0.*scale_0.*rot_0"):
        GaussianSet.load(path)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"not a ply", "not a .ply"),
        (b"ply\nformat ascii 1.0\n", "ascii"),
        (b"ply\nformat binary_little_endian 1.0\nelement chunk 4\nproperty float min_x\n", "compressed"),
        (b"ply\nformat binary_little_endian 1.0\n", "header ends early"),
        (b"ply\nformat\nend_header\n", "header line 'format'"),
        (b"ply\nformat binary_little_endian 1.0\nelement vertex\nend_header\n", "header line 'element vertex'"),
        (b"ply\nformat binary_little_endian 1.0\nelement vertex abc\nend_header\n", "'abc' vertices"),
        (b"ply\nformat binary_little_endian 1.0\nelement vertex -3\nend_header\n", "'-3' vertices"),
        (
            b"ply\nformat binary_little_endian 1.0\nelement vertex 1\n" + 2 * b"property float x\n" + b"end_header\n",
            "property 'x' twice",
        ),
    ],
)
def test_other_files_are_refused_in_words(tmp_path, content, words):
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(GaussianFileError, match=words):
        GaussianSet.load(tmp_path / "a.ply")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(GaussianFileError, match=r"gone\.ply: no such file"):
        GaussianSet.load(tmp_path / "gone.ply")


def test_a_file_cut_short_is_refused(gaussians, tmp_path):
    path = tmp_path / "a.ply"
    gaussians.save(path)
    path.write_bytes(path.read_bytes()[:-10])
    with pytest.raises(GaussianFileError, match="cut short"):
        GaussianSet.load(path)
