"""A CT volume of the user's own as an object whose inside is known: X-rayed anew, with few projections.

What a full scan shows stands for the object. Its projections are exact line integrals of the volume as scanned; the
truth is that volume, averaged over blocks of voxels where it is finer than few projections can tell.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..capture.detectors import CircularScan
from ..capture.volumes import read_volume
from ..errors import SettingError
from ..files import atomic_folder
from ..progress import Progress, Reporter
from ..volume import Volume
from .projections import count_photons
from .scanner import scan_file, write_scan
from .settings import check_new
from .truth import Truth, write_truth

_MAGNIFICATION, _AWAY = 1.5, 4.0


@dataclass(frozen=True)
class ScanSettings:
    """How a volume is X-rayed: cone beam, magnification 1.5, angles over the full circle.

    Attributes:
        angles: projections for training, evenly from angle 0.
        heldout: projections at random angles, for measuring only.
        size: pixels of the detector's longer side; it sees the whole volume at every angle.
        voxels: at most so many of the truth along each side.
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
        for name, least in (("angles", 1), ("heldout", 0), ("size", 4), ("voxels", 4), ("seed", 0)):
            if getattr(self, name) < least:
                raise SettingError(f"{name} is {getattr(self, name)}; give {least} or more.")
        if not 0 < self.photons < np.inf:
            raise SettingError(f"photons is {self.photons}; give a number above zero.")


def make_scanned(
    source: Path, folder: Path, settings: ScanSettings | None = None, reporter: Reporter | None = None
) -> Path:
    """Writes a capture of X-rays alone from a volume: xray/ in R²-Gaussian's layout, and truth.npz.

    Args:
        source: any volume that a capture may hold (.nii.gz, .mha, .nrrd, .npz, .tif, a folder of DICOM slices), in
            Hounsfield units, mm⁻¹ or grey values; what lies under air counts as air.
        folder: must be missing or empty.

    Returns:
        The folder.

    Raises:
        CaptureError: the volume cannot be read, or has no voxel size.
        SettingError: a folder with something in it, a setting out of range, or a volume without anything in it.
        DiskFullError, RunFolderError: the folder cannot be written.
        Cancelled: through `reporter`. As after any error, nothing is left of the capture.
    """
    source, folder, settings = Path(source), Path(folder), settings or ScanSettings()
    reporter = reporter or Reporter()
    check_new(folder)
    settings.check()
    reporter.update(Progress("phantom", message=f"reading {source}"))
    read = read_volume(source).volume
    # Whole blocks of what the truth averages, so that both have the same middle.
    blocks = [-(-count // settings.voxels) for count in read.values.shape]
    whole = tuple(slice(count // block * block) for count, block in zip(read.values.shape, blocks, strict=True))
    volume = Volume.centered(np.maximum(read.values[whole], 0.0), read.spacing_mm)
    scan = scan_of(volume, settings.size)
    rng = np.random.default_rng(settings.seed)
    angles = np.concatenate(
        [
            np.arange(settings.angles) * 2 * np.pi / settings.angles,
            np.sort(rng.uniform(0, 2 * np.pi, settings.heldout)),
        ]
    )
    images = _projected(volume, scan, angles, reporter)
    if not images.any():
        raise SettingError(f"{source}: has no attenuation above that of air; give the volume of an object.")
    if settings.noise:
        images = count_photons(images, settings.photons, rng)
    truth = volume.averaged(settings.voxels)
    grid, spacing = truth.values.shape[::-1], truth.spacing_mm.tolist()
    more = {"photons": settings.photons} if settings.noise else {}
    content = scan_file(scan, grid, spacing, settings.noise, object=source.name, **more)
    with atomic_folder(folder) as unfinished:
        write_scan(unfinished / "xray", content, images.astype(np.float32), angles, settings.angles)
        write_truth(unfinished / "truth.npz", Truth(truth, None, effects=("noise",) if settings.noise else ()))
    reporter.update(Progress("phantom", fraction=1.0, message=f"{folder} is ready"))
    return folder


def scan_of(volume: Volume, size: int) -> CircularScan:
    """A scanner that sees all of a volume about the origin at every angle, with square pixels."""
    low, high = volume.box_mm
    extent = high - low
    to_axis, radius = _AWAY * float(extent.max()), 0.5 * float(np.hypot(extent[0], extent[1]))
    wide = 2 * _MAGNIFICATION * to_axis * radius / np.sqrt(to_axis**2 - radius**2)
    tall = _MAGNIFICATION * to_axis * float(extent[2]) / (to_axis - radius)
    pitch = max(wide, tall) / size
    width, height = (max(int(np.ceil(side / pitch - 1e-9)), 1) for side in (wide, tall))
    return CircularScan(width, height, (pitch, pitch), to_axis, _MAGNIFICATION * to_axis)


def _projected(volume: Volume, scan: CircularScan, angles: np.ndarray, reporter: Reporter) -> np.ndarray:
    from ..forward_projection import forward_project

    def step(done: int) -> None:
        reporter.update(Progress("phantom", "xray", done / (len(angles) + 1), done, len(angles)))

    step(0)
    return forward_project(volume, scan.detectors(angles), step)
