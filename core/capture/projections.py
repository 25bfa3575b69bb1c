"""X-ray projections as they lie on disk -> Projections (line integrals, detectors in mm)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..told import Told
from .air import air_level, look_like_intensities
from .dead_pixels import dead_findings, dead_pixels, filled, silent_findings, silent_pixels, stuck_pixels
from .detectors import CircularScan
from .findings import CaptureProblem, info, name_some, warning
from .listing import shown_files
from .model import Finding, Projections
from .values import every_eighth, listed, number, numbers, positive, read_array, read_json

LOWEST_TRANSMISSION = 1e-6
"""Transmissions are clipped here before the logarithm: a starved pixel has no finite line integral."""

_GIVE_FLAT = Told(
    "put flat.npy (and dark.npy) beside the projections, or set 'values': 'line_integral' if they are that"
)
_AIR_IS_1 = "projections are intensities without a flat field, none above 1; air was taken to be 1"
_AIR_IS_BRIGHTEST = "projections are intensities without a flat field; air was taken from where each image is brightest"


@dataclass
class ProjectionFiles:
    """What a reader of one file layout hands over.

    Attributes:
        projections: as line integrals.
        files: every file that was read, for the capture's digest.
        findings: what there is to say about them.
    """

    projections: Projections
    files: list[Path]
    findings: list[Finding] = field(default_factory=list)


def find_projections(folder: Path) -> Path | None:
    """The file that describes the projections in `folder`: meta_data.json, a NAF .pickle or a Nikon .xtekct.

    Raises:
        CaptureError: several of a kind do.
    """
    meta = folder / "meta_data.json"
    if meta.is_file():
        return meta
    for pattern in ("*.pickle", "*.pkl", "*.xtekct"):
        # A Mac leaves hidden ones beside them.
        found = sorted(path for path in folder.glob(pattern) if path.is_file() and not path.name.startswith("."))
        if len(found) > 1:
            raise CaptureProblem(
                folder,
                "holds several scans: {names}",
                "keep the file of the one that is to be used",
                names=name_some([path.name for path in found]),
            )
        if found:
            return found[0]
    return None


def read_projections(source: Path) -> ProjectionFiles:
    """Reads projections in R²-Gaussian's layout, a NAF .pickle or a Nikon scanner's own files.

    Args:
        source: what `find_projections` returned.

    Raises:
        CaptureError: a file is missing, broken, of another size than the others, not finite or all zero; or the
            geometry lacks a value.
    """
    if source.suffix in (".pickle", ".pkl"):
        from .naf import read_naf

        return read_naf(source)
    if source.suffix == ".xtekct":
        from .nikon import read_nikon

        return read_nikon(source)
    return _read_r2(source)


def line_integrals(
    intensities: np.ndarray, flat: np.ndarray | float = 1.0, dark: np.ndarray | float = 0.0
) -> np.ndarray:
    """p = −ln((I − D) / (F − D)) (Beer-Lambert), the transmission clipped at 1e-6.

    Pixels that do not see the X-rays (see `dead_pixels`, `silent_pixels`) get the mean of their neighbours.

    Args:
        intensities: (M, H, W) detector readings.
        flat: F, reading without an object; a number, (H, W) or (M, 1, 1).
        dark: D, reading without X-rays.

    Returns:
        (M, H, W) float32, no unit.
    """
    return _converted(intensities, flat, dark)[0]


def _converted(
    intensities: np.ndarray, flat: np.ndarray | float, dark: np.ndarray | float
) -> tuple[np.ndarray, np.ndarray]:
    """Line integrals as of `line_integrals`, and where (H, W) pixels are silent that the flat field does not tell."""
    dark = np.asarray(dark, np.float32)
    dead = dead_pixels(flat, dark)
    span = np.where(dead, 1.0, np.asarray(flat, np.float32) - dark).astype(np.float32)
    transmission = (np.asarray(intensities, np.float32) - dark) / span
    integrals = -np.log(np.maximum(transmission, LOWEST_TRANSMISSION))
    silent = silent_pixels(transmission, LOWEST_TRANSMISSION)
    if dead.ndim < intensities.ndim:
        silent &= ~dead
    all_dead = dead | silent
    if all_dead.any():
        integrals = filled(integrals, np.broadcast_to(all_dead, integrals.shape))
    return integrals, silent


def are_line_integrals(images: np.ndarray, *, raw_counts: bool, has_flat: bool, declared: str | None = None) -> bool:
    """Whether projections (M, H, W), all or the first, are line integrals, not intensities; see `to_line_integrals`."""
    return declared == "line_integral" or not (declared or has_flat or raw_counts or look_like_intensities(images))


def to_line_integrals(
    source: Path,
    names: Sequence[str],
    images: np.ndarray,
    *,
    raw_counts: bool = False,
    flat: np.ndarray | float | None = None,
    dark: np.ndarray | float | None = None,
    declared: str | None = None,
    advice: Told = _GIVE_FLAT,
) -> tuple[np.ndarray, list[Finding]]:
    """Line integrals from whatever the images are, and what they were taken for.

    Args:
        names: of the images, for messages.
        raw_counts: the files hold integers, which only raw readings do.
        flat, dark: reference readings when there are any.
        declared: "intensity" or "line_integral" when the user says so, which goes before all else; without it a
            flat field says that the images are intensities, else the images themselves decide.
        advice: what the user can do where they decided for intensities without a reference reading.

    Raises:
        CaptureError: see `read_projections`.
    """
    if declared not in (None, "intensity", "line_integral"):
        raise CaptureProblem(
            source,
            "'values' is {declared}",
            "set it to 'intensity' or 'line_integral', or leave it out",
            declared=repr(declared),
        )
    if are_line_integrals(images, raw_counts=raw_counts, has_flat=flat is not None, declared=declared):
        stuck = stuck_pixels(images)
        if stuck.any():
            images = filled(images, np.broadcast_to(stuck, images.shape))
        told = info(source, "projections are line integrals (no unit)")
        return images, [told, *silent_findings(source, stuck), *_unused(source, flat, dark)]
    findings = []
    if flat is not None:
        findings.append(info(source, "projections are intensities, divided by the flat field"))
        findings += dead_findings(source, flat, 0.0 if dark is None else dark)
    else:
        images, dark = images if dark is None else images - np.asarray(dark, np.float32), None
        flat = air_level(images)
        doubt = Told(_AIR_IS_1) if np.all(flat == 1) else Told(_AIR_IS_BRIGHTEST)
        findings.append(Finding("warning", str(source), doubt, advice))
    converted, silent = _converted(images, flat, 0.0 if dark is None else dark)
    findings += silent_findings(source, silent)
    check_images(names, list(converted))
    return converted, findings


def _unused(source: Path, flat: object, dark: object) -> list[Finding]:
    names = [name for name, reference in (("flat.npy", flat), ("dark.npy", dark)) if reference is not None]
    if not names:
        return []
    return [
        warning(
            source,
            "{names} not used, because the projections are taken for line integrals",
            "set 'values': 'intensity' if they are detector readings, or take the reference images away",
            names=Told("flat.npy and dark.npy") if len(names) > 1 else names[0],
        )
    ]


def check_images(names: Sequence[str], images: Sequence[np.ndarray]) -> None:
    """Checks that projections are two-dimensional, of one size, finite and not blank.

    Raises:
        CaptureError: naming the first file that is not.
    """
    for name, image in zip(names, images, strict=True):
        if image.ndim != 2 or min(image.shape) < 2:
            raise CaptureProblem(
                name, "has shape {shape}, not rows x columns", "save one 2D image a file", shape=image.shape
            )
        if image.shape != images[0].shape:
            raise CaptureProblem(
                name,
                "is {size} but {first} is {first_size} (width x height)",
                "export all projections at one size, or take this one out of the list",
                size=_size(image),
                first=names[0],
                first_size=_size(images[0]),
            )
        if not np.isfinite(image).all():
            bad = int((~np.isfinite(image)).sum())
            raise CaptureProblem(
                name,
                "has {bad} pixels that are NaN or infinite",
                "export it again, or fill dead pixels from their neighbors",
                bad=bad,
            )
        if image.min() == image.max():
            raise CaptureProblem(
                name,
                "is {level:g} everywhere" if image.any() else "is zero everywhere",
                "export it again, or take it out of the list",
                level=image.flat[0],
            )


def check_distances(source: Path, to_axis: float, to_detector: float) -> None:
    """Raises CaptureError when the source is not before the axis and the axis not before the detector."""
    if not 0 < to_axis < to_detector:
        raise CaptureProblem(
            source,
            "the source is {to_axis:g} mm from the axis and {to_detector:g} mm from the detector",
            "DSO must be above zero and below DSD; check that the two are not swapped",
            to_axis=to_axis,
            to_detector=to_detector,
        )


def _read_r2(path: Path) -> ProjectionFiles:
    """R²-Gaussian's layout (arXiv 2405.20693): meta_data.json beside folders of .npy projections."""
    meta, train, held = read_meta(path)
    angles = np.array([_angle(path, frame, i) for i, frame in enumerate(train + held)])
    files = listed_files(path, train + held)
    raw = [load_npy(file) for file in files]
    check_images([str(file) for file in files], raw)
    images, meaning = to_line_integrals(
        path,
        [str(file) for file in files],
        np.stack([image.astype(np.float32) for image in raw]),
        raw_counts=all(image.dtype.kind in "iu" for image in raw),
        flat=_reference(path.parent / "flat.npy", raw[0].shape),
        dark=_reference(path.parent / "dark.npy", raw[0].shape),
        declared=meta.get("values"),
    )
    scan, box, voxels = r2_geometry(path, meta, raw[0].shape)
    held_out = np.arange(len(files)) >= len(train) if held else every_eighth(len(files))
    projections = Projections(
        images=images,
        detectors=scan.detectors(angles),
        held_out=held_out,
        angles_rad=angles,
        box_mm=box,
        voxels=voxels,
        source_to_axis_mm=scan.source_to_axis_mm,
        source_to_detector_mm=scan.source_to_detector_mm,
    )
    references = [p for p in (path.parent / "flat.npy", path.parent / "dark.npy") if p.is_file()]
    return ProjectionFiles(
        projections, [path, *files, *references], [*meaning, *_unlisted(path, files), *_offset_note(path, scan)]
    )


