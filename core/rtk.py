"""What InsideOut hands to ITK-RTK and gets back: geometry, projections, volumes, and a filter that can be stopped.

ITK-RTK: Rit et al., J. Phys. Conf. Ser. 489, 2014.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from .capture.model import Projections
from .errors import CaptureError, SettingError
from .rtk_classes import rtk_class
from .told import Told
from .views import Detector
from .volume import Volume

# Box diagonals between a parallel beam's detector and the source that stands for it.
_FAR = 1e5
# What ITK and C++ say where an image does not fit into memory.
_NO_MEMORY = ("failed to allocate memory", "bad_alloc")
# RTK turns about y: x -> x, y -> -z, z -> y of RTK's frame.
_TO_RTK = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def used_projections(projections: Projections, subset: np.ndarray | None) -> np.ndarray:
    """Indices of the projections that `subset` (M,) picks, or of those that are not held out.

    Raises:
        SettingError: a subset of another length.
        CaptureError: fewer than two projections.
    """
    mask = ~np.asarray(projections.held_out, bool) if subset is None else np.asarray(subset, bool)
    if mask.shape != (len(projections.detectors),):
        raise SettingError(
            "subset has shape {shape}; give one value for each of the {count} projections.",
            shape=mask.shape,
            count=len(projections.detectors),
        )
    used = np.flatnonzero(mask)
    if len(used) < 2:
        raise CaptureError(
            "a reconstruction needs at least two projections, not {count}; add projections to the capture.",
            count=len(used),
        )
    return used


def grid_of(projections: Projections, voxels: tuple[int, int, int] | None) -> tuple[int, ...]:
    """Voxels along x, y, z; the projections' own when None.

    Raises:
        SettingError: not three counts of at least 1.
    """
    grid = tuple(int(n) for n in (projections.voxels if voxels is None else voxels))
    if len(grid) != 3 or min(grid) < 1:
        raise SettingError("voxels is {grid}; give three counts of at least 1, along x, y and z.", grid=grid)
    return grid


def as_cone(detector: Detector, box_mm: np.ndarray) -> Detector:
    """A parallel beam as a source very far away; the rays differ by less than 1e-5 in direction."""
    if not detector.parallel:
        return detector
    direction = np.asarray(detector.source, np.float64) / np.linalg.norm(detector.source)
    away = _FAR * float(np.linalg.norm(np.diff(box_mm, axis=0)))
    return replace(detector, source=np.asarray(detector.center, np.float64) - away * direction, parallel=False)


def circular_geometry(detectors: list[Detector]) -> tuple[Any, np.ndarray]:
    """RTK's geometry, and for each projection the pixel pitch (u, v) in mm.

    RTK wants unit row and column directions whose cross product points at the source, with columns upwards: image
    rows are turned over to match.
    """
    geometry = rtk_class("ThreeDCircularProjectionGeometry").New()
    pitches = []
    for detector in detectors:
        u, up = np.asarray(detector.u, np.float64), -np.asarray(detector.v, np.float64)
        pitch = np.array([np.linalg.norm(u), np.linalg.norm(up)])
        vectors = (detector.source, detector.center, u / pitch[0], up / pitch[1])
        source, center, row, column = ((_TO_RTK @ np.asarray(v, np.float64)).tolist() for v in vectors)
        if not geometry.AddProjection(source, center, row, column):
            raise CaptureError(
                "a projection's detector cannot be used (its rows and columns are not at right angles, or the source "
                "lies in its plane); mend the geometry, or bring the scanner's own volume."
            )
        pitches.append(pitch)
    return geometry, np.array(pitches)


def projection_image(images: np.ndarray, pitches: np.ndarray) -> Any:
    """RTK's stack of projections in mm about the detector's middle; one pitch for all of them."""
    import itk

    pitch = pitches[0]
    if not np.allclose(pitches, pitch, rtol=1e-3):
        raise CaptureError("the projections have different pixel sizes; resample them to one first.")
    stack = itk.image_from_array(np.ascontiguousarray(images[:, ::-1, :], np.float32))
    height, width = images.shape[1:]
    stack.SetSpacing([float(pitch[0]), float(pitch[1]), 1.0])
    stack.SetOrigin([-0.5 * (width - 1) * float(pitch[0]), -0.5 * (height - 1) * float(pitch[1]), 0.0])
    return stack


def empty_volume(box_mm: np.ndarray, grid: tuple[int, ...]) -> tuple[Any, np.ndarray, np.ndarray]:
    """Zeros on a grid that fills the box, its lowest corner (3,) and its spacing (3,), both along x, y, z in mm.

    Raises:
        CaptureError: there is no memory for it.
    """
    import itk

    low, high = np.asarray(box_mm, np.float64)
    spacing = (high - low) / np.asarray(grid)
    nx, ny, nz = grid
    try:
        empty = itk.image_from_array(np.zeros((ny, nz, nx), np.float32))
    except MemoryError as error:
        raise CaptureError(
            "a volume of {nx} x {ny} x {nz} voxels does not fit into memory; lower the scan's number of voxels.",
            nx=nx,
            ny=ny,
            nz=nz,
        ) from error
    _place(empty, low, high, spacing)
    return empty, low, spacing


def _place(image: Any, low: np.ndarray, high: np.ndarray, spacing: np.ndarray) -> None:
    """Puts an image of axes [-y, z, x] where a box in the world lies."""
    image.SetSpacing([float(spacing[0]), float(spacing[2]), float(spacing[1])])
    first = [low[0] + 0.5 * spacing[0], low[2] + 0.5 * spacing[2], -(high[1] - 0.5 * spacing[1])]
    image.SetOrigin([float(value) for value in first])


def run_filter(
    solver: Any, event: Any, tell: Callable[[], None], what: Told, stop: Callable[[], None] | None = None
) -> None:
    """Runs an ITK filter and calls `tell` at each of its events; what `tell` raises stops it and is raised.

    Args:
        stop: what makes the filter end soon; its own abort when None.

    Raises:
        CaptureError: the filter failed; `what` says at what.
        MemoryError: for want of memory.
    """
    import itk

    cancelled: list[BaseException] = []

    def watch() -> None:
        # An exception cannot cross ITK's C++ frames: stop the filter and raise afterwards.
        try:
            tell()
        except BaseException as raised:
            cancelled.append(raised)
            (stop or solver.AbortGenerateDataOn)()

    solver.AddObserver(event, watch)
    # RTK warns once a projection and thread about short scans; `core.fdk.coverage` says it once.
    warnings = itk.Object.GetGlobalWarningDisplay()
    itk.Object.SetGlobalWarningDisplay(False)
    try:
        solver.Update()
    except RuntimeError as error:
        if not cancelled:
            if any(words in str(error).lower() for words in _NO_MEMORY):
                raise MemoryError(_last_line(error)) from error
            raise CaptureError(
                "the {what} failed ({reason}); check the scanner's geometry, or bring its own volume.",
                what=what,
                reason=_last_line(error),
            ) from error
    finally:
        itk.Object.SetGlobalWarningDisplay(warnings)
    if cancelled:
        raise cancelled[0]


def image_of(volume: Volume) -> Any:
    """A Volume as an ITK image in RTK's frame: the inverse of `volume_of`."""
    import itk

    # Axes [z, y, x] to RTK's [-y, z, x].
    image = itk.image_from_array(np.ascontiguousarray(volume.values[:, ::-1, :].transpose(1, 0, 2), np.float32))
    low, high = np.asarray(volume.box_mm, np.float64)
    _place(image, low, high, np.asarray(volume.spacing_mm, np.float64))
    return image


def volume_of(image: Any, low: np.ndarray, spacing: np.ndarray) -> Volume:
    """An ITK image in RTK's frame as a Volume in ours."""
    import itk

    # RTK's axes [-y, z, x] to [z, y, x].
    values = np.ascontiguousarray(itk.array_from_image(image).transpose(1, 0, 2)[:, ::-1, :], np.float32)
    return Volume(values, spacing, low + 0.5 * spacing)


def _last_line(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1] if lines else type(error).__name__
