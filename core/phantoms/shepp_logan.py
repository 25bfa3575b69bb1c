"""The Shepp-Logan head in three dimensions and its projections, exact: what tomography has always been measured on.

Ten ellipsoids after Kak and Slaney, Principles of Computerized Tomographic Imaging (1988), table 3.1, the ones that
ITK-RTK's `rtkdrawshepploganphantom` draws: skull 2, brain 1.02, details that differ by 0.01 to 0.04.

The protocol whose figures are quoted: `--phantomscale 110`, 128³ voxels of 2 mm, 256² pixels of 1.6 mm, source 1000 mm
from the axis and 1536 mm from the detector, 75 noise-free projections over 360°. PSNR is over all voxels, against the
phantom at voxel centres, with the skull as full scale. ITK-RTK scores 24.0 dB with FDK, 25.2 dB under a Hann window,
and 26.8 dB with three iterations of SART at its own relaxation of 0.3 and positivity.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..capture.detectors import CircularScan
from ..capture.model import Projections
from ..errors import SettingError
from ..evaluate.metrics import psnr
from ..files import atomic_folder, check_new
from ..progress import Progress, Reporter
from ..views import Detector
from ..volume import Volume
from .scanner import scan_file, write_fdk, write_scan
from .truth import Surface, Truth, joined, write_truth

UNIT_PER_MM = 0.02
"""mm⁻¹ of the table's value 1: brain is like water at about 60 keV, and no ray loses more than e⁻⁴·³."""

PEAK_PER_MM = 2 * UNIT_PER_MM
"""mm⁻¹ of the skull, the largest value and full scale of `volume_psnr`."""

_UNIT_MM = 110.0
_SOURCE_TO_AXIS_MM, _SOURCE_TO_DETECTOR_MM = 1000.0, 1536.0
_DETECTOR_MM, _BOX_MM = 409.6, 256.0
# An edge of a subdivided icosahedron in the unit ball is about as long, halved by each subdivision.
_ICOSAHEDRON_EDGE, _SURFACE_OFF_MM = 1.2, 0.01
# Semi axes and centre in units of `_UNIT_MM`, turn about z in degrees, value added.
_TABLE = (
    ((0.69, 0.92, 0.9), (0.0, 0.0, 0.0), 0.0, 2.0),
    ((0.6624, 0.874, 0.88), (0.0, 0.0, 0.0), 0.0, -0.98),
    ((0.41, 0.16, 0.21), (-0.22, 0.0, -0.25), 108.0, -0.02),
    ((0.31, 0.11, 0.22), (0.22, 0.0, -0.25), 72.0, -0.02),
    ((0.21, 0.25, 0.5), (0.0, 0.35, -0.25), 0.0, 0.02),
    ((0.046, 0.046, 0.046), (0.0, 0.1, -0.25), 0.0, 0.02),
    ((0.046, 0.023, 0.02), (-0.08, -0.65, -0.25), 0.0, 0.01),
    ((0.046, 0.023, 0.02), (0.06, -0.65, -0.25), 90.0, 0.01),
    ((0.056, 0.04, 0.1), (0.06, -0.105, 0.625), 90.0, 0.02),
    ((0.056, 0.056, 0.1), (0.0, 0.1, 0.625), 0.0, -0.02),
)


@dataclass(frozen=True)
class SheppLoganScan:
    """How the head is scanned: cone beam, source 1000 mm from the axis and 1536 mm from the detector.

    Attributes:
        angles: projections for training, evenly over the full circle from angle 0.
        heldout: projections at random angles, for measuring only.
        detector: pixels a side, over 409.6 mm.
        voxels: a side, over 256 mm.
        seed: of the held-out angles.
    """

    angles: int = 75
    heldout: int = 6
    detector: int = 256
    voxels: int = 128
    seed: int = 0


