"""Writes a synthetic capture folder: photos, projections in R²-Gaussian's layout, landmarks, and the truth."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from ..errors import SettingError
from ..files import atomic_folder, atomic_write, check_new, write_json
from ..progress import Progress, Reporter
from ..similarity import Similarity
from .matryoshka import matryoshka
from .model import Phantom
from .part_tables import PartTables
from .pharaoh import pharaoh
from .scanner import field_of_view, voxels, write_fdk, write_projections
from .settings import CaptureSettings
from .shots import Shot, plan_shots, shot_truth, transforms
from .skull import skull
from .studio import blender_command, take_photos
from .terracotta import terracotta
from .toy_gun import toy_gun
from .truth import Truth, truth_surfaces, truth_volume, write_truth

PHANTOMS: dict[str, Callable[[], Phantom]] = {
    "matryoshka": matryoshka,
    "pharaoh": pharaoh,
    "terracotta": terracotta,
    "skull": skull,
    "toy_gun": toy_gun,
}

_MM_PER_PHOTO_UNIT = 60.0
DETECTOR_SHARE = 148 / 256
"""Pixels of the detector's longer side over those of a photo's."""
_MOST_VOXELS = 1000**3


def make_capture(
    name: str,
    folder: Path,
    settings: CaptureSettings | None = None,
    seed: int = 0,
    reporter: Reporter | None = None,
) -> Path:
    """Makes the capture folder of a phantom.

    Writes photos/ with transforms.json (in an arbitrary similarity of the X-ray frame), xray/ with meta_data.json
    and float16 line integrals, landmarks.json if it is to be there, and truth.npz, which no stage reads but
    `read_truth`:

    - `volume`, `spacing_mm_zyx`, `origin_mm_zyx`: attenuation in mm⁻¹ at the phantom's photon energy;
    - `scale`, `rotation`, `translation`: x_mm = scale · R · x_photo + t;
    - `outer_vertices`, `outer_faces`, `inner_vertices`, `inner_faces`: surfaces in mm, see `Truth`;
    - `effects`, and with them `aperture_mm`, `focus_mm`, `shutter_poses`, `exposure_gain`, see `Truth`, and
      `scan_offset_px` and others of `ScanFlaws`.

    With the setting `fdk` there is fdk.npz, too, a `Volume` on the grid of the truth, which no stage reads either.

    Args:
        name: a key of `PHANTOMS`.
        folder: must be missing or empty.

    Returns:
        The folder.

    Raises:
        SettingError: an unknown name, a folder with something in it, or a setting out of range.
        DiskFullError, RunFolderError: the folder cannot be written.
        Cancelled: through `reporter`. As after any error, nothing is left of the capture.
    """
    settings, reporter, folder = settings or CaptureSettings(), reporter or Reporter(), Path(folder)
    check_new(folder)
    settings.check()
    phantom = _phantom(name, settings)
    _check_spacings(phantom, settings)
    if settings.photos_by == "cycles":
        blender_command()
    with atomic_folder(folder) as unfinished:
        _make(phantom, unfinished, settings, seed, reporter)
    reporter.update(Progress("phantom", fraction=1.0, message=f"{folder} is ready"))
    return folder


def _make(phantom: Phantom, folder: Path, settings: CaptureSettings, seed: int, reporter: Reporter) -> None:
    rng = np.random.default_rng(seed)
    to_world = _random_similarity(rng)
    shots = plan_shots(max(phantom.size_mm), settings, rng)
    # Closed, Blender is ended too, whatever went wrong between two photos.
    with closing(take_photos(phantom, shots, settings, seed, reporter)) as photos:
        _write_photos(folder / "photos", photos, shots, settings.photo_quality, to_world.inverse(), reporter)
    tables = PartTables.bake(phantom, settings.table_mm, lambda done: reporter.check())
    flaws = write_projections(phantom, tables, folder / "xray", settings, rng, reporter.within(0.6, 0.95))
    if phantom.of_revolution if settings.landmarks is None else settings.landmarks:
        marks = phantom.landmarks
        content = {"photo": to_world.inverse().apply(marks).tolist(), "xray": marks.tolist()}
        write_json(folder / "landmarks.json", content)
    reporter.update(Progress("phantom", "truth", 0.95))
    outer, inner = truth_surfaces(phantom, tables, settings.surface_mm)
    reporter.check()
    volume = truth_volume(phantom, tables, settings.voxel_mm)
    hidden = {**shot_truth(shots, to_world.inverse()), "scan": flaws.truth()}
    write_truth(folder / "truth.npz", Truth(volume, to_world, outer, inner, settings.effects, **hidden))
    if settings.fdk:
        write_fdk(folder, reporter.within(0.96, 1.0))


def sized(name: str, size: int, settings: CaptureSettings) -> CaptureSettings:
    """`settings` with photos of `size` pixels along the longer side, and a detector of 58 % as many along its own.

    Upright objects get photos of 3 : 4, others square ones; the detector has the shape of what it must see.

    Raises:
        SettingError: an unknown name, a size under 16, or a setting out of range.
    """
    if size < 16:
        raise SettingError(f"size is {size}; give at least 16 pixels.")
    settings.check()
    phantom = _phantom(name, settings)
    upright = phantom.size_mm[2] >= 1.25 * max(phantom.size_mm[:2])
    wide, high = field_of_view(phantom)
    unit = DETECTOR_SHARE * size / max(wide, high)
    return replace(
        settings,
        photo_width=round(0.75 * size) if upright else size,
        photo_height=size,
        detector_width=max(4 * int(unit * wide / 4), 4),
        detector_height=max(4 * int(unit * high / 4), 4),
    )


def _phantom(name: str, settings: CaptureSettings) -> Phantom:
    if name not in PHANTOMS:
        known = ", ".join(sorted(PHANTOMS))
        raise SettingError(
            f"phantom '{name}' is not known, and there is no such file; choose one of: {known}; or the file of a CT "
            "volume."
        )
    if settings.shells is None:
        return PHANTOMS[name]()
    if name != "matryoshka":
        raise SettingError(f"shells is for the matryoshka; leave it out for {name}.")
    return matryoshka(settings.shells)


def _check_spacings(phantom: Phantom, settings: CaptureSettings) -> None:
    widest = min(phantom.size_mm) / 4
    for field in ("voxel_mm", "surface_mm"):
        if getattr(settings, field) > widest:
            raise SettingError(f"{field} is {getattr(settings, field):g}; give {widest:g} or less for {phantom.name}.")
    grid = voxels(phantom, settings.voxel_mm)
    if math.prod(grid) > _MOST_VOXELS:
        counts = " x ".join(map(str, grid))
        raise SettingError(f"voxel_mm is {settings.voxel_mm:g}, which makes {counts} voxels; give more.")


def _random_similarity(rng: np.random.Generator) -> Similarity:
    """Photo frame -> world: any rotation, about 60 mm a unit, some way off."""
    matrix, triangle = np.linalg.qr(rng.standard_normal((3, 3)))
    rotation = matrix * np.sign(np.diag(triangle))
    if np.linalg.det(rotation) < 0:
        rotation[:, 0] *= -1
    scale = _MM_PER_PHOTO_UNIT * float(rng.uniform(0.85, 1.15))
    return Similarity(scale, rotation, rng.uniform(-40, 40, 3))


def _write_photos(
    folder: Path,
    photos: Generator[np.ndarray],
    shots: list[Shot],
    quality: int,
    to_photo: Similarity,
    reporter: Reporter,
) -> None:
    names = [f"{index:03d}.jpg" for index in range(len(shots))]
    for index, name in enumerate(names):
        reporter.update(Progress("phantom", "photos", 0.6 * index / len(shots), index, len(shots)))
        pixels = next(photos)
        with atomic_write(folder / name) as stream:
            Image.fromarray(pixels).save(stream, "JPEG", quality=quality, subsampling=0)
    write_json(folder / "transforms.json", transforms([shot.camera for shot in shots], names, to_photo))
