"""A page as a file, above all as PDF: pictures, shapes, and text that can be searched. Numpy and zlib alone, no bpy.

After ISO 32000-1 (PDF 1.7). Lettering is drawn by its outlines, so that it needs no font; the text itself lies over it
unseen.
"""

from __future__ import annotations

import zlib
from collections.abc import Generator
from pathlib import Path

import numpy as np

from ...core.errors import SettingError
from ...core.files import atomic_write
from ...core.steps import part_of_work
from ..scene.png import compress_in_steps
from .page import MM_PER_INCH, Page, Picture, Shape, save_png_in_steps

PAGE_KINDS = (".pdf", ".png")
POINTS_PER_MM = 72 / MM_PER_INCH
# More would be a picture of hundreds of megabytes.
_MOST_PIXELS = 6000
# What Helvetica in its standard encoding has no letter for.
_PLAIN = str.maketrans({"⁻": "-", "−": "-"})
# Mean width of Helvetica's letters for a size of 1: only how well a selection covers the text hangs on it.
_MEAN_WIDTH = 0.52


def _write_pdf_in_steps(path: Path, page: Page) -> Generator[float, None, None]:
    """Writes a page in real size, atomically."""
    pictures = [part for part in page.parts if isinstance(part, Picture)]
    images = []
    for number, part in enumerate(pictures):
        packing = part_of_work(_image_in_steps(part.pixels), number / len(pictures), (number + 1) / len(pictures))
        images.append((yield from packing))
    names = {id(part): f"Im{index}" for index, part in enumerate(pictures)}
    first_image = 7
    resources = " ".join(f"/{name} {first_image + index} 0 R" for index, name in enumerate(names.values()))
    width, height = page.width * POINTS_PER_MM, page.height * POINTS_PER_MM
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        (
            f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {width:.4f} {height:.4f}] /Contents 4 0 R "
            f"/Resources << /Font << /F1 5 0 R >> /XObject << {resources} >> >> >>"
        ).encode(),
        _stream("", zlib.compress(_content(page, names), 6)),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica /Encoding /WinAnsiEncoding >>",
        b"<< /Title " + _string(page.title) + b" /Producer (InsideOut) >>",
        *images,
    ]
    with atomic_write(Path(path)) as stream:
        stream.write(_file(objects))


def save_page_in_steps(path: Path, page: Page, dots_per_inch: float) -> Generator[float, None, None]:
    """Writes a page as .pdf, or as .png with this resolution, or as much of it as 6000 pixels allow.

    Yields the share that is done; nothing is on the disk before the last of these breaks.

    Raises:
        SettingError: another kind of file.
        DiskFullError, RunFolderError: as `atomic_write`.
    """
    kind = path.suffix.lower()
    if kind not in PAGE_KINDS:
        raise SettingError("{file}: pages are saved as .pdf or .png; choose one of them.", file=path.name)
    if kind == ".pdf":
        yield from _write_pdf_in_steps(path, page)
    else:
        most = _MOST_PIXELS * MM_PER_INCH / max(page.width, page.height)
        yield from save_png_in_steps(path, page, min(dots_per_inch, most))


def _file(objects: list[bytes]) -> bytes:
    """Objects numbered from 1, the catalogue first and the properties sixth, with the table of their places."""
    content, offsets = b"%PDF-1.7\n%\xe2\xe3\xcf\xd3\n", []
    parts = [content]
    length = len(content)
    for number, body in enumerate(objects, 1):
        offsets.append(length)
        parts.append(b"%d 0 obj\n%b\nendobj\n" % (number, body))
        length += len(parts[-1])
    table = b"".join(b"%010d 00000 n \n" % offset for offset in offsets)
    parts.append(b"xref\n0 %d\n0000000000 65535 f \n%b" % (len(objects) + 1, table))
    parts.append(
        b"trailer\n<< /Size %d /Root 1 0 R /Info 6 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (len(objects) + 1, length)
    )
    return b"".join(parts)


def _image_in_steps(pixels: np.ndarray) -> Generator[float, None, bytes]:
    height, width = pixels.shape[:2]
    packed = yield from compress_in_steps(np.ascontiguousarray(pixels, np.uint8).tobytes())
    return _stream(
        f"/Type /XObject /Subtype /Image /Width {width} /Height {height} /ColorSpace /DeviceRGB /BitsPerComponent 8",
        packed,
    )


def _stream(entries: str, packed: bytes) -> bytes:
    head = f"<< {entries} /Length {len(packed)} /Filter /FlateDecode >>\nstream\n".replace("<<  ", "<< ")
    return head.encode() + packed + b"\nendstream"


def _content(page: Page, names: dict[int, str]) -> bytes:
    # From here on in mm from the top-left corner.
    lines = [f"{POINTS_PER_MM:.8f} 0 0 {-POINTS_PER_MM:.8f} 0 {page.height * POINTS_PER_MM:.4f} cm".encode()]
    for part in page.parts:
        if isinstance(part, Picture):
            place = f"{part.width:.4f} 0 0 {-part.height:.4f} {part.left:.4f} {part.top + part.height:.4f}"
            lines.append(f"q {place} cm /{names[id(part)]} Do Q".encode())
        else:
            lines += _shape(part)
    return b"\n".join(lines)


def _shape(part: Shape) -> list[bytes]:
    lines = ["{:.3f} {:.3f} {:.3f} rg".format(*part.color).encode()]
    for loop in part.loops:
        points = [f"{x:.4f} {y:.4f}" for x, y in loop]
        lines.append(f"{points[0]} m {' '.join(f'{point} l' for point in points[1:])} h".encode())
    if part.loops:
        lines.append(b"f")
    if part.text.strip():
        stretch = 100 * part.width / (len(part.text) * _MEAN_WIDTH * part.size)
        x, y = part.place
        lines.append(f"BT 3 Tr /F1 {part.size:.4f} Tf {stretch:.1f} Tz 1 0 0 -1 {x:.4f} {y:.4f} Tm ".encode())
        lines[-1] += _string(part.text) + b" Tj ET"
    return lines


def _string(text: str) -> bytes:
    packed = text.translate(_PLAIN).encode("cp1252", "replace")
    for special in (b"\\", b"(", b")"):
        packed = packed.replace(special, b"\\" + special)
    return b"(" + packed + b")"
