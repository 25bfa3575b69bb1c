"""Whether the backgrounds of photos are the same image, and that image without what stands before it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from ...capture.backdrop import border, in_light, light_ratio, pattern
from ...progress import Tick, unstopped

# Of a photo's others so many have to show the same background: a camera may stand at up to five heights in turn.
SHARE, FEWEST = 0.15, 4
# Pixels that are the same in nine of ten photos are never covered, or always by what looks the same from all sides.
_STILL, _SEEN, _SEEN_BY = 0.9, 0.15, 3
_NOISES, _LEAST_TOLERANCE, _MOST_TOLERANCE = 4.0, 0.03, 0.12
# Rows of pixels at a time.
_ROWS = 32


def alike(images: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """How alike the patterns of the photos' borders are at the same pixels.

    Args:
        images: (H, W, 3) in 0..1.

    Returns:
        (N, N) correlations, not a number on the diagonal and between photos of several sizes; (N,) standard deviations
        of the borders' patterns.
    """
    frames = [pattern(image)[border(*image.shape[:2])] for image in images]
    found = np.full((len(images), len(images)), np.nan)
    for size in {image.shape for image in images}:
        same = [place for place, image in enumerate(images) if image.shape == size]
        values = np.stack([frames[place] - frames[place].mean() for place in same])
        values /= np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-9)
        found[np.ix_(same, same)] = values @ values.T
    np.fill_diagonal(found, np.nan)
    return found, np.array([frame.std() for frame in frames])


def groups(correlations: np.ndarray, least: float) -> list[np.ndarray]:
    """Places of photos with one background, the largest group first: those that are as alike as that to one of them.

    Args:
        correlations: (N, N) of `alike`.
    """
    left, found = np.nan_to_num(correlations, nan=-1.0) >= least, []
    needed = max(FEWEST, int(np.ceil(SHARE * (len(correlations) - 1))))
    while len(left) and left.sum(axis=1).max() >= needed:
        first = int(left.sum(axis=1).argmax())
        members = np.flatnonzero(left[first] | (np.arange(len(left)) == first))
        found.append(members)
        left[members] = left[:, members] = False
    return found


def tolerance_of(levels: np.ndarray) -> float:
    """Largest difference of a channel that is noise, by the borders of photos (N, H, W, 3) bytes of one background."""
    frames = levels[:, border(*levels.shape[1:3])].astype(np.float32) / 255
    noise = 1.4826 * float(np.median(np.abs(frames - np.median(frames, axis=0))))
    return float(np.clip(_NOISES * noise, _LEAST_TOLERANCE, _MOST_TOLERANCE))


def in_one_light(levels: np.ndarray) -> np.ndarray:
    """Bytes (N, H, W, 3) of photos with one background, as bright as the middle one of them."""
    frame = border(*levels.shape[1:3])
    middle = np.zeros(levels.shape[1:], np.float32)
    middle[frame] = np.median(levels[:, frame], axis=0) / 255
    result = levels
    for place, image in enumerate(levels):
        gain = light_ratio(image / np.float32(255), middle, frame)
        if (gain != 1).any():
            result = levels.copy() if result is levels else result
            result[place] = np.round(255 * in_light(image / np.float32(255), 1 / gain))
    return result


def most_common(levels: np.ndarray, tolerance: float, tick: Tick = unstopped) -> tuple[np.ndarray, np.ndarray]:
    """At each pixel the colour that most photos show, and the share of them that does.

    A median would need the background in more than half of the photos.

    Args:
        levels: (N, H, W, 3) bytes.
        tolerance: colours that differ by less in all channels are the same.
        tick: called now and then; may raise to stop.

    Returns:
        (H, W, 3) in 0..1, the mean of those that agree, and (H, W).
    """
    count, height, width = levels.shape[:3]
    color, share = np.zeros((height, width, 3), np.float32), np.zeros((height, width), np.float32)
    for row in range(0, height, _ROWS):
        tick()
        part = levels[:, row : row + _ROWS].reshape(count, -1, 3).astype(np.int16)
        most, mean = np.zeros(part.shape[1], np.int64), np.zeros(part.shape[1:], np.float32)
        # What more than half of them show nothing else can beat.
        left = np.arange(part.shape[1])
        for one in range(count):
            seen = part[:, left]
            same = (np.abs(seen - seen[one]) <= 255 * tolerance).all(axis=-1)
            votes = same.sum(axis=0)
            better = votes > most[left]
            places = left[better]
            most[places] = votes[better]
            mean[places] = (seen[:, better] * same[:, better, None]).sum(axis=0) / votes[better, None]
            left = left[2 * most[left] <= count]
        color[row : row + _ROWS] = mean.reshape(-1, width, 3) / 255
        share[row : row + _ROWS] = most.reshape(-1, width) / count
    return color, share


def is_background(share: np.ndarray, count: int) -> np.ndarray:
    """Where (H, W) the most common colour is that of the background.

    What nearly all photos show is so only if it reaches the image's border: inside it is the object's, where that
    looks the same from all sides.

    Args:
        share: (H, W) of `most_common`.
        count: of photos.
    """
    still = share >= _STILL
    labels, _ = ndimage.label(still)
    reached = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    outside = np.isin(labels, reached[reached > 0])
    return outside | (~still & (share >= max(_SEEN, _SEEN_BY / count)))


def is_covered(share: np.ndarray) -> float:
    """The share of all pixels that something stands before in some photos."""
    return float((share < _STILL).mean())
