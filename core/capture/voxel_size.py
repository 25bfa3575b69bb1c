"""What the header of a volume tells about the size of its voxels that ITK leaves out: whether it does, and its unit."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

_META_END = re.compile(rb"^\s*ElementDataFile\s*=", re.IGNORECASE | re.MULTILINE)
_META = re.compile(rb"^\s*Element(Spacing|Size)\s*=", re.IGNORECASE | re.MULTILINE)
_META_UNIT = re.compile(rb"^\s*DistanceUnits\s*=\s*(.*?)\s*$", re.IGNORECASE | re.MULTILINE)
_NRRD_END = re.compile(rb"\r?\n\r?\n")
# A colon before "=" is one of a note of somebody's.
_NRRD = re.compile(rb"^(spacings|space directions)\s*:(?!=)", re.IGNORECASE | re.MULTILINE)
# Of the axes where the space has none: Fiji writes the one, most others the other.
_NRRD_UNITS = re.compile(rb"^(?:space )?units\s*:(?!=)\s*(.*?)\s*$", re.IGNORECASE | re.MULTILINE)
_LONGEST_HEADER, _AXES = 1 << 16, 3
_MICRONS = ("micron", "microns", "micrometer", "micrometers", "micrometre", "micrometres")
_MM = {
    **dict.fromkeys(("mm", "millimeter", "millimeters", "millimetre", "millimetres"), 1.0),
    **dict.fromkeys(("cm", "centimeter", "centimeters", "centimetre", "centimetres"), 10.0),
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), 1000.0),
    # The micro sign, the Greek letter that looks the same, and how ImageJ writes either in a .tif.
    **dict.fromkeys(("um", "\u00b5m", "\u03bcm", "\\u00b5m", *_MICRONS), 1e-3),
    **dict.fromkeys(("nm", "nanometer", "nanometers", "nanometre", "nanometres"), 1e-6),
    **dict.fromkeys(("in", "inch", "inches"), 25.4),
}


class HeaderSize(NamedTuple):
    """What a header says of the size of voxels.

    Attributes:
        told: whether it gives one; ITK takes 1 where the header of a MetaImage or NRRD does not.
        unit: in which unit; empty where it says none, which both formats mean to be mm.
    """

    told: bool
    unit: str


def mm_of(unit: str) -> float | None:
    """Length of a unit in mm, "µm" or "microns", say; None where it is none that is known."""
    return _MM.get(unit.strip().lower())


def size_in_header(path: Path, suffix: str) -> HeaderSize:
    """Of a .mha, .mhd, .nrrd or .nhdr; other formats have one in mm as ITK reads them."""
    if suffix in (".mha", ".mhd"):
        header = _header(path, _META_END)
        units = _META_UNIT.findall(header)
        return HeaderSize(_META.search(header) is not None, "" if not units else _text(units[0]).replace("?", ""))
    if suffix in (".nrrd", ".nhdr"):
        header = _header(path, _NRRD_END)
        words = [word for line in _NRRD_UNITS.findall(header) for word in re.findall(r'"([^"]*)"', _text(line))]
        # A fourth axis may be of time.
        if len(words) > _AXES and sum(mm_of(word) is not None for word in words) >= _AXES:
            words = [word for word in words if mm_of(word) is not None]
        # Of those that contradict each other there is nothing to be known: all are named.
        return HeaderSize(_NRRD.search(header) is not None, ", ".join(dict.fromkeys(filter(None, words))))
    return HeaderSize(True, "")


def _header(path: Path, end: re.Pattern[bytes]) -> bytes:
    with open(path, "rb") as stream:
        start = stream.read(_LONGEST_HEADER)
    found = end.search(start)
    return start if found is None else start[: found.start()]


def _text(line: bytes) -> str:
    """Headers are ASCII; a micro sign in one may be written in either way."""
    try:
        return line.decode("utf-8")
    except UnicodeDecodeError:
        return line.decode("latin-1")
