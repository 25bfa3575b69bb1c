"""Filtered backprojection of projections from any circular or nearly circular scan, by ITK-RTK on the CPU.

Feldkamp, Davis and Kress, J. Opt. Soc. Am. A 1(6), 1984; ITK-RTK: Rit et al., J. Phys. Conf. Ser. 489, 2014.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from .capture.model import Projections
from .errors import CaptureError, SettingError
from .progress import Progress, Reporter
from .views import Detector
from .volume import Volume

FILTERS = ("ramp", "hann")

# A parallel beam is a cone from this many box diagonals away; the rays differ by less than 1e-5 in direction.
_FAR = 1e5
# RTK turns about y: x -> x, y -> -z, z -> y of RTK's frame.
_TO_RTK = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
# A wider gap, other than between sparse views, means that the scan is not a full circle (RTK's own threshold).
_SHORT_SCAN_GAP = np.radians(20.0)

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

    Detectors may stand anywhere (offsets, tilts, a pose for each projection) as long as they turn about z. A scan
    over less than a full turn is weighted after Parker (Med. Phys. 9(2), 1982), a laterally displaced detector after
    Wang (Med. Phys. 29(7), 2002). A parallel beam is treated as a source very far away, half a turn of it completed
    with its mirror images. Too few angles still give a volume, with the streaks of a limited angle: see `coverage`.

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
        raise SettingError(f"the FDK window is '{window}'; choose one of: {', '.join(FILTERS)}.")
    used = _used(projections, subset)
    grid = tuple(int(n) for n in (projections.voxels if voxels is None else voxels))
    if len(grid) != 3 or min(grid) < 1:
        raise SettingError(f"voxels is {grid}; give three counts of at least 1, along x, y and z.")
    reporter.update(Progress(stage, "fdk", 0.0, message=f"FDK from {len(used)} projections"))
    detectors, images = [projections.detectors[i] for i in used], projections.images[used]
    _check_axis(detectors)
    if all(detector.parallel for detector in detectors):
        detectors, images = _full_turn(detectors, images)
    detectors, images = _level(detectors, images)
    cones = [_as_cone(detector, projections.box_mm) for detector in detectors]
    images, short = _weigh_gaps(cones, images)
    volume = _reconstruct(images, cones, short, projections.box_mm, grid, window, reporter, stage)
    reporter.update(Progress(stage, "fdk", 1.0))
    return volume


def load() -> None:
    """Loads ITK-RTK, which takes some ten seconds the first time in a process."""
    from itk import RTK as rtk

    _ = rtk.ThreeDCircularProjectionGeometry


def coverage(projections: Projections, subset: np.ndarray | None = None) -> dict[str, Any]:
    """How well the projections cover the object.

    Returns:
        views; angular_range_deg (360 less the largest gap, or 360 when that gap is an ordinary step);
        largest_gap_deg; cut_off: the share of views in which the upright cylinder inscribed in the box leaves the
        detector; enough: whether the angles suffice for an exact mid-plane
        (a full circle, or half a turn plus the fan).
    """
    used = _used(projections, subset)
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


def _used(projections: Projections, subset: np.ndarray | None) -> np.ndarray:
    mask = ~np.asarray(projections.held_out, bool) if subset is None else np.asarray(subset, bool)
    if mask.shape != (len(projections.detectors),):
        raise SettingError(
            f"subset has shape {mask.shape}; give one value for each of the {len(projections.detectors)} projections."
        )
    used = np.flatnonzero(mask)
    if len(used) < 2:
        raise CaptureError(f"FDK needs at least two projections, not {len(used)}; add projections to the capture.")
    return used


def _as_cone(detector: Detector, box_mm: np.ndarray) -> Detector:
    if not detector.parallel:
        return detector
    direction = np.asarray(detector.source, np.float64) / np.linalg.norm(detector.source)
    away = _FAR * float(np.linalg.norm(np.diff(box_mm, axis=0)))
    return replace(detector, source=np.asarray(detector.center, np.float64) - away * direction, parallel=False)


def _angular_range(detectors: list[Detector]) -> tuple[float, float]:
    """Radians that the source goes through, and the largest gap between neighbours around the circle."""
    angles = np.sort(np.mod([_source_angle(detector) for detector in detectors], 2 * np.pi))
    gaps = np.diff(np.concatenate([angles, angles[:1] + 2 * np.pi]))
    largest, ordinary = float(gaps.max()), float(np.median(gaps))
    closed = largest < max(_SHORT_SCAN_GAP, 2.5 * ordinary)
    return 2 * np.pi if closed else 2 * np.pi - largest + ordinary, largest


def _level(detectors: list[Detector], images: np.ndarray) -> tuple[list[Detector], np.ndarray]:
    """Projections whose rows run level, resampled in the detector's own plane where they do not.

    FDK filters along rows, which is right only for rows at right angles to the axis of rotation.
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
        levelled[index] = _resample(images[index], u, v, level, down)
    return turned, levelled


