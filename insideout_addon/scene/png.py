"""PNG writing with numpy and zlib, with real size and text in the file. No bpy."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Generator
from pathlib import Path

import numpy as np

from ...core.files import atomic_write, synced_in_steps
from ...core.steps import part_of_work, run_through

# Bytes that are compressed at once: some hundredths of a second.
_PIECE = 1 << 20
# Share of the writing that is done when all is compressed; the rest is the disk's.
_PACKED = 0.9


def write_png(
    path: Path, pixels: np.ndarray, mm_per_pixel: tuple[float, float], texts: dict[str, str] | None = None
) -> None:
    """Writes an image, atomically.

    Args:
        pixels: (height, width) uint8 or uint16 grey, or (height, width, 3 or 4) uint8.
        mm_per_pixel: width and height, stored as the physical pixel size.
        texts: keyword -> Latin-1 text, stored beside the image.

    Raises:
        DiskFullError, RunFolderError: as `atomic_write`.
    """
    run_through(write_png_in_steps(path, pixels, mm_per_pixel, texts))


def write_png_in_steps(
    path: Path, pixels: np.ndarray, mm_per_pixel: tuple[float, float], texts: dict[str, str] | None = None
) -> Generator[float, None, None]:
    """As `write_png`, with breaks that tell the share that is done; closed before its end the file is as it was."""
    height, width = pixels.shape[:2]
    channels = 1 if pixels.ndim == 2 else pixels.shape[2]
    color_type = {1: 0, 3: 2, 4: 6}[channels]
    depth = 16 if pixels.dtype == np.uint16 else 8
    big_endian = pixels.astype(">u2") if depth == 16 else pixels.astype(np.uint8)
    rows = np.ascontiguousarray(big_endian).reshape(height, -1).view(np.uint8)
    filtered = np.concatenate([np.zeros((height, 1), np.uint8), rows], axis=1)
    per_metre = [max(1, round(1000.0 / side)) for side in mm_per_pixel]
    chunks = [(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, color_type, 0, 0, 0))]
    chunks.append((b"pHYs", struct.pack(">IIB", *per_metre, 1)))
    for keyword, text in (texts or {}).items():
        chunks.append((b"tEXt", keyword.encode("latin-1") + b"\0" + text.encode("latin-1", "replace")))
    packed = yield from part_of_work(compress_in_steps(filtered.tobytes()), 0.0, _PACKED)
    chunks += [(b"IDAT", packed), (b"IEND", b"")]
    with atomic_write(Path(path)) as stream:
        stream.write(b"\x89PNG\r\n\x1a\n")
        for kind, content in chunks:
            stream.write(struct.pack(">I", len(content)) + kind + content)
            stream.write(struct.pack(">I", zlib.crc32(kind + content)))
        yield from part_of_work(synced_in_steps(stream), _PACKED, 1.0)


def compress_in_steps(content: bytes) -> Generator[float, None, bytes]:
    """What `zlib.compress` makes, with breaks that tell the share that is done."""
    packer, parts = zlib.compressobj(6), []
    for first in range(0, len(content), _PIECE):
        parts.append(packer.compress(content[first : first + _PIECE]))
        yield min((first + _PIECE) / len(content), 1.0)
    return b"".join([*parts, packer.flush()])
