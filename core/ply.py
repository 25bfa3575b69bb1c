"""Gaussian .ply in and out: the 3DGS fields, plus `density` (mm⁻¹, or relative) and `modality`. Numpy alone.

Field meanings follow Kerbl et al. 2023 (arXiv 2308.04079): opacity as logit, scale as log, rotation w first,
f_rest channel by channel. Viewers of 3DGS files that read the header's names open what is written here.
"""

from __future__ import annotations

import json
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .densities import PER_MM, Densities
from .errors import GaussianFileError
from .files import atomic_write, synced_in_steps
from .gaussians import GaussianSet, Modality
from .rotations import normalize_quats
from .steps import part_of_work, run_through

_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float32": "f4",
    "float64": "f8",
}
_REQUIRED = (
    ["x", "y", "z", "opacity"]
    + [f"f_dc_{i}" for i in range(3)]
    + [f"scale_{i}" for i in range(3)]
    + [f"rot_{i}" for i in range(4)]
)
# Fields for colours above degree 0, by degree.
_HARMONICS = (0, 9, 24, 45)
_FLOAT = np.dtype("<f4")
# Records read or written at once: they stay in a core's cache, and a file is never in memory twice.
_BLOCK = 1 << 14
_MOST_LINES = 4096
# Share of the writing that is done when the system has everything; the rest is the disk's.
_GIVEN = 0.8
# How many words the lines of a header need.
_WORDS = {"format": 3, "element": 3, "property": 3}
# Some programs read a line of the header into a buffer of fixed size.
_COMMENT_BYTES = 240
FACT_PREFIX = "insideout "
"""How a comment begins that tells a fact, see `fact_comment`."""

# What the first comment says.
_IN_MM, _RELATIVE = "InsideOut: density in 1/mm", "InsideOut: density is relative"
# An opacity of exactly 0 or 1 has an infinite logit; this is the nearest that float32 keeps apart from 1.
_OPACITY_MARGIN = 1e-7


def write_ply(gaussians: GaussianSet, path: Path, comments: Sequence[str] = (), densities: Densities = PER_MM) -> None:
    """Writes numpy `gaussians` as a binary little-endian .ply, atomically.

    Args:
        comments: a line of the header each, which readers skip; characters beyond ASCII are written as escapes, and
            what is longer than 240 bytes is cut off.
        densities: what they are in, said by comments, too.

    Raises:
        DiskFullError, RunFolderError: as `atomic_write`.
    """
    run_through(write_in_steps(gaussians, path, comments, densities))


def write_in_steps(
    gaussians: GaussianSet, path: Path, comments: Sequence[str] = (), densities: Densities = PER_MM
) -> Generator[float, None, None]:
    """As `write_ply`, with breaks that tell the share that is done, 0 to 1.

    Closed before its end the file is as it was.
    """
    rest = gaussians.sh.shape[1] - 1
    names = (
        ["x", "y", "z"]
        + [f"f_dc_{i}" for i in range(3)]
        + [f"f_rest_{i}" for i in range(3 * rest)]
        + ["opacity"]
        + [f"scale_{i}" for i in range(3)]
        + [f"rot_{i}" for i in range(4)]
        + ["density"]
    )
    record = np.dtype([(name, "<f4") for name in names] + [("modality", "u1")])
    count = len(gaussians)
    said = [_RELATIVE if densities.relative else _IN_MM]
    if densities.water_per_mm is not None:
        said.append(fact_comment("water_per_mm", densities.water_per_mm))
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [f"comment {_one_line(comment)}" for comment in (*said, *comments)]
    lines += [f"element vertex {count}"]
    lines += [f"property float {name}" for name in names] + ["property uchar modality", "end_header"]
    with atomic_write(path) as stream:
        stream.write(("\n".join(lines) + "\n").encode("ascii"))
        for first in range(0, count, _BLOCK):
            yield _GIVEN * first / count
            stream.write(_records(gaussians, slice(first, min(first + _BLOCK, count)), record, rest).tobytes())
        yield from part_of_work(synced_in_steps(stream), _GIVEN, 1.0)


