"""What a scanner does that the files about it do not say: where it stands, how wide its spot is, how its pixels answer.

Line integrals are taken along the true rays; `meta_data.json` describes the scanner as it was meant to be.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from ..capture.detectors import CircularScan
from ..views import Detector
from .part_tables import PartTables
from .projections import path_lengths, project
from .settings import CaptureSettings
from .spectrum import Spectrum

# Where an object that settles gives way, as a share of the turn, and how much of its way it goes then.
_JUMP_AT, _JUMP = 0.6, 0.4
# Points of a focal spot: one, and rings of six and twelve.
_SPOT_RINGS = ((1, 0.0), (6, 1.0), (12, 2.0))


@dataclass(frozen=True, eq=False)
class ScanFlaws:
    """What is true of a scan of M projections and is not in its files; None where it is as it should be.

    Attributes:
        offset_px: (2,) how far the detector stands to the right and down, in its pixels.
        tilt_rad: how far it is turned in its own plane, from its rows towards its columns.
        jitter_px: (M, 2) as `offset_px`, of each projection beside that.
        drift_mm: (M, 3) how far the object is from where it should be, in the world frame; over the training
            projections 0 on average.
        turn_rad: (M, 3) rotation vectors about the origin, before that; as much on average.
        spot_mm: diameter of the focal spot; 0 for a point.
        log_gain: (height, width) natural logarithm of what a pixel says over what it should.
    """

    offset_px: np.ndarray | None = None
    tilt_rad: float = 0.0
    jitter_px: np.ndarray | None = None
    drift_mm: np.ndarray | None = None
    turn_rad: np.ndarray | None = None
    spot_mm: float = 0.0
    log_gain: np.ndarray | None = None

    def truth(self) -> dict[str, np.ndarray]:
        """What there is of it, for truth.npz."""
        numbers = {"tilt_rad": self.tilt_rad, "spot_mm": self.spot_mm}
        arrays = {name: getattr(self, name) for name in ("offset_px", "jitter_px", "drift_mm", "turn_rad", "log_gain")}
        found = {name: np.asarray(value) for name, value in numbers.items() if value}
        return found | {name: value for name, value in arrays.items() if value is not None}


def plan_flaws(
    settings: CaptureSettings, scan: CircularScan, angles_rad: np.ndarray, rng: np.random.Generator
) -> ScanFlaws:
    """The flaws that `settings.effects` names.

    Args:
        angles_rad: (M,) of all projections; the scan goes round once, so that they tell the time, too.
        rng: a child of it is asked, so that what else is left to chance is the same with flaws and without.
    """
    rng = rng.spawn(1)[0]
    flaws, chosen, count = ScanFlaws(), settings.effects, len(angles_rad)
    if "geometry" in chosen:
        flaws = replace(
            flaws,
            offset_px=np.array(settings.offset_px, np.float64),
            tilt_rad=float(np.radians(settings.tilt_degrees)),
            jitter_px=settings.jitter_px * rng.standard_normal((count, 2)),
        )
    if "motion" in chosen:
        drift, turn = _motion(settings, scan, angles_rad, rng)
        flaws = replace(flaws, drift_mm=drift, turn_rad=turn)
    if "focal_spot" in chosen:
        # The spot is seen (DSD - DSO) / DSO times as large; the deviation of a disc is a quarter of its diameter.
        shown = scan.source_to_detector_mm / scan.source_to_axis_mm - 1.0
        flaws = replace(flaws, spot_mm=4.0 * settings.spot_px * scan.pixel_mm[0] / shown)
    if "ring" in chosen:
        # A pixel that answers with a hundredth of what it should is a dead one, which scanners leave out.
        gains = np.maximum(1.0 + settings.ring_share * rng.standard_normal((scan.height, scan.width)), 0.01)
        flaws = replace(flaws, log_gain=np.log(gains))
    return flaws


def true_detectors(scan: CircularScan, angles_rad: np.ndarray, flaws: ScanFlaws) -> list[Detector]:
    """Where source and detector really were, seen from the object."""
    detectors = scan.detectors(angles_rad)
    return [_moved(detector, flaws, index) for index, detector in enumerate(detectors)]


def seen_columns(width: int, settings: CaptureSettings) -> int:
    """Pixels of a detector's rows: fewer where it is too narrow for the object."""
    return max(round(settings.seen_share * width), 1) if "truncation" in settings.effects else width


