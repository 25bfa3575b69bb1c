"""A .tif as ImageJ, scanners and others leave it -> its numbers, and what it says of them."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .findings import CaptureProblem, warning
from .listing import notes_path
from .model import Finding
from .voxel_size import mm_of

if TYPE_CHECKING:
    import tifffile

_CHECK_DEPTH = 'check the voxel depth in Image > Properties, or put a {name} beside it with {{"spacing_mm": [x, y, z]}}'
# ImageJ leaves out the distance of slices that are 1 apart.
_IMAGEJ_DEPTH = 1.0
# What ImageJ's calibration of values is: a straight line, none; others are curves.
_LINE, _NONE = 0, 20


@dataclass
class TiffStack:
    """A stack, and what it says of itself.

    Attributes:
        values: [z, y, x], of another number of axes where it is no stack; as ImageJ shows them, where it is from there.
        spacing_mm: (3,) along x, y, z; None where it does not say it in a unit of length.
        findings: what there is to say about its values.
        of_size: and about `spacing_mm`.
    """

    values: np.ndarray
    spacing_mm: np.ndarray | None
    findings: list[Finding] = field(default_factory=list)
    of_size: list[Finding] = field(default_factory=list)


def read_image(path: Path) -> np.ndarray:
    """One projection as it is stored. Raises CaptureError."""
    with _opened(path) as file:
        return file.asarray()


def read_stack(path: Path) -> TiffStack:
    """A stack; ImageJ's spacing and resolution are its voxel size when their unit is a length.

    Raises:
        CaptureError: it cannot be read, or has fewer images than it says.
    """
    with _opened(path, of_a_scanner=False) as file:
        notes: dict[str, Any] = dict(file.imagej_metadata or {})
        values = _joined(file)
        page = file.pages.first
        here = values.size // (page.imagelength * page.imagewidth * page.samplesperpixel)
        said = int(notes.get("images", 0))
        if here < said:
            raise CaptureProblem(
                path,
                "is cut short: {here} of its {said} images are there",
                "copy it again, or save it again",
                here=here,
                said=said,
            )
        spacing, of_size = _spacing(path, notes, page.tags)
        values, findings = _calibrated(path, values, notes)
    return TiffStack(values, spacing, findings, of_size)


@contextmanager
def _opened(path: Path, of_a_scanner: bool = True) -> Iterator[tifffile.TiffFile]:
    """A file that is read in the block, in which what damaged ones raise becomes a CaptureError."""
    import lzma

    import tifffile

    try:
        with tifffile.TiffFile(path) as file:
            yield file
    except (
        ArithmeticError,
        AssertionError,
        AttributeError,
        LookupError,
        OSError,
        RuntimeError,
        TypeError,
        ValueError,
        lzma.LZMAError,
        struct.error,
        zlib.error,
    ) as error:
        raise CaptureProblem(
            path,
            "cannot be read as .tif ({error})" if of_a_scanner else "cannot be read as a .tif stack ({error})",
            "copy it again from the scanner" if of_a_scanner else "save it again",
            error=error,
        ) from error


def _joined(file: tifffile.TiffFile) -> np.ndarray:
    """All images of one stack; those that were written one by one are series of their own."""
    series = file.series
    shape, kind = series[0].shape, series[0].dtype
    if len(series) == 1 or len(shape) != 2 or any((one.shape, one.dtype) != (shape, kind) for one in series):
        return file.asarray()
    values = np.empty((len(series), *shape), kind)
    for image, one in zip(values, series, strict=True):
        image[:] = one.asarray()
    return values


def _spacing(path: Path, notes: dict[str, Any], tags: Any) -> tuple[np.ndarray | None, list[Finding]]:
    per_unit = [tags[name].value for name in ("XResolution", "YResolution") if name in tags]
    unit = mm_of(str(notes.get("unit")))
    if unit is None or len(per_unit) != 2 or not all(count for count, _ in per_unit):
        return None, []
    x, y = (apart / count for count, apart in per_unit)
    depth = float(notes.get("spacing", _IMAGEJ_DEPTH))
    doubts = []
    if "spacing" not in notes and not np.allclose([x, y], depth, rtol=0.01):
        doubts.append(
            warning(
                path,
                "says no distance of slices, by which ImageJ means {depth:g} mm; its voxels are {x:g} x {y:g} mm",
                _CHECK_DEPTH,
                depth=unit * depth,
                x=unit * x,
                y=unit * y,
                name=notes_path(path).name,
            )
        )
    return unit * np.array([x, y, depth]), doubts


def _calibrated(path: Path, values: np.ndarray, notes: dict[str, Any]) -> tuple[np.ndarray, list[Finding]]:
    """Values as ImageJ shows them: signed ones of 16 bits are stored as unsigned ones, with a line to calibrate them.

    Of floats ImageJ does not use it either.
    """
    curve = notes.get("cf", _NONE)
    if curve == _NONE or values.dtype.kind not in "iu":
        return values, []
    if curve == _LINE:
        shift, slope = float(notes.get("c0", 0.0)), float(notes.get("c1", 1.0))
        if np.isfinite([shift, slope]).all() and slope != 0:
            calibrated = values.astype(np.float32)
            calibrated *= np.float32(slope)
            calibrated += np.float32(shift)
            return calibrated, []
    return values, [
        warning(
            path,
            "has a calibration of its values that is not a straight line; it is not used",
            "to use it, convert it to 32 bits in Fiji (Image > Type > 32-bit) and save it again",
        )
    ]
