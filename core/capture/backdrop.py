"""Taking a background that stands still out of photos, with soft outlines."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from PIL import Image
from scipy import ndimage

from ..errors import RunFolderError
from ..files import atomic_write
from ..srgb import linear_to_srgb, srgb_to_linear
from .background import drop_small
from .model import Backdrop

# Photos whose light differs less than that from the backdrop's are taken as they are.
_SAME_LIGHT = 0.03
# What is darker than that in linear light is noise and rounding, what is brighter than that in sRGB may be cut off.
_DARK, _BRIGHT = 0.01, 0.98
# A channel's light is told by so many pixels of the border, and so many at least; no two exposures differ by more.
_LEAST_SHARE, _LEAST_PIXELS, _MOST_TIMES = 0.05, 50, 8.0
# Of the whole image: specks of noise, and gaps in the object that are filled.
_SPECK, _GAP = 0.002, 0.0005
# Holes that an object is looked through show the pattern of what is behind it.
_ALIKE, _LEAST_PATTERN, _FEWEST_PIXELS = 0.7, 0.01, 8
# Outlines mix object and background. So far from one the object's colours are tried, nearest first; what is farther
# from a mixture of them than that, in linear light, is none.
_REACH_PX, _UNEXPLAINED = 4, 0.05
_LEAST_CONTRAST = 1e-4
_SQUARE = np.ones((3, 3), bool)
_NEARBY = sorted(
    ((down, right) for down in range(-_REACH_PX, _REACH_PX + 1) for right in range(-_REACH_PX, _REACH_PX + 1)),
    key=lambda by: by[0] ** 2 + by[1] ** 2,
)


def write_plate(path: Path, plate: np.ndarray, known: np.ndarray) -> None:
    """Writes what stands behind the object, (H, W, 3) in 0..1, and where that is known, (H, W) bool, as a PNG,
    atomically. Raises DiskFullError, RunFolderError."""
    levels = np.round(255 * np.dstack([plate, known])).astype(np.uint8)
    with atomic_write(path) as stream:
        Image.fromarray(levels, "RGBA").save(stream, "PNG")


def without_backdrop(pixels: np.ndarray, backdrop: Backdrop, least: tuple[int, int]) -> np.ndarray:
    """A photo with the plain colour of its backdrop behind the object.

    Pixels of an outline show a share α of the object and 1 − α of the background, in linear light. With the background
    B and the object's colour F beside the outline α = (I − B) · (F − B) / |F − B|² (the known background of Smith and
    Blinn's matting, SIGGRAPH 1996). A photo that is brighter than the backdrop is made as dark: the room is the same.

    Args:
        pixels: (H, W, 3) float in 0..1.
        least: width and height that are needed; the photo may come back smaller than it was given, but not than these.

    Returns:
        (h, w, 3) float32 in 0..1.

    Raises:
        RunFolderError: the backdrop cannot be read.
    """
    plate, known = _read_plate(backdrop.path)
    if least[0] <= plate.shape[1] < pixels.shape[1]:
        pixels = _scaled(pixels, plate)
    # Where a photo is larger than the backdrop its outline is as coarse as that.
    looked_at = pixels if pixels.shape[1] <= plate.shape[1] else plate
    image, behind = _scaled(pixels, looked_at), _scaled(plate, looked_at)
    sure = _scaled(known, looked_at) > 0.999
    gain = 1 / light_ratio(image, behind, sure)
    image, pixels = in_light(image, gain), in_light(pixels, gain)
    alpha = _share_of_object(image, behind, sure, object_mask(image, behind, sure, backdrop.tolerance))
    alpha, behind = (_scaled(part, pixels) for part in (alpha, behind))
    return _before(pixels, behind, alpha, np.asarray(backdrop.color, np.float32))


def object_mask(image: np.ndarray, behind: np.ndarray, known: np.ndarray, tolerance: float) -> np.ndarray:
    """Which pixels (H, W) bool differ from the background, (H, W, 3), or stand where it is not known.

    What has the background's colour inside the object by chance is filled; where the background's pattern shows it is
    a hole.

    Args:
        known: (H, W) bool.
        tolerance: largest difference of a channel that is still background.
    """
    difference = np.asarray(image, np.float32) - behind
    mask = (np.abs(difference).max(axis=-1) > tolerance) | ~known
    mask = ndimage.binary_closing(np.pad(mask, 1, mode="edge"), _SQUARE)[1:-1, 1:-1]
    mask = drop_small(mask, _SPECK * mask.size)
    labels, _ = ndimage.label(~mask)
    outside = {int(label) for side in (labels[0], labels[-1], labels[:, 0], labels[:, -1]) for label in np.unique(side)}
    here, there = pattern(image), pattern(behind)
    for label, place in enumerate(ndimage.find_objects(labels), start=1):
        inside = labels[place] == label
        if label not in outside and not _is_hole(here[place][inside], there[place][inside], _GAP * mask.size):
            mask[place] |= inside
    return mask


def pattern(image: np.ndarray, shown: np.ndarray | None = None) -> np.ndarray:
    """(H, W) the mean of the channels without what is larger than some 3 % of the longer side.

    Args:
        shown: (H, W) bool, what counts: the rest has no part in what is taken off; None for all.
    """
    grey = np.asarray(image, np.float32).mean(axis=-1)
    reach = pattern_reach(grey.shape)
    if shown is None or shown.all():
        return grey - ndimage.gaussian_filter(grey, reach)
    # Normalised convolution (Knutsson and Westin, CVPR 1993).
    weight = ndimage.gaussian_filter(shown.astype(np.float32), reach)
    return grey - ndimage.gaussian_filter(grey * shown, reach) / np.maximum(weight, 1e-6)


def pattern_reach(shape: Sequence[int]) -> float:
    """Pixels, the standard deviation of what `pattern` takes off."""
    return max(2.0, 0.03 * max(shape))


def correlation(one: np.ndarray, other: np.ndarray) -> float:
    """Pearson's, of two arrays of one shape; 0 where either is even."""
    one, other = one - one.mean(), other - other.mean()
    norm = float(np.sqrt((one**2).sum() * (other**2).sum()))
    return float((one * other).sum()) / norm if norm > 0 else 0.0


