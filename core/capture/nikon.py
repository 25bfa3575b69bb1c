"""Nikon (X-Tek) scans: .xtekct settings beside numbered .tif projections."""

from __future__ import annotations

import configparser
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..told import Told
from .detectors import CircularScan, visible_box
from .findings import CaptureProblem, name_some, warning
from .listing import shown_files
from .model import Finding, Projections
from .projections import ProjectionFiles, check_distances, check_images, to_line_integrals
from .tiff import read_image
from .values import every_eighth, number, positive

# Scanners often take one more at the end of the turn, to compare with the first.
_USUALLY_MORE = 2
_OF_THE_AXIS = ("ObjectOffsetX", "ObjectRoll", "ObjectTilt", "CentreOfRotationTop", "CentreOfRotationBottom")


def read_nikon(path: Path) -> ProjectionFiles:
    """Reads a .xtekct file and its .tif projections; intensities become line integrals by its white level.

    The stage turns clockwise seen from above, so the source goes round counter-clockwise, as gantry angles do. Images
    are stored as seen from behind the detector, with the source beyond it: here they are turned over to be as seen
    from the source (as CIL reads these files, arXiv 2102.04560; TIGRE turns the stage the other way and counts rows
    upwards, which is the same scan standing on its head).

    Raises:
        CaptureError: see `read_projections`.
    """
    settings = read_settings(path)
    count = int(number(path, settings, "projections"))
    positive(path, "Projections", count)
    here = numbered_images(path, count)
    files = here[:count]
    raw = [read_image(file) for file in files]
    names = [str(file) for file in files]
    check_images(names, raw)
    scan, box, voxels = geometry_of(path, settings, raw[0].shape)
    white = number(path, settings, "whitelevel", 0.0)
    images, meaning = to_line_integrals(
        path,
        names,
        np.stack([image[:, ::-1].astype(np.float32) for image in raw]),
        raw_counts=all(image.dtype.kind in "iu" for image in raw),
        flat=white if white > 0 else None,
        advice=Told("give WhiteLevel, what a pixel reads with nothing in front of it"),
    )
    angles = _angles(path, settings, len(files))
    to_the_right, up = scan.offset_mm
    scan = replace(scan, offset_mm=(-to_the_right, up))
    detectors = scan.detectors(angles)
    try:
        box = visible_box(detectors) if box is None else box
    except ValueError as error:
        raise CaptureProblem(
            path, "{error}", "give VoxelSizeX and VoxelsX, or mend the detector's offsets", error=error
        ) from error
    projections = Projections(
        images=images,
        detectors=detectors,
        held_out=every_eighth(len(files)),
        angles_rad=angles,
        box_mm=box,
        voxels=voxels,
        source_to_axis_mm=scan.source_to_axis_mm,
        source_to_detector_mm=scan.source_to_detector_mm,
    )
    return ProjectionFiles(
        projections, [path, *files], [*meaning, *unnamed_findings(path, files, here), *_axis_findings(path, settings)]
    )


def read_settings(path: Path) -> dict[str, Any]:
    """The section [XTekCT] of a .xtekct file, keys in lower case. Raises CaptureError."""
    parser = configparser.ConfigParser(interpolation=None, strict=False)
    try:
        parser.read_string(path.read_text("utf-8-sig", errors="replace"))
    except (OSError, configparser.Error) as error:
        raise CaptureProblem(path, "cannot be read ({error})", "copy it again from the scanner", error=error) from error
    if not parser.has_section("XTekCT"):
        raise CaptureProblem(path, "has no [XTekCT] section", "copy it again from the scanner")
    return dict(parser["XTekCT"])


