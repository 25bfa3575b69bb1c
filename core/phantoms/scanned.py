"""A CT volume of the user's own as an object whose inside is known: X-rayed anew, with few projections.

What a full scan shows, linear between voxel centres, stands for the object. The truth is what voxels hold of that on
average, blocks of voxels where the scan is finer than few projections can tell.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import ndimage

from ..capture.detectors import CircularScan
from ..capture.model import Finding
from ..capture.volumes import find_volume, read_volume
from ..errors import CaptureError, SettingError
from ..files import atomic_folder, check_new
from ..progress import Progress, Reporter
from ..volume import Volume
from .projections import count_photons
from .scanner import scan_file, write_scan
from .truth import Truth, write_truth

_MAGNIFICATION, _AWAY = 1.5, 4.0
_LEAST_PIXELS = 8


@dataclass(frozen=True)
class ScanSettings:
    """How a volume is X-rayed: cone beam, magnification 1.5, angles over the full circle.

    Attributes:
        angles: projections for training, evenly from angle 0.
        heldout: projections at random angles, for measuring only.
        size: pixels of the detector's longer side; it sees the whole volume at every angle.
        voxels: about so many of the truth along each side, of a volume that has more.
        noise: counting noise of `photons` a detector pixel.
        photons: mean count in air.
        seed: of noise and held-out angles.
    """

    angles: int = 75
    heldout: int = 9
    size: int = 148
    voxels: int = 128
    noise: bool = True
    photons: float = 50_000.0
    seed: int = 0

    def check(self) -> None:
        """Raises SettingError, which names the first setting that is out of range."""
        for name, least in (("angles", 1), ("heldout", 0), ("size", _LEAST_PIXELS), ("voxels", 4), ("seed", 0)):
            if getattr(self, name) < least:
                raise SettingError(f"{name} is {getattr(self, name)}; give {least} or more.")
        if not 0 < self.photons < np.inf:
            raise SettingError(f"photons is {self.photons}; give a number above zero.")


def make_scanned(
    source: Path, folder: Path, settings: ScanSettings | None = None, reporter: Reporter | None = None
) -> list[Finding]:
    """Writes a capture of X-rays alone from a volume: xray/ in R²-Gaussian's layout, and truth.npz.

    Args:
        source: any volume that a capture may hold (.nii.gz, .mha, .nrrd, .npz, .npy, .tif, a folder of DICOM slices),
            in Hounsfield units, mm⁻¹ or grey values, or a folder with one; what lies under air counts as air.
        folder: must be missing or empty.

    Returns:
        What the volume's values were taken for, and what else there is to say about it.

    Raises:
        CaptureError: the volume cannot be read, has no voxel size, or does not fit into memory.
        SettingError: a folder with something in it, a setting out of range, a volume without anything in it, or one
            that next to no photon would get through.
        DiskFullError, RunFolderError: the folder cannot be written.
        Cancelled: through `reporter`. As after any error, nothing is left of the capture.
    """
    source, folder, settings = Path(source), Path(folder), settings or ScanSettings()
    reporter = reporter or Reporter()
    check_new(folder)
    settings.check()
    reporter.update(Progress("phantom", message=f"reading {source}"))
    try:
        read = read_volume(_file_of(source))
        _make(read.volume, source, folder, settings, reporter)
    except MemoryError as error:
        raise CaptureError(f"{source}: does not fit into memory; average its voxels to fewer first.") from error
    reporter.update(Progress("phantom", fraction=1.0, message=f"{folder} is ready"))
    return [read.meaning, *read.findings]


def _file_of(source: Path) -> Path:
    """The volume itself where a folder that holds one is named."""
    if not source.is_dir():
        return source
    found = find_volume(source)
    if found is None:
        raise SettingError(f"{source}: holds no CT volume; name the file, or a folder of DICOM slices.")
    return found


def _make(scanned: Volume, source: Path, folder: Path, settings: ScanSettings, reporter: Reporter) -> None:
    volume, truth = _object_and_truth(scanned, settings.voxels)
    if not volume.values.any():
        raise SettingError(f"{source}: has no attenuation above that of air; give the volume of an object.")
    scan = scan_of(volume, settings.size)
    rng = np.random.default_rng(settings.seed)
    training = np.arange(settings.angles) * 2 * np.pi / settings.angles
    angles = np.concatenate([training, np.sort(rng.uniform(0, 2 * np.pi, settings.heldout))])
    images = _projected(volume, scan, angles, reporter)
    if settings.noise:
        most = float(images.max())
        if settings.photons * np.exp(-most) < 1:
            raise SettingError(
                f"{source}: on its densest path, of a line integral of {most:.1f}, no photon of {settings.photons:g} "
                "gets through; leave the noise out (--effects ''), or mend the volume's unit."
            )
        images = count_photons(images, settings.photons, rng)
    more = {"photons": settings.photons} if settings.noise else {}
    grid, spacing = truth.values.shape[::-1], truth.spacing_mm.tolist()
    content = scan_file(scan, grid, spacing, settings.noise, object=source.name, **more)
    with atomic_folder(folder) as unfinished:
        write_scan(unfinished / "xray", content, images.astype(np.float32), angles, settings.angles)
        write_truth(unfinished / "truth.npz", Truth(truth, None, effects=("noise",) if settings.noise else ()))


def _object_and_truth(scanned: Volume, voxels: int) -> tuple[Volume, Volume]:
    """What is projected and what is true of it, both about the origin."""
    sizes = [max(1, round(count / voxels)) for count in scanned.values.shape]
    # Whole blocks alone, so that both have the same middle.
    whole = tuple(slice(count // size * size) for count, size in zip(scanned.values.shape, sizes, strict=True))
    volume = Volume.centered(np.maximum(scanned.values[whole], 0.0), scanned.spacing_mm)
    means = volume.values
    for axis in range(3):
        # The mean over a voxel of what is linear between its centre and its neighbours'.
        means = ndimage.correlate1d(means, [1 / 8, 3 / 4, 1 / 8], axis, mode="constant")
    return volume, Volume(means, volume.spacing_mm, volume.origin_mm).blocks(sizes)


def scan_of(volume: Volume, size: int) -> CircularScan:
    """A scanner that sees all of a volume about the origin at every angle, with square pixels."""
    low, high = volume.box_mm
    extent = high - low
    to_axis, radius = _AWAY * float(extent.max()), 0.5 * float(np.hypot(extent[0], extent[1]))
    wide = 2 * _MAGNIFICATION * to_axis * radius / np.sqrt(to_axis**2 - radius**2)
    tall = _MAGNIFICATION * to_axis * float(extent[2]) / (to_axis - radius)
    pitch = max(wide, tall) / size
    width, height = (max(int(np.ceil(side / pitch - 1e-9)), _LEAST_PIXELS) for side in (wide, tall))
    return CircularScan(width, height, (pitch, pitch), to_axis, _MAGNIFICATION * to_axis)


def _projected(volume: Volume, scan: CircularScan, angles: np.ndarray, reporter: Reporter) -> np.ndarray:
    from ..forward_projection import forward_project

    def step(done: int) -> None:
        reporter.update(Progress("phantom", "xray", done / (len(angles) + 1), done, len(angles)))

    step(0)
    return forward_project(volume, scan.detectors(angles), step)
