"""A lens that bends lines, of cameras whose files say nothing of it: it is taken out before splats are placed.

Where cameras are found by structure from motion it finds the lens with them, and a lens that a file tells is taken out
as it says; neither is looked at here. What is found is kept as the `lens` of each photo, held-out ones too, so that all
who read photos get them straight: nothing is learnt, and no step takes longer.

Poses stay as they are given. Of the given focal length and principal point the fit asks for no more than points demand:
they are free beside the lens while it is looked for, so that a lens counts only by what no other focal length, no shift
and no other distance of the points explains, and are changed with it only where they are surely not as given.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ..capture.model import Lens, Photo
from ..capture.photos import fitted_size, pinhole_for
from ..capture.tracks import read_tracks
from ..told import Told
from ..views import Camera
from .finding import EffectFinding
from .look.lenses import NUMBERS, Lenses, as_stored, distorted, fitted, folds
from .look.readout import chosen, motions
from .photos import PhotoEvidence

_NAME, _UNIT = "lens", "px"
# In the corner; over the image the mean of r³ is 2 / 5 of that. A shift by 0.2 px changes an image of edges of height
# 0.3, in a tenth of its pixels, by 0.0018 in mean square: 27 dB.
THRESHOLD = 0.5
"""Px that the corner of a photo, as it is trained, has to be off by."""

_ERRORS, _SURELY_NOT, _CHANCE = 3.0, 2.0, 1e-4
# What a lens explains of how far sightings are off: 0.2 % on a clean pharaoh, where features are a little aside as if
# there were one, and 2 to 8 % on three phantoms with one.
_LEAST_EXPLAINED = 0.005
# Of the same, what cameras that move while rows are read out explain: from a fifth on, and twice what the lens does,
# nobody knows what of it is a lens. 83 and 2 % on a matryoshka with a rolling shutter alone, 2 and 19 % with a lens.
_BY_ROWS, _TIMES = 0.2, 2.0
_FEWEST_POINTS, _FEWEST_PHOTOS, _MOST_OF_THEM, _POINTS_A_PHOTO = 30, 3, 0.5, 1000
# Structure from motion keeps no point that is off by more.
_MOST_ERROR_PX = 4.0
# Photos of one lens have focal lengths that differ by less, where each has its own.
_SAME_FOCAL = 0.02
# Photos without their lens show a little more than with it.
_BEYOND = 1.1

Numbers = Mapping[Path, np.ndarray]
"""Of each photo with a lens that was found, by its path: see `NUMBERS`, pixels those of the photo's own camera."""


@dataclass(frozen=True, eq=False)
class Look:
    """What points tell of lenses.

    Attributes:
        finding: of the lens that moves a corner most.
        numbers: of all photos with a lens that is needed; where none is, of all whose lens could be told.
        more: whether points of photos from which this is taken out may tell more.
    """

    finding: EffectFinding
    numbers: Numbers = field(default_factory=dict)
    more: bool = False


def detect(evidence: PhotoEvidence) -> EffectFinding:
    """How many pixels of training a photo's corner is from where it would be without a lens; of several lenses the one
    that moves it most."""
    return look(evidence).finding


