"""The colours of the same things in several photos."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter

from ...capture.background import border_parts, foreground_mask, plain_background
from ...capture.tracks import Tracks
from ...srgb import srgb_to_linear
from ...views import Camera

View = tuple[np.ndarray, Camera]
"""Pixels (H, W, 3) in 0..1 and their camera."""

# Of the sparse points that a photo sees, those that most others see, too: of them all whole sides could be missing.
_POINTS_A_PHOTO = 200
# Light below is noise, and sRGB no power of it; light above is cut off.
DARKEST, BRIGHTEST = 0.05, 0.9
# Of sRGB; parts of a border that are farther from the rest show something else.
_ALIKE = 0.06
_FEWEST_PIXELS = 50


class Colors(NamedTuple):
    """Of E sightings the place of the photo (E,), the thing (E,), and log linear light (E, 3): not a number where a
    channel is too dark or too bright to compare."""

    photo: np.ndarray
    thing: np.ndarray
    light: np.ndarray


def of_points(views: Sequence[View], tracks: Tracks) -> Colors:
    """Of sparse points, means over 3 x 3 pixels of the photos that see them."""
    chosen = np.zeros(len(tracks.points), bool)
    seen = np.bincount(tracks.point, minlength=len(tracks.points))
    for place in range(len(views)):
        own = tracks.point[tracks.photo == place]
        chosen[own[np.argsort(-seen[own], kind="stable")[:_POINTS_A_PHOTO]]] = True
    photos, things, light = [], [], []
    for place, (image, camera) in enumerate(views):
        points = tracks.point[(tracks.photo == place) & chosen[tracks.point]]
        columns, rows, inside = camera.pixels_of(tracks.points[points])
        mean = uniform_filter(srgb_to_linear(image), (3, 3, 0))
        photos.append(np.full(inside.sum(), place))
        things.append(points[inside])
        light.append(mean[rows[inside], columns[inside]])
    return Colors(np.concatenate(photos), np.concatenate(things), _comparable(np.concatenate(light)))


def of_borders(views: Sequence[View]) -> Colors:
    """Of eight parts of each photo's border where it is plain, whatever its colour; no sightings where none is."""
    photos, light = [], []
    for place, (image, _) in enumerate(views):
        plain = plain_background([image])
        if plain is None:
            continue
        colors = np.array([np.median(part, axis=0) for part in border_parts(image)])
        alike = np.abs(colors - plain).max(axis=1) <= _ALIKE
        photos.append(place)
        light.append(np.where(alike[:, None], srgb_to_linear(colors), np.nan))
    things = np.tile(np.arange(8), len(photos))
    return Colors(np.repeat(np.array(photos, np.int64), 8), things, _comparable(np.reshape(light, (-1, 3))))


def of_objects(views: Sequence[View]) -> np.ndarray:
    """(N, 3) log of the mean linear light of what stands before each photo's plain border; not a number where that is
    not plain, or hardly anything stands there."""
    found = np.full((len(views), 3), np.nan)
    for place, (image, _) in enumerate(views):
        plain = plain_background([image])
        if plain is None:
            continue
        mask = foreground_mask(image, plain)
        if mask.sum() >= _FEWEST_PIXELS:
            found[place] = np.log(np.maximum(srgb_to_linear(image[mask]).mean(axis=0), 1e-6))
    return found


def _comparable(light: np.ndarray) -> np.ndarray:
    known = (light >= DARKEST) & (light <= BRIGHTEST)
    return np.where(known, np.log(np.where(known, light, 1.0)), np.nan)
