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
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..capture.model import Lens, Photo
from ..capture.photos import fitted_size, pinhole_for
from ..capture.tracks import Tracks, read_tracks
from ..views import Camera
from .finding import EffectFinding
from .look.lenses import NUMBERS, as_stored, distorted, fitted
from .look.readout import chosen
from .photos import PhotoEvidence

_NAME, _UNIT = "lens", "px"
# In the corner; over the image the mean of r³ is 2 / 5 of that. A shift by 0.2 px changes an image of edges of height
# 0.3, in a tenth of its pixels, by 0.0018 in mean square: 27 dB.
THRESHOLD = 0.5
"""Px that the corner of a photo, as it is trained, has to be off by."""

SETTLED_PX = 0.05
"""What is found in photos from which a lens was taken out changes it no more than this in the corner."""

_ERRORS, _SURELY_NOT, _CHANCE = 3.0, 2.0, 1e-4
_FEWEST_POINTS, _FEWEST_PHOTOS, _MOST_OF_THEM, _POINTS_A_PHOTO = 30, 3, 0.5, 1000
# Structure from motion keeps no point that is off by more.
_MOST_ERROR_PX = 4.0
# Photos of one lens have focal lengths that differ by less, where each has its own.
_SAME_FOCAL = 0.02
# Less than this share of a step outwards in the scene leads outwards in the photo: the lens folds.
_LEAST_SLOPE, _BEYOND = 0.2, 1.1

Numbers = Mapping[Path, np.ndarray]
"""Of each photo with a lens that was found, by its path: see `NUMBERS`, pixels those of the photo's own camera."""


@dataclass(frozen=True, eq=False)
class _Looked:
    """Lenses by group: (G, 7) numbers in pixels of training, by how much the farthest corner moves, its error."""

    numbers: np.ndarray
    strength: np.ndarray
    error: np.ndarray


def detect(evidence: PhotoEvidence, known: Numbers | None = None) -> tuple[EffectFinding, dict[Path, np.ndarray]]:
    """How many pixels of training a photo's corner is from where it would be without a lens; of several lenses the one
    that moves it most.

    Args:
        evidence: its photos have the cameras that were given. Its model is of the training photos from which `known`
            was taken out.

    Returns:
        What was found, and the lenses of all photos that belong to one that is needed; where none is, of all whose lens
        could be told; nothing where none could.
    """
    photos = [photo for photo in evidence.photos.photos if photo.camera is not None]
    if not photos or all(photo.lens is not None for photo in photos):
        return told_by_files(), {}
    if evidence.model is None or any(camera.orthographic for camera in evidence.cameras):
        return _unknown("No points that photos share tell whether their lens bends lines."), {}
    tracks = read_tracks(evidence.model, evidence.cameras, evidence.tick, _MOST_ERROR_PX)
    if tracks is None:
        return _unknown("No points that photos share tell whether their lens bends lines."), {}
    evidence.tick()
    count = len(evidence.training)
    tracks = chosen(tracks, count, _FEWEST_POINTS, _POINTS_A_PHOTO)
    seen = np.bincount(tracks.photo, minlength=count) > 0
    if seen.sum() < max(_FEWEST_PHOTOS, _MOST_OF_THEM * count):
        return _unknown(f"Too few photos share {_FEWEST_POINTS} points to say whether their lens bends lines."), {}
    groups = _groups(photos)
    group = np.array([groups[photo.path] for photo in evidence.training])
    enough = {one for one in set(group.tolist()) - {-1} if (seen & (group == one)).sum() >= _FEWEST_PHOTOS}
    if not enough:
        return _unknown(f"Too few photos of one lens share {_FEWEST_POINTS} points to say whether it bends lines."), {}
    numbered = {one: place for place, one in enumerate(sorted(enough))}
    group = np.array([numbered.get(one, -1) for one in group.tolist()])
    before = np.array([_scaled(known, photo, evidence.long_side) for photo in evidence.training])
    tracks = as_stored(evidence.cameras, tracks, before)
    start = np.array([before[group == place][0] for place in range(len(numbered))])
    looked, chance = _looked(evidence.cameras, tracks, group, start)
    if looked is None:
        return _unknown("Points that photos share ask for a lens that would show some places twice."), {}
    finding = _finding(looked, chance, int(seen.sum()))
    needed = (looked.strength >= THRESHOLD) & (looked.strength >= _ERRORS * looked.error)
    wanted = needed if finding.found else np.ones(len(numbered), bool)
    of = {one: looked.numbers[place] for one, place in numbered.items() if wanted[place]}
    return finding, {
        photo.path: of[groups[photo.path]] / _scale(photo, evidence.long_side)
        for photo in photos
        if groups[photo.path] in of
    }


def told_by_files() -> EffectFinding:
    """Of photos whose cameras' file has a lens for each."""
    reason = "The cameras' file tells of the lens, and it is taken out as the file says."
    return EffectFinding(_NAME, False, None, _UNIT, THRESHOLD, reason)


def found_with_cameras() -> EffectFinding:
    """Of photos whose cameras structure from motion finds."""
    reason = "Structure from motion finds what the lens bends together with the cameras, and it is taken out."
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


def _looked(
    cameras: Sequence[Camera], tracks: Tracks, group: np.ndarray, start: np.ndarray
) -> tuple[_Looked | None, float]:
    found = fitted(cameras, tracks, group, start)
    strength, error = np.zeros(len(start)), np.zeros(len(start))
    for place, numbers in enumerate(found.numbers):
        camera = cameras[int(np.flatnonzero(group == place)[0])]
        if _folds(camera, numbers):
            return None, found.chance
        strength[place], error[place] = _in_the_corner(camera, numbers, found.covariance[place])
    return _Looked(found.numbers, strength, error), found.chance


def _finding(looked: _Looked, chance: float, photos: int) -> EffectFinding:
    worst = int(np.argmax(looked.strength))
    strength, error = float(looked.strength[worst]), float(looked.error[worst])
    several = f" (the most of {len(looked.strength)} lenses)" if len(looked.strength) > 1 else ""
    told = f"The lens moves a photo's corner by {strength:.2f} px{several}, give or take {error:.2f} px"
    needed: bool | None = bool(strength >= THRESHOLD and strength >= _ERRORS * error and chance < _CHANCE)
    if needed:
        reason = f"{told}, and the cameras' file says nothing of it; from {THRESHOLD:g} px on that blurs the model."
    elif strength + _SURELY_NOT * error < THRESHOLD:
        needed, reason = False, f"{told}; less than {THRESHOLD:g} px does no harm."
    else:
        needed, reason = None, f"{told}; that is too uncertain to say whether it matters."
    return EffectFinding(_NAME, needed, strength, _UNIT, THRESHOLD, reason, error)


def _unknown(reason: str) -> EffectFinding:
    return EffectFinding(_NAME, None, None, _UNIT, THRESHOLD, reason)


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


def _folds(camera: Camera, numbers: np.ndarray) -> bool:
    """Whether farther out in the scene would be farther in somewhere in the photo."""
    far = np.hypot(max(camera.cx, camera.width - camera.cx), max(camera.cy, camera.height - camera.cy))
    square = (np.linspace(0, _BEYOND, 50) * far / min(camera.fx, camera.fy)) ** 2
    return bool((1 + 3 * numbers[3] * square + 5 * numbers[4] * square**2).min() < _LEAST_SLOPE)


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
