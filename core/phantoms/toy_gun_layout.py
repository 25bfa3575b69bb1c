"""Where the toy gun's parts lie, for those that make its outside, its inside and its paint; mm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

AXIS_Z = 14.0
WALL_MM, GAP_MM = 1.8, 0.25
BARREL_X, CLEAR_RADIUS, CLEAR_WALL_MM = (15.0, 48.5), 6.2, 1.5
RINGS = ((25.0, 12.0), (32.5, 10.6), (40.0, 9.2))
"""x and radius of each cooling ring."""
MUZZLE, MUZZLE_RADIUS = (52.4, 0.0, AXIS_Z), 6.6


@dataclass(frozen=True)
class Screw:
    """A screw along y, its head on the right.

    Attributes:
        x, z: its axis.
        head_y: where the head's flat top lies; the shaft runs from there towards +y.
        end_y: its tip.
    """

    x: float
    z: float
    head_y: float
    end_y: float


SCREWS = (
    Screw(-13.5, 24.0, -7.6, 5.5),
    Screw(2.5, 6.2, -5.6, 5.0),
    Screw(-43.5, 9.0, -5.2, 4.6),
    Screw(-35.2, -33.0, -5.8, 4.8),
)


def axis_distance(points: np.ndarray, screw: Screw) -> np.ndarray:
    """(N,) mm from points (N, 3) to the line that the screw lies on."""
    return np.hypot(points[:, 0] - np.float32(screw.x), points[:, 2] - np.float32(screw.z))


def well(points: np.ndarray, screw: Screw) -> np.ndarray:
    """(N,) signed distance of the hole through the right shell down to the screw's head."""
    return np.maximum(axis_distance(points, screw) - np.float32(2.6), points[:, 1] - np.float32(screw.head_y))
