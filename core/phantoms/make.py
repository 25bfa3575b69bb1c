"""Writes a synthetic capture folder: photos, projections in R²-Gaussian's layout, landmarks, and the truth."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from ..capture.detectors import CircularScan
from ..errors import SettingError
from ..files import atomic_write, write_json
from ..progress import Progress, Reporter
from ..similarity import Similarity
from ..volume import Volume
from .distance_grid import DistanceGrid
from .matryoshka import matryoshka
from .model import Phantom
from .photos import camera_ring, render_photo, transforms
from .projections import count_photons, project

PHANTOMS: dict[str, Callable[[], Phantom]] = {"matryoshka": matryoshka}

_MM_PER_PHOTO_UNIT = 60.0


@dataclass(frozen=True)
class CaptureSettings:
    """How a phantom is photographed and X-rayed.

    Attributes:
        photos: number of photos.
        photo_width, photo_height: pixels.
        photo_quality: JPEG quality, 1 to 95.
        projections: for training, evenly over the full circle.
        heldout_projections: at random angles, for measuring.
        detector_width, detector_height: pixels.
        photons: mean count of a detector pixel in air, which sets the noise.
        voxel_mm: spacing of the reconstruction grid that the scanner suggests, and of the truth.
        table_mm: spacing of the tables that distances are read from; curves finer than a few of it are rounded.
    """

    photos: int = 44
    photo_width: int = 192
    photo_height: int = 256
    photo_quality: int = 90
    projections: int = 50
    heldout_projections: int = 6
    detector_width: int = 120
    detector_height: int = 148
    photons: float = 50_000.0
    voxel_mm: float = 0.75
    table_mm: float = 0.4


def make_capture(
    name: str,
    folder: Path,
    settings: CaptureSettings | None = None,
    seed: int = 0,
    reporter: Reporter | None = None,
) -> Path:
    """Makes the capture folder of a phantom.

    Writes photos/ with transforms.json (in an arbitrary similarity of the X-ray frame), xray/ with meta_data.json
    and float16 line integrals, landmarks.json, and truth.npz: `volume`, `spacing_mm_zyx`, `origin_mm_zyx` of the
    attenuation, and `scale`, `rotation`, `translation` with x_mm = scale · R · x_photo + t. No stage reads truth.npz.

    Args:
        name: a key of `PHANTOMS`.
        folder: must be missing or empty.

    Returns:
        The folder.

    Raises:
        SettingError: an unknown name, a folder with something in it, or a setting out of range.
        Cancelled: through `reporter`.
    """
    settings, reporter, folder = settings or CaptureSettings(), reporter or Reporter(), Path(folder)
    _check(name, folder, settings)
    phantom = PHANTOMS[name]()
    rng = np.random.default_rng(seed)
    to_world = _random_similarity(rng)
    _write_photos(phantom, folder / "photos", settings, to_world.inverse(), rng, reporter)
    _write_projections(phantom, folder / "xray", settings, rng, reporter)
    landmarks = phantom.landmarks
    write_json(
        folder / "landmarks.json",
        {"photo": to_world.inverse().apply(landmarks).tolist(), "xray": landmarks.tolist()},
    )
    _write_truth(phantom, folder / "truth.npz", settings.voxel_mm, to_world)
    reporter.update(Progress("phantom", fraction=1.0, message=f"{folder} is ready"))
    return folder


def truth_volume(phantom: Phantom, voxel_mm: float) -> Volume:
    """The attenuation that a perfect reconstruction would find, voxel by voxel."""
    nx, ny, nz = _voxels(phantom, voxel_mm)
    empty = Volume.centered(np.zeros((nz, ny, nx), np.float32), np.full(3, voxel_mm))
    axes = [empty.origin_mm[k] + voxel_mm * np.arange(n) for k, n in enumerate((nx, ny, nz))]
    values = empty.values
    for index, height in enumerate(axes[2]):
        points = np.stack(np.broadcast_arrays(axes[0][None, :], axes[1][:, None], height), axis=-1)
        values[index] = phantom.voxel_means(points, voxel_mm)
    return empty


def scan_geometry(phantom: Phantom, width: int, height: int) -> CircularScan:
    """A cone-beam scanner with magnification 1.5 that sees the phantom whole, and nearly all of its box."""
    size = np.asarray(phantom.size_mm)
    to_axis = 4.0 * float(size.max())
    to_detector = 1.5 * to_axis
    radius = 0.93 * 0.5 * float(np.hypot(size[0], size[1]))
    half_width = to_detector * radius / np.sqrt(to_axis**2 - radius**2)
    half_height = to_detector * 0.5 * size[2] / (to_axis - radius)
    pitch = 1.02 * max(2 * half_width / width, 2 * half_height / height)
    return CircularScan(width, height, (pitch, pitch), to_axis, to_detector)


def _check(name: str, folder: Path, settings: CaptureSettings) -> None:
    if name not in PHANTOMS:
        raise SettingError(f"phantom '{name}' is not known; choose one of: {', '.join(sorted(PHANTOMS))}.")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise SettingError(f"{folder}: is not empty; choose another --out, nothing was changed.")
    for field in ("photos", "photo_width", "photo_height", "projections", "detector_width", "detector_height"):
        if getattr(settings, field) < 1:
            raise SettingError(f"{field} is {getattr(settings, field)}; give at least 1.")
    if settings.heldout_projections < 0:
        raise SettingError(f"heldout_projections is {settings.heldout_projections}; give 0 or more.")
    for field in ("photons", "voxel_mm", "table_mm"):
        if not getattr(settings, field) > 0:
            raise SettingError(f"{field} is {getattr(settings, field)}; give a number above zero.")


def _random_similarity(rng: np.random.Generator) -> Similarity:
    """Photo frame -> world: any rotation, about 60 mm a unit, some way off."""
    matrix, triangle = np.linalg.qr(rng.standard_normal((3, 3)))
    rotation = matrix * np.sign(np.diag(triangle))
    if np.linalg.det(rotation) < 0:
        rotation[:, 0] *= -1
    scale = _MM_PER_PHOTO_UNIT * float(rng.uniform(0.85, 1.15))
    return Similarity(scale, rotation, rng.uniform(-40, 40, 3))


def _write_photos(
    phantom: Phantom,
    folder: Path,
    settings: CaptureSettings,
    to_photo: Similarity,
    rng: np.random.Generator,
    reporter: Reporter,
) -> None:
    grid = DistanceGrid.bake(phantom.surface, np.array(phantom.size_mm), settings.table_mm)
    cameras = camera_ring(settings.photos, max(phantom.size_mm), settings.photo_width, settings.photo_height, rng)
    names = [f"{index:03d}.jpg" for index in range(len(cameras))]
    for index, (camera, name) in enumerate(zip(cameras, names, strict=True)):
        reporter.update(Progress("phantom", "photos", 0.5 * index / len(cameras), index, len(cameras)))
        pixels = np.round(255 * render_photo(phantom, grid, camera)).astype(np.uint8)
        with atomic_write(folder / name) as stream:
            Image.fromarray(pixels).save(stream, "JPEG", quality=settings.photo_quality, subsampling=0)
    write_json(folder / "transforms.json", transforms(cameras, names, to_photo))


def _write_projections(
    phantom: Phantom, folder: Path, settings: CaptureSettings, rng: np.random.Generator, reporter: Reporter
) -> None:
    scan = scan_geometry(phantom, settings.detector_width, settings.detector_height)
    count = settings.projections
    training = np.arange(count) * 2 * np.pi / count
    testing = np.sort(rng.uniform(0, 2 * np.pi, settings.heldout_projections))
    angles = np.concatenate([training, testing])

    def step(done: int) -> None:
        reporter.update(Progress("phantom", "xray", 0.5 + 0.5 * done / len(angles), done, len(angles)))

    exact = project(phantom, scan.detectors(angles), settings.table_mm, step)
    images = count_photons(exact, settings.photons, rng)
    lists: dict[str, list[dict[str, object]]] = {"proj_train": [], "proj_test": []}
    for index, (image, angle) in enumerate(zip(images, angles, strict=True)):
        part, number = ("proj_train", index) if index < count else ("proj_test", index - count)
        name = f"{part}/{number:04d}.npy"
        with atomic_write(folder / name) as stream:
            np.save(stream, image.astype(np.float16))
        lists[part].append({"file_path": name, "angle": float(angle)})
    write_json(folder / "meta_data.json", {**_scanner(phantom, scan, settings), **lists})


def _scanner(phantom: Phantom, scan: CircularScan, settings: CaptureSettings) -> dict[str, object]:
    voxels = _voxels(phantom, settings.voxel_mm)
    size = [n * settings.voxel_mm for n in voxels]
    scanner = {
        "mode": "cone",
        "DSD": scan.source_to_detector_mm,
        "DSO": scan.source_to_axis_mm,
        "nDetector": [scan.height, scan.width],
        "sDetector": [scan.height * scan.pixel_mm[1], scan.width * scan.pixel_mm[0]],
        "nVoxel": list(voxels),
        "sVoxel": size,
        "offOrigin": [0, 0, 0],
        "offDetector": [0, 0],
        "accuracy": 0.5,
        "totalAngle": 360.0,
        "startAngle": 0.0,
        "noise": True,
        "filter": None,
        "photons": settings.photons,
    }
    return {"scanner": scanner, "bbox": [[-0.5 * s for s in size], [0.5 * s for s in size]]}


def _voxels(phantom: Phantom, voxel_mm: float) -> tuple[int, int, int]:
    nx, ny, nz = (int(np.ceil(size / voxel_mm)) + 1 for size in phantom.size_mm)
    return nx, ny, nz


def _write_truth(phantom: Phantom, path: Path, voxel_mm: float, to_world: Similarity) -> None:
    volume = truth_volume(phantom, voxel_mm)
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        volume=volume.values.astype(np.float16),
        spacing_mm_zyx=volume.spacing_mm[::-1],
        origin_mm_zyx=volume.origin_mm[::-1],
        **to_world.to_json(),
    )
    with atomic_write(path) as stream:
        stream.write(buffer.getvalue())