def look(evidence: PhotoEvidence, known: Numbers | None = None) -> Look:
    """See `detect`.

    Args:
        evidence: its photos have the cameras that were given. Its model is of the training photos from which `known`
            was taken out.
    """
    photos = [photo for photo in evidence.photos.photos if photo.camera is not None]
    if not photos or all(photo.lens is not None for photo in photos):
        return Look(told_by_files())
    if evidence.model is None or any(camera.orthographic for camera in evidence.cameras):
        return _unknown(Told("No points that photos share tell whether their lens bends lines."))
    tracks = read_tracks(evidence.model, evidence.cameras, evidence.tick, _MOST_ERROR_PX)
    if tracks is None:
        return _unknown(Told("No points that photos share tell whether their lens bends lines."))
    evidence.tick()
    count = len(evidence.training)
    tracks = chosen(tracks, count, _FEWEST_POINTS, _POINTS_A_PHOTO)
    seen = np.bincount(tracks.photo, minlength=count) > 0
    if seen.sum() < max(_FEWEST_PHOTOS, _MOST_OF_THEM * count):
        few = "Too few photos share {points} points to say whether their lens bends lines."
        return _unknown(Told(few, points=_FEWEST_POINTS))
    groups = _groups(photos)
    of_training = [groups[photo.path] for photo in evidence.training]
    enough = {one for one in set(of_training) - {-1} if (seen & (np.array(of_training) == one)).sum() >= _FEWEST_PHOTOS}
    if not enough:
        few = "Too few photos of one lens share {points} points to say whether it bends lines."
        return _unknown(Told(few, points=_FEWEST_POINTS))
    numbered = {one: place for place, one in enumerate(sorted(enough))}
    group = np.array([numbered.get(one, -1) for one in of_training])
    before = np.array([_scaled(known, photo, evidence.long_side) for photo in evidence.training])
    firsts = [int(np.flatnonzero(group == place)[0]) for place in range(len(numbered))]
    cameras = [evidence.cameras[first] for first in firsts]
    reach = [_BEYOND * _farthest(camera) for camera in cameras]
    raw = as_stored(evidence.cameras, tracks, before)
    found = fitted(evidence.cameras, raw, group, before[firsts], reach)
    if any(folds(own[3:], far) for own, far in zip(found.numbers, reach, strict=True)):
        return _unknown(Told("Points that photos share ask for a lens that would show some places twice."))
    ways = [
        _in_the_corner(camera, own, covariance)
        for camera, own, covariance in zip(cameras, found.numbers, found.covariance, strict=True)
    ]
    finding, more = _finding(ways, found), max(ways)[0] >= THRESHOLD and found.explained >= _LEAST_EXPLAINED
    if more:
        evidence.tick()
        by_rows = motions(evidence.cameras, chosen(raw, count, _FEWEST_POINTS)).by_rows
        if by_rows >= max(_BY_ROWS, _TIMES * found.explained):
            return _unknown(Told("Cameras moved while photos were read out; beside that it cannot be told of a lens."))
    wanted = [not finding.found or (px >= THRESHOLD and px >= _ERRORS * error) for px, error in ways]
    of = {one: found.numbers[place] for one, place in numbered.items() if wanted[place]}
    numbers = {
        photo.path: of[groups[photo.path]] / _scale(photo, evidence.long_side)
        for photo in photos
        if groups[photo.path] in of
    }
    return Look(finding, numbers, more)


def told_by_files() -> EffectFinding:
    """Of photos whose cameras' file has a lens for each."""
    reason = Told("The cameras' file tells of the lens, and it is taken out as the file says.")
    return EffectFinding(_NAME, False, None, _UNIT, THRESHOLD, reason)


def found_with_cameras() -> EffectFinding:
    """Of photos whose cameras structure from motion finds."""
    reason = Told("Structure from motion finds what the lens bends together with the cameras, and it is taken out.")
    return EffectFinding(_NAME, False, None, _UNIT, THRESHOLD, reason)


def taken_out(photos: Sequence[Photo], numbers: Numbers) -> list[Photo]:
    """The photos with the lenses that were found, and the pinhole cameras that fit them."""
    return [_with_lens(photo, numbers[photo.path]) if photo.path in numbers else photo for photo in photos]


def apart(photos: Sequence[Photo], one: Numbers, other: Numbers, long_side: int) -> float:
    """Px of training by which lenses differ at most, in corners and in what focal length and principal point differ."""
    ways = [0.0]
    for photo in photos:
        if photo.path in one or photo.path in other:
            camera = _trained(_camera(photo), long_side)
            shown = [_corners(camera, _scaled(numbers, photo, long_side)) for numbers in (one, other)]
            ways.append(float(np.linalg.norm(shown[0] - shown[1], axis=1).max()))
    return max(ways)


def _finding(ways: Sequence[tuple[float, float]], found: Lenses) -> EffectFinding:
    strength, error = max(ways)
    told = Told(
        "The lens moves a photo's corner by {px:.2f} px (the most of {count} lenses), give or take {error:.2f} px"
        if len(ways) > 1
        else "The lens moves a photo's corner by {px:.2f} px, give or take {error:.2f} px",
        px=strength,
        count=len(ways),
        error=error,
    )
    sure = strength >= _ERRORS * error and found.chance < _CHANCE and found.explained >= _LEAST_EXPLAINED
    needed: bool | None = bool(strength >= THRESHOLD and sure)
    if needed:
        why = "{told}, and the cameras' file says nothing of it; from {least:g} px on that blurs the model."
        reason = Told(why, told=told, least=THRESHOLD)
    elif strength + _SURELY_NOT * error < THRESHOLD:
        needed, reason = False, Told("{told}; less than {least:g} px does no harm.", told=told, least=THRESHOLD)
    else:
        needed, reason = None, Told("{told}; that is too uncertain to say whether it matters.", told=told)
    return EffectFinding(_NAME, needed, strength, _UNIT, THRESHOLD, reason, error)