def make_shepp_logan(
    folder: Path,
    angles: int = 75,
    scan: SheppLoganScan | None = None,
    reporter: Reporter | None = None,
    with_fdk: bool = False,
) -> Path:
    """Writes the head as a capture without photos.

    xray/ with meta_data.json and float32 line integrals without noise (R2-Gaussian's layout), and truth.npz
    (`volume`, `spacing_mm_zyx`, `origin_mm_zyx`, `at_centers`, `outer_vertices`, `outer_faces`, `inner_vertices`,
    `inner_faces`), which no stage reads.

    Args:
        folder: must be missing or empty.
        angles: projections for training, when `scan` is not given.
        with_fdk: write fdk.npz, too: what the usual CT reconstruction makes of the training projections.

    Returns:
        The folder.

    Raises:
        SettingError: a folder with something in it, or a setting out of range.
        CaptureError: fewer than two projections, with `with_fdk`.
        DiskFullError, RunFolderError: the folder cannot be written.
        Cancelled: through `reporter`. As after any error, nothing is left of the capture.
    """
    folder, reporter, scan = Path(folder), reporter or Reporter(), scan or SheppLoganScan(angles=angles)
    check_new(folder)
    share = 0.5 if with_fdk else 1.0

    def step(done: int) -> None:
        count = scan.angles + scan.heldout
        reporter.update(Progress("phantom", "xray", share * done / (count + 1), done, count))

    projections = shepp_logan_projections(scan, step)
    with atomic_folder(folder) as unfinished:
        _write(unfinished, scan, projections)
        if with_fdk:
            write_fdk(unfinished, reporter.within(share, 1.0))
    reporter.update(Progress("phantom", fraction=1.0, message=f"{folder} is ready"))
    return folder


def _write(folder: Path, scan: SheppLoganScan, projections: Projections) -> None:
    content = scan_file(_scanner(scan), (scan.voxels,) * 3, (_BOX_MM / scan.voxels,) * 3, noise=False)
    write_scan(folder / "xray", content, projections.images, projections.angles_rad, scan.angles)
    outer, inner = shepp_logan_surfaces()
    truth = Truth(shepp_logan_volume(scan.voxels), None, outer, inner, at_centers=True)
    write_truth(folder / "truth.npz", truth)


def shepp_logan_volume(voxels: int = 128) -> Volume:
    """The head's attenuation at the centres of `voxels`³ voxels that fill 256 mm a side."""
    spacing = _BOX_MM / voxels
    axis = (np.arange(voxels) + 0.5) * spacing - 0.5 * _BOX_MM
    values = np.zeros((voxels, voxels, voxels), np.float32)
    for layer, z in zip(values, axis, strict=True):
        points = np.stack(np.broadcast_arrays(axis[None, :], axis[:, None], z), axis=-1)
        layer[:] = sum(part.value * part.holds(points) for part in _ellipsoids())
    return Volume.centered(values, np.full(3, spacing))


def shepp_logan_surfaces() -> tuple[Surface, Surface]:
    """The head's outer surface, and those of its other nine ellipsoids: all places inside where its value changes.

    Corners lie on the ellipsoids, edges up to 0.01 mm inside.
    """
    skull, *others = (part.surface() for part in _ellipsoids())
    return skull, joined(others)


def shepp_logan_projections(
    scan: SheppLoganScan | None = None, step: Callable[[int], None] | None = None
) -> Projections:
    """The head's exact line integrals through pixel centres, without noise.

    Args:
        step: called with the number of projections done so far; may raise to stop.

    Raises:
        SettingError: a count of `scan` that is too small.
    """
    scan = scan or SheppLoganScan()
    _check(scan)
    rng = np.random.default_rng([scan.seed, 19])
    angles = np.concatenate(
        [np.arange(scan.angles) * 2 * np.pi / scan.angles, np.sort(rng.uniform(0, 2 * np.pi, scan.heldout))]
    )
    images = np.zeros((len(angles), scan.detector, scan.detector), np.float32)
    detectors = _scanner(scan).detectors(angles)
    for index, detector in enumerate(detectors):
        images[index] = head_projection(detector)
        if step is not None:
            step(index + 1)
    return Projections(
        images=images,
        detectors=detectors,
        held_out=np.arange(len(angles)) >= scan.angles,
        angles_rad=angles,
        box_mm=0.5 * _BOX_MM * np.array([[-1.0] * 3, [1.0] * 3]),
        voxels=(scan.voxels,) * 3,
        source_to_axis_mm=_SOURCE_TO_AXIS_MM,
        source_to_detector_mm=_SOURCE_TO_DETECTOR_MM,
    )


