"""Gaussian .ply files: what goes out comes back, and what is wrong is named."""

import numpy as np
import pytest

from insideout.core import ply
from insideout.core.densities import Densities
from insideout.core.errors import GaussianFileError
from insideout.core.gaussians import GaussianSet, Modality
from insideout.core.ply import read_comments, read_header, says_relative, write_ply


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


@pytest.fixture
def small_blocks(monkeypatch):
    """Three splats are several steps."""
    monkeypatch.setattr(ply, "_BLOCK", 1)


def test_ended_early_the_older_file_stays(gaussians, tmp_path, small_blocks):
    (tmp_path / "a.ply").write_bytes(b"older")
    for count in range(1, len(gaussians) + 1):
        steps = ply.write_in_steps(gaussians, tmp_path / "a.ply")
        shares = [next(steps) for _ in range(count)]
        steps.close()
        assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]
        assert (tmp_path / "a.ply").read_bytes() == b"older"
    assert shares == pytest.approx([0.8 * index / len(gaussians) for index in range(len(gaussians))])


def test_in_steps_it_is_the_same_file_and_the_same_set(gaussians, tmp_path, monkeypatch):
    gaussians.save(tmp_path / "whole.ply")
    monkeypatch.setattr(ply, "_BLOCK", 4)
    gaussians.save(tmp_path / "parts.ply")
    assert (tmp_path / "parts.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()
    shares = list(ply.read_in_steps(tmp_path / "whole.ply"))
    assert shares == [first / len(gaussians) for first in range(0, len(gaussians), 4)]
    np.testing.assert_array_equal(ply.read_ply(tmp_path / "whole.ply").sh, gaussians.sh)


@pytest.mark.parametrize("kind", ["<f4", "<f8", ">f4", ">f8"])
def test_fields_may_come_in_any_order_and_as_other_numbers(gaussians, tmp_path, kind):
    """Ours lie side by side and are taken as they lie; those of other programs are gathered."""
    gaussians.save(tmp_path / "a.ply")
    count, record, start = read_header(tmp_path / "a.ply")
    table = np.fromfile(tmp_path / "a.ply", record, count, offset=start)
    names = [str(name) for name in np.random.default_rng(0).permutation(record.names)]
    types = dict.fromkeys(names, kind) | {"modality": "u1"}
    shuffled = np.empty(count, np.dtype([(name, types[name]) for name in names]))
    for name in names:
        shuffled[name] = table[name]
    order, word = ("little" if kind[0] == "<" else "big"), {"f4": "float", "f8": "double"}[kind[1:]]
    lines = ["ply", f"format binary_{order}_endian 1.0", f"element vertex {count}"]
    lines += [f"property {'uchar' if name == 'modality' else word} {name}" for name in names] + ["end_header"]
    (tmp_path / "b.ply").write_bytes(("\n".join(lines) + "\n").encode() + shuffled.tobytes())
    ours, others = (GaussianSet.load(tmp_path / name) for name in ("a.ply", "b.ply"))
    for name in ("means", "quats", "scales", "opacities", "sh", "density", "modality"):
        np.testing.assert_array_equal(getattr(others, name), getattr(ours, name))


def test_view_dependent_colors_may_be_left_in_the_file(gaussians, tmp_path):
    gaussians.save(tmp_path / "a.ply")
    plain = ply.read_ply(tmp_path / "a.ply", view_dependent=False)
    np.testing.assert_array_equal(plain.sh, gaussians.sh[:, :1])
    np.testing.assert_array_equal(plain.means, gaussians.means)
    assert ply.read_sh_degree(tmp_path / "a.ply") == 2


@pytest.mark.parametrize("rest", [range(1), range(1, 10), range(46)])
def test_colors_of_no_degree_are_refused(tmp_path, rest):
    fields = [*ply._REQUIRED, *(f"f_rest_{index}" for index in rest)]
    lines = ["ply", "format binary_little_endian 1.0", "element vertex 1"]
    lines += [f"property float {name}" for name in fields] + ["end_header"]
    (tmp_path / "a.ply").write_bytes(("\n".join(lines) + "\n").encode() + bytes(4 * len(fields)))
    for read in (ply.read_ply, ply.read_sh_degree):
        with pytest.raises(GaussianFileError, match=f"has {len(rest)} f_rest fields"):
            read(tmp_path / "a.ply")


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


class TestComments:
    """Lines of the header for people."""

    def test_they_come_back_and_change_nothing_else(self, gaussians, tmp_path):
        write_ply(gaussians, tmp_path / "a.ply", ["capture: a doll", "element vertex 3", "end_header"])
        assert read_comments(tmp_path / "a.ply")[1:] == ["capture: a doll", "element vertex 3", "end_header"]
        np.testing.assert_array_equal(GaussianSet.load(tmp_path / "a.ply").means, gaussians.means)

    @pytest.mark.parametrize(
        ("densities", "comments"),
        [
            (Densities(), ["InsideOut: density in 1/mm"]),
            (Densities(relative=True), ["InsideOut: density is relative"]),
            (Densities(water_per_mm=0.0206), ["InsideOut: density in 1/mm", "insideout water_per_mm = 0.0206"]),
        ],
    )
    def test_they_say_what_densities_are_in(self, gaussians, tmp_path, densities, comments):
        gaussians.save(tmp_path / "a.ply", densities)
        assert read_comments(tmp_path / "a.ply") == comments
        assert says_relative(comments) == densities.relative

    def test_none_can_become_another_line(self, gaussians, tmp_path):
        write_ply(gaussians, tmp_path / "a.ply", ["a\nelement face 1\r\nend_header", "ü\u2028x", "y" * 9000])
        assert [c[:33] for c in read_comments(tmp_path / "a.ply")[1:]] == [
            "a element face 1 end_header",
            "\\xfc x",
            "y" * 33,
        ]
        assert len(GaussianSet.load(tmp_path / "a.ply")) == len(gaussians)

    @pytest.mark.parametrize("content", [None, b"", b"not a ply\ncomment x\n", b"ply\ncomment x"])
    def test_other_files_have_none_worth_an_error(self, tmp_path, content):
        if content is not None:
            (tmp_path / "a.ply").write_bytes(content)
        assert read_comments(tmp_path / "a.ply") == (["x"] if content == b"ply\ncomment x" else [])
