"""The scanner of a synthetic capture: where its source and detector stand, and its files in R²-Gaussian's layout."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..capture.detectors import CircularScan
from ..capture.read import read_capture
from ..fdk_process import end_fdk, fdk
from ..files import atomic_write, write_json
from ..progress import Progress, Reporter
from .flaws import ScanFlaws, plan_flaws, project_truly, seen_columns, true_detectors
from .model import Phantom
from .part_tables import PartTables
from .projections import add_scatter, count_photons
from .settings import CaptureSettings
from .spectrum import monochromatic, tube_spectrum

_MAGNIFICATION = 1.5


def scan_geometry(phantom: Phantom, width: int, height: int) -> CircularScan:
    """A cone-beam scanner with magnification 1.5 that sees the phantom whole, and nearly all of its box."""
    wide, high = field_of_view(phantom)
    pitch = 1.02 * max(wide / width, high / height)
    to_axis = _to_axis(phantom)
    return CircularScan(width, height, (pitch, pitch), to_axis, _MAGNIFICATION * to_axis)


def field_of_view(phantom: Phantom) -> tuple[float, float]:
    """Width and height in mm of the phantom's shadow on the detector, over all angles."""
    to_axis = _to_axis(phantom)
    radius = 0.93 * 0.5 * float(np.hypot(*phantom.size_mm[:2]))
    half_width = _MAGNIFICATION * to_axis * radius / np.sqrt(to_axis**2 - radius**2)
    half_height = _MAGNIFICATION * to_axis * 0.5 * phantom.size_mm[2] / (to_axis - radius)
    return 2 * float(half_width), 2 * half_height


def _to_axis(phantom: Phantom) -> float:
    return 4.0 * max(phantom.size_mm)


def voxels(phantom: Phantom, voxel_mm: float) -> tuple[int, int, int]:
    """Voxels along x, y, z of the grid that holds the phantom's box."""
    nx, ny, nz = (int(np.ceil(size / voxel_mm)) + 1 for size in phantom.size_mm)
    return nx, ny, nz


def write_projections(
    phantom: Phantom,
    tables: PartTables,
    folder: Path,
    settings: CaptureSettings,
    rng: np.random.Generator,
    reporter: Reporter,
) -> ScanFlaws:
    """Writes meta_data.json, proj_train/ and proj_test/ as float16 line integrals; returns what they do not say.

    Args:
        tables: the phantom's, baked.
        rng: of the held-out angles, of flaws and of the noise.
    """
    scan = scan_geometry(phantom, settings.detector_width, settings.detector_height)
    scan = replace(scan, width=seen_columns(scan.width, settings))
    count = settings.projections
    training = np.arange(count) * 2 * np.pi / count
    testing = np.sort(rng.uniform(0, 2 * np.pi, settings.heldout_projections))
    angles = np.concatenate([training, testing])

    def step(done: int) -> None:
        reporter.update(Progress("phantom", "xray", done / len(angles), done, len(angles)))

    hardens = "beam_hardening" in settings.effects
    spectrum = tube_spectrum(phantom.energy_kev) if hardens else monochromatic(phantom.energy_kev)
    flaws = plan_flaws(settings, scan, angles, rng)
    images = project_truly(tables, true_detectors(scan, angles, flaws), spectrum, flaws, step)
    if "scatter" in settings.effects:
        images = add_scatter(images, settings.scatter_share)
    if "noise" in settings.effects:
        images = count_photons(images, settings.photons, rng)
    if flaws.log_gain is not None:
        images -= flaws.log_gain.astype(np.float32)
    extra = {
        **({"photons": settings.photons} if "noise" in settings.effects else {}),
        **({"scatter_share": settings.scatter_share} if "scatter" in settings.effects else {}),
        "beam": spectrum.description,
        "effects": list(settings.effects),
    }
    grid = voxels(phantom, settings.voxel_mm)
    content = scan_file(scan, grid, (settings.voxel_mm,) * 3, "noise" in settings.effects, **extra)
    write_scan(folder, content, images.astype(np.float16), angles, count)
    return flaws


def scan_file(
    scan: CircularScan, grid: Sequence[int], spacing_mm: Sequence[float], noise: bool, **more: object
) -> dict[str, object]:
    """What meta_data.json says in R²-Gaussian's layout, but for the list of projections.

    Args:
        grid, spacing_mm: voxels along x, y, z about the origin that the scanner suggests.
        more: of the scanner, too.
    """
    size = [count * step for count, step in zip(grid, spacing_mm, strict=True)]
    scanner = {
        "mode": "cone",
        "DSD": scan.source_to_detector_mm,
        "DSO": scan.source_to_axis_mm,
        "nDetector": [scan.height, scan.width],
        "sDetector": [scan.height * scan.pixel_mm[1], scan.width * scan.pixel_mm[0]],
        "nVoxel": list(grid),
        "sVoxel": size,
        "offOrigin": [0, 0, 0],
        "offDetector": [0, 0],
        "accuracy": 0.5,
        "totalAngle": 360.0,
        "startAngle": 0.0,
        "noise": noise,
        "filter": None,
        **more,
    }
    box = [[-0.5 * s for s in size], [0.5 * s for s in size]]
    return {"values": "line_integral", "scanner": scanner, "bbox": box}


def write_scan(
    folder: Path, content: Mapping[str, object], images: np.ndarray, angles_rad: np.ndarray, training: int
) -> None:
    """Writes proj_train/ (the first `training` images), proj_test/ (the others) and meta_data.json."""
    lists: dict[str, list[dict[str, object]]] = {"proj_train": [], "proj_test": []}
    for index, (image, angle) in enumerate(zip(images, angles_rad, strict=True)):
        part, number = ("proj_train", index) if index < training else ("proj_test", index - training)
        name = f"{part}/{number:04d}.npy"
        with atomic_write(folder / name) as stream:
            np.save(stream, image)
        lists[part].append({"file_path": name, "angle": float(angle)})
    write_json(folder / "meta_data.json", {**content, **lists})


def write_fdk(folder: Path, reporter: Reporter) -> None:
    """Writes fdk.npz, what the usual CT reconstruction makes of the training projections in xray/, beside that.

    Raises:
        CaptureError: there are fewer than two.
        DiskFullError, RunFolderError: the folder cannot be written.
        Cancelled: through `reporter`.
    """
    # Whatever the photos are like: one alone is no capture.
    projections = read_capture(folder / "xray").projections
    if projections is None:
        raise AssertionError("they were written")
    try:
        fdk(projections, window="hann", reporter=reporter, stage="phantom").save(folder / "fdk.npz")
    finally:
        end_fdk()