def light_ratio(image: np.ndarray, plate: np.ndarray, known: np.ndarray) -> np.ndarray:
    """(3,) how much brighter the light of a photo (H, W, 3) is than that of its backdrop, by the median over what is
    known (H, W) of its border; 1 where they differ by less than 3 %.

    Pixels that are dark in the backdrop, or nearly white in either, say nothing of a channel. One of which too few are
    left, or whose light cannot be that of an exposure, changes as the others do on average; 1 where none is left.
    """
    frame = border(*known.shape)
    where = known & frame
    least = max(_LEAST_PIXELS, _LEAST_SHARE * np.count_nonzero(frame))
    ratios = np.full(3, np.nan)
    for channel in range(3):
        seen, shown = image[where, channel], plate[where, channel]
        here, there = srgb_to_linear(seen), srgb_to_linear(shown)
        usable = (there > _DARK) & (seen < _BRIGHT) & (shown < _BRIGHT)
        if np.count_nonzero(usable) >= least:
            ratio = float(np.median(here[usable] / there[usable]))
            ratios[channel] = ratio if 1 / _MOST_TIMES <= ratio <= _MOST_TIMES else np.nan
    told = np.isfinite(ratios)
    if not told.any():
        return np.ones(3)
    ratios[~told] = ratios[told].mean()
    return ratios if np.abs(ratios - 1).max() > _SAME_LIGHT else np.ones(3)


