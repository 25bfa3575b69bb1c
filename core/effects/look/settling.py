"""How an object moved during a scan, from views beside the reprojection of their FDK.

What views cannot tell is decided beforehand. Shifts along the beam are hardly seen and left to the smooth curves
through time. An object that goes round with the detector looks like a detector off its place, or turned: both are
fitted beside the curves, which bend as little as views allow, so that what can be the detector's is not the object's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import f as f_distribution

from ...capture.detectors import project_points
from ...capture.model import Projections
from ...volume import Volume
from ..rays import RayEvidence
from .rigid import WAYS, Says, carved, views_say
from .trajectory import Motion, curves, roughness

_MOST_VIEWS = 72
_VIEWS_A_PIECE, _MOST_PIECES = 6, 10
# How far curves bend from knot to knot, and objects slip, before anything is measured: standard deviations.
_BEND_PX, _SLIP_PX = 0.3, 2.0
_ROUNDS, _DETECTOR_ROUNDS, _DONE_PX, _UNSETTLED_PX = 9, 2, 0.04, 0.15
# A slip leaves so many views before and after it; it is looked for once curves are near, and told if it is so far.
_BESIDE_A_SLIP, _NEAR_PX, _LEAST_SLIP_PX = 3, 0.3, 0.35
_CERTAIN = 0.999
# What bends may cost, in squares of what is likely, before a motion that goes round is called the detector's.
_LIKELY_BENDS = 4.0
_POINTS, _SOLID = 60, 0.3
# The detector's offset along its rows, and its turn.
_DETECTOR = 2


@dataclass(frozen=True, eq=False)
class Settling:
    """What the views of a scan say of the object's motion.

    Attributes:
        motion: of all views; 0 on average over the training views.
        slip_px: how far the object slipped at once, rms over its points; 0 for a smooth motion.
        range_px: how far its points went on the detector, beside what a detector off its place would make of them:
            the larger of along rows and columns, rms over points.
        error_px: what `range_px` would be on average if views differed as much in no order.
        certain: whether views in no order would say as much less than once in a thousand times.
        settled: whether the last round left the object where it was.
        gain: how much of the mean square that the first reprojection did not explain the last one does.
    """

    motion: Motion
    slip_px: float
    range_px: float
    error_px: float
    certain: bool
    settled: bool
    gain: float


def settling(evidence: RayEvidence, times: np.ndarray) -> Settling:
    """The smooth motion, and a slip, with which views agree best with their FDK.

    The volume is made of the training views, and up to 72 of them, evenly spread, are registered with it in up to
    nine rounds; held-out ones have no say and are carried along.

    Args:
        times: (M,) of `acquired`.

    Raises:
        CaptureError: the projections cannot be reconstructed.
        Cancelled: through the evidence's reporter.
    """
    search = _Search(evidence, times)
    numbers, lefts = search.nothing(), []
    for round_ in range(_ROUNDS):
        volume = search.volume(numbers)
        says = search.says(numbers, volume)
        lefts.append(float((says.left**2).mean()))
        # A detector that is off makes a smear that curves would be laid through: it is put right first.
        found = search.detector_alone(says, numbers)
        if round_ < _DETECTOR_ROUNDS and search.seen_px(found - numbers, volume) > _NEAR_PX:
            numbers = found
            continue
        found, doubt = search.solved(says, numbers)
        step = search.seen_px(found - numbers, volume)
        if step < _NEAR_PX and search.slips(says, numbers, doubt, volume):
            numbers = search.with_slip(numbers)
            found, doubt = search.solved(says, numbers)
            step = search.seen_px(found - numbers, volume)
        before, numbers = numbers, found
        if step < _DONE_PX:
            break
    gain = 1 - lefts[-1] / max(lefts[0], 1e-30)
    motion = search.motion(search.with_doubtful(says, before, doubt))
    return search.told(numbers, motion, says, doubt, volume, step < _UNSETTLED_PX, gain)


class _Search:
    """Numbers (6 K + 2,) are K of the curves for each of three shifts in mm and three turns times `reach`; then how far
    the detector is off along its rows and turned in its plane, as motions of the object."""

    def __init__(self, evidence: RayEvidence, times: np.ndarray) -> None:
        self._evidence, self._times = evidence, times
        self._slip: float | None = None
        self._training = evidence.training
        chosen = np.linspace(0, len(self._training) - 1, min(len(self._training), _MOST_VIEWS))
        self._used = self._training[chosen.astype(int)]
        self._pieces = int(np.clip(len(self._training) // _VIEWS_A_PIECE, 2, _MOST_PIECES))
        box = evidence.views.box_mm
        self._middle, self._reach = box.mean(axis=0), 0.25 * float((box[1] - box[0]).mean())
        self._pixel_mm = evidence.views.pixel_mm
        self._laid()

    def _laid(self) -> None:
        """The design (M, 6, 6 K + 2) of all views' motions, and what bending costs."""
        curve = curves(self._times, self._pieces, self._slip)
        count = curve.shape[1]
        shape = (len(self._times), WAYS, WAYS * count + _DETECTOR)
        self._design, self._bending = np.zeros(shape), 1e-6 * np.eye(shape[2])
        stiff = roughness(self._pieces, self._slip is not None) / (_BEND_PX * self._pixel_mm) ** 2
        for way in range(WAYS):
            part = slice(way * count, (way + 1) * count)
            self._design[:, way, part] = curve
            self._bending[part, part] += stiff
            if self._slip is not None:
                self._bending[part.stop - 1, part.stop - 1] += 1 / (_SLIP_PX * self._pixel_mm) ** 2
        for index, detector in enumerate(self._evidence.views.detectors):
            along, down = np.asarray(detector.u, np.float64), np.asarray(detector.v, np.float64)
            normal = np.cross(along, down)
            self._design[index, :3, -2] = along / np.linalg.norm(along)
            self._design[index, 3:, -1] = normal / np.linalg.norm(normal)

    def nothing(self) -> np.ndarray:
        """The numbers of an object that stands still."""
        return np.zeros(self._design.shape[2])

    def motion(self, numbers: np.ndarray, detector: bool = False) -> Motion:
        """Of all views.

        Args:
            detector: with what is the detector's.
        """
        ways = self._ways(numbers, detector)
        return Motion(ways[:, :3], ways[:, 3:] / self._reach, self._middle)

    def _ways(self, numbers: np.ndarray, detector: bool) -> np.ndarray:
        """(M, 6) mm."""
        shown: np.ndarray = self._design @ (numbers if detector else np.append(numbers[:-_DETECTOR], [0.0] * _DETECTOR))
        return shown

    def volume(self, numbers: np.ndarray) -> Volume:
        """What the training views make of an object that moved so, without what cannot be the object."""
        views = self._evidence.views
        here: Projections = replace(views, detectors=self.motion(numbers, True).seen_by(views.detectors))
        made = self._evidence.reconstructed(here)
        return carved(made, here, self._training)

    def says(self, numbers: np.ndarray, volume: Volume) -> Says:
        """What the registered views say of it."""
        motion = self.motion(numbers, True).at(self._used)
        return views_say(self._evidence, volume, self._used, motion, self._reach, self._pixel_mm)

    def solved(self, says: Says, numbers: np.ndarray) -> tuple[np.ndarray, float]:
        """The numbers that views ask for, and how many times their own variance they differ by."""
        normal, towards = self._sums(says, numbers)
        doubt = 1.0
        for _ in range(2):
            found = np.linalg.solve(normal / doubt + self._bending, towards / doubt)
            doubt = max(1.0, self._misfit(says, found - numbers) / self._freedom)
        return self._centred(found), doubt

    def detector_alone(self, says: Says, numbers: np.ndarray) -> np.ndarray:
        """The numbers with the detector where views ask for it, the object as it was."""
        design = self._design[self._used][:, :, -_DETECTOR:]
        normal = np.einsum("nka,nkb->ab", design, says.weight @ design)
        step = np.linalg.solve(normal, np.einsum("nka,nk->a", design, says.pull))
        return np.append(numbers[:-_DETECTOR], numbers[-_DETECTOR:] + step)

    def with_doubtful(self, says: Says, numbers: np.ndarray, doubt: float) -> np.ndarray:
        """The numbers with the detector where the files say, unless that bends the curves more than is likely.

        What goes round is the detector's if nothing else moves. Of an object that moves, a little of its own way goes
        round, too, and is its own.
        """
        normal, towards = self._sums(says, numbers)
        system, kept = normal / doubt + self._bending, np.s_[:-_DETECTOR]
        found = np.linalg.solve(system, towards / doubt)
        own = np.append(np.linalg.solve(system[kept, kept], towards[kept] / doubt), np.zeros(_DETECTOR))
        costs = float((own - found) @ system @ (own - found))
        return self._centred(own if costs < _LIKELY_BENDS else found)

    def _centred(self, found: np.ndarray) -> np.ndarray:
        """The numbers of a motion that is 0 on average over the training views."""
        count = (len(found) - _DETECTOR) // WAYS
        curve = self._design[self._training, 0, :count]
        for way in range(WAYS):
            part = found[way * count : (way + 1) * count]
            # The splines sum to one, and the step is not one of them.
            part[: self._pieces + 3] -= (curve @ part).mean()
        return found

    def _sums(self, says: Says, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Normal equations of the numbers themselves."""
        design = self._design[self._used]
        heavy = says.weight @ design
        normal = np.einsum("nka,nkb->ab", design, heavy)
        return normal, np.einsum("nka,nk->a", design, says.pull) + normal @ numbers

    @property
    def _freedom(self) -> int:
        return max(1, (WAYS - 1) * len(self._used) - self._design.shape[2])

    def _misfit(self, says: Says, step: np.ndarray) -> float:
        """Sum of squares, in errors, of what views say beside a step of the numbers."""
        own = np.einsum("nab,nb->na", np.linalg.pinv(says.weight, rcond=1e-9, hermitian=True), says.pull)
        beside = own - self._design[self._used] @ step
        return float(np.einsum("na,nab,nb->", beside, says.weight, beside))

    def slips(self, says: Says, numbers: np.ndarray, doubt: float, volume: Volume) -> bool:
        """Whether the object slipped once, for certain and by more than smooth curves can follow; noted if it did."""
        if self._slip is not None or len(self._used) <= 2 * _BESIDE_A_SLIP:
            return False
        design = self._design[self._used]
        normal, towards = self._sums(says, numbers)
        inverse = np.linalg.inv(normal / doubt + self._bending)
        heavy = says.weight @ design / doubt
        unmet = says.pull / doubt - np.einsum("nka,a->nk", heavy, inverse @ towards / doubt - numbers)
        best, best_at, best_step = 0.0, 0, np.zeros(WAYS)
        for at in range(_BESIDE_A_SLIP, len(self._used) - _BESIDE_A_SLIP + 1):
            cross, pull = heavy[at:].sum(axis=0), unmet[at:].sum(axis=0)
            left = says.weight[at:].sum(axis=0) / doubt - cross @ inverse @ cross.T
            step = np.linalg.solve(left + np.eye(WAYS) / (_SLIP_PX * self._pixel_mm) ** 2, pull)
            won = float(pull @ step)
            if won > best:
                best, best_at, best_step = won, at, step
        cuts = len(self._used) - 2 * _BESIDE_A_SLIP + 1
        sure = f_distribution.isf((1 - _CERTAIN) / cuts, WAYS, self._freedom)
        if best < WAYS * sure or self._way_px(best_step, volume) < _LEAST_SLIP_PX * self._evidence.block:
            return False
        self._slip = float(self._times[self._used[best_at - 1 : best_at + 1]].mean())
        self._laid()
        return True

    def _way_px(self, way: np.ndarray, volume: Volume) -> float:
        """How far a motion (6,) moves points of the object on the detector, rms, in pixels of the capture."""
        seen = self._seen(np.tile(way, (len(self._times), 1)), volume)
        return float(np.sqrt((seen**2).sum(axis=-1).mean()))

    def with_slip(self, numbers: np.ndarray) -> np.ndarray:
        """The numbers of curves to which a step was added."""
        curves_of = numbers[:-_DETECTOR].reshape(WAYS, -1)
        return np.concatenate([np.pad(curves_of, ((0, 0), (0, 1))).ravel(), numbers[-_DETECTOR:]])

    def seen_px(self, numbers: np.ndarray, volume: Volume) -> float:
        """How far that moves points of the object on the detector, rms, in pixels of the views."""
        seen = self._seen(self._design @ numbers, volume) / self._evidence.block
        return float(np.sqrt((seen**2).mean()))

    def _seen(self, ways: np.ndarray, volume: Volume) -> np.ndarray:
        """(training views, points, 2) how far motions (M, 6) move points of the object, in pixels of the capture."""
        solid = np.argwhere(volume.values >= _SOLID * _usual(volume.values))
        chosen = solid[np.random.default_rng(self._evidence.seed).integers(len(solid), size=_POINTS)]
        points = chosen[:, ::-1] * np.asarray(volume.spacing_mm) + np.asarray(volume.origin_mm)
        motion = Motion(ways[:, :3], ways[:, 3:] / self._reach, self._middle).at(self._training)
        detectors = [self._evidence.projections.detectors[index] for index in self._training]
        pairs = zip(motion.seen_by(detectors), detectors, strict=True)
        return np.stack([project_points(moved, points) - project_points(still, points) for moved, still in pairs])

    def told(
        self,
        numbers: np.ndarray,
        motion: Motion,
        says: Says,
        doubt: float,
        volume: Volume,
        settled: bool,
        gain: float,
    ) -> Settling:
        """What the last round found."""
        ways = self._ways(numbers, False)
        # A constant motion is the frame's, and one that goes round is the detector's: neither tells of a motion.
        still = np.tile(np.eye(WAYS), (len(ways), 1, 1))
        free = np.concatenate([still, self._design[:, :, -_DETECTOR:]], axis=2)
        weight = says.weight / doubt
        heavy = weight @ free[self._used]
        normal = np.einsum("nka,nkb->ab", free[self._used], heavy)
        towards = np.einsum("nka,nk->a", heavy, ways[self._used])
        ways = ways - free @ np.linalg.lstsq(normal, towards, rcond=None)[0]
        tells = float(np.einsum("na,nab,nb->", ways[self._used], weight, ways[self._used]))
        range_px = float(np.sqrt((np.ptp(self._seen(ways, volume), axis=0) ** 2).mean(axis=0).max()))
        count = max(1, len(numbers) - _DETECTOR - free.shape[2])
        ratio = tells / count
        slip = numbers[:-_DETECTOR].reshape(WAYS, -1)[:, -1] if self._slip is not None else np.zeros(WAYS)
        return Settling(
            motion=motion,
            slip_px=self._way_px(slip, volume),
            range_px=range_px,
            error_px=range_px / max(np.sqrt(ratio), 1e-9),
            certain=ratio > f_distribution.isf(1 - _CERTAIN, count, self._freedom),
            settled=settled,
            gain=gain,
        )


def _usual(values: np.ndarray) -> float:
    """What half of all that attenuates is below, of values that are 0 where there is no object, however small it is."""
    some = np.sort(values[values > 0])
    if not some.size:
        return 0.0
    total = np.cumsum(some, dtype=np.float64)
    return float(some[np.searchsorted(total, 0.5 * total[-1])])
