"""A scan with fewer pixels, projections and voxels, so that it fits into memory; one image is read at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import SettingError
from ..files import atomic_folder, check_new, explained, write_json
from ..progress import Progress, Reporter
from ..told import Told
from .air import air_level
from .dead_pixels import silent_pixels, stuck_pixels
from .findings import CaptureProblem
from .model import Finding
from .nikon import geometry_of, numbered_images, read_settings, unnamed_findings
from .projections import (
    LOWEST_TRANSMISSION,
    are_line_integrals,
    check_images,
    find_projections,
    listed_files,
    load_npy,
    r2_geometry,
    read_meta,
)
from .tiff import read_image
from .values import number, positive

_LEAST_PIXELS = 4


@dataclass(frozen=True)
class BinnedScan:
    """What was written: projections, their pixels along a row and a column, voxels x, y, z of the first grid; how many
    pixels of the old scan are in no block's mean, since they saw no X-rays in any projection; and what of the old scan
    the new one cannot tell any more."""

    projections: int
    width: int
    height: int
    voxels: tuple[int, int, int]
    dead: int
    findings: tuple[Finding, ...] = ()


@dataclass(frozen=True)
class _Blocks:
    """Blocks of `by` x `by` pixels of images of a shape; what is left over at the borders is dropped on both sides.

    Attributes:
        first: rows and columns that are dropped before the first block.
        shape: rows and columns of blocks.
        shift: how far the middle of the blocks lies behind that of the image, down and right, in its pixels.
    """

    by: int
    first: tuple[int, int]
    shape: tuple[int, int]
    shift: tuple[float, float]

    @classmethod
    def of(cls, shape: tuple[int, ...], by: int) -> _Blocks:
        rest = [side % by for side in shape]
        first = [left // 2 for left in rest]
        count = (shape[0] // by, shape[1] // by)
        if min(count) < _LEAST_PIXELS:
            raise SettingError(
                "--by {by}: leaves {columns} x {rows} pixels of {width} x {height}; give less.",
                by=by,
                columns=count[1],
                rows=count[0],
                width=shape[1],
                height=shape[0],
            )
        down, right = (before - left / 2 for before, left in zip(first, rest, strict=True))
        return cls(by, (first[0], first[1]), count, (down, right))

    def average(self, image: np.ndarray, dead: np.ndarray) -> np.ndarray:
        """(rows, columns) of the means of what is not `dead` of blocks, integers rounded.

        Of a block that is dead altogether it is the least, so that it is found to be dead when it is read.
        """
        blocks = self._blocks(image)
        means = blocks.mean(axis=(1, 3), dtype=np.float64)
        if dead.any():
            spoilt = self._blocks(dead).any(axis=(1, 3))
            some, living = blocks.swapaxes(1, 2)[spoilt], ~self._blocks(dead).swapaxes(1, 2)[spoilt]
            count, sums = living.sum(axis=(1, 2)), some.sum(axis=(1, 2), dtype=np.float64, where=living)
            means[spoilt] = np.where(count > 0, sums / np.maximum(count, 1), some.min(axis=(1, 2)))
        return (means.round() if image.dtype.kind in "iu" else means).astype(image.dtype)

    def _blocks(self, image: np.ndarray) -> np.ndarray:
        """(rows, by, columns, by)"""
        (top, left), (rows, columns) = self.first, self.shape
        cut = image[top : top + rows * self.by, left : left + columns * self.by]
        return cut.reshape(rows, self.by, columns, self.by)


@dataclass(frozen=True)
class _Images:
    """The projections of a scan that are kept, in their order; one is in memory at a time, and the first.

    Attributes:
        read: one of the files. Raises CaptureError.
    """

    files: list[Path]
    read: Callable[[Path], np.ndarray]
    first: np.ndarray

    @classmethod
    def of(cls, files: list[Path], read: Callable[[Path], np.ndarray]) -> _Images:
        first = read(files[0])
        check_images([str(files[0])], [first])
        return cls(files, read, first)

    def every(self, reporter: Reporter) -> Iterator[np.ndarray]:
        for index, file in enumerate(self.files):
            reporter.update(Progress("bin", fraction=index / len(self.files)))
            image = self.read(file)
            check_images([str(self.files[0]), str(file)], [self.first, image])
            yield image

    def dead(self, line_integrals: bool, dark: np.ndarray | float, reporter: Reporter) -> tuple[np.ndarray, Reporter]:
        """Pixels (rows, columns) that see no X-rays: with others in a block they would not be found afterwards. And a
        reporter for what is to be done then: all images may have been read for them, half of the work."""
        seen = 0

        def views() -> Iterator[np.ndarray]:
            nonlocal seen
            for image in self.every(reporter.within(0.0, 0.5)):
                seen += 1
                yield image.astype(np.float32)  # As scans are read: a millionth in float64 is more than in float32.

        if line_integrals:
            pixels = stuck_pixels(views())
        else:
            dark = np.asarray(dark, np.float32)
            air = air_level(self.first.astype(np.float32)[None] - dark)[0]
            pixels = silent_pixels((view - dark for view in views()), LOWEST_TRANSMISSION * air)
        return pixels, reporter.within(0.5 * seen / len(self.files), 1.0)


def bin_scan(scan: Path, out: Path, by: int = 4, every: int = 1, reporter: Reporter | None = None) -> BinnedScan:
    """Writes the projections of a scan anew: means of blocks of pixels, every so-many-th, with the geometry that fits.

    The grid of the first reconstruction gets as much coarser as the pixels, in the same box.

    Args:
        scan: a folder with Nikon's .xtekct and .tif files, or R²-Gaussian's meta_data.json, or one with such an xray/.
        out: missing or empty.
        by: pixels along a block's side.
        every: of so many projections the first is kept.

    Raises:
        SettingError: an option is out of range, or `out` holds something.
        CaptureError: there is no such scan, or something of it is missing or broken.
        Cancelled: the user asked to stop; nothing is kept.
    """
    for name, value in (("by", by), ("every", every)):
        if value < 1:
            raise SettingError("--{name} {value}: give 1 or more.", name=name, value=value)
    check_new(out)
    reporter = reporter or Reporter()
    if not scan.is_dir():
        raise CaptureProblem(scan, "is not a folder", "give the folder of a scan")
    source = find_projections(scan)
    if source is None and (scan / "xray").is_dir():
        source = find_projections(scan / "xray")
    if source is None or source.suffix not in (".json", ".xtekct"):
        raise CaptureProblem(
            source or scan, "is no scan that can be binned", "give one with a Nikon .xtekct or a meta_data.json"
        )
    with atomic_folder(out) as unfinished, explained(out):
        write = _bin_nikon if source.suffix == ".xtekct" else _bin_r2
        made = write(source, unfinished, by, every, reporter)
    reporter.update(Progress("bin", fraction=1.0, message=Told("{folder} is ready", folder=out)))
    return made


def _bin_nikon(source: Path, out: Path, by: int, every: int, reporter: Reporter) -> BinnedScan:
    import tifffile

    settings = read_settings(source)
    count = int(number(source, settings, "projections"))
    positive(source, "Projections", count)
    here = numbered_images(source, count)
    files = here[:count:every]
    images = _Images.of(files, read_image)
    first = images.first
    blocks = _Blocks.of(first.shape, by)
    scan, _, voxels = geometry_of(source, settings, first.shape)
    has_white = number(source, settings, "whitelevel", 0.0) > 0
    lines = are_line_integrals(first[None], raw_counts=first.dtype.kind in "iu", has_flat=has_white)
    dead, rest = images.dead(lines, 0.0, reporter)
    for file, image in zip(files, images.every(rest), strict=True):
        tifffile.imwrite(out / file.name, blocks.average(image, dead))
    changed: dict[str, float] = {
        "Projections": len(files),
        "AngularStep": every * number(source, settings, "angularstep"),
    }
    grid = _coarser(voxels, by)
    for place, axis in enumerate("XY"):
        pitch, shift = scan.pixel_mm[place], (blocks.shift[1], -blocks.shift[0])[place]
        changed[f"DetectorPixels{axis}"] = blocks.shape[1 - place]
        changed[f"DetectorPixelSize{axis}"] = by * pitch
        changed[f"DetectorOffset{axis}"] = scan.offset_mm[place] + shift * pitch
    for place, axis in enumerate("XYZ"):
        changed[f"Voxels{axis}"] = grid[place]
        size = number(source, settings, f"voxelsize{axis.lower()}", 0.0)
        if size > 0:
            changed[f"VoxelSize{axis}"] = size * voxels[place] / grid[place]
    text = source.read_text("utf-8-sig", errors="replace")
    (out / source.name).write_text(_with_settings(text, changed), "utf-8")
    told = tuple(unnamed_findings(source, here[:count], here))
    return BinnedScan(len(files), blocks.shape[1], blocks.shape[0], grid, int(dead.sum()), told)


def _with_settings(text: str, changed: dict[str, float]) -> str:
    """A .xtekct file with other values in [XTekCT]; what it did not say before is added there, all else stays."""
    names = {name.lower() for name in changed}
    lines, inside = [], False
    for line in text.splitlines():
        if line.strip().startswith("["):
            inside = line.strip().lower() == "[xtekct]"
        elif inside and line.split("=")[0].strip().lower() in names:
            continue
        lines.append(line)
        if inside and line.strip().startswith("["):
            lines += [f"{name}={value:.12g}" for name, value in changed.items()]
    return "\n".join(lines) + "\n"


def _bin_r2(source: Path, out: Path, by: int, every: int, reporter: Reporter) -> BinnedScan:
    meta, train, held = read_meta(source)
    listed_files(source, train + held)
    parts = {"proj_train": train[::every], "proj_test": held[::every]}
    images = _Images.of([file for frames in parts.values() for file in listed_files(source, frames)], load_npy)
    first = images.first
    blocks = _Blocks.of(first.shape, by)
    scan, _, voxels = r2_geometry(source, meta, first.shape)
    references = {
        name: _reference(source.parent / name, first.shape)
        for name in ("flat.npy", "dark.npy")
        if (source.parent / name).is_file()
    }
    lines = are_line_integrals(
        first[None],
        raw_counts=first.dtype.kind in "iu",
        has_flat="flat.npy" in references,
        declared=meta.get("values"),
    )
    dead, rest = images.dead(lines, references.get("dark.npy", 0.0), reporter)
    every_image = images.every(rest)
    for part, frames in parts.items():
        (out / part).mkdir()
        for index, frame in enumerate(frames):
            frames[index] = {**frame, "file_path": f"{part}/{index:04d}.npy"}
            np.save(out / part / f"{index:04d}.npy", blocks.average(next(every_image), dead))
    for name, image in references.items():
        np.save(out / name, blocks.average(image, dead))
    grid = _coarser(voxels, by)
    shift = np.array([blocks.shift[1], -blocks.shift[0]]) * scan.pixel_mm
    scanner: dict[str, Any] = {
        **meta["scanner"],
        "nDetector": list(blocks.shape),
        "sDetector": [by * blocks.shape[0] * scan.pixel_mm[1], by * blocks.shape[1] * scan.pixel_mm[0]],
        "offDetector": (np.asarray(scan.offset_mm) + shift).tolist(),
        "nVoxel": list(grid),
    }
    write_json(out / "meta_data.json", {**meta, **parts, "scanner": scanner})
    return BinnedScan(len(images.files), blocks.shape[1], blocks.shape[0], grid, int(dead.sum()))


def _reference(source: Path, shape: tuple[int, ...]) -> np.ndarray:
    """A flat or dark image; of several the mean."""
    image = load_npy(source)
    image = image.astype(np.float32).mean(axis=0) if image.ndim == 3 else image
    if image.shape != shape:
        raise CaptureProblem(
            source, "is {here}, the projections are {shape}", "export it again", here=image.shape, shape=shape
        )
    return image


def _coarser(voxels: tuple[int, int, int], by: int) -> tuple[int, int, int]:
    x, y, z = (max(round(count / by), 1) for count in voxels)
    return x, y, z
