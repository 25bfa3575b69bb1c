"""Photos of an object that turns before a camera and a room that stand still: seen from the object the room turns, so
that it agrees with no model of it.

The room is taken out before cameras are looked for: what it shows at a pixel is the same in most photos.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from ..capture.backdrop import correlation, frame_of, object_mask, pattern, write_plate
from ..capture.background import color_apart, plain_background
from ..capture.model import Backdrop, Photo, Photos
from ..capture.photos import read_bare
from ..evaluate.photos import spread
from ..progress import Tick, unstopped
from ..told import Told
from .finding import EffectFinding
from .look.still import (
    FEWEST,
    SHARE,
    alike,
    groups,
    in_one_light,
    is_background,
    is_covered,
    most_common,
    shown,
    tolerance_of,
    torn,
)

_NAME, _UNIT = "moving_background", "%"
# Of patterns that have nothing to do with each other the correlation is 0 ± 1 / √n with n patches in a border, at least
# 100 of them; noise of half a pattern's strength leaves 80 % of it. Rooms that stand still are alike to 96 % and more.
_THRESHOLD, _ERRORS, _SURELY_NOT = 70.0, 3.0, 2.0
_LEAST_TEXTURE = 0.01
# Cameras this close to each other may see the same room though both move with it.
_APART_DEGREES = 20.0
# So many photos have to be before one colour; objects that reach the border hide it in some.
_PLAIN = 0.5
# Something has to turn before it.
_LEAST_COVERED = 0.01
# Whole objects have gaps of 1 to 4 % of their outlines; those that lost a tenth of themselves, of more than 10 %.
_MOST_TORN = 0.07
_TOO_FEW = Told("Too few photos share a background; it is left as it is.")
_LONGEST, _MOST_PHOTOS, _SMALL = 400, 40, 160
_PLATE_SIDE, _PLATE_PHOTOS = 800, 32


@dataclass(frozen=True, eq=False)
class BareEvidence:
    """Photos as they came, with cameras or without, and what was computed of them, each once.

    Attributes:
        photos: of the capture.
        tick: called between photos; may raise to stop.
    """

    photos: Photos
    tick: Tick = unstopped

    @cached_property
    def training(self) -> list[Photo]:
        """Up to 40 photos, evenly over those that are not held out."""
        return spread([photo for photo in self.photos.photos if not photo.held_out], _MOST_PHOTOS)

    @cached_property
    def views(self) -> list[np.ndarray]:
        """Pixels (H, W, 3) in 0..1 of `training`, at most 400 a side. Raises CaptureError."""
        return [self._read(photo, _LONGEST) for photo in self.training]

    @cached_property
    def correlations(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """`alike` of `views`; not numbers between photos whose cameras stand close to each other, either."""
        found, textures, patches = alike(self.views)
        cameras = [photo.camera for photo in self.training]
        if all(camera is not None for camera in cameras):
            axes = np.array([np.asarray(camera.world_to_camera)[2, :3] for camera in cameras if camera is not None])
            close = axes @ axes.T > np.cos(np.radians(_APART_DEGREES))
            found = np.where(close, np.nan, found)
        return found, textures, patches

    def _read(self, photo: Photo, side: int) -> np.ndarray:
        self.tick()
        return read_bare(photo, side)


@dataclass(frozen=True)
class Left:
    """Why a background is not taken out.

    Attributes:
        reason: a sentence.
        unsure: whether what stands before it cannot be told from it.
    """

    reason: Told
    unsure: bool = False


def detect(evidence: BareEvidence) -> EffectFinding:
    """How alike the photos' backgrounds are at the same pixels: a photo's correlation with the one of its others that
    leaves 15 % of them above it, the median over photos, in percent.

    Backgrounds that are plain are never found to move: nothing of them is in the way.
    """
    if len(evidence.training) <= FEWEST:
        few = "There are {count} photos, too few to tell what stands still in them."
        return _unknown(Told(few, count=len(evidence.training)))
    # Each by itself, for exposures may differ.
    if sum(plain_background([image]) is not None for image in evidence.views) > _PLAIN * len(evidence.views):
        return replace(_unknown(Told("The background is plain; nothing of it can disagree.")), found=False)
    correlations, textures, patches = evidence.correlations
    if np.median(textures) < _LEAST_TEXTURE:
        return _unknown(Told("The background is not plain, but too smooth to tell whether it stands still."))
    best = _typical(correlations)
    known = np.isfinite(best)
    if known.sum() <= FEWEST:
        return _unknown(Told("The photos are taken from too few sides to tell what stands still in them."))
    middle = float(np.median(best[known]))
    # Of a median of normal numbers, and of a correlation of so many patches, which all photos share.
    drawn = 1.25 * float(best[known].std()) / float(known.sum()) ** 0.5
    measured = (1 - middle**2) / float(np.median(patches[known])) ** 0.5
    strength, error = 100 * middle, 100 * float(np.hypot(drawn, measured))
    told = Told(
        "At the same pixels the photos' backgrounds are {share:.0f} % alike, give or take {error:.0f} %",
        share=strength,
        error=error,
    )
    found: bool | None = strength >= max(_THRESHOLD, _ERRORS * error)
    if found and _covered(evidence) < _LEAST_COVERED:
        found, reason = None, Told("{told}, but so is what they stand behind: nothing is seen to turn.", told=told)
    elif found:
        why = "{told}; from {least:g} % on the object turns before them, and they become clouds around it."
        reason = Told(why, told=told, least=_THRESHOLD)
    elif strength + _SURELY_NOT * error < _THRESHOLD:
        why = "{told}; under {least:g} % they turn with the object, and are part of the scene."
        found, reason = False, Told(why, told=told, least=_THRESHOLD)
    else:
        found, reason = None, Told("{told}; that is too uncertain to say whether they stand still.", told=told)
    return EffectFinding(_NAME, found, strength, _UNIT, _THRESHOLD, reason, error)


def _typical(correlations: np.ndarray) -> np.ndarray:
    """(N,) of each photo the correlation that so many of its others reach as have to share its background."""
    rank = max(FEWEST, int(np.ceil(SHARE * (len(correlations) - 1))))
    ordered = -np.sort(-correlations, axis=1)
    return ordered[:, rank - 1] if ordered.shape[1] >= rank else np.full(len(correlations), np.nan)


def _covered(evidence: BareEvidence) -> float:
    """The largest share of an image that something turns before."""
    shares = []
    for members in groups(evidence.correlations[0], _THRESHOLD / 100):
        evidence.tick()
        level = in_one_light(_read(evidence, [evidence.training[place] for place in members[:_PLATE_PHOTOS]], _SMALL))
        shares.append(is_covered(most_common(level, tolerance_of(level), evidence.tick)[1]))
    return max(shares, default=0.0)


def _unknown(reason: Told) -> EffectFinding:
    return EffectFinding(_NAME, None, None, _UNIT, _THRESHOLD, reason)


def taken_out(evidence: BareEvidence, folder: Path) -> Photos | Left:
    """The photos with backdrops, which are taken out whenever they are read, or why they are left as they are: too few
    share a background, or the object cannot be told from it.

    Photos before another background are left out, as those are that structure from motion cannot place.

    Args:
        folder: where the backdrops are left, as `backdrop-1.png` and so on.

    Raises:
        CaptureError: a photo cannot be read.
        DiskFullError, RunFolderError: the folder cannot be written.
        Cancelled: through the evidence's tick.
    """
    plates = []
    for number, members in enumerate(groups(evidence.correlations[0], _THRESHOLD / 100), start=1):
        photos = spread([evidence.training[place] for place in members], _PLATE_PHOTOS)
        plates.append(_make_plate(evidence, photos, folder / f"backdrop-{number}.png"))
    found = _with_backdrops(evidence, plates)
    if isinstance(found, Left):
        for plate in plates:
            plate.path.unlink(missing_ok=True)
    return found


def _with_backdrops(evidence: BareEvidence, plates: Sequence[_Plate]) -> Photos | Left:
    if not plates:
        return Left(_TOO_FEW)
    worst = max(plate.torn for plate in plates)
    if worst > _MOST_TORN:
        reason = Told(
            "The object has too much of one color to be told from the room ({share:.0f} % of it would go with it); "
            "photograph it before a plain background.",
            share=100 * worst,
        )
        return Left(reason, unsure=True)
    color = color_apart(np.concatenate([plate.object_colors for plate in plates]))
    kept = []
    for photo in evidence.photos.photos:
        evidence.tick()
        behind = _behind(read_bare(photo, _LONGEST), plates)
        if behind is not None:
            kept.append(replace(photo, backdrop=Backdrop(behind.path, color, behind.tolerance)))
    training = sum(not photo.held_out for photo in kept)
    return replace(evidence.photos, photos=kept) if training > FEWEST else Left(_TOO_FEW)


@dataclass(frozen=True, eq=False)
class _Plate:
    """A background: its image in a file and small, where that shows something, colours (K, 3) of what is before it, and
    how torn that is."""

    path: Path
    tolerance: float
    small: np.ndarray
    shown: np.ndarray
    object_colors: np.ndarray
    torn: float


def _make_plate(evidence: BareEvidence, photos: Sequence[Photo], path: Path) -> _Plate:
    levels = in_one_light(_read(evidence, photos, _PLATE_SIDE))
    tolerance = tolerance_of(levels)
    plate, share = most_common(levels, tolerance, evidence.tick)
    known = is_background(levels, plate, share, tolerance, evidence.tick)
    write_plate(path, plate, known)
    colors, gaps = [], []
    for image in levels[:: max(1, len(levels) // 8)]:
        evidence.tick()
        values = image / np.float32(255)
        mask = object_mask(values, plate, known, tolerance)
        colors.append(values[mask][:: max(1, known.size // 4000)])
        gaps.append(torn(mask))
    seen = shown(image / np.float32(255) for image in levels)
    return _Plate(path, tolerance, plate, seen, np.concatenate(colors), float(np.mean(gaps)))


def _behind(image: np.ndarray, plates: Sequence[_Plate]) -> _Plate | None:
    """The background that a photo shows, None where it shows another."""
    import cv2

    best, found = _THRESHOLD / 100, None
    for plate in plates:
        size = image.shape[1], image.shape[0]
        if abs(plate.small.shape[1] * size[1] - plate.small.shape[0] * size[0]) > max(*size, *plate.small.shape[:2]):
            continue
        small = cv2.resize(plate.small, size, interpolation=cv2.INTER_AREA)
        seen = cv2.resize(plate.shown.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.999
        frame = frame_of(seen)
        like = correlation(pattern(image, seen)[frame], pattern(small, seen)[frame])
        if like >= best:
            best, found = like, plate
    return found


def _read(evidence: BareEvidence, photos: Sequence[Photo], side: int) -> np.ndarray:
    """Bytes (N, H, W, 3) of photos, at most `side` pixels a side.

    Photos whose sizes differ a little are of one size as thumbnails, and not always when they are scaled to another: of
    several sizes there are those of the most common one.
    """
    read = []
    for photo in photos:
        evidence.tick()
        read.append(np.round(255 * read_bare(photo, side)).astype(np.uint8))
    shape, _ = Counter(image.shape for image in read).most_common(1)[0]
    return np.stack([image for image in read if image.shape == shape])