def read_meta(path: Path) -> tuple[dict[str, Any], list[Any], list[Any]]:
    """A meta_data.json and the entries of its projections, to train on and held out. Raises CaptureError."""
    meta = read_json(path)
    if not isinstance(meta, dict):
        raise CaptureProblem(path, "is not a JSON object", "start from R²-Gaussian's layout")
    for key in ("scanner", "proj_train"):
        if key not in meta:
            raise CaptureProblem(path, "lacks '{key}'", "add it as in R²-Gaussian's layout", key=key)
    train, held = listed(path, meta, "proj_train"), listed(path, meta, "proj_test")
    if not train:
        raise CaptureProblem(path, "lists no projections in 'proj_train'", "list one entry a projection")
    for index, frame in enumerate(train + held):
        _angle(path, frame, index)
    return meta, train, held


def r2_geometry(
    path: Path, meta: dict[str, Any], shape: tuple[int, ...]
) -> tuple[CircularScan, np.ndarray, tuple[int, int, int]]:
    """The scan for images of a shape (rows, columns), the box (2, 3) mm, and its voxels x, y, z.

    Raises:
        CaptureError: a value is missing, out of range, or not that of images of this shape.
    """
    scanner = meta["scanner"]
    if not isinstance(scanner, dict):
        raise CaptureProblem(path, "'scanner' is not a JSON object", "start from R²-Gaussian's layout")
    mode = scanner.get("mode", "cone")
    if mode not in ("cone", "parallel"):
        raise CaptureProblem(path, "'mode' is {mode}", "set it to 'cone' or 'parallel'", mode=repr(mode))
    to_axis, to_detector = number(path, scanner, "DSO"), number(path, scanner, "DSD")
    check_distances(path, to_axis, to_detector)
    pixels = numbers(path, scanner, "nDetector", 2)
    if tuple(pixels.astype(int)) != tuple(shape):
        swapped = tuple(pixels.astype(int)[::-1]) == tuple(shape)
        raise CaptureProblem(
            path,
            "'nDetector' [rows, columns] is {pixels} but the projections have {stored}",
            "swap the two numbers, and those of sDetector" if swapped else "correct it or the projections",
            pixels=pixels.astype(int).tolist(),
            stored=list(shape),
        )
    size = numbers(path, scanner, "sDetector", 2)
    positive(path, "sDetector", size)
    extent = numbers(path, scanner, "sVoxel", 3)
    positive(path, "sVoxel", extent)
    voxels = numbers(path, scanner, "nVoxel", 3)
    positive(path, "nVoxel", voxels)
    middle = numbers(path, scanner, "offOrigin", 3, [0, 0, 0])
    offset = numbers(path, scanner, "offDetector", 2, [0, 0])
    scan = CircularScan(
        width=shape[1],
        height=shape[0],
        pixel_mm=(size[1] / shape[1], size[0] / shape[0]),
        source_to_axis_mm=to_axis,
        source_to_detector_mm=to_detector,
        offset_mm=(offset[0], offset[1]),
        parallel=mode == "parallel",
    )
    box = np.stack([middle - extent / 2, middle + extent / 2])
    return scan, box, (int(voxels[0]), int(voxels[1]), int(voxels[2]))