def in_light(srgb: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """sRGB values (..., 3) as if the light had been `gain` (3,) times as much."""
    if (gain == 1).all():
        return srgb
    return linear_to_srgb(np.clip(srgb_to_linear(srgb) * gain, 0, 1)).astype(np.float32)


def border(height: int, width: int) -> np.ndarray:
    """(height, width) bool, a frame a tenth of the image wide."""
    rows, columns = max(1, height // 10), max(1, width // 10)
    frame = np.ones((height, width), bool)
    frame[rows : height - rows, columns : width - columns] = False
    return frame


def frame_of(shown: np.ndarray) -> np.ndarray:
    """(H, W) bool, a frame as of `border` around what photos show, (H, W) bool."""
    rows, columns = np.flatnonzero(shown.any(axis=1)), np.flatnonzero(shown.any(axis=0))
    frame = np.zeros(shown.shape, bool)
    if len(rows):
        inside = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        frame[inside] = border(*shown[inside].shape)
    return frame & shown


def _is_hole(here: np.ndarray, there: np.ndarray, least: float) -> bool:
    """Whether pixels inside the object show what is behind it."""
    if len(here) < max(least, _FEWEST_PIXELS) or there.std() < _LEAST_PATTERN:
        return False
    return correlation(here, there) >= _ALIKE


def _share_of_object(image: np.ndarray, behind: np.ndarray, known: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """α (H, W) float32 in 0..1: 0 or 1 but for pixels inside the mask's outline whose background is known.

    Of the object's colours nearby the one that explains a pixel best is taken; one that none explains shows the object
    alone, in a colour of its own.
    """
    alpha = mask.astype(np.float32)
    # A mask reaches a pixel beyond what is mixed, for its tolerance is small; thin parts have no more than a middle.
    near, sure = (ndimage.binary_erosion(mask, _SQUARE, iterations=steps, border_value=1) for steps in (1, 2))
    sure |= near & ~ndimage.binary_dilation(sure, _SQUARE, iterations=3)
    rows, columns = np.nonzero(mask & known & ~sure)
    if not len(rows) or not sure.any():
        return alpha
    light = srgb_to_linear(image).astype(np.float32)
    seen, back = light[rows, columns], srgb_to_linear(behind[rows, columns]).astype(np.float32)
    least, share = np.full(len(rows), _UNEXPLAINED**2, np.float32), np.ones(len(rows), np.float32)
    for down, right in _NEARBY:
        r, c = (
            np.clip(at + by, 0, most - 1) for at, by, most in ((rows, down, len(mask)), (columns, right, mask.shape[1]))
        )
        way = light[r, c] - back
        contrast = (way**2).sum(axis=1)
        part = (((seen - back) * way).sum(axis=1) / np.maximum(contrast, _LEAST_CONTRAST)).clip(0, 1)
        left = ((seen - back - part[:, None] * way) ** 2).sum(axis=1)
        better = sure[r, c] & (contrast > _LEAST_CONTRAST) & (left < least)
        least[better], share[better] = left[better], part[better]
    alpha[rows, columns] = share
    return alpha


def _before(pixels: np.ndarray, behind: np.ndarray, alpha: np.ndarray, color: np.ndarray) -> np.ndarray:
    """The photo where α is 1, the plain colour where it is 0, and the one background put in the other's place where
    both show."""
    result = np.where(alpha[..., None] >= 0.5, pixels, color).astype(np.float32)
    mixed = (alpha > 0.01) & (alpha < 0.99)
    seen, back = (srgb_to_linear(part[mixed]) for part in (pixels, behind))
    light = seen + (1 - alpha[mixed, None]) * (srgb_to_linear(color) - back)
    result[mixed] = linear_to_srgb(np.clip(light, 0, 1))
    return result


def _scaled(values: np.ndarray, like: np.ndarray) -> np.ndarray:
    """Averaged or interpolated to the size of another image."""
    height, width = like.shape[:2]
    if values.shape[:2] == (height, width):
        return values
    smaller = height * width < values.shape[0] * values.shape[1]
    way = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
    return cv2.resize(np.asarray(values, np.float32), (width, height), interpolation=way)


def _read_plate(path: Path) -> tuple[np.ndarray, np.ndarray]:
    try:
        return _kept_plate(path, path.stat().st_mtime_ns)
    except (OSError, ValueError, SyntaxError) as error:
        raise RunFolderError(
            "{path}: cannot be read ({error}); run the stage initialize again.", path=path, error=error
        ) from error


@lru_cache(maxsize=8)
def _kept_plate(path: Path, changed: int) -> tuple[np.ndarray, np.ndarray]:
    with Image.open(path) as image:
        levels = np.asarray(image.convert("RGBA"), np.float32) / 255
    return np.ascontiguousarray(levels[..., :3]), np.ascontiguousarray(levels[..., 3])
