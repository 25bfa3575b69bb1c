"""NAF's .pickle captures (arXiv 2209.14540), read without running what a pickle may carry."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np

from ..told import Told
from .detectors import CircularScan
from .findings import CaptureProblem
from .model import Projections
from .projections import ProjectionFiles, check_distances, check_images, to_line_integrals
from .values import every_eighth, number, numbers, positive

_ALLOWED = {
    "builtins": {
        "dict",
        "list",
        "tuple",
        "set",
        "frozenset",
        "int",
        "float",
        "complex",
        "bool",
        "str",
        "bytes",
        "bytearray",
        "slice",
    },
    # Protocol 2 stores the bytes of an array as text and turns them back with this.
    "_codecs": {"encode"},
    "numpy": {"ndarray", "dtype"},
    "numpy.core.multiarray": {"_reconstruct", "scalar"},
    "numpy._core.multiarray": {"_reconstruct", "scalar"},
    "numpy.core.numeric": {"_frombuffer"},
    "numpy._core.numeric": {"_frombuffer"},
}


class _NumbersOnly(pickle.Unpickler):
    """An unpickler that knows numpy arrays and built-in containers and nothing else."""

    def find_class(self, module: str, name: str) -> Any:
        module = "builtins" if module == "__builtin__" else module
        if name not in _ALLOWED.get(module, ()):
            raise pickle.UnpicklingError(f"it holds {module}.{name}")
        try:
            return super().find_class(module, name)
        except ModuleNotFoundError:  # As numpy 2 calls them, read by numpy 1.
            return super().find_class(module.replace("numpy._core", "numpy.core"), name)


def load_numbers(path: Path) -> Any:
    """Unpickles numpy arrays and built-in values.

    Raises:
        CaptureError: the file is damaged, or would run code of something else.
    """
    try:
        with open(path, "rb") as stream:
            return _NumbersOnly(stream, encoding="latin1").load()
    except (
        pickle.UnpicklingError,
        OSError,
        EOFError,
        ValueError,
        IndexError,
        KeyError,
        TypeError,
        AttributeError,
        ImportError,
        UnicodeDecodeError,
        MemoryError,
        OverflowError,
    ) as error:
        raise CaptureProblem(
            path,
            "cannot be read as a pickle of numbers and arrays ({error})",
            "save the projections in R²-Gaussian's layout, or export a plain NAF pickle",
            error=error,
        ) from error


def read_naf(path: Path) -> ProjectionFiles:
    """A NAF pickle: geometry in mm, train and val projections [M, rows, columns] with angles in radians.

    Raises:
        CaptureError: see `read_projections`.
    """
    content = load_numbers(path)
    if not isinstance(content, dict) or not isinstance(content.get("train"), dict):
        raise CaptureProblem(path, "holds no 'train' projections", "export a NAF pickle or use meta_data.json")
    parts = [part for part in (content["train"], content.get("val")) if isinstance(part, dict)]
    stacks, angles = zip(*(_part(path, part) for part in parts), strict=True)
    single = [image for stack in stacks for image in stack]
    names = [f"{path} projection {i}" for i in range(len(single))]
    if not len(stacks[0]):
        raise CaptureProblem(path, "has no projections in 'train'", "export it again with projections and angles")
    check_images(names, single)
    raw = np.stack(single)
    images, meaning = to_line_integrals(
        path,
        names,
        raw.astype(np.float32),
        raw_counts=raw.dtype.kind in "iu",
        declared=content.get("values"),
        advice=Told("save it with 'values': 'line_integral' beside 'train' if they are that"),
    )
    scan, box, voxels = _geometry(path, content, raw.shape[1:])
    all_angles = np.concatenate(angles)
    held_out = np.arange(len(raw)) >= len(stacks[0]) if len(stacks) > 1 else every_eighth(len(raw))
    projections = Projections(
        images=images,
        detectors=scan.detectors(all_angles),
        held_out=held_out,
        angles_rad=all_angles,
        box_mm=box,
        voxels=voxels,
        source_to_axis_mm=scan.source_to_axis_mm,
        source_to_detector_mm=scan.source_to_detector_mm,
    )
    return ProjectionFiles(projections, [path], meaning)


def _part(path: Path, part: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    for key in ("projections", "angles"):
        if key not in part:
            raise CaptureProblem(path, "lacks '{key}'", "export it again with projections and angles", key=key)
    images, angles = np.asarray(part["projections"]), np.asarray(part["angles"], np.float64).ravel()
    if images.ndim != 3 or images.dtype.kind not in "fiu":
        raise CaptureProblem(
            path, "'projections' has shape {shape}", "store [count, rows, columns]", shape=images.shape
        )
    if len(angles) < len(images) or not np.isfinite(angles).all():
        raise CaptureProblem(
            path,
            "has {count} projections but {angles} finite angles",
            "store one angle a projection",
            count=len(images),
            angles=len(angles),
        )
    return images, angles[: len(images)]


def _geometry(
    path: Path, content: dict[str, Any], shape: tuple[int, ...]
) -> tuple[CircularScan, np.ndarray, tuple[int, int, int]]:
    to_axis, to_detector = number(path, content, "DSO"), number(path, content, "DSD")
    check_distances(path, to_axis, to_detector)
    columns_rows = numbers(path, content, "nDetector", 2).astype(int)
    if tuple(columns_rows[::-1]) != tuple(shape):
        raise CaptureProblem(
            path,
            "'nDetector' [columns, rows] is {pixels} but the projections have {stored}",
            "correct one of the two",
            pixels=columns_rows.tolist(),
            stored=list(shape),
        )
    pixel = numbers(path, content, "dDetector", 2)
    voxels, voxel = numbers(path, content, "nVoxel", 3), numbers(path, content, "dVoxel", 3)
    for key, values in (("dDetector", pixel), ("nVoxel", voxels), ("dVoxel", voxel)):
        positive(path, key, values)
    offset = numbers(path, content, "offDetector", 2, [0, 0])
    scan = CircularScan(
        width=shape[1],
        height=shape[0],
        pixel_mm=(pixel[0], pixel[1]),
        source_to_axis_mm=to_axis,
        source_to_detector_mm=to_detector,
        offset_mm=(offset[0], offset[1]),
        parallel=content.get("mode", "cone") == "parallel",
    )
    middle = numbers(path, content, "offOrigin", 3, [0, 0, 0])
    half = voxels * voxel / 2
    return scan, np.stack([middle - half, middle + half]), (int(voxels[0]), int(voxels[1]), int(voxels[2]))
