"""What `insideout check` says about photos, projections, a volume and landmarks that could be read."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..densities import Densities
from ..told import Told
from ..volume import Volume
from .detectors import unseen_fraction
from .findings import info, joined, name_some, warning
from .model import Finding, Landmarks, Photos, Projections
from .photos import ImageFacts, image_facts

_FEW_PHOTOS = 8
_FEW_PROJECTIONS = 20
_SMALLEST_BOX_MM = 5.0
_LARGEST_VOXELS = 512**3
_EDGE_SHARE = 0.1
# Beyond it steps of float32 are a thousandth of how far the cameras are apart.
_FARTHEST_ORIGIN = 1e4

MOST_CUT_OFF = 0.05
"""Share of the projections in which the object may reach the detector's edge."""


def describe_photos(subject: Path, photos: Photos, poses: str) -> list[Finding]:
    """Counts, sizes, poses and what EXIF says.

    Args:
        poses: where the poses are from ("transforms.json"), "" when there are none yet.
    """
    facts = [image_facts(photo.path) for photo in photos.photos]
    sizes = Counter(fact.upright for fact in facts)
    most = sizes.most_common(3)
    known = [Told("{count} of {width} x {height}", count=count, width=w, height=h) for (w, h), count in most]
    found = [
        info(
            subject,
            "{count} photos ({sizes} pixels and others)" if len(sizes) > 3 else "{count} photos ({sizes} pixels)",
            count=len(facts),
            sizes=joined(known),
        )
    ]
    if poses:
        held = sum(photo.held_out for photo in photos.photos)
        lens = any(photo.lens is not None for photo in photos.photos)
        found.append(
            info(
                subject,
                "cameras from {poses}, {held} held out, images are undistorted"
                if lens
                else "cameras from {poses}, {held} held out",
                poses=poses,
                held=held,
            )
        )
        if photos.points is not None:
            found.append(info(subject, "{count} sparse points", count=len(photos.points)))
        found += _origin_finding(subject, photos)
    else:
        found.append(info(subject, "no known cameras: structure from motion will find them"))
        found += _focal_finding(subject, facts)
    turned = sum(fact.turned for fact in facts)
    if turned and not poses:
        found.append(info(subject, "{count} photos are turned upright as their EXIF says", count=turned))
    if any(fact.alpha for fact in facts):
        found.append(info(subject, "photos have transparency; it is filled with the background color"))
    if len(facts) < _FEW_PHOTOS:
        more = "take 20 or more all around the object, overlapping"
        found.append(warning(subject, "{count} photos are few", more, count=len(facts)))
    return found


def _origin_finding(subject: Path, photos: Photos) -> list[Finding]:
    """A warning when cameras lie as far from the origin as map coordinates are: float32 cannot tell splats apart."""
    centers = np.stack([photo.camera.center for photo in photos.photos if photo.camera is not None])
    middle = centers.mean(axis=0)
    apart = float(np.linalg.norm(centers - middle, axis=1).max())
    away = float(np.linalg.norm(middle))
    if away <= _FARTHEST_ORIGIN * apart or apart == 0.0:
        return []
    return [
        warning(
            subject,
            "cameras lie {away:.0f} units from the origin and at most {apart:.3g} from their middle: splats there "
            "would be rounded to places {step:.2g} apart",
            "export the poses with an origin near the object",
            away=away,
            apart=apart,
            step=float(np.spacing(np.float32(away))),
        )
    ]


def unused_photos(subject: Path, images: Sequence[Path], photos: Photos) -> list[Finding]:
    """A warning when the folder holds images that the known poses leave out."""
    used = {photo.path.resolve() for photo in photos.photos}
    extra = [path.name for path in images if path.resolve() not in used]
    if not extra:
        return []
    return [
        warning(
            subject,
            "{count} images have no known camera and are not used: {names}",
            "add them to the poses, or remove the pose files to have all cameras found anew",
            count=len(extra),
            names=name_some(extra),
        )
    ]


def describe_projections(subject: Path, projections: Projections) -> list[Finding]:
    """Counts, geometry, units, angular coverage, and whether the object leaves the detector."""
    return [
        *_geometry_findings(subject, projections),
        *_coverage_findings(subject, projections),
        *_view_findings(subject, projections),
        *_value_findings(subject, projections),
    ]


