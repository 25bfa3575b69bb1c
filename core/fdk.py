"""Filtered backprojection of projections from any circular or nearly circular scan, by ITK-RTK on the CPU.

Feldkamp, Davis and Kress, J. Opt. Soc. Am. A 1(6), 1984; ITK-RTK: Rit et al., J. Phys. Conf. Ser. 489, 2014.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .capture.model import Projections
from .errors import CaptureError, SettingError
from .progress import Progress, Reporter
from .rtk import (
    as_cone,
    circular_geometry,
    empty_volume,
    grid_of,
    projection_image,
    run_filter,
    used_projections,
    volume_of,
)
from .rtk_classes import rtk_class
from .told import Told
from .views import Detector
from .volume import Volume

FILTERS = ("ramp", "hann")

# A wider gap, other than between sparse views, means that the scan is not a full circle (RTK's own threshold).
_SHORT_SCAN_GAP = np.radians(20.0)

# A cylinder that leaves the detector by less than this share of its width is taken to be seen: that of a box as wide as
# the field of view does so by its tangent rays.
_JUST_LEAVES = 0.1

# Rows that rise by less than this share of their length count as level.
_LEVEL = 1e-3


def fdk(
    projections: Projections,
    subset: np.ndarray | None = None,
    voxels: tuple[int, int, int] | None = None,
    reporter: Reporter | None = None,
    window: str = "ramp",
    stage: str = "initialize",
) -> Volume:
    """The attenuation volume that the projections imply.

    Detectors may stand anywhere (offsets, tilts, a pose for each projection) as long as they turn about z. A scan over
    less than a full turn is weighted after Parker (Med. Phys. 9(2), 1982), a laterally displaced detector after Wang
    (Med. Phys. 29(7), 2002), whose weights count on each ray being measured again from the other side: over less than a
    full turn only where the detector leaves out much of the box on one side. A parallel beam is treated as a source
    very far away, half a turn of it completed with its mirror images. Rows that end in the object are continued where
    the projections say so (`beyond`). Too few angles still give a volume, with the streaks of a limited angle: see
    `coverage`.

    Args:
        projections: line integrals and detectors.
        subset: (M,) bool, which projections to use; those that are not held out when None.
        voxels: (nx, ny, nz) over `projections.box_mm`; its own grid when None.
        window: "ramp", or "hann" for the ramp under a Hann window: less noise, less detail.
        stage: the name under which progress is reported.

    Returns:
        Volume in mm⁻¹. Noise and few views make some values negative; they are left as they are.

    Raises:
        CaptureError: fewer than two projections, or rays that do not turn about z.
        SettingError: an unknown window, a subset or a grid of the wrong form.
        Cancelled: through `reporter`.
    """
    reporter = reporter or Reporter()
    if window not in FILTERS:
        raise SettingError(
            "the FDK window is '{window}'; choose one of: {known}.", window=window, known=", ".join(FILTERS)
        )
    used = used_projections(projections, subset)
    grid = grid_of(projections, voxels)
    reporter.update(Progress(stage, "fdk", 0.0, message=Told("FDK from {count} projections", count=len(used))))
    detectors, images = [projections.detectors[i] for i in used], projections.images[used]
    _check_axis(detectors)
    parallel = all(detector.parallel for detector in detectors)
    if parallel:
        detectors, images = _full_turn(detectors, images)
    # What goes on behind the border must not end in air there.
    detectors, images = _level(detectors, images, "nearest" if projections.beyond else "constant")
    if projections.beyond:
        from .continuation import continued

        detectors, images = continued(detectors, images, projections.beyond)
    cones = [as_cone(detector, projections.box_mm) for detector in detectors]
    images, short = _weigh_gaps(cones, images, mirrored=parallel)
    weights = _Weights(short, _counts_on_the_other_side(cones, projections.box_mm))
    volume = _reconstruct(images, cones, weights, projections.box_mm, grid, window, reporter, stage)
    reporter.update(Progress(stage, "fdk", 1.0))
    return volume


def coverage(projections: Projections, subset: np.ndarray | None = None) -> dict[str, Any]:
    """How well the projections cover the object.

    Returns:
        views; angular_range_deg (360 less the largest gap, or 360 when that gap is an ordinary step);
        largest_gap_deg; cut_off: the share of views in which the upright cylinder inscribed in the box leaves the
        detector; enough: whether the angles suffice for an exact mid-plane
        (a full circle, or half a turn plus the fan).
    """
    used = used_projections(projections, subset)
    covered, largest = _angular_range([projections.detectors[i] for i in used])
    fan = max(_fan_angle(projections.detectors[i]) for i in used)
    cut = [_leaves(projections.detectors[i], projections.box_mm) for i in used]
    return {
        "views": len(used),
        "angular_range_deg": float(np.degrees(covered)),
        "largest_gap_deg": float(np.degrees(largest)),
        "cut_off": float(np.mean(cut)),
        "enough": bool(covered >= np.pi + fan - 1e-3),
    }


def _angular_range(detectors: list[Detector]) -> tuple[float, float]:
    """Radians that the source goes through, and the largest gap between neighbours around the circle."""
    angles = np.sort(np.mod([_source_angle(detector) for detector in detectors], 2 * np.pi))
    gaps = np.diff(np.concatenate([angles, angles[:1] + 2 * np.pi]))
    largest, ordinary = float(gaps.max()), float(np.median(gaps))
    closed = largest < max(_SHORT_SCAN_GAP, 2.5 * ordinary)
    return 2 * np.pi if closed else 2 * np.pi - largest + ordinary, largest


def _level(
    detectors: list[Detector], images: np.ndarray, beyond: str = "constant"
) -> tuple[list[Detector], np.ndarray]:
    """Projections whose rows run level, resampled in the detector's own plane where they do not.

    FDK filters along rows, which is right only for rows at right angles to the axis of rotation.

    Args:
        beyond: what is behind the border: air, "constant", or what the border has, "nearest".
    """
    turned, levelled = list(detectors), images
    for index, detector in enumerate(detectors):
        u, v = np.asarray(detector.u, np.float64), np.asarray(detector.v, np.float64)
        normal = np.cross(u, v)
        level = np.cross([0.0, 0.0, 1.0], normal)
        level *= np.sign(level @ u) * np.linalg.norm(u) / np.linalg.norm(level)
        if np.linalg.norm(level - u) < _LEVEL * np.linalg.norm(u):
            continue
        down = np.cross(normal, level)
        down *= np.linalg.norm(v) / np.linalg.norm(down)
        turned[index] = replace(detector, u=level, v=down)
        levelled = images.copy() if levelled is images else levelled
        levelled[index] = _resample(images[index], u, v, level, down, beyond)
    return turned, levelled


def _resample(
    image: np.ndarray, u: np.ndarray, v: np.ndarray, new_u: np.ndarray, new_v: np.ndarray, beyond: str
) -> np.ndarray:
    """The image on pixels with other steps along rows and columns about the same middle."""
    from scipy.ndimage import affine_transform

    metric = np.array([[u @ u, u @ v], [u @ v, v @ v]])
    # Columns: where one new step along u and along v leads, in old columns and rows.
    steps = np.linalg.solve(metric, np.array([[u @ new_u, u @ new_v], [v @ new_u, v @ new_v]]))
    matrix = steps[::-1, ::-1]
    middle = 0.5 * (np.array(image.shape) - 1)
    return affine_transform(image, matrix, middle - matrix @ middle, order=3, mode=beyond)


def _full_turn(detectors: list[Detector], images: np.ndarray) -> tuple[list[Detector], np.ndarray]:
    """Parallel projections and, unless they go all around, the same rays seen from the other side."""
    if _angular_range(detectors)[0] >= 2 * np.pi:
        return detectors, images
    mirrored = [replace(d, source=-np.asarray(d.source), u=-np.asarray(d.u)) for d in detectors]
    return [*detectors, *mirrored], np.concatenate([images, images[:, :, ::-1]])


def _weigh_gaps(cones: list[Detector], images: np.ndarray, mirrored: bool) -> tuple[np.ndarray, bool]:
    """Images ready for RTK's weights by angular gap, and whether Parker's weights apply.

    RTK weights each view by half the way to its two neighbours, which is wrong beside a gap that nobody measured.

    Args:
        mirrored: half of them are mirror images, which leave two gaps of less than half a turn: Parker's weights know
            of one.
    """
    covered, largest = _angular_range(cones)
    if covered >= 2 * np.pi:
        return images, False
    angles = np.array([_source_angle(cone) for cone in cones])
    order = np.argsort(np.mod(angles, 2 * np.pi))
    steps = np.mod(np.diff(np.append(angles[order], angles[order[0]])), 2 * np.pi)
    wide = steps > max(_SHORT_SCAN_GAP, 2.5 * np.median(steps))
    two_gaps = mirrored and np.count_nonzero(wide) > 1
    if covered >= np.pi + 0.5 * max(_fan_angle(cone) for cone in cones) and not two_gaps:
        return images, True
    ordinary = np.minimum(steps, 2.5 * np.median(steps))
    factors = np.empty(len(cones))
    factors[order] = (ordinary + np.roll(ordinary, 1)) / np.maximum(steps + np.roll(steps, 1), 1e-9)
    # Without opposite views each ray was measured once and must count twice.
    opposite = covered > np.pi or largest < np.pi
    return images * np.asarray(factors if opposite else 2 * factors, np.float32)[:, None, None], False


def _check_axis(detectors: list[Detector]) -> None:
    up = np.array([np.asarray(d.v, np.float64)[2] / np.linalg.norm(d.v) for d in detectors])
    if np.any(np.abs(up) < 0.7):
        raise CaptureError(
            "the projections do not turn about the z axis (detector columns are more than 45° off it); "
            "turn the geometry so that z is the scanner's axis."
        )


def _source_angle(detector: Detector) -> float:
    source = -np.asarray(detector.source) if detector.parallel else np.asarray(detector.source)
    return float(np.arctan2(source[1], source[0]))


def _fan_angle(detector: Detector) -> float:
    if detector.parallel:
        return 0.0
    middle = np.asarray(detector.center, np.float64)
    edges = [middle + side * 0.5 * detector.width * np.asarray(detector.u) - detector.source for side in (-1, 1)]
    cosine = edges[0] @ edges[1] / (np.linalg.norm(edges[0]) * np.linalg.norm(edges[1]))
    return float(np.arccos(np.clip(cosine, -1, 1)))


def _leaves(detector: Detector, box_mm: np.ndarray) -> bool:
    pixel = _rims(detector, box_mm)
    return bool(np.any(pixel < 0) or np.any(pixel > [detector.width, detector.height]))


def _counts_on_the_other_side(cones: list[Detector], box_mm: np.ndarray) -> bool:
    """Whether a displaced detector is to be weighted: over a full turn, or where it leaves out much of a side."""
    if _angular_range(cones)[0] >= 2 * np.pi:
        return True
    across = [_rims(cone, box_mm)[:, 0] / cone.width for cone in cones]
    return any(np.any(column < -_JUST_LEAVES) or np.any(column > 1 + _JUST_LEAVES) for column in across)


def _rims(detector: Detector, box_mm: np.ndarray) -> np.ndarray:
    """(K, 2) column and row where the detector sees the rims of the upright cylinder inscribed in the box."""
    from .capture.detectors import project_points

    middle, half = box_mm.mean(axis=0), 0.5 * (box_mm[1] - box_mm[0])
    turn = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    rim = min(half[:2]) * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    rims = [np.column_stack([rim, np.full(len(rim), z)]) for z in (-half[2], half[2])]
    return project_points(detector, middle + np.concatenate(rims))


@dataclass(frozen=True)
class _Weights:
    """Whether RTK is to weigh projections after Parker, and after Wang."""

    short_scan: bool
    displaced: bool


def _reconstruct(
    images: np.ndarray,
    detectors: list[Detector],
    weights: _Weights,
    box_mm: np.ndarray,
    grid: tuple[int, ...],
    window: str,
    reporter: Reporter,
    stage: str,
) -> Volume:
    import itk

    geometry, pitches = circular_geometry(detectors)
    feed = projection_image(images, pitches)
    # An ITK filter lives only as long as something refers to it.
    filters = [
        *(["DisplacedDetectorImageFilter"] if weights.displaced else []),
        *(["ParkerShortScanImageFilter"] if weights.short_scan else []),
    ]
    alive = []
    for name in filters:
        alive.append(rtk_class(name, 1).New(Input=feed, Geometry=geometry))
        feed = alive[-1].GetOutput()
    empty, low, spacing = empty_volume(box_mm, grid)
    solver = rtk_class("FDKConeBeamReconstructionFilter", 1).New(Geometry=geometry)
    solver.SetInput(0, empty)
    solver.SetInput(1, feed)
    if window == "hann":
        solver.GetRampFilter().SetHannCutFrequency(1.0)

    def tell() -> None:
        reporter.update(Progress(stage, "fdk", min(0.99, float(solver.GetProgress()))))

    size = " x ".join(map(str, grid))
    what = Told("FDK of {count} projections on {voxels} voxels", count=len(detectors), voxels=size)
    run_filter(solver, itk.ProgressEvent(), tell, what)
    return volume_of(solver.GetOutput(), low, spacing)
