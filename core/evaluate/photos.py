"""The photos of a run: registered cameras, pixels, and the background behind the object."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..capture.background import cut_out_background, plain_background
from ..capture.model import Photo, Photos
from ..progress import Tick, unstopped
from ..views import Camera

if TYPE_CHECKING:
    from ..effects.kept import KeptEffects
    from ..stages.context import StageContext


def registered_photos(context: StageContext) -> Photos | None:
    """The photos with the cameras that `initialize` found, else the capture's own when all have a camera."""
    stored = context.run.path / "initialize" / "photos.json"
    if stored.exists():
        from ..capture.registered import load_photos

        return load_photos(stored)
    photos = context.capture.photos
    return photos if photos is not None and photos.posed else None


def kept_effects(context: StageContext, cameras: dict[str, Camera], scale: float = 1.0) -> KeptEffects | None:
    """What `surface` found its training photos to show besides the object, None where it was asked for nothing.

    Args:
        cameras: by the paths of the photos, in the frame that is drawn in.
        scale: of that frame over the photos' own.

    Raises:
        RunFolderError: what it left cannot be read.
    """
    if not context.effects.photos:
        return None
    from ..effects.kept import FILE, KeptEffects

    path = context.run.path / "surface" / FILE
    return KeptEffects(path, context.effects.photos, cameras, scale) if path.exists() else None


def read_views(
    photos: Sequence[Photo], long_side: int, background: np.ndarray | None = None, tick: Tick = unstopped
) -> list[tuple[Camera, np.ndarray]]:
    """Each photo's camera and pixels (H, W, 3) float32 0..1, no larger than `long_side`, with the colour (3,) behind
    what is transparent, black if None; `tick` is called between photos. Raises CaptureError."""
    from ..capture.photos import read_photo

    red, green, blue = (0.0, 0.0, 0.0) if background is None else background.tolist()
    views = []
    for photo in photos:
        tick()
        image, camera = read_photo(photo, long_side, (red, green, blue))
        views.append((camera, image))
    return views


def spread(items: Sequence[Photo], count: int) -> list[Photo]:
    """At most `count` items at even steps."""
    if len(items) <= count:
        return list(items)
    return [items[round(i)] for i in np.linspace(0, len(items) - 1, count)]


def photo_background(photos: Photos, long_side: int = 200, tick: Tick = unstopped) -> np.ndarray | None:
    """The plain colour (3,) behind the object, from up to ten training photos, or None where there is none; where the
    object was cut out, a colour that it does not have, to be put behind what is transparent."""
    return shown_or_put_background(photos, long_side, tick)[0]


def shown_or_put_background(
    photos: Photos, long_side: int = 200, tick: Tick = unstopped
) -> tuple[np.ndarray | None, bool]:
    """As `photo_background`, and whether it is put there and no photo shows it."""
    from ..capture.photos import image_facts

    some = spread([photo for photo in photos.photos if photo.camera is not None and not photo.held_out], 10)
    seen = [image for _, image in read_views(some, long_side, tick=tick)]
    if all(image_facts(photo.path).alpha for photo in some):
        before_white = [image for _, image in read_views(some, long_side, np.ones(3), tick)]
        chosen = cut_out_background(seen, before_white)
        if chosen is not None:
            return chosen.astype(np.float32), True
    plain = plain_background(seen)
    # In the place of a room that was taken out is a colour that all photos have alike, whatever the light in them.
    return plain, plain is not None and bool(some) and all(photo.backdrop is not None for photo in some)