def grid_findings(subject: Path, voxels: tuple[int, int, int]) -> list[Finding]:
    """A warning when the grid (x, y, z) that projections are reconstructed on first, by FDK, is very fine."""
    count = math.prod(voxels)
    if count <= _LARGEST_VOXELS:
        return []
    return [
        warning(
            subject,
            "the scanner's grid has {millions:.0f} million voxels; each first reconstruction on it takes {gb:.1f} GB "
            "of memory or more",
            "make the scan smaller with insideout bin, or lower nVoxel and keep sVoxel (Nikon: fewer VoxelsX, Y and Z "
            "with a larger VoxelSize) to about 256 along each side",
            millions=count / 1e6,
            gb=4e-9 * count,
        )
    ]


def describe_volume(subject: Path, volume: Volume, densities: Densities) -> list[Finding]:
    """Voxels, spacing, box and range of a volume, whose values are in `densities`."""
    nz, ny, nx = volume.values.shape
    spacing = " x ".join(f"{length:.3g}" for length in volume.spacing_mm)
    found = [
        info(
            subject,
            "volume of {voxels} voxels of {spacing} mm (box {box} mm), relative densities {least:.3g} to {most:.3g}"
            if densities.relative
            else "volume of {voxels} voxels of {spacing} mm (box {box} mm), attenuation {least:.3g} to {most:.3g} mm⁻¹",
            voxels=f"{nx} x {ny} x {nz}",
            spacing=spacing,
            box=_box_text(volume.box_mm),
            least=volume.values.min(),
            most=volume.values.max(),
        )
    ]
    if nx * ny * nz > _LARGEST_VOXELS:
        found.append(
            warning(
                subject,
                "{millions:.0f} million voxels take {gb:.1f} GB of memory",
                "bin the volume by two if memory is short",
                millions=nx * ny * nz / 1e6,
                gb=volume.values.nbytes / 1e9,
            )
        )
    return found + _unit_finding(subject, volume.box_mm)


def describe_landmarks(subject: Path, landmarks: Landmarks) -> list[Finding]:
    """How many points there are."""
    return [info(subject, "{count} landmarks", count=len(landmarks.photo))]


def angular_coverage(angles_rad: np.ndarray, period: float = 2 * np.pi) -> tuple[float, float]:
    """(covered angle, largest gap) in radians of gantry angles on a circle of the given period."""
    angles = np.unique(np.round(np.mod(angles_rad, period), 6))
    if len(angles) < 2:
        return 0.0, period
    gaps = np.diff(np.append(angles, angles[0] + period))
    typical = float(np.median(gaps))
    # A gap up to three steps is sampling; beyond that it is a missing wedge.
    largest = float(gaps.max())
    return (period if largest <= 3 * typical else period - largest + typical), largest


def cut_off_share(images: np.ndarray, axis: int) -> float:
    """Share of projections in which the object reaches the detector's edge.

    Args:
        images: (M, H, W) line integrals.
        axis: 2 for the left and right edge, 1 for top and bottom.
    """
    strong = float(np.percentile(images, 99))
    if strong <= 0:
        return 0.0
    count = images.shape[axis]
    outermost = (range(min(2, count)), range(max(count - 2, 0), count))
    edges = [np.take(images, list(places), axis=axis).mean(axis=axis) for places in outermost]
    reach = np.maximum(*(np.percentile(edge, 95, axis=1) for edge in edges))
    return float(np.mean(reach > _EDGE_SHARE * strong))


def _focal_finding(subject: Path, facts: list[ImageFacts]) -> list[Finding]:
    known = [fact.focal_px for fact in facts if fact.focal_px is not None]
    if known:
        return [info(subject, "focal length from EXIF: about {px:.0f} pixels", px=np.median(known))]
    return [
        warning(
            subject,
            "no focal length in EXIF; structure from motion starts from a guess",
            "use the camera's original files, which have EXIF, if some photos do not register",
        )
    ]


