"""A voxel volume of attenuation in the world frame. Numpy alone."""

from __future__ import annotations

import tokenize
import zipfile
import zlib
from collections.abc import Generator, Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import IO, Any

import numpy as np

from .densities import PER_MM, Densities
from .errors import CaptureError
from .files import atomic_write, synced_in_steps
from .progress import Tick, unstopped
from .steps import run_through
from .views import Plane

ARCHIVE_ERRORS = (
    *(OSError, ValueError, EOFError, KeyError, RuntimeError, TypeError),
    *(zipfile.BadZipFile, zlib.error, tokenize.TokenError),
)
"""What numpy, zipfile and zlib raise for an .npz that is cut short, damaged, encrypted or none at all, TypeError for an
.npy of that name."""

# Bytes that are read, and pixels that are interpolated, between two steps: some hundredths of a second.
_PIECE, _PIXELS = 1 << 23, 1 << 19
# Bytes that are compressed between two ticks, which takes ten times as long as reading them.
_PRESSED = 1 << 20


@dataclass(frozen=True, eq=False)
class Volume:
    """Values on a grid whose axes are the world's x, y, z.

    Attributes:
        values: (nz, ny, nx) float32, attenuation in mm⁻¹.
        spacing_mm: (3,) voxel size along x, y, z.
        origin_mm: (3,) world position x, y, z of the centre of voxel [0, 0, 0].
    """

    values: np.ndarray
    spacing_mm: np.ndarray
    origin_mm: np.ndarray

    @classmethod
    def centered(cls, values: np.ndarray, spacing_mm: np.ndarray) -> Volume:
        """A volume whose middle is the world's origin."""
        spacing = np.asarray(spacing_mm, np.float64)
        shape = np.array(values.shape[::-1])
        return cls(np.ascontiguousarray(values, np.float32), spacing, -0.5 * (shape - 1) * spacing)

    @property
    def box_mm(self) -> np.ndarray:
        """(2, 3) lowest and highest corner, voxel faces included."""
        shape = np.array(self.values.shape[::-1])
        low = self.origin_mm - 0.5 * self.spacing_mm
        return np.stack([low, low + shape * self.spacing_mm])

    def sample(self, points_mm: np.ndarray) -> np.ndarray:
        """Trilinear values (...,) at world points (..., 3); 0 outside the box."""
        position = (np.asarray(points_mm, np.float64) - self.origin_mm) / self.spacing_mm
        return self._interpolated(position[..., axis] for axis in range(3))

    def averaged(self, most: int) -> Volume:
        """The volume averaged over blocks of voxels so that no axis has more than `most`; what is left over is cut."""
        return self.blocks([-(-n // most) for n in self.values.shape])

    def blocks(self, sizes: Sequence[int]) -> Volume:
        """The volume averaged over blocks of so many voxels along z, y, x; what is left over is cut."""
        counts = [n // size for n, size in zip(self.values.shape, sizes, strict=True)]
        used = self.values[tuple(slice(n * size) for n, size in zip(counts, sizes, strict=True))]
        blocks = used.reshape(counts[0], sizes[0], counts[1], sizes[1], counts[2], sizes[2])
        steps, spacing = np.array(sizes[::-1]), np.asarray(self.spacing_mm, np.float64)
        return Volume(blocks.mean(axis=(1, 3, 5)), steps * spacing, self.origin_mm + 0.5 * (steps - 1) * spacing)

    def section(self, plane: Plane) -> np.ndarray:
        """(height, width) values on a plane, as `sample` has them at its points, which are not made one by one."""
        return run_through(self.section_in_steps(plane))

    def section_in_steps(self, plane: Plane) -> Generator[float, None, np.ndarray]:
        """As `section`, with breaks that tell the share that is done, 0 to 1."""
        origin, u, v = (np.asarray(part, np.float64) / self.spacing_mm for part in (plane.origin, plane.u, plane.v))
        origin = origin - self.origin_mm / self.spacing_mm
        columns, rows = np.arange(plane.width) + 0.5, np.arange(plane.height)[:, None] + 0.5
        bands, height = [], max(_PIXELS // max(plane.width, 1), 1)
        for first in range(0, plane.height, height):
            band = rows[first : first + height]
            bands.append(self._interpolated(origin[axis] + columns * u[axis] + band * v[axis] for axis in range(3)))
            yield min((first + height) / plane.height, 1.0)
        return np.concatenate(bands)

    def _interpolated(self, position: Iterable[np.ndarray]) -> np.ndarray:
        """(...,) float32 trilinear values at x, y, z (...,) float64 in voxels; 0 outside the box."""
        shape, strides = self.values.shape[::-1], (1, self.values.shape[2], self.values[0].size)
        inside, first, parts = np.ones((), bool), np.zeros((), np.int64), []
        for along, count, stride in zip(position, shape, strides, strict=True):
            inside = inside & (along > -0.5) & (along < count - 0.5)
            along = np.clip(along, 0, count - 1)
            low = np.minimum(along.astype(np.int64), max(count - 2, 0))
            parts.append((along - low).astype(np.float32))
            first = first + low * stride
        steps = [stride if count > 1 else 0 for count, stride in zip(shape, strides, strict=True)]
        values = np.ascontiguousarray(self.values, np.float32).ravel()

        def mixed(index: np.ndarray, axis: int) -> np.ndarray:
            """Interpolated along this axis and those before it."""
            if axis < 0:
                return values.take(index)
            low, high = mixed(index, axis - 1), mixed(index + steps[axis], axis - 1)
            return low + parts[axis] * (high - low)

        return np.where(inside, mixed(first, 2), np.float32(0))

    def save(self, path: Path, densities: Densities = PER_MM, tick: Tick = unstopped, compressed: bool = True) -> None:
        """Writes an .npz with `volume` [z, y, x], `spacing_mm_zyx`, `origin_mm_zyx` and its `unit`, atomically.

        Args:
            densities: what the values are in (`densities_of` reads it again); the `unit` of relative ones is "grey",
                and the water of a scan in Hounsfield units is kept as `water_per_mm`.
            tick: called between pieces, also while the disk is waited for; may raise to stop, and the file is as it
                was then.
            compressed: False for a file that is written in a moment, which `compress` makes smaller later.

        Raises:
            DiskFullError, RunFolderError: as `atomic_write`.
        """
        content = {
            "volume": np.ascontiguousarray(self.values),
            "spacing_mm_zyx": np.asarray(self.spacing_mm)[::-1],
            "origin_mm_zyx": np.asarray(self.origin_mm)[::-1],
            "unit": np.array("grey" if densities.relative else "1/mm"),
        }
        if densities.water_per_mm is not None:
            content["water_per_mm"] = np.array(densities.water_per_mm)
        with atomic_write(path) as stream:
            how = zipfile.ZIP_DEFLATED if compressed else zipfile.ZIP_STORED
            with zipfile.ZipFile(stream, "w", how) as archive:
                for name, values in content.items():
                    with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                        np.lib.format.write_array(_InPieces(entry, tick), values, allow_pickle=False)
            run_through(synced_in_steps(stream), lambda _: tick())

    @classmethod
    def load(cls, path: Path) -> Volume:
        """Reads what `save` wrote; without an origin the middle of the volume is the world's origin.

        Raises:
            CaptureError: the file is unreadable or lacks `volume` or `spacing_mm_zyx`.
        """
        return run_through(cls.load_in_steps(path))

    @classmethod
    def load_in_steps(cls, path: Path) -> Generator[float, None, Volume]:
        """As `load`, with breaks that tell the share that is done, 0 to 1; unpacking gigabytes takes long."""
        try:
            with np.load(path, allow_pickle=False) as archive:
                content = {name: archive[name] for name in archive.files if name != "volume"}
                if "volume" in archive.files:
                    content["volume"] = yield from _unpacked(archive.zip, "volume.npy")
        except ARCHIVE_ERRORS as error:
            raise _unreadable(path, error) from error
        for name in ("volume", "spacing_mm_zyx"):
            if name not in content:
                raise CaptureError(
                    "{path}: lacks '{name}'; save it with volume [z, y, x] and spacing_mm_zyx.", path=path, name=name
                )
        spacing = np.asarray(content["spacing_mm_zyx"], np.float64)[::-1].copy()
        values = np.ascontiguousarray(content["volume"], np.float32)
        if "origin_mm_zyx" not in content:
            return cls.centered(values, spacing)
        return cls(values, spacing, np.asarray(content["origin_mm_zyx"], np.float64)[::-1].copy())


def compress(path: Path, tick: Tick = unstopped) -> None:
    """Compresses a file of `Volume.save`, atomically; does nothing where it is compressed already.

    Args:
        tick: as of `Volume.save`.

    Raises:
        CaptureError: the file is unreadable.
        DiskFullError, RunFolderError: as `atomic_write`.
    """
    if _is_compressed(path):
        return
    with atomic_write(path) as stream:
        with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as smaller:
            for name, pieces in groupby(_pieces(path), lambda one: one[0]):
                with smaller.open(name, "w", force_zip64=True) as entry:
                    for _, piece in pieces:
                        _InPieces(entry, tick).write(piece)
        run_through(synced_in_steps(stream), lambda _: tick())


def _is_compressed(path: Path) -> bool:
    try:
        with zipfile.ZipFile(path) as archive:
            return all(entry.compress_type == zipfile.ZIP_DEFLATED for entry in archive.infolist())
    except ARCHIVE_ERRORS as error:
        raise _unreadable(path, error) from error


def _pieces(path: Path) -> Generator[tuple[str, bytes], None, None]:
    """Pieces of an archive's files one after the other, each with its file's name. It is closed with the last of them,
    because Windows replaces no file that is open."""
    try:
        with zipfile.ZipFile(path) as archive:
            for name in archive.namelist():
                with archive.open(name) as values:
                    while piece := values.read(_PIECE):
                        yield name, piece
    except ARCHIVE_ERRORS as error:
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: Exception) -> CaptureError:
    return CaptureError("{path}: cannot be read as .npz ({error}); save it again.", path=path, error=error)


class _InPieces:
    """Of a stream that compresses what is written to it, small pieces with a tick before each."""

    def __init__(self, stream: IO[bytes], tick: Tick) -> None:
        self._stream, self._tick = stream, tick

    def write(self, content: Any) -> None:
        view = memoryview(content)
        for start in range(0, len(view), _PRESSED):
            self._tick()
            self._stream.write(view[start : start + _PRESSED])


def densities_of(path: Path) -> Densities:
    """What the values of a file of `Volume.save` are in, without reading them; mm⁻¹ where it does not say.

    Raises:
        CaptureError: the file is unreadable.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            unit, water = (archive.get(name) for name in ("unit", "water_per_mm"))
    except ARCHIVE_ERRORS as error:
        raise _unreadable(path, error) from error
    return Densities(unit is not None and str(unit) == "grey", told_water(water))


def told_water(kept: np.ndarray | None) -> float | None:
    """The `water_per_mm` that an .npz has; None of what is none."""
    if kept is None or kept.shape != () or kept.dtype.kind != "f":
        return None
    water = float(kept)
    return water if np.isfinite(water) and water > 0 else None


def _unpacked(archive: zipfile.ZipFile, name: str) -> Generator[float, None, np.ndarray]:
    """An array of an .npz as `np.load` has it, with breaks that tell the share that is done."""
    read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    with archive.open(name) as stream:
        shape, by_columns, kind = read[np.lib.format.read_magic(stream)](stream)
        if kind.hasobject:
            raise ValueError("holds objects, not numbers")
        values = np.empty(shape, kind, order="F" if by_columns else "C")
        raw, done = values.ravel(order="K").view(np.uint8), 0
        while done < len(raw):
            piece = stream.read(min(_PIECE, len(raw) - done))
            if not piece:
                raise EOFError("is cut short")
            raw[done : done + len(piece)] = np.frombuffer(piece, np.uint8)
            done += len(piece)
            yield done / len(raw)
        # At the end the checksum is looked at.
        stream.read()
    return values