def head_projection(detector: Detector) -> np.ndarray:
    """(height, width) float32 exact line integrals of the head, no unit."""
    origins, directions = detector.rays()
    total = np.zeros(origins.shape[:-1])
    for part in _ellipsoids():
        total += part.value * part.chords(origins, directions)
    return total.astype(np.float32)


def volume_psnr(volume: Volume) -> float:
    """The protocol's PSNR in dB of a reconstruction of the head: all voxels, full scale the skull's attenuation.

    Raises:
        ValueError: the volume is not a cube of 256 mm about the origin.
    """
    truth = shepp_logan_volume(volume.values.shape[0])
    if volume.values.shape != truth.values.shape or not np.allclose(volume.box_mm, truth.box_mm, atol=1e-3):
        raise ValueError("volume_psnr: the head lies in a cube of 256 mm about the origin")
    return psnr(volume.values, truth.values, PEAK_PER_MM)


@dataclass(frozen=True, eq=False)
class _Ellipsoid:
    """Centre (3,) in mm, the matrix (3, 3) from mm to its unit ball, what it adds in mm⁻¹."""

    center: np.ndarray
    to_ball: np.ndarray
    value: float

    def holds(self, points: np.ndarray) -> np.ndarray:
        """(...,) bool of points (..., 3)."""
        return (((points - self.center) @ self.to_ball.T) ** 2).sum(axis=-1) <= 1

    def chords(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """(...,) mm that whole lines with unit directions (..., 3) run inside."""
        start, along = (origins - self.center) @ self.to_ball.T, directions @ self.to_ball.T
        square, mixed = (along**2).sum(axis=-1), (start * along).sum(axis=-1)
        return 2 * np.sqrt(np.maximum(mixed**2 - square * ((start**2).sum(axis=-1) - 1), 0)) / square

    def surface(self) -> Surface:
        """Its triangles, edges up to `_SURFACE_OFF_MM` inside of it."""
        import trimesh

        from_ball = np.linalg.inv(self.to_ball)
        longest = float(np.linalg.norm(from_ball, axis=0).max())
        halvings = np.log2(_ICOSAHEDRON_EDGE * np.sqrt(longest / (8 * _SURFACE_OFF_MM)))
        ball = trimesh.creation.icosphere(max(math.ceil(halvings), 0))
        corners = np.asarray(ball.vertices) @ from_ball.T + self.center
        return Surface(corners.astype(np.float32), np.asarray(ball.faces, np.int32))


def _ellipsoids() -> list[_Ellipsoid]:
    found = []
    for semi_axes, center, turn_deg, value in _TABLE:
        cos, sin = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
        unturn = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
        to_ball = unturn / (_UNIT_MM * np.array(semi_axes))[:, None]
        found.append(_Ellipsoid(_UNIT_MM * np.array(center), to_ball, UNIT_PER_MM * value))
    return found


def _check(scan: SheppLoganScan) -> None:
    for name, least in (("angles", 1), ("heldout", 0), ("detector", 1), ("voxels", 1)):
        if getattr(scan, name) < least:
            raise SettingError(f"{name} is {getattr(scan, name)}; give {least} or more.")


def _scanner(scan: SheppLoganScan) -> CircularScan:
    pitch = _DETECTOR_MM / scan.detector
    return CircularScan(scan.detector, scan.detector, (pitch, pitch), _SOURCE_TO_AXIS_MM, _SOURCE_TO_DETECTOR_MM)