def _angle(path: Path, frame: Any, index: int) -> float:
    unnamed = Told("projection {index}", index=index)
    name = frame.get("file_path", unnamed) if isinstance(frame, dict) else unnamed
    if not isinstance(frame, dict) or "file_path" not in frame:
        raise CaptureProblem(path, "{name} has no 'file_path'", "name its .npy file", name=name)
    if frame.get("angle") is None:
        raise CaptureProblem(path, "{name} has no 'angle'", "add the gantry angle in radians", name=name)
    angle = number(path, frame, "angle")
    if abs(angle) > 8 * np.pi:
        raise CaptureProblem(
            path,
            "{name} has angle {angle:g}, which looks like degrees",
            "give angles in radians",
            name=name,
            angle=angle,
        )
    return angle


def listed_files(path: Path, frames: list[dict[str, Any]]) -> list[Path]:
    """The files of entries of meta_data.json. Raises CaptureError where one is missing or listed twice."""
    # A list that was written on Windows.
    names = [str(frame["file_path"]).replace("\\", "/") for frame in frames]
    files = [path.parent / name for name in names]
    twice = [name for name, count in Counter(file.resolve() for file in files).items() if count > 1]
    if twice:
        raise CaptureProblem(
            path,
            "lists {count} projections more than once: {names}",
            "keep each in one place: those in 'proj_test' are for measuring and may not be in 'proj_train'",
            count=len(twice),
            names=name_some([file.name for file in twice]),
        )
    missing = [name for name, file in zip(names, files, strict=True) if not file.is_file()]
    if missing:
        raise CaptureProblem(
            path,
            "lists {count} projections but {gone} files are missing: {missing}",
            "copy them into the folder, or take them out of the list",
            count=len(files),
            gone=len(missing),
            missing=name_some(missing),
        )
    return files


