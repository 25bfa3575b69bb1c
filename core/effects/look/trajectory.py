"""How an object moves while it is scanned: smoothly in time, and once at a slip."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation

from ...capture.model import Projections
from ...views import Detector

# Neighbours in time are neighbours in angle; golden angles and shuffled files are neither.
_WIDEST_STEP_RAD = np.radians(45.0)
_DEGREE = 3


def acquired(projections: Projections) -> np.ndarray | None:
    """(M,) when views were taken, 0 at the first and 1 at the last training view of a scan that turns evenly.

    Views are taken in the order of the file. Held-out ones that all stand at its end (R²-Gaussian, NAF) were taken when
    their angle passed, even where the first of them is a small step on from the last training view.

    Returns:
        None where angles jump back and forth, or where a scan of several turns does not say in which of them held-out
        views were taken.
    """
    training, angles = np.flatnonzero(~projections.held_out), projections.angles_rad
    if len(training) < 2:
        return None
    last = int(training[-1])
    apart = training.size == last + 1 < len(angles)
    whole, known = None if apart else _unwrapped(angles), _unwrapped(angles[training])
    if whole is not None:
        times = (whole - whole[training[0]]) / (whole[last] - whole[training[0]])
    elif known is not None and known[-1] < 2 * np.pi + np.diff(known).max():
        # With both ends of the turn in it, or a little more, a scan is of one turn all the same.
        forwards = np.sign(np.sin(angles[training[1]] - angles[training[0]]))
        times = np.mod(forwards * (angles - angles[training[0]]), 2 * np.pi) / known[-1]
        times[training] = known / known[-1]
    else:
        return None
    clipped: np.ndarray = np.clip(times, 0.0, 1.0)
    return clipped


def goes_one_way(projections: Projections) -> bool:
    """Whether the angles of training views follow each other in the order of the file."""
    return _unwrapped(projections.angles_rad[~projections.held_out]) is not None


def _unwrapped(angles_rad: np.ndarray) -> np.ndarray | None:
    """(N,) how far a scan has turned since its first view, rad; None where it does not go one way in small steps."""
    steps = np.mod(np.diff(angles_rad) + np.pi, 2 * np.pi) - np.pi
    forwards = np.sign(steps[:1])
    if len(steps) == 0 or np.any(forwards * steps <= 0) or np.abs(steps).max() > _WIDEST_STEP_RAD:
        return None
    return np.concatenate([[0.0], np.cumsum(np.abs(steps))])


def curves(times: np.ndarray, pieces: int, slip: float | None = None) -> np.ndarray:
    """(M, K) cubic B-splines over `pieces` equal spans of time, which sum to 1, and a step at `slip` as the last."""
    ends = [0.0] * _DEGREE, [1.0] * _DEGREE
    knots = np.concatenate([ends[0], np.linspace(0.0, 1.0, pieces + 1), ends[1]])
    smooth: np.ndarray = BSpline.design_matrix(times, knots, _DEGREE).toarray()
    return smooth if slip is None else np.column_stack([smooth, times > slip])


def roughness(pieces: int, slip: bool = False) -> np.ndarray:
    """(K, K) of the sum of squares of second differences of the splines' numbers; a step is not rough.

    P-splines: Eilers and Marx, Statistical Science 11(2), 1996.
    """
    count = pieces + _DEGREE
    second = np.diff(np.eye(count), 2, axis=0)
    return np.pad(second.T @ second, (0, int(slip)))


@dataclass(frozen=True, eq=False)
class Motion:
    """Where an object was in each of M views.

    Attributes:
        shift_mm: (M, 3) in the world frame.
        turn_rad: (M, 3) rotation vectors about `middle_mm`, before the shift.
        middle_mm: (3,).
    """

    shift_mm: np.ndarray
    turn_rad: np.ndarray
    middle_mm: np.ndarray

    def at(self, places: np.ndarray) -> Motion:
        """Of some of the views."""
        return replace(self, shift_mm=self.shift_mm[places], turn_rad=self.turn_rad[places])

    def further(self, way: int, mm: float, reach_mm: float) -> Motion:
        """The same and `mm` along x, y or z, or as far at `reach_mm` from an axis along them about it."""
        shift, turn = self.shift_mm.copy(), self.turn_rad.copy()
        if way < 3:
            shift[:, way] += mm
        else:
            turn[:, way - 3] += mm / reach_mm
        return replace(self, shift_mm=shift, turn_rad=turn)

    def seen_by(self, detectors: Sequence[Detector]) -> list[Detector]:
        """Where sources and detectors (M,) stood beside an object that stands still."""
        turns = Rotation.from_rotvec(self.turn_rad).as_matrix()
        return [
            detector.moved(turn, shift, self.middle_mm)
            for detector, turn, shift in zip(detectors, turns, self.shift_mm, strict=True)
        ]
