"""Opening image files: a phone's photo may have more pixels than Pillow takes for harmless."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from PIL import Image

from .findings import CaptureProblem

MOST_PIXELS = 250_000_000
"""Of a photo: phones take 200 megapixels, of which Pillow suspects everything above 179. Where a format decodes to no
smaller size than it is stored in, so many are three gigabytes of floats."""

# Pillow's limit is the whole process's, in which others may rely on it.
_LIMIT = threading.RLock()
_SUSPECTED = (Image.DecompressionBombError, Image.DecompressionBombWarning)


@contextmanager
def open_image(path: Path) -> Iterator[Image.Image]:
    """An image file, opened and not decoded; those that Pillow would not open are worked on one at a time.

    Raises:
        CaptureProblem: it has more than `MOST_PIXELS`.
        OSError and what else Pillow raises: it cannot be read.
    """
    with ExitStack() as stack:
        image = _opened(path)
        if image is None:
            # While it is decoded as well: that of uncompressed TIFF asks once more.
            stack.enter_context(_raised_limit())
            image = _opened(path)
        if image is None:
            raise _too_large(path)
        stack.enter_context(image)
        if image.width * image.height > MOST_PIXELS:
            raise _too_large(path)
        yield image


def _opened(path: Path) -> Image.Image | None:
    """None where Pillow suspects it, by a limit that no other thread has raised."""
    with _LIMIT:
        try:
            return Image.open(path)
        except _SUSPECTED:
            return None


@contextmanager
def _raised_limit() -> Iterator[None]:
    with _LIMIT:
        before = Image.MAX_IMAGE_PIXELS
        Image.MAX_IMAGE_PIXELS = MOST_PIXELS
        try:
            yield
        finally:
            Image.MAX_IMAGE_PIXELS = before


def _too_large(path: Path) -> CaptureProblem:
    most = MOST_PIXELS // 10**6
    return CaptureProblem(
        path, "is larger than {most} megapixels", "scale it down, or remove it from the folder", most=most
    )