def project_truly(
    tables: PartTables,
    detectors: Sequence[Detector],
    spectrum: Spectrum,
    flaws: ScanFlaws,
    step: Callable[[int], None] | None = None,
) -> np.ndarray:
    """As `projections.project`, from a focal spot as wide as it is: the mean of what arrives from its points."""
    if flaws.spot_mm == 0:
        return project(tables, detectors, spectrum, step)
    images = np.zeros((len(detectors), detectors[0].height, detectors[0].width), np.float32)
    for index, detector in enumerate(detectors):
        sources = _spot(detector, flaws.spot_mm)
        arrives = np.zeros(images.shape[1:])
        for source in sources:
            lengths = path_lengths(tables, replace(detector, source=source))
            arrives += np.exp(-spectrum.line_integrals(tables.materials, lengths)) / len(sources)
        images[index] = -np.log(arrives)
        if step is not None:
            step(index + 1)
    return images


def _moved(detector: Detector, flaws: ScanFlaws, index: int) -> Detector:
    source, center, u, v = (np.asarray(part) for part in (detector.source, detector.center, detector.u, detector.v))
    for shift in (flaws.offset_px, None if flaws.jitter_px is None else flaws.jitter_px[index]):
        if shift is not None:
            center = center + shift[0] * np.asarray(detector.u) + shift[1] * np.asarray(detector.v)
    if flaws.tilt_rad:
        cos, sin, shape = np.cos(flaws.tilt_rad), np.sin(flaws.tilt_rad), np.linalg.norm(u) / np.linalg.norm(v)
        u, v = cos * u + sin * shape * v, cos * v - sin / shape * u
    stands = replace(detector, source=source, center=center, u=u, v=v)
    if flaws.drift_mm is None or flaws.turn_rad is None:
        return stands
    turn = Rotation.from_rotvec(flaws.turn_rad[index]).as_matrix()
    return stands.moved(turn, flaws.drift_mm[index], np.zeros(3))


def _motion(
    settings: CaptureSettings, scan: CircularScan, angles_rad: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """(M, 3) mm and (M, 3) rad: it slides and tips slowly, and gives way once; from beginning to end it goes
    `drift_px`, and what is at the rim of the field of view turns as far."""
    shown = scan.source_to_detector_mm / scan.source_to_axis_mm
    far = settings.drift_px * scan.pixel_mm[0] / shown
    rim = 0.5 * scan.width * scan.pixel_mm[0] / shown
    way, axis = (each / np.linalg.norm(each) for each in rng.standard_normal((2, 3)))
    time = np.mod(angles_rad, 2 * np.pi) / (2 * np.pi)
    slow = 0.5 - 0.5 * np.cos(np.pi * time)
    share: np.ndarray = (1 - _JUMP) * slow + _JUMP * (time > _JUMP_AT)
    # Where it was on average is where it is said to be.
    share -= share[: settings.projections].mean()
    return share[:, None] * far * way, share[:, None] * (far / rim) * axis


def _spot(detector: Detector, diameter_mm: float) -> list[np.ndarray]:
    """Points (3,) of the focal spot, in rings, with the deviation of a disc."""
    source = np.asarray(detector.source, np.float64)
    across, down = (np.asarray(part) / np.linalg.norm(part) for part in (detector.u, detector.v))
    places = [
        ring * np.array([np.cos(turn), np.sin(turn)])
        for count, ring in _SPOT_RINGS
        for turn in 2 * np.pi * np.arange(count) / count
    ]
    # A disc's deviation along an axis is a quarter of its diameter.
    step = 0.25 * diameter_mm / np.std(places, axis=0)[0]
    return [source + step * (x * across + y * down) for x, y in places]