def _records(gaussians: GaussianSet, rows: slice, record: np.dtype, rest: int) -> np.ndarray:
    """Rows of a set as records of a .ply; `rest` colour coefficients above degree 0 each."""
    table = np.zeros(rows.stop - rows.start, record)
    for axis, name in enumerate("xyz"):
        table[name] = gaussians.means[rows, axis]
    for channel in range(3):
        table[f"f_dc_{channel}"] = gaussians.sh[rows, 0, channel]
        for k in range(rest):
            table[f"f_rest_{channel * rest + k}"] = gaussians.sh[rows, 1 + k, channel]
    opacities = np.clip(gaussians.opacities[rows].astype(np.float64), _OPACITY_MARGIN, 1 - _OPACITY_MARGIN)
    table["opacity"] = np.log(opacities) - np.log1p(-opacities)
    for axis in range(3):
        table[f"scale_{axis}"] = np.log(np.maximum(gaussians.scales[rows, axis], np.finfo(np.float32).tiny))
    for axis in range(4):
        table[f"rot_{axis}"] = gaussians.quats[rows, axis]
    table["density"] = gaussians.density[rows]
    table["modality"] = gaussians.modality[rows]
    return table


def _one_line(comment: str) -> str:
    """A comment that cannot become another line of the header."""
    return " ".join(comment.split()).encode("ascii", "backslashreplace")[:_COMMENT_BYTES].decode("ascii")


def fact_comment(name: str, value: Any) -> str:
    """A comment that tells a fact: `insideout water_per_mm = 0.0195`, the value as JSON."""
    return f"{FACT_PREFIX}{name} = {json.dumps(value)}"


def says_relative(comments: Sequence[str]) -> bool:
    """Whether the comments of a .ply say that its densities have no unit."""
    return _RELATIVE in comments


def read_comments(path: Path) -> list[str]:
    """The comments in the header of a .ply, in order; none of a file that is missing or no .ply."""
    comments = []
    try:
        with open(path, "rb") as stream:
            if stream.readline(16).strip() != b"ply":
                return []
            for _ in range(_MOST_LINES):
                line = stream.readline(4096).decode("ascii", "replace")
                if not line or line.split() == ["end_header"]:
                    break
                if line.startswith("comment "):
                    comments.append(line.removeprefix("comment ").strip())
    except OSError:
        return []
    return comments


def read_header(path: Path) -> tuple[int, np.dtype, int]:
    """The number of vertices, their record type, and the byte at which the records start.

    Reads only the header, so that a viewer can show what an import will cost before it is made.

    Raises:
        GaussianFileError: not a binary .ply whose first element is `vertex` with scalar properties.
    """
    if not path.is_file():
        raise GaussianFileError("{path}: no such file; choose a Gaussian .ply, such as fused.ply of a run.", path=path)
    order, count, element = "", -1, ""
    properties: list[tuple[str, str]] = []
    with open(path, "rb") as stream:
        if stream.readline(16).strip() != b"ply":
            raise GaussianFileError("{path}: is not a .ply file; choose a Gaussian .ply.", path=path)
        for _ in range(_MOST_LINES):
            words = stream.readline(4096).decode("ascii", "replace").split()
            if not words:
                raise GaussianFileError(
                    "{path}: the header ends early; the file is damaged, export it again.", path=path
                )
            if words[0] == "end_header":
                break
            if len(words) < _WORDS.get(words[0], 0):
                raise GaussianFileError(
                    "{path}: has the header line '{line}'; export it again.", path=path, line=" ".join(words)
                )
            if words[0] == "format":
                order = {"binary_little_endian": "<", "binary_big_endian": ">"}.get(words[1], "")
                if not order:
                    raise GaussianFileError(
                        "{path}: is an {format} .ply; export it as binary.", path=path, format=words[1]
                    )
            elif words[0] == "element":
                element = words[1]
                if element == "vertex":
                    if not words[2].isdecimal():
                        raise GaussianFileError(
                            "{path}: has '{count}' vertices; export it again.", path=path, count=words[2]
                        )
                    count = int(words[2])
                elif count < 0:
                    raise GaussianFileError(
                        "{path}: starts with the element '{element}', not 'vertex' (a compressed .ply?); "
                        "export it as a plain 3DGS .ply.",
                        path=path,
                        element=element,
                    )
            elif words[0] == "property" and element == "vertex":
                if words[1] == "list" or words[1] not in _TYPES:
                    raise GaussianFileError(
                        "{path}: the vertex property '{property}' is no plain number.", path=path, property=words[-1]
                    )
                if any(name == words[2] for name, _ in properties):
                    raise GaussianFileError(
                        "{path}: has the vertex property '{property}' twice; export it again.",
                        path=path,
                        property=words[2],
                    )
                properties.append((words[2], order + _TYPES[words[1]]))
        start = stream.tell()
    if count < 0:
        raise GaussianFileError("{path}: has no vertices element; choose a Gaussian .ply.", path=path)
    return count, np.dtype(properties), start


