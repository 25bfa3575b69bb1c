"""Whether the backgrounds of photos are the same image, and that image without what stands before it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import cv2
import numpy as np
from scipy import ndimage

from ...capture.backdrop import frame_of, in_light, light_ratio, pattern, pattern_reach
from ...capture.background import drop_small
from ...progress import Tick, unstopped

# Of a photo's others so many have to show the same background: a camera may stand at up to five heights in turn.
SHARE, FEWEST = 0.15, 4
# Pixels that are the same in nine of ten photos are never covered, or always by what looks the same from all sides.
_STILL, _SEEN, _SEEN_BY = 0.9, 0.15, 3
# Colours that agree because they are one differ by noise, a quarter of the tolerance; those that are alike by chance,
# evenly over it, by 1 / √3 of it. What is looked at is the middle of so many pixels.
_TIGHT, _NOT_TIGHT, _UNEVEN, _MIDDLE_PX = 0.375, 0.5, 1.1, 5
# A way from the image's border through background is so wide, of a longer side of so many pixels; a pixel of these is
# background if so much of it is.
_WAY, _COARSE, _MOSTLY = 0.07, 96, 0.75
# Gaps in the object that are as wide as that are closed; of its parts those that are as large as that count.
_GAP_WIDTH, _SPECK = 0.09, 0.05
_NOISES, _LEAST_TOLERANCE, _MOST_TOLERANCE = 4.0, 0.03, 0.12
# Bars and corners that a photo does not fill are as dark or as bright as that in all of them; their edges are soft.
_BLACK, _WHITE, _EMPTY, _EDGE = 3.5 / 255, 251.5 / 255, 0.9, 0.01
_FEWEST_PIXELS = 50
# Rows of pixels at a time.
_ROWS = 32


def shown(images: Iterable[np.ndarray]) -> np.ndarray:
    """Which pixels (H, W) bool of photos, (H, W, 3) in 0..1 of one size, show something: all but black or white ones
    that are the same in nine of ten, bars above and below and the corners of photos whose lens was taken out."""
    empty, count = None, 0
    for image in images:
        one = (image.max(axis=-1) <= _BLACK) | (image.min(axis=-1) >= _WHITE)
        empty, count = (one.astype(np.int64) if empty is None else empty + one), count + 1
    if empty is None:
        raise ValueError("no photos")
    bare = empty >= _EMPTY * count
    if not bare.any():
        return ~bare
    return ~ndimage.binary_dilation(bare, np.ones((3, 3), bool), iterations=max(2, round(_EDGE * max(bare.shape))))


def alike(images: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How alike the patterns of the photos' borders are at the same pixels.

    Args:
        images: (H, W, 3) in 0..1.

    Returns:
        (N, N) correlations, not a number on the diagonal, between photos of several sizes and where nothing is shown;
        (N,) standard deviations of the borders' patterns; (N,) how many patches of a pattern a border has.
    """
    found = np.full((len(images), len(images)), np.nan)
    textures, patches = np.zeros(len(images)), np.zeros(len(images))
    for size in {image.shape for image in images}:
        same = [place for place, image in enumerate(images) if image.shape == size]
        seen = shown(images[place] for place in same)
        frame = frame_of(seen)
        if np.count_nonzero(frame) < _FEWEST_PIXELS:
            continue
        values = np.stack([pattern(images[place], seen)[frame] for place in same])
        textures[same], patches[same] = values.std(axis=1), values.shape[1] / pattern_reach(size[:2]) ** 2
        values -= values.mean(axis=1, keepdims=True)
        values /= np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-9)
        found[np.ix_(same, same)] = values @ values.T
    np.fill_diagonal(found, np.nan)
    return found, textures, patches


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
    frames = levels[:, _frame(levels)].astype(np.float32) / 255
    noise = 1.4826 * float(np.median(np.abs(frames - np.median(frames, axis=0)))) if frames.size else 0.0
    return float(np.clip(_NOISES * noise, _LEAST_TOLERANCE, _MOST_TOLERANCE))


def _frame(levels: np.ndarray) -> np.ndarray:
    return frame_of(shown(image / np.float32(255) for image in levels))


def in_one_light(levels: np.ndarray) -> np.ndarray:
    """Bytes (N, H, W, 3) of photos with one background, as bright as the middle one of them."""
    frame = _frame(levels)
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