def load_npy(path: Path) -> np.ndarray:
    """Numbers as they are stored. Raises CaptureError."""
    image = read_array(path)
    if image.dtype.kind not in "fiu":
        raise CaptureProblem(path, "holds {dtype}, not numbers", "export it as float or integer", dtype=image.dtype)
    return image


def _reference(path: Path, shape: tuple[int, ...]) -> np.ndarray | None:
    """A flat or dark image beside the projections; several are averaged."""
    if not path.is_file():
        return None
    image = load_npy(path).astype(np.float32)
    image = image.mean(axis=0) if image.ndim == 3 else image
    if image.shape != tuple(shape) or not np.isfinite(image).all():
        raise CaptureProblem(
            path,
            "is {size} or not finite, the projections are {columns} x {rows}",
            "export it again",
            size=_size(image),
            columns=shape[1],
            rows=shape[0],
        )
    return image


def _unlisted(path: Path, files: list[Path]) -> list[Finding]:
    """A warning when the folders of the listed projections hold more files than are listed."""
    known = {file.resolve() for file in files}
    folders = {file.parent for file in files} - {path.parent}
    beside = [file for folder in folders for file in shown_files(folder) if file.suffix == ".npy"]
    extra = sorted(file.name for file in beside if file.resolve() not in known)
    if not extra:
        return []
    return [
        warning(
            path,
            "{count} projections in the folder are not listed and not used: {names}",
            "list them with their angles if they belong to the scan",
            count=len(extra),
            names=name_some(extra),
        )
    ]


def _offset_note(path: Path, scan: CircularScan) -> list[Finding]:
    if not any(scan.offset_mm):
        return []
    u, v = scan.offset_mm
    moved = "the detector is moved {u:g} mm along its rows (right) and {v:g} mm along the axis (up)"
    return [info(path, moved, u=u, v=v)]


def _size(image: np.ndarray) -> str:
    return " x ".join(str(n) for n in image.shape[::-1])