def read_sh_degree(path: Path) -> int:
    """The degree of the colours in a Gaussian .ply, 0 to 3, from its header alone.

    Raises:
        GaussianFileError: as `read_header`, or it has another number of colour coefficients than any degree.
    """
    return _sh_degree(path, read_header(path)[1])


def _sh_degree(path: Path, record: np.dtype) -> int:
    names = set(record.names or ())
    count = sum(name.startswith("f_rest_") for name in names)
    if count not in _HARMONICS or not names.issuperset(f"f_rest_{index}" for index in range(count)):
        raise GaussianFileError(
            "{path}: has {count} f_rest fields where 0, 9, 24 or 45, numbered from 0, are expected (SH degree 0 to 3).",
            path=path,
            count=count,
        )
    return _HARMONICS.index(count)


def read_ply(path: Path, view_dependent: bool = True) -> GaussianSet:
    """Reads a Gaussian .ply; `density` and `modality` may be missing (0 and RGB then).

    Args:
        view_dependent: reads the colours above degree 0, which are most of a file; else the set is of degree 0.

    Raises:
        GaussianFileError: the file is cut short, or names each 3DGS field that is missing.
    """
    return run_through(read_in_steps(path, view_dependent))


def read_in_steps(path: Path, view_dependent: bool = True) -> Generator[float, None, GaussianSet]:
    """As `read_ply`, with breaks that tell the share that is done, 0 to 1."""
    count, record, start = read_header(path)
    missing = [name for name in _REQUIRED if name not in (record.names or ())]
    if missing:
        raise GaussianFileError(
            "{path}: is not a Gaussian splat file, it lacks {missing}; "
            "export it as a 3DGS .ply from the program that made it.",
            path=path,
            missing=", ".join(missing),
        )
    if path.stat().st_size < start + count * record.itemsize:
        raise GaussianFileError(
            "{path}: is cut short (its header promises {count} splats); copy it again.", path=path, count=count
        )
    degree = _sh_degree(path, record)
    rest = _HARMONICS[degree] // 3 if view_dependent else 0
    gaussians = GaussianSet(
        means=np.empty((count, 3), np.float32),
        quats=np.empty((count, 4), np.float32),
        scales=np.empty((count, 3), np.float32),
        opacities=np.empty(count, np.float32),
        sh=np.empty((count, 1 + rest, 3), np.float32),
        density=np.zeros(count, np.float32),
        modality=np.full(count, Modality.RGB, np.uint8),
    )
    with open(path, "rb") as stream:
        stream.seek(start)
        for first in range(0, count, _BLOCK):
            yield first / count
            table = np.fromfile(stream, dtype=record, count=min(_BLOCK, count - first))
            _fill(gaussians, slice(first, first + len(table)), table, rest)
    return gaussians


def _fill(gaussians: GaussianSet, rows: slice, table: np.ndarray, rest: int) -> None:
    """Writes records of a .ply into rows of a set; `rest` coefficients of each colour above degree 0."""

    def columns(*wanted: str) -> np.ndarray:
        return _columns(table, wanted)

    gaussians.means[rows] = columns("x", "y", "z")
    gaussians.quats[rows] = normalize_quats(columns("rot_0", "rot_1", "rot_2", "rot_3"))
    gaussians.scales[rows] = np.exp(np.clip(columns("scale_0", "scale_1", "scale_2"), -87.0, 87.0))
    gaussians.opacities[rows] = 0.5 * (1 + np.tanh(0.5 * table["opacity"].astype(np.float64)))
    gaussians.sh[rows, 0] = columns("f_dc_0", "f_dc_1", "f_dc_2")
    if rest:
        flat = columns(*[f"f_rest_{i}" for i in range(3 * rest)])
        gaussians.sh[rows, 1:] = flat.reshape(-1, 3, rest).swapaxes(1, 2)
    for name, values in (("density", gaussians.density), ("modality", gaussians.modality)):
        if name in (table.dtype.names or ()):
            values[rows] = table[name]


def _columns(table: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """(N, len(names)) float32 of fields of records; where they lie side by side as such, as usual, a view of them."""
    fields = [table.dtype.fields[name] for name in names]
    first = fields[0][1]
    if all(field[:2] == (_FLOAT, first + _FLOAT.itemsize * index) for index, field in enumerate(fields)):
        shape, strides = (len(table), len(names)), (table.strides[0], _FLOAT.itemsize)
        return np.ndarray(shape, _FLOAT, table, first, strides)
    return np.stack([table[name].astype(np.float32) for name in names], axis=-1)