def _unknown(reason: Told) -> Look:
    return Look(EffectFinding(_NAME, None, None, _UNIT, THRESHOLD, reason))


def _groups(photos: Sequence[Photo]) -> dict[Path, int]:
    """Which lens each photo has, by its path: photos of one size whose focal lengths are alike; −1 where the file tells
    of it."""
    found, last, number = {}, None, -1
    for photo in sorted(photos, key=lambda one: (_camera(one).width, _camera(one).height, _camera(one).fx)):
        camera = _camera(photo)
        if photo.lens is not None:
            found[photo.path] = -1
            continue
        alike = last is not None and (last.width, last.height) == (camera.width, camera.height)
        if last is None or not alike or camera.fx > (1 + _SAME_FOCAL) * last.fx:
            number += 1
        found[photo.path], last = number, camera
    return found


def _in_the_corner(camera: Camera, numbers: np.ndarray, covariance: np.ndarray) -> tuple[float, float]:
    """Px by which a lens moves the corner that it moves most, and the error."""
    bare = numbers.copy()
    bare[:3] = 0
    ways = _corners(camera, bare) - _corners(camera, np.zeros(NUMBERS))
    lengths = np.linalg.norm(ways, axis=1)
    worst = int(np.argmax(lengths))
    # Displacements are linear in the coefficients.
    by_number = np.stack([_corners(camera, one)[worst] for one in np.eye(NUMBERS)[3:]], axis=1)
    by_number -= _corners(camera, np.zeros(NUMBERS))[worst][:, None]
    both = by_number @ covariance[3:, 3:] @ by_number.T
    along = ways[worst] / lengths[worst] if lengths[worst] > 0 else np.array([1.0, 0.0])
    return float(lengths[worst]), float(max(along @ both @ along, 0.0)) ** 0.5


def _corners(camera: Camera, numbers: np.ndarray) -> np.ndarray:
    """(4, 2) px, where a lens shows what a pinhole shows in the corners."""
    at = np.array([[x, y] for x in (0.0, camera.width) for y in (0.0, camera.height)])
    focal, middle = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    return focal * (1 + numbers[0]) * distorted((at - middle) / focal, numbers[3:]) + middle + numbers[1:3]


def _farthest(camera: Camera) -> float:
    """How far a corner is from the middle at most, as a share of the focal length."""
    far = np.hypot(max(camera.cx, camera.width - camera.cx), max(camera.cy, camera.height - camera.cy))
    return float(far) / min(camera.fx, camera.fy)


def _with_lens(photo: Photo, numbers: np.ndarray) -> Photo:
    camera = _camera(photo)
    lens = Lens(
        width=camera.width,
        height=camera.height,
        fx=float(camera.fx * (1 + numbers[0])),
        fy=float(camera.fy * (1 + numbers[0])),
        cx=float(camera.cx + numbers[1]),
        cy=float(camera.cy + numbers[2]),
        coefficients=tuple(float(value) for value in numbers[3:]),
    )
    return replace(photo, camera=pinhole_for(lens, np.asarray(camera.world_to_camera)), lens=lens)


def _scaled(numbers: Numbers | None, photo: Photo, long_side: int) -> np.ndarray:
    """(7,) of a photo in pixels of training; 0 where there is none."""
    own = None if numbers is None else numbers.get(photo.path)
    return np.zeros(NUMBERS) if own is None else own * _scale(photo, long_side)


def _scale(photo: Photo, long_side: int) -> np.ndarray:
    """(7,) what numbers of a photo's own pixels are multiplied by to be those of training."""
    camera = _camera(photo)
    shrunk = _trained(camera, long_side).width / camera.width
    return np.array([1.0, shrunk, shrunk, 1.0, 1.0, 1.0, 1.0])


def _trained(camera: Camera, long_side: int) -> Camera:
    return camera.resized(*fitted_size(camera.width, camera.height, long_side))


def _camera(photo: Photo) -> Camera:
    if photo.camera is None:
        raise AssertionError("only photos with cameras get here")
    return photo.camera
