"""Scanner geometry -> one Detector a projection. Numpy alone.

Axes as TIGRE, NAF and R²-Gaussian have them: at gantry angle θ the source is at (DSO cosθ, DSO sinθ, 0), the
detector behind the axis at distance DSD from it. A row of the image runs along (−sinθ, cosθ, 0), a column runs
downwards along (0, 0, −1), so the top row of an upright image is the top of the object.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..views import Detector


@dataclass(frozen=True)
class CircularScan:
    """A source and a flat detector turning together about the z axis (or the object the other way round).

    Attributes:
        width, height: pixels of the detector.
        pixel_mm: pixel pitch along u (a row) and v (a column), mm.
        source_to_axis_mm: DSO.
        source_to_detector_mm: DSD.
        offset_mm: how far the detector's middle is moved along u (with the rows, to the right) and along world z
            (up), mm; TIGRE's and R²-Gaussian's offDetector.
        parallel: parallel beam; DSO and DSD then only say where the detector stands.
    """

    width: int
    height: int
    pixel_mm: tuple[float, float]
    source_to_axis_mm: float
    source_to_detector_mm: float
    offset_mm: tuple[float, float] = (0.0, 0.0)
    parallel: bool = False

    def detector(self, angle_rad: float) -> Detector:
        """The detector and source at one gantry angle."""
        cos, sin = np.cos(angle_rad), np.sin(angle_rad)
        outward = np.array([cos, sin, 0.0])
        along_row = np.array([-sin, cos, 0.0])
        up = np.array([0.0, 0.0, 1.0])
        behind_axis = self.source_to_detector_mm - self.source_to_axis_mm
        center = -behind_axis * outward + self.offset_mm[0] * along_row + self.offset_mm[1] * up
        return Detector(
            width=self.width,
            height=self.height,
            source=-outward if self.parallel else self.source_to_axis_mm * outward,
            center=center,
            u=self.pixel_mm[0] * along_row,
            v=-self.pixel_mm[1] * up,
            parallel=self.parallel,
        )

    def detectors(self, angles_rad: np.ndarray) -> list[Detector]:
        """One detector for each angle."""
        return [self.detector(float(angle)) for angle in angles_rad]


def project_points(detector: Detector, points: np.ndarray) -> np.ndarray:
    """Where rays through world points meet the detector.

    Args:
        points: (..., 3) mm.

    Returns:
        (..., 2) pixel coordinates (column, row); the centre of pixel (i, j) is (j + 0.5, i + 0.5).
    """
    points = np.asarray(points, np.float64)
    source, center = np.asarray(detector.source, np.float64), np.asarray(detector.center, np.float64)
    u, v = np.asarray(detector.u, np.float64), np.asarray(detector.v, np.float64)
    normal = np.cross(u, v)
    direction = np.broadcast_to(source, points.shape) if detector.parallel else points - source
    reach = ((center - points) @ normal) / (direction @ normal)
    hit = points + reach[..., None] * direction - center
    # u and v need not be at right angles on a tilted or sheared detector: solve for both together.
    metric = np.array([[u @ u, u @ v], [u @ v, v @ v]])
    coordinates = np.stack([hit @ u, hit @ v], axis=-1) @ np.linalg.inv(metric)
    return coordinates + 0.5 * np.array([detector.width, detector.height])


# Mean direction of the rays of a full turn, and where on the detector the axis lies that is seen from one side mostly.
_FULL_TURN, _SET_OFF = 0.1, 0.4


def visible_box(detectors: list[Detector]) -> np.ndarray:
    """(2, 3) mm: a box about the origin whose inscribed cylinder every detector sees whole; one that is set off to
    see more (half fan, over a full turn) sees it in half of the projections.

    Used when a scanner's file does not say where the object lies.

    Raises:
        ValueError: no detector sees the axis.
    """
    radius = height = np.inf
    turns_fully = np.linalg.norm(_directions(detectors).mean(axis=0)) < _FULL_TURN
    for detector in detectors:
        along_row = np.asarray(detector.u) / np.linalg.norm(detector.u)
        middle, right, top = project_points(detector, np.stack([np.zeros(3), along_row, [0.0, 0.0, 1.0]]))
        columns_per_mm = abs(right[0] - middle[0])
        rows_per_mm = abs(top[1] - middle[1])
        near, far = sorted((middle[0], detector.width - middle[0]))
        half_fan = turns_fully and 0 < near < _SET_OFF * detector.width
        radius = min(radius, (far if half_fan else near) / columns_per_mm)
        height = min(height, min(middle[1], detector.height - middle[1]) / rows_per_mm)
    if not (radius > 0 and height > 0):
        raise ValueError("the detector does not see the axis")
    high = np.array([radius, radius, height])
    return np.stack([-high, high])


def unseen_fraction(detectors: list[Detector], box_mm: np.ndarray, samples: int = 12) -> float:
    """Share of the box, over all projections, that falls outside the detector: 0 when nothing is cut off.

    Over a full turn what one projection misses may be in the opposite one, as a detector set off to one side has it.
    """
    axes = [np.linspace(box_mm[0][k], box_mm[1][k], samples) for k in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    inside = np.zeros((len(detectors), len(points)), bool)
    for index, detector in enumerate(detectors):
        pixel = project_points(detector, points)
        inside[index] = np.all((pixel >= 0) & (pixel <= [detector.width, detector.height]), axis=-1)
    directions = _directions(detectors)
    if np.linalg.norm(directions.mean(axis=0)) < _FULL_TURN:
        inside |= inside[np.argmin(directions @ directions.T, axis=1)]
    return 1.0 - float(inside.mean()) if inside.size else 0.0


def _directions(detectors: list[Detector]) -> np.ndarray:
    """(K, 3) unit normals of the detectors."""
    normals = np.array([np.cross(detector.u, detector.v) for detector in detectors], np.float64).reshape(-1, 3)
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)