def is_background(
    levels: np.ndarray, plate: np.ndarray, share: np.ndarray, tolerance: float, tick: Tick = unstopped
) -> np.ndarray:
    """Where (H, W) the most common colour is that of the background.

    Where the object always covers a pixel the most common colour is its own. It is taken for the background's only if
    the photos that show it differ no more than noise makes them, and if in enough of them a wide way of background
    leads from the image's border to it. What nearly all photos show has to reach the border itself.

    Args:
        levels: (N, H, W, 3) bytes.
        plate, share: of `most_common`.
        tolerance: as given to it.
        tick: called between photos; may raise to stop.
    """
    known = _is_often_seen(share, len(levels))
    known &= _is_tight(levels, plate, known, tolerance, tick)
    height, width = share.shape
    times = min(1.0, _COARSE / max(height, width))
    size = max(1, round(times * width)), max(1, round(times * height))
    square = np.ones((max(3, round(_WAY * max(size))),) * 2, bool)
    reached = np.zeros(size[::-1], np.int64)
    for image in levels:
        tick()
        shown = (_agrees(image, plate, tolerance) & known).astype(np.float32)
        open_ = cv2.resize(shown, size, interpolation=cv2.INTER_AREA) >= _MOSTLY
        margin = len(square)
        open_ = ndimage.binary_opening(np.pad(open_, margin, mode="edge"), square)
        reached += _joined_to_border(open_[margin:-margin, margin:-margin])
    enough = ndimage.binary_dilation(reached >= max(_SEEN_BY, _SEEN * len(levels)), np.ones((3, 3), bool))
    return known & (cv2.resize(enough.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0)


def _is_often_seen(share: np.ndarray, count: int) -> np.ndarray:
    still = share >= _STILL
    return _joined_to_border(still) | (~still & (share >= max(_SEEN, _SEEN_BY / count)))


def _is_tight(levels: np.ndarray, plate: np.ndarray, known: np.ndarray, tolerance: float, tick: Tick) -> np.ndarray:
    """Where (H, W) the photos that agree do so within noise, which the known pixels of their borders tell."""
    votes, square = np.zeros(known.shape, np.float32), np.zeros(plate.shape, np.float32)
    for image in levels:
        tick()
        same = _agrees(image, plate, tolerance)
        votes += same
        square += same[..., None] * (image / np.float32(255) - plate) ** 2
    off = np.sqrt(square / np.maximum(votes, 1)[..., None]).max(axis=-1)
    off = cv2.medianBlur(off, _MIDDLE_PX)
    frame = off[known & _frame(levels)]
    # Noise may be more in some places than in others, as it is in JPEGs.
    noise = _UNEVEN * float(np.percentile(frame, 99)) if len(frame) else 0.0
    return off <= np.clip(noise, _TIGHT * tolerance, _NOT_TIGHT * tolerance)


def _agrees(image: np.ndarray, plate: np.ndarray, tolerance: float) -> np.ndarray:
    return (np.abs(image / np.float32(255) - plate) <= tolerance).all(axis=-1)


def _joined_to_border(mask: np.ndarray) -> np.ndarray:
    labels, _ = ndimage.label(mask)
    reached = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    return np.isin(labels, reached[reached > 0])


def torn(mask: np.ndarray) -> float:
    """The share of an object, (H, W) bool, that its gaps and holes are once all narrower than 9 % of the image are
    closed: objects have a few of their own, and many where what has the background's colour was taken out of them."""
    times = min(1.0, _COARSE / max(mask.shape))
    size = max(1, round(times * mask.shape[1])), max(1, round(times * mask.shape[0]))
    small = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) >= 0.5
    small = ndimage.binary_opening(np.pad(small, 1, mode="edge"), np.ones((3, 3), bool))[1:-1, 1:-1]
    small = drop_small(small, _SPECK * np.count_nonzero(small))
    width = max(3, round(_GAP_WIDTH * max(size)))
    whole = ndimage.binary_closing(np.pad(small, width), np.ones((width, width), bool))
    whole = ndimage.binary_fill_holes(whole)[width:-width, width:-width]
    return float((whole & ~small).sum() / max(1, whole.sum()))


def is_covered(share: np.ndarray) -> float:
    """The share of all pixels that something stands before in some photos."""
    return float((share < _STILL).mean())