def _resample(image: np.ndarray, u: np.ndarray, v: np.ndarray, new_u: np.ndarray, new_v: np.ndarray) -> np.ndarray:
    """The image on pixels with other steps along rows and columns about the same middle; air beyond its border."""
    from scipy.ndimage import affine_transform

    metric = np.array([[u @ u, u @ v], [u @ v, v @ v]])
    # Columns: where one new step along u and along v leads, in old columns and rows.
    steps = np.linalg.solve(metric, np.array([[u @ new_u, u @ new_v], [v @ new_u, v @ new_v]]))
    matrix = steps[::-1, ::-1]
    middle = 0.5 * (np.array(image.shape) - 1)
    return affine_transform(image, matrix, middle - matrix @ middle, order=3, mode="constant")


def _full_turn(detectors: list[Detector], images: np.ndarray) -> tuple[list[Detector], np.ndarray]:
    """Parallel projections and, unless they go all around, the same rays seen from the other side."""
    if _angular_range(detectors)[0] >= 2 * np.pi:
        return detectors, images
    mirrored = [replace(d, source=-np.asarray(d.source), u=-np.asarray(d.u)) for d in detectors]
    return [*detectors, *mirrored], np.concatenate([images, images[:, :, ::-1]])


def _weigh_gaps(cones: list[Detector], images: np.ndarray) -> tuple[np.ndarray, bool]:
    """Images ready for RTK's weights by angular gap, and whether Parker's weights apply.

    RTK weights each view by half the way to its two neighbours, which is wrong beside a gap that nobody measured.
    """
    covered, largest = _angular_range(cones)
    if covered >= 2 * np.pi:
        return images, False
    if covered >= np.pi + 0.5 * max(_fan_angle(cone) for cone in cones):
        return images, True
    angles = np.array([_source_angle(cone) for cone in cones])
    order = np.argsort(np.mod(angles, 2 * np.pi))
    steps = np.mod(np.diff(np.append(angles[order], angles[order[0]])), 2 * np.pi)
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
    from .capture.detectors import project_points

    middle, half = box_mm.mean(axis=0), 0.5 * (box_mm[1] - box_mm[0])
    turn = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    rim = min(half[:2]) * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    rims = [np.column_stack([rim, np.full(len(rim), z)]) for z in (-half[2], half[2])]
    pixel = project_points(detector, middle + np.concatenate(rims))
    return bool(np.any(pixel < 0) or np.any(pixel > [detector.width, detector.height]))


def _geometry(detectors: list[Detector]) -> tuple[Any, np.ndarray]:
    """RTK's geometry, and for each projection the pixel pitch (u, v) in mm.

    RTK wants unit row and column directions whose cross product points at the source, with columns upwards: image
    rows are turned over to match.
    """
    from itk import RTK as rtk

    geometry = rtk.ThreeDCircularProjectionGeometry.New()
    pitches = []
    for detector in detectors:
        u, up = np.asarray(detector.u, np.float64), -np.asarray(detector.v, np.float64)
        pitch = np.array([np.linalg.norm(u), np.linalg.norm(up)])
        vectors = (detector.source, detector.center, u / pitch[0], up / pitch[1])
        source, center, row, column = ((_TO_RTK @ np.asarray(v, np.float64)).tolist() for v in vectors)
        if not geometry.AddProjection(source, center, row, column):
            raise CaptureError(
                "a projection's detector cannot be used for FDK (its rows and columns are not at right angles, or the "
                "source lies in its plane); mend the geometry, or bring the scanner's own volume."
            )
        pitches.append(pitch)
    return geometry, np.array(pitches)