def _geometry_findings(subject: Path, projections: Projections) -> list[Finding]:
    count, height, width = projections.images.shape
    detector = projections.detectors[0]
    pitch = f"{np.linalg.norm(detector.u):.3g} x {np.linalg.norm(detector.v):.3g} mm"
    held = int(projections.held_out.sum())
    nx, ny, nz = projections.voxels
    found = [
        info(
            subject,
            "{count} projections of {size} pixels of {pitch}, parallel beam, {held} held out"
            if detector.parallel
            else "{count} projections of {size} pixels of {pitch}, cone beam, {held} held out",
            count=count,
            size=f"{width} x {height}",
            pitch=pitch,
            held=held,
        ),
        info(
            subject,
            "object box {box} mm, {voxels} voxels",
            box=_box_text(projections.box_mm),
            voxels=f"{nx} x {ny} x {nz}",
        ),
    ]
    to_axis, to_detector = projections.source_to_axis_mm, projections.source_to_detector_mm
    if not detector.parallel and to_axis and to_detector:
        found.append(
            info(
                subject,
                "source to axis {to_axis:.4g} mm, to detector {to_detector:.4g} mm, magnification {times:.3g}",
                to_axis=to_axis,
                to_detector=to_detector,
                times=to_detector / to_axis,
            )
        )
    return found + _unit_finding(subject, projections.box_mm)


def _unit_finding(subject: Path, box_mm: np.ndarray) -> list[Finding]:
    widest = float((box_mm[1] - box_mm[0]).max())
    if widest >= _SMALLEST_BOX_MM:
        return []
    return [
        warning(
            subject,
            "the box is {widest:g} mm wide: units look normalized, not mm",
            "if so, lengths and densities in the result are relative; else give the true sizes in mm",
            widest=widest,
        )
    ]


def _coverage_findings(subject: Path, projections: Projections) -> list[Finding]:
    detector = projections.detectors[0]
    parallel = detector.parallel
    period = np.pi if parallel else 2 * np.pi
    covered, largest = angular_coverage(projections.angles_rad, period)
    needed = np.pi
    if not parallel and projections.source_to_detector_mm:
        half_width = 0.5 * detector.width * np.linalg.norm(detector.u)
        needed += 2 * np.arctan(half_width / projections.source_to_detector_mm)
    degrees = {"covered": np.degrees(covered), "step": np.degrees(largest)}
    if covered >= min(needed, period) - 1e-3:
        return [info(subject, "angles cover {covered:.0f}°, largest step {step:.1f}°", **degrees)]
    return [
        warning(
            subject,
            "angles cover {covered:.0f}°, largest step {step:.1f}°; {needed:.0f}° are needed",
            "scan the missing angles too; until then edges along them stay blurred",
            needed=np.degrees(needed),
            **degrees,
        )
    ]


def _view_findings(subject: Path, projections: Projections) -> list[Finding]:
    found = []
    training = int((~projections.held_out).sum())
    if training < _FEW_PROJECTIONS:
        few = "{count} projections to learn from are few"
        found.append(warning(subject, few, "take 50 or more if the scanner can", count=training))
    missed = unseen_fraction(projections.detectors, projections.box_mm)
    if missed > 0.02:
        found.append(
            warning(
                subject,
                "{percent:.0f} % of the box falls outside the detector on average",
                "shrink sVoxel to the object, or check DSO, DSD and sDetector",
                percent=100 * missed,
            )
        )
    return found


def _value_findings(subject: Path, projections: Projections) -> list[Finding]:
    images = projections.images
    found = [info(subject, "line integrals from {least:.3g} to {most:.3g}", least=images.min(), most=images.max())]
    sideways, upwards = cut_off_share(images, axis=2), cut_off_share(images, axis=1)
    if sideways > MOST_CUT_OFF:
        found.append(
            warning(
                subject,
                "the object leaves the detector at the side in {percent:.0f} % of the projections",
                "center it or move it closer to the detector; densities near the rim will be too high",
                percent=100 * sideways,
            )
        )
    if upwards > MOST_CUT_OFF:
        found.append(
            warning(
                subject,
                "the object goes on above or below the detector in {percent:.0f} % of the projections",
                "the model ends where the detector ends; scan in two heights for the rest",
                percent=100 * upwards,
            )
        )
    spread = float(np.percentile(images, 99)) or 1.0
    if float(np.percentile(images, 1)) < -0.2 * abs(spread):
        found.append(
            warning(
                subject,
                "many line integrals are below zero",
                "check the flat field: air must read the same with and without the object",
            )
        )
    starved = float(np.mean(images > 10))
    if starved > 1e-4:
        found.append(
            warning(
                subject,
                "{percent:.2g} % of the pixels let less than 1 in 20,000 photons through",
                "raise the voltage or the exposure; metal there will cause streaks",
                percent=100 * starved,
            )
        )
    return found


def _box_text(box_mm: np.ndarray) -> str:
    return " x ".join(f"{length:.4g}" for length in box_mm[1] - box_mm[0])
