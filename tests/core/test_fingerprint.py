"""Fingerprints tell files apart and are quick with large ones."""

import numpy as np
import pytest

from insideout.core.fingerprint import fingerprint, fingerprint_in_steps
from insideout.core.steps import run_through


@pytest.mark.parametrize("size", [0, 1, 1000, 4 << 20, (4 << 20) + 1, 9_000_001])
def test_a_copy_has_the_same_and_another_file_has_not(tmp_path, size):
    content = np.random.default_rng(0).integers(0, 256, size, np.uint8).tobytes()
    for name, written in {"a": content, "copy": content, "longer": content + b"x", "turned": content[::-1]}.items():
        (tmp_path / name).write_bytes(written)
    known = fingerprint(tmp_path / "a")
    assert len(known) == 64
    assert fingerprint(tmp_path / "copy") == known
    assert fingerprint(tmp_path / "longer") != known
    assert (fingerprint(tmp_path / "turned") == known) == (size < 2)


@pytest.mark.parametrize("place", [0, -1])
def test_the_first_and_the_last_byte_count(tmp_path, place):
    content = bytearray(9_000_001)
    (tmp_path / "a").write_bytes(content)
    content[place] = 1
    (tmp_path / "b").write_bytes(content)
    assert fingerprint(tmp_path / "a") != fingerprint(tmp_path / "b")


def test_a_file_that_is_gone(tmp_path):
    with pytest.raises(OSError, match="gone"):
        fingerprint(tmp_path / "gone")


def test_a_large_one_is_read_in_steps(tmp_path):
    (tmp_path / "a").write_bytes(bytes(9_000_001))
    shares = []
    found = run_through(fingerprint_in_steps(tmp_path / "a"), shares.append)
    assert shares == [block / 64 for block in range(64)]
    assert found == fingerprint(tmp_path / "a")