def _reconstruct(
    images: np.ndarray,
    detectors: list[Detector],
    short_scan: bool,
    box_mm: np.ndarray,
    grid: tuple[int, ...],
    window: str,
    reporter: Reporter,
    stage: str,
) -> Volume:
    import itk
    from itk import RTK as rtk

    geometry, pitches = _geometry(detectors)
    stack = _projection_image(itk, images, pitches)
    image_type = type(stack)
    # An ITK filter lives only as long as a name refers to it, so each has its own.
    displaced = rtk.DisplacedDetectorImageFilter[image_type].New(Input=stack, Geometry=geometry)
    feed = displaced
    if short_scan:
        feed = rtk.ParkerShortScanImageFilter[image_type].New(Input=displaced.GetOutput(), Geometry=geometry)
    empty, low, spacing = _empty_volume(itk, box_mm, grid)
    solver = rtk.FDKConeBeamReconstructionFilter[image_type].New(Geometry=geometry)
    solver.SetInput(0, empty)
    solver.SetInput(1, feed.GetOutput())
    if window == "hann":
        solver.GetRampFilter().SetHannCutFrequency(1.0)
    cancelled: list[BaseException] = []

    def watch() -> None:
        # An exception cannot cross ITK's C++ frames: stop the filter and raise afterwards.
        try:
            reporter.update(Progress(stage, "fdk", min(0.99, float(solver.GetProgress()))))
        except BaseException as stop:
            cancelled.append(stop)
            solver.AbortGenerateDataOn()

    solver.AddObserver(itk.ProgressEvent(), watch)
    # RTK warns once a projection and thread about short scans; `coverage` says it once.
    warnings = itk.Object.GetGlobalWarningDisplay()
    itk.Object.SetGlobalWarningDisplay(False)
    try:
        solver.Update()
    except RuntimeError as error:
        if not cancelled:
            raise CaptureError(
                f"the FDK of {len(detectors)} projections on {' x '.join(map(str, grid))} voxels failed "
                f"({_last_line(error)}); check the scanner's geometry, or bring its own volume."
            ) from error
    finally:
        itk.Object.SetGlobalWarningDisplay(warnings)
    if cancelled:
        raise cancelled[0]
    turned = itk.array_from_image(solver.GetOutput())
    # RTK's axes [-y, z, x] to [z, y, x].
    values = np.ascontiguousarray(turned.transpose(1, 0, 2)[:, ::-1, :], np.float32)
    return Volume(values, spacing, low + 0.5 * spacing)


def _projection_image(itk: Any, images: np.ndarray, pitches: np.ndarray) -> Any:
    """RTK's stack of projections in mm about the detector's middle; one pitch for all of them."""
    pitch = pitches[0]
    if not np.allclose(pitches, pitch, rtol=1e-3):
        raise CaptureError("the projections have different pixel sizes; resample them to one before FDK.")
    stack = itk.image_from_array(np.ascontiguousarray(images[:, ::-1, :], np.float32))
    height, width = images.shape[1:]
    stack.SetSpacing([float(pitch[0]), float(pitch[1]), 1.0])
    stack.SetOrigin([-0.5 * (width - 1) * float(pitch[0]), -0.5 * (height - 1) * float(pitch[1]), 0.0])
    return stack


def _empty_volume(itk: Any, box_mm: np.ndarray, grid: tuple[int, ...]) -> tuple[Any, np.ndarray, np.ndarray]:
    low, high = np.asarray(box_mm, np.float64)
    spacing = (high - low) / np.asarray(grid)
    nx, ny, nz = grid
    try:
        empty = itk.image_from_array(np.zeros((ny, nz, nx), np.float32))
    except MemoryError as error:
        raise CaptureError(
            f"a volume of {nx} x {ny} x {nz} voxels does not fit into memory; lower the scan's number of voxels."
        ) from error
    empty.SetSpacing([float(spacing[0]), float(spacing[2]), float(spacing[1])])
    first = [low[0] + 0.5 * spacing[0], low[2] + 0.5 * spacing[2], -(high[1] - 0.5 * spacing[1])]
    empty.SetOrigin([float(value) for value in first])
    return empty, low, spacing


def _last_line(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1] if lines else type(error).__name__
