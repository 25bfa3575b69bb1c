"""Is the background of the photos plain, what colour is it, and which pixels are the object."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy import ndimage

from ..progress import Tick, unstopped
from ..srgb import linear_to_srgb, srgb_to_linear

# Largest difference of a channel (0..1) from the background colour that still counts as background.
_TOLERANCE = 0.06
# Share of all border pixels that must be background; objects may touch the border here and there.
_PLAIN_SHARE = 0.85
# A background that less of a border is near to than this may be as bright as another exposure has it: up to so many
# times, of all channels alike but for so much.
_MOSTLY, _MOST_TIMES, _SAME_COLOR = 0.5, 4.0, 1.25
# With less of the photo before it, it is an object of its colour, seen from near. With so much less than in others it
# may be one, or what is before it is an object seen edge-on: colours tell that so much of the object has in others.
_LEAST_OBJECT, _MUCH_LESS, _PART = 0.02, 1 / 3, 0.1
# Pixels a photo, and of a part, whose colours are compared.
_OF_PHOTO, _OF_PART = 300, 100
# Channels of the colours that may be put behind an object whose own background was taken out.
_COLORS = (0.2, 0.5, 0.8)


def plain_background(images: Sequence[np.ndarray]) -> np.ndarray | None:
    """The colour (3,) in 0..1 that the borders of all photos share, or None when they share none.

    Where photos differ in exposure it is that colour in the light of their (geometric) mean.

    Args:
        images: photos (H, W, 3), float 0..1; a handful spread over the capture is enough.
    """
    color = _shared_color(images)
    return _in_mean_light(images) if color is None and len(images) > 1 else color


def _shared_color(images: Sequence[np.ndarray]) -> np.ndarray | None:
    borders = [_border_pixels(np.asarray(image, np.float64)) for image in images]
    if not borders:
        return None
    pixels = np.concatenate(borders)
    color = np.median(pixels, axis=0)
    near = np.abs(pixels - color).max(axis=1) <= _TOLERANCE
    if near.mean() < _PLAIN_SHARE:
        return None
    return pixels[near].mean(axis=0).astype(np.float32)


def _in_mean_light(images: Sequence[np.ndarray]) -> np.ndarray | None:
    """The colour (3,) of a plain background that photos show in lights of their own; None where too few show one with
    something before it, or they differ by more than exposures do."""
    found = []
    for image in images:
        color = _shared_color([image])
        # A wall that fills photos has a colour in each, too.
        if color is not None and _unlike(np.asarray(image, np.float64), color).mean() >= _LEAST_OBJECT:
            found.append(np.log(np.maximum(srgb_to_linear(color), 1e-6)))
    if len(found) < _PLAIN_SHARE * len(images):
        return None
    # Not their mean: a single photo with something dark at its border would darken it.
    middle = linear_to_srgb(np.exp(np.median(found, axis=0)))
    alike = [light for light in found if _is_exposure(linear_to_srgb(np.exp(light)), middle)]
    if len(alike) < _PLAIN_SHARE * len(images):
        return None
    return np.asarray(linear_to_srgb(np.exp(np.mean(alike, axis=0))), np.float32)


def cut_out_background(on_black: Sequence[np.ndarray], on_white: Sequence[np.ndarray]) -> np.ndarray | None:
    """A colour (3,) in 0..1 to put behind objects that were cut out, apart from theirs: before black, their black parts
    would be taken for background. None where borders are not transparent.

    Args:
        on_black, on_white: the same photos (H, W, 3), float 0..1, with black and with white behind what is transparent.
    """
    clear = [(white - black).mean(axis=-1) for black, white in zip(on_black, on_white, strict=True)]
    borders = [_border_pixels(one) for one in clear]
    if not borders or (np.concatenate(borders) > 0.5).mean() < _PLAIN_SHARE:
        return None
    return np.array(
        color_apart(np.concatenate([black[one < 0.01] for black, one in zip(on_black, clear, strict=True)]))
    )


def color_apart(colors: np.ndarray) -> tuple[float, float, float]:
    """Of 27 colours the one that hardly any of the object's, (K, 3), comes near to."""
    tries = np.stack(np.meshgrid(_COLORS, _COLORS, _COLORS, indexing="ij"), axis=-1).reshape(-1, 3)
    if not len(colors):
        return 0.5, 0.5, 0.5
    near = [np.percentile(np.abs(colors - one).max(axis=1), 2) for one in tries]
    red, green, blue = tries[int(np.argmax(near))].tolist()
    return red, green, blue


