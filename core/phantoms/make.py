"""Writes a synthetic capture folder: photos, projections in R²-Gaussian's layout, landmarks, and the truth."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

from ..errors import SettingError
from ..files import atomic_write, write_json
from ..progress import Progress, Reporter
from ..similarity import Similarity
from .distance_grid import DistanceGrid
from .matryoshka import matryoshka
from .model import Phantom
from .part_tables import PartTables
from .photos import camera_ring, render_photo, transforms
from .scanner import write_projections
from .settings import CaptureSettings
from .truth import write_truth

PHANTOMS: dict[str, Callable[[], Phantom]] = {"matryoshka": matryoshka}

_MM_PER_PHOTO_UNIT = 60.0


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
    tables = PartTables.bake(phantom, settings.table_mm, lambda done: reporter.check())
    write_projections(phantom, tables, folder / "xray", settings, rng, reporter.within(0.5, 0.97))
    landmarks = phantom.landmarks
    write_json(
        folder / "landmarks.json",
        {"photo": to_world.inverse().apply(landmarks).tolist(), "xray": landmarks.tolist()},
    )
    write_truth(phantom, tables, folder / "truth.npz", settings.voxel_mm, to_world)
    reporter.update(Progress("phantom", fraction=1.0, message=f"{folder} is ready"))
    return folder


def _check(name: str, folder: Path, settings: CaptureSettings) -> None:
    if name not in PHANTOMS:
        raise SettingError(f"phantom '{name}' is not known; choose one of: {', '.join(sorted(PHANTOMS))}.")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise SettingError(f"{folder}: is not empty; choose another --out, nothing was changed.")
    settings.check()


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
