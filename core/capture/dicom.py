"""A folder of DICOM slices -> one image in ITK, and what its header says of its values."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .findings import CaptureProblem, last_line, name_some, warning
from .listing import notes_path, shown_files
from .model import Finding

if TYPE_CHECKING:
    import SimpleITK

LEAST_HU = -3100
"""Below air: scanners fill what they did not measure with as little."""

# Its entry lists the slices of a disc, and has their mark, too.
_INDEX = "dicomdir"
_LOOKED_AT = 20
# What ITK takes for a size that it does not find.
_UNKNOWN = 1.0
# Cosine of the largest angle between the normal of slices and the way from one to the next: no gantry tilts further.
_TILTED = 0.5
# Image Position; Spacing Between Slices and Slice Thickness; Pixel Spacing, and what scanned films have instead.
_PLACE, _APART, _PIXEL = "0020|0032", ("0018|0088", "0018|0050"), ("0028|0030", "0018|2010", "0018|1164")


@dataclass
class Series:
    """Slices as one image.

    Attributes:
        files: of the slices, in their order.
        in_hounsfield: whether they say so; else their numbers have no known unit.
        tells_size: whether they say how large voxels are; if not, the image's are a default of ITK's.
        of_size: what there is to say about that.
    """

    image: SimpleITK.Image
    files: list[Path]
    in_hounsfield: bool
    tells_size: bool = True
    findings: list[Finding] = field(default_factory=list)
    of_size: list[Finding] = field(default_factory=list)


def find_series(folder: Path) -> Path | None:
    """The folder, if it holds DICOM slices itself, or the one folder in it that does.

    Raises:
        CaptureError: several folders in it hold some.
    """
    if _holds_slices(folder):
        return folder
    inner = sorted(place for place in folder.iterdir() if place.is_dir() and not place.name.startswith("proj"))
    found = [place for place in inner if _holds_slices(place)]
    if len(found) > 1:
        raise CaptureProblem(
            folder,
            "holds several folders of DICOM slices: {names}",
            "keep the one that is the scan, and move the others elsewhere",
            names=name_some([place.name for place in found]),
        )
    return found[0] if found else None


def read_series(folder: Path) -> Series:
    """The series of a folder that has the most slices; a file may hold many. Where a gantry was tilted the image is
    sheared, as its slices lie.

    Raises:
        CaptureError: there is none, or it cannot be read.
    """
    import SimpleITK as sitk

    series = {key: _slices(folder, key) for key in sitk.ImageSeriesReader.GetGDCMSeriesIDs(str(folder))}
    if not series:
        raise CaptureProblem(folder, "holds no DICOM series that can be read", "export the slices again")
    files = next(iter(series.values())) if len(series) == 1 else max(series.values(), key=_count_slices)
    reader = sitk.ImageSeriesReader()
    reader.SetFileNames([str(path) for path in files])
    reader.MetaDataDictionaryArrayUpdateOn()
    reader.LoadPrivateTagsOff()
    try:
        image = reader.Execute()
    except RuntimeError as error:
        raise CaptureProblem(
            folder, "cannot be read ({reason})", "export the slices again", reason=last_line(error)
        ) from error
    read = Series(image, files, _in_hounsfield(reader))
    positions = _positions(reader, len(files))
    if image.GetDimension() == 3 and image.GetSize()[2] == len(files):
        if positions is not None:
            _follow(image, positions)
        _take_size(read, reader, folder)
    if len(series) > 1:
        left = len(series) - 1
        read.findings.append(
            warning(folder, "holds {left} other DICOM series, not used", "keep one series in the folder", left=left)
        )
    if positions is not None and _uneven(positions):
        read.findings.append(
            warning(folder, "the DICOM slices are not evenly spaced; some may be missing", "export all slices again")
        )
    return read


def _holds_slices(folder: Path) -> bool:
    files = [path for path in shown_files(folder) if path.name.lower() != _INDEX]
    return any(_is_dicom(path) for path in files[:_LOOKED_AT])


def _is_dicom(path: Path) -> bool:
    with open(path, "rb") as stream:
        stream.seek(128)
        return stream.read(4) == b"DICM"


def _slices(folder: Path, series: str) -> list[Path]:
    import SimpleITK as sitk

    return [Path(name) for name in sitk.ImageSeriesReader.GetGDCMSeriesFileNames(str(folder), series)]


def _count_slices(files: list[Path]) -> int:
    """Of a series, those of files that hold several (multi-frame) included; what cannot be read counts as one."""
    import SimpleITK as sitk

    reader, count = sitk.ImageFileReader(), 0
    for path in files:
        reader.SetFileName(str(path))
        try:
            reader.ReadImageInformation()
        except RuntimeError:
            count += 1
            continue
        count += int(np.prod(reader.GetSize()[2:]))
    return count


def _in_hounsfield(reader: SimpleITK.ImageSeriesReader) -> bool:
    """Whether a DICOM series says that it has Hounsfield units: of CT, and they are named, or what was added to its
    numbers is below 0. Micro and industrial CT leave grey values as CT, too, with noise about 0."""

    def said(key: str) -> str:
        return reader.GetMetaData(0, key).strip() if reader.HasMetaDataKey(0, key) else ""

    modality, kind = said("0008|0060"), said("0028|1054").upper()
    if modality != "CT" or kind not in ("HU", "US", ""):
        return False
    try:
        added = float(said("0028|1052"))
    except ValueError:
        added = 0.0
    return kind == "HU" or LEAST_HU <= added < 0


def _take_size(read: Series, reader: SimpleITK.ImageSeriesReader, folder: Path) -> None:
    """The size of voxels where ITK takes 1 mm: of slices without a position, or without a pixel size. Enhanced ones
    have either in groups, which ITK reads and does not show."""
    across, down, apart = read.image.GetSpacing()
    if apart == _UNKNOWN and not _placed(reader, len(read.files)):
        apart = next((size[0] for size in (_lengths(reader, key) for key in _APART) if size), 0.0)
        read.tells_size = apart > 0
        if read.tells_size:
            told = "its slices have no position; {apart:g} mm apart was taken from their spacing or thickness"
            mend = 'check it; if it is another, say "spacing_mm": [x, y, z] in {name} beside the folder'
            read.of_size.append(warning(folder, told, mend, apart=apart, name=notes_path(folder).name))
    if across == down == _UNKNOWN:
        pixel = next((size for size in (_lengths(reader, key) for key in _PIXEL) if len(size) == 2), [])
        read.tells_size &= bool(pixel)
        down, across = pixel or (down, across)
    if read.tells_size:
        read.image.SetSpacing((across, down, apart))


def _placed(reader: SimpleITK.ImageSeriesReader, count: int) -> bool:
    """Whether slices say where they are, and not all the same."""
    places = {reader.GetMetaData(i, _PLACE).strip() if reader.HasMetaDataKey(i, _PLACE) else "" for i in range(count)}
    return "" not in places and (count == 1 or len(places) > 1)


def _lengths(reader: SimpleITK.ImageSeriesReader, key: str) -> list[float]:
    """Lengths in mm of the first slice; none where it has none, or what is no length."""
    if not reader.HasMetaDataKey(0, key):
        return []
    try:
        lengths = [float(part) for part in reader.GetMetaData(0, key).split("\\")]
    except ValueError:
        return []
    return lengths if all(0 < length < np.inf for length in lengths) else []


def _positions(reader: SimpleITK.ImageSeriesReader, count: int) -> np.ndarray | None:
    """(count, 3) where in mm the first voxel of each slice lies; None where they do not say it, or of one."""
    if count < 2 or not _placed(reader, count):
        return None
    try:
        positions = np.array([[float(x) for x in reader.GetMetaData(i, _PLACE).split("\\")] for i in range(count)])
    except ValueError:
        return None
    return positions if positions.shape == (count, 3) and np.isfinite(positions).all() else None


def _follow(image: SimpleITK.Image, positions: np.ndarray) -> None:
    """Where a gantry was tilted, slices lie one above the other, and not along their normal, as ITK stacks them."""
    step = (positions[-1] - positions[0]) / (len(positions) - 1)
    apart = float(np.linalg.norm(step))
    direction = np.reshape(image.GetDirection(), (3, 3))
    if apart == 0 or np.allclose(step / apart, direction[:, 2], atol=1e-3):
        return
    if abs(direction[:, 2] @ step) < _TILTED * apart:
        return
    direction[:, 2] = step / apart
    image.SetDirection(direction.ravel().tolist())
    image.SetSpacing((*image.GetSpacing()[:2], apart))


def _uneven(positions: np.ndarray) -> bool:
    """Whether the slices of a DICOM series are not evenly spaced."""
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    return bool(np.ptp(steps) > 0.01 * np.median(steps) + 1e-3)