def border_parts(image: np.ndarray) -> list[np.ndarray]:
    """The colours (P, 3) of eight parts of a photo's border, (H, W, 3): its corners and the sides between."""
    height, width = image.shape[:2]
    parts = np.add.outer(3 * (3 * np.arange(height) // height), 3 * np.arange(width) // width)
    border = ~_inner(height, width)
    return [image[border & (parts == part)] for part in range(9) if part != 4]


@dataclass(frozen=True)
class UsualObject:
    """What the object looks like in photos whose border shows the background in its own light.

    Attributes:
        share: of a photo that it takes up, the median; 0 where there are no such photos.
        colors: (K, 3) in 0..1, of some of its pixels in all of them.
    """

    share: float
    colors: np.ndarray

    @classmethod
    def of(cls, images: Iterable[np.ndarray], background: np.ndarray) -> UsualObject:
        """In some photos (H, W, 3) of a capture, with the colour (3,) of their background."""
        shares, colors = [], [np.zeros((0, 3))]
        for image in images:
            if _near(image, background) >= _MOSTLY:
                mask = _unlike(image, background)
                shares.append(float(mask.mean()))
                colors.append(_some(image[mask], _OF_PHOTO))
        return cls(float(np.median(shares)) if shares else 0.0, np.concatenate(colors))

    def has(self, colors: np.ndarray) -> bool:
        """Whether a tenth of it or more has about a colour of these, (C, 3): the mean of their shares."""
        if not len(self.colors):
            return False
        alike = [np.abs(self.colors - color).max(axis=1) <= _TOLERANCE for color in _some(colors, _OF_PART)]
        return float(np.mean(alike)) >= _PART


def foreground_masks(images: Sequence[np.ndarray], background: np.ndarray, tick: Tick = unstopped) -> list[np.ndarray]:
    """`foreground_mask` of each of several photos of a capture; `tick` is called between them."""

    def ticked() -> Iterator[np.ndarray]:
        for image in images:
            tick()
            yield image

    usual = cache(lambda: UsualObject.of(ticked(), background))
    return [foreground_mask(image, background, usual) for image in ticked()]


def foreground_mask(
    image: np.ndarray, background: np.ndarray, usual: Callable[[], UsualObject] | None = None
) -> np.ndarray:
    """Which pixels (H, W) bool show the object in front of a plain background.

    A pixel is foreground when a channel differs from the background by more than the border's own noise allows.
    Specks are dropped, and small islands of background colour inside the object are filled; large ones are
    real holes that the photo looks through. A photo of another exposure is compared with the background as bright as
    its own border has it, unless hardly anything is before that, or the border shows a part of the object seen from
    near, as far as other photos tell.

    Args:
        image: (H, W, 3) float 0..1.
        background: (3,) from `plain_background`.
        usual: tells what the object looks like in others; asked only where the photo may be of another exposure.
    """
    image = np.asarray(image, np.float64)
    exposed = _as_exposed(image, background)
    if exposed is not None:
        mask = _unlike(image, exposed)
        from_near = mask.mean() < _LEAST_OBJECT
        if usual is not None and not from_near:
            from_near = _is_from_near(image[mask], float(mask.mean()), background, exposed, usual())
        if not from_near:
            return mask
    return _unlike(image, background)


def _is_from_near(
    before: np.ndarray, share: float, background: np.ndarray, exposed: np.ndarray, usual: UsualObject
) -> bool:
    """Whether a border of one colour (3,) is a part of the object, and pixels before it (P, 3), a share of the photo,
    details on it; not the background in another light, and those the object.

    An object seen edge-on is as small. So the border has to have a colour of the object, and the pixels none that it
    has in that light; in doubt they are the object.
    """
    if share >= _MUCH_LESS * usual.share or not usual.has(exposed[None]):
        return False
    gain = srgb_to_linear(exposed) / np.maximum(srgb_to_linear(background), 1e-6)
    return not usual.has(linear_to_srgb(srgb_to_linear(before) / gain))


def _unlike(image: np.ndarray, background: np.ndarray) -> np.ndarray:
    difference = np.abs(image - background).max(axis=-1)
    border = np.abs(_border_pixels(image) - background).max(axis=1)
    quiet = border[border <= _TOLERANCE]
    noise = float(np.percentile(quiet, 99)) if len(quiet) else 0.0
    mask = difference > min(max(2.0 * noise, 0.03), _TOLERANCE)
    mask = drop_small(mask, 0.002 * mask.size)
    return ~drop_small(~mask, 0.0005 * mask.size)


def _as_exposed(image: np.ndarray, background: np.ndarray) -> np.ndarray | None:
    """The background (3,) in the light of this photo; None where the border does not show it in another."""
    own = None if _near(image, background) >= _MOSTLY else plain_background([image])
    return own if own is not None and _is_exposure(own, background) else None


def _is_exposure(color: np.ndarray, background: np.ndarray) -> bool:
    """Whether a colour (3,) is that of a background (3,) in the light of another exposure."""
    gains = srgb_to_linear(color) / np.maximum(srgb_to_linear(background), 1e-6)
    return bool(gains.min() >= 1 / _MOST_TIMES and gains.max() <= min(_MOST_TIMES, _SAME_COLOR * gains.min()))


def _near(image: np.ndarray, background: np.ndarray) -> float:
    """The share of a photo's border that has about the background's colour."""
    return float((np.abs(_border_pixels(image) - background).max(axis=1) <= _TOLERANCE).mean())


def _some(pixels: np.ndarray, count: int) -> np.ndarray:
    """Of pixels (P, 3) so many or fewer, evenly spread."""
    return pixels[:: max(-(-len(pixels) // count), 1)]


def _border_pixels(image: np.ndarray) -> np.ndarray:
    """(P, 3) pixels of a frame 2 % of the image wide."""
    return image[~_inner(*image.shape[:2])]


def _inner(height: int, width: int) -> np.ndarray:
    rows, columns = max(1, height // 50), max(1, width // 50)
    inner = np.zeros((height, width), bool)
    inner[rows : height - rows, columns : width - columns] = True
    return inner


def drop_small(mask: np.ndarray, area: float) -> np.ndarray:
    """`mask` without its connected parts of fewer than `area` pixels."""
    labels, count = ndimage.label(mask)
    if count == 0:
        return mask
    keep = np.bincount(labels.ravel()) >= area
    keep[0] = False
    return keep[labels]
