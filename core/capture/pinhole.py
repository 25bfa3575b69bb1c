"""A Detector as a Camera that sees each point in the same pixel. Numpy alone."""

from __future__ import annotations

import numpy as np

from ..errors import CaptureError
from ..views import Camera, Detector

# Sine of the angle by which rows and columns may miss a right one.
_SQUARE = 1e-6
_EDGE_ON = "a projection's rays run along its detector, so that nothing can be seen on it; mend the geometry."


def camera_of(detector: Detector) -> Camera:
    """The pinhole camera of a cone beam, the orthographic camera of a parallel beam.

    Offsets, tilts and unequal pixel pitches are represented; depth is measured along the detector's normal from the
    source (cone), or along the rays (parallel).

    Raises:
        CaptureError: rows and columns are not at right angles as the camera sees them, the image is mirrored, or the
            source lies in the detector's plane: no camera has such pixels.
    """
    return _orthographic(detector) if detector.parallel else _pinhole(detector)


def _pinhole(detector: Detector) -> Camera:
    u, v = np.asarray(detector.u, np.float64), np.asarray(detector.v, np.float64)
    source = np.asarray(detector.source, np.float64)
    x, y = u / np.linalg.norm(u), v / np.linalg.norm(v)
    axes = _axes(x, y)
    to_center = axes @ (np.asarray(detector.center, np.float64) - source)
    _check_side(to_center[2] / max(float(np.linalg.norm(to_center)), 1e-30))
    return Camera(
        width=detector.width,
        height=detector.height,
        fx=float(to_center[2] / np.linalg.norm(u)),
        fy=float(to_center[2] / np.linalg.norm(v)),
        cx=float(detector.width / 2 - to_center[0] / np.linalg.norm(u)),
        cy=float(detector.height / 2 - to_center[1] / np.linalg.norm(v)),
        world_to_camera=_matrix(axes, source),
    )


def _orthographic(detector: Detector) -> Camera:
    direction = np.asarray(detector.source, np.float64)
    direction = direction / np.linalg.norm(direction)
    center = np.asarray(detector.center, np.float64)
    columns = np.column_stack([detector.u, detector.v, direction]).astype(np.float64)
    sides = np.linalg.norm(columns, axis=0)
    if abs(np.linalg.det(columns / sides)) < _SQUARE:
        raise CaptureError(_EDGE_ON)
    # Rows say how many pixels a step in the world leads along a row and down a column; both lie across the rays.
    by_column, by_row = np.linalg.inv(columns)[:2]
    fx, fy = float(np.linalg.norm(by_column)), float(np.linalg.norm(by_row))
    axes = _axes(by_column / fx, by_row / fy)
    _check_side(axes[2] @ direction)
    # Depth only orders the splats: from behind all that can lie before the detector.
    away = 4 * (np.linalg.norm(center) + np.linalg.norm(sides[:2] * [detector.width, detector.height]))
    return Camera(
        width=detector.width,
        height=detector.height,
        fx=fx,
        fy=fy,
        cx=detector.width / 2,
        cy=detector.height / 2,
        world_to_camera=_matrix(axes, center - away * direction),
        orthographic=True,
    )


def _axes(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) with rows x, y, x × y."""
    if abs(float(x @ y)) > _SQUARE:
        raise CaptureError(
            "a projection's rows and columns are not at right angles as its source sees them, which no camera has; "
            "fit the projections with the additive model, or resample them."
        )
    y = y - (x @ y) * x
    y /= np.linalg.norm(y)
    return np.stack([x, y, np.cross(x, y)])


def _check_side(depth: float) -> None:
    """`depth`: how squarely the detector faces the source, −1 for a mirror image to 1."""
    if abs(depth) < _SQUARE:
        raise CaptureError(_EDGE_ON)
    if depth < 0:
        raise CaptureError(
            "a projection is a mirror image (its rows, its columns and the rays make a left-handed frame), which no "
            "camera shows; turn its columns over, or fit the projections with the additive model."
        )


def _matrix(axes: np.ndarray, center: np.ndarray) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = axes
    matrix[:3, 3] = -axes @ center
    return matrix