def numbered_images(path: Path, count: int) -> list[Path]:
    """The projections, in the order of the number at the end of their names, of those that are named as the settings
    where others, as flat fields, lie beside them; the first `count` are those of the settings, there may be more.
    Raises CaptureError where some lack, or where it is not clear which they are."""
    series: dict[str, dict[int, Path]] = {}
    for file in shown_files(path.parent):
        match = re.fullmatch(r"(.*?)(\d+)\.tiff?", file.name, re.IGNORECASE)
        if match:
            series.setdefault(match.group(1), {})[int(match.group(2))] = file
    own = {name: files for name, files in series.items() if name.rstrip(" _-.").lower() == path.stem.lower()}
    enough = own or {name: files for name, files in series.items() if len(files) >= count}
    if len(enough) > 1:
        names = [files[min(files)].name for _, files in sorted(enough.items())]
        raise CaptureProblem(
            path,
            "lies beside more than one series of .tif files ({names})",
            "move all but the projections into another folder",
            names=name_some(names),
        )
    numbered = next(iter(enough.values()), max(series.values(), key=len, default={}))
    files = [numbered[index] for index in sorted(numbered)]
    if len(files) < count:
        raise CaptureProblem(
            path,
            "names {count} projections but {here} .tif files are here ({names})"
            if files
            else "names {count} projections but {here} .tif files are here (none)",
            "copy the others too",
            count=count,
            here=len(files),
            names=name_some([file.name for file in files], 2),
        )
    return files


def unnamed_findings(path: Path, files: list[Path], here: list[Path]) -> list[Finding]:
    """A warning where the files are clearly more than the settings name: `Projections` alone does not say which."""
    extra = here[len(files) :]
    if len(extra) <= _USUALLY_MORE:
        return []
    return [
        warning(
            path,
            "names {count} projections but {here} .tif files are here; the last of them are not used: {names}",
            "to use every fourth alone, say, move the other .tif into another folder; to use all, give Projections and "
            "AngularStep as they were scanned",
            count=len(files),
            here=len(here),
            names=name_some([file.name for file in extra]),
        )
    ]


def _axis_findings(path: Path, settings: dict[str, Any]) -> list[Finding]:
    """A warning where the file has the axis elsewhere than it is taken to be: upright, in the middle."""
    known = [name for name in _OF_THE_AXIS if _is_not_zero(settings.get(name.lower()))]
    if not known:
        return []
    return [
        warning(
            path,
            "says where the axis of rotation is ({names}), which is not read: it is taken to be upright, in the middle",
            "if edges come out double, run with --effects geometry, which finds the axis",
            names=", ".join(f"{name}={settings[name.lower()]}" for name in known),
        )
    ]


def _is_not_zero(value: str | None) -> bool:
    try:
        return float(value or 0.0) != 0.0
    except ValueError:
        return False


def _angles(path: Path, settings: dict[str, Any], count: int) -> np.ndarray:
    step = number(path, settings, "angularstep")
    return np.deg2rad(number(path, settings, "initialangle", 0.0) + step * np.arange(count))


def geometry_of(
    path: Path, settings: dict[str, Any], shape: tuple[int, ...]
) -> tuple[CircularScan, np.ndarray | None, tuple[int, int, int]]:
    """The scan for images of a shape (rows, columns) as they are stored, the box (2, 3) mm or None, and its voxels
    x, y, z.

    Raises:
        CaptureError: a setting is missing or out of range.
    """
    to_axis, to_detector = number(path, settings, "srctoobject"), number(path, settings, "srctodetector")
    check_distances(path, to_axis, to_detector)
    pixels = np.array([number(path, settings, f"detectorpixels{axis}") for axis in "xy"])
    pitch = np.array([number(path, settings, f"detectorpixelsize{axis}") for axis in "xy"])
    positive(path, "DetectorPixels", pixels)
    positive(path, "DetectorPixelSize", pitch)
    # Binned exports keep the field of view: the pitch grows as the pixels get fewer.
    pitch = pitch * pixels / np.array(shape[::-1])
    offset = [number(path, settings, f"detectoroffset{axis}", 0.0) for axis in "xy"]
    scan = CircularScan(
        width=shape[1],
        height=shape[0],
        pixel_mm=(pitch[0], pitch[1]),
        source_to_axis_mm=to_axis,
        source_to_detector_mm=to_detector,
        offset_mm=(offset[0], offset[1]),
    )
    voxels = np.array([number(path, settings, f"voxels{axis}", 256) for axis in "xyz"])
    positive(path, "Voxels", voxels)
    size = np.array([number(path, settings, f"voxelsize{axis}", 0.0) for axis in "xyz"])
    count = (int(voxels[0]), int(voxels[1]), int(voxels[2]))
    if np.any(size <= 0):
        return scan, None, count
    middle = np.array([number(path, settings, f"offset{axis}", 0.0) for axis in "xyz"])
    return scan, np.stack([middle - voxels * size / 2, middle + voxels * size / 2]), count
