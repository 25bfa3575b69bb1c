"""What is true of a synthetic capture: attenuation, surfaces, and where the photos' frame lies. No stage reads it."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..errors import CaptureError
from ..files import atomic_write
from ..similarity import Similarity
from ..volume import ARCHIVE_ERRORS, Volume
from .distance_grid import DistanceGrid
from .meshes import surface_mesh
from .model import Phantom
from .part_tables import PartTables
from .scanner import voxels

# A face of a part this near to what photos see belongs to the outer surface.
_OUTER_MM = 0.3
_FINEST_MM = 0.1
# Vertices are kept to about a micrometre: what is finer is noise that does not compress.
_STEPS_PER_MM = 1024
_OF_PHOTOS = ("aperture_mm", "focus_mm", "shutter_poses", "exposure_gain", "lens")
_SCAN = "scan_"


@dataclass(frozen=True, eq=False)
class Surface:
    """A triangle mesh in the world frame.

    Attributes:
        vertices: (V, 3) float32, mm.
        faces: (F, 3) int32, counterclockwise seen from the side that faces away from the part.
    """

    vertices: np.ndarray
    faces: np.ndarray


@dataclass(frozen=True, eq=False)
class Truth:
    """What is true of a synthetic capture.

    Attributes:
        volume: attenuation in mm⁻¹ at the phantom's photon energy, averaged over voxels unless `at_centers`.
        photo_to_world: x_mm = scale · R · x_photo + t; None without photos (the Shepp-Logan head).
        outer: what photos see; closed. None in captures from before there were surfaces.
        inner: all other places where the material changes, to air too; open where parts meet, and double where two
            parts touch. None as above.
        effects: what the capture was made with; None where it does not say.
        aperture_mm, focus_mm: (photos,) of the lens, see `Shot`; None without "defocus".
        shutter_poses: (photos, 2, 4, 4) camera-to-world matrices (OpenGL axes, photo frame) while the first and the
            last row were read, or when the shutter opened and closed; None without "rolling_shutter" or "motion_blur".
        exposure_gain: (photos, 3) of red, green and blue, see `Shot`; None without "exposure".
        lens: (photos, 4) OpenCV's k1, k2, p1, p2, which transforms.json does not tell; None without "lens".
        scan: what is true of the scanner and not in its files, by the names of `ScanFlaws`; empty where there is none.
        at_centers: the volume has the values at voxel centres (the Shepp-Logan head, as tomography measures on it).
    """

    volume: Volume
    photo_to_world: Similarity | None
    outer: Surface | None = None
    inner: Surface | None = None
    effects: tuple[str, ...] | None = None
    aperture_mm: np.ndarray | None = None
    focus_mm: np.ndarray | None = None
    shutter_poses: np.ndarray | None = None
    exposure_gain: np.ndarray | None = None
    lens: np.ndarray | None = None
    scan: Mapping[str, np.ndarray] = field(default_factory=dict)
    at_centers: bool = False


def read_truth(folder: Path) -> Truth:
    """The truth of a capture folder that `make_capture` wrote.

    Raises:
        CaptureError: there is no truth.npz, or it cannot be read.
    """
    path = Path(folder) / "truth.npz"
    if not path.is_file():
        raise CaptureError(f"{path}: is missing; only a capture made by `insideout phantom` has a truth.")
    try:
        with np.load(path) as arrays:
            content = dict(arrays)
        to_world = None
        if any(name in content for name in ("scale", "rotation", "translation")):
            to_world = Similarity(float(content["scale"]), content["rotation"], content["translation"])
    except ARCHIVE_ERRORS as error:
        raise CaptureError(f"{path}: cannot be read ({error}); make the capture again.") from error
    return Truth(
        volume=Volume.load(path),
        photo_to_world=to_world,
        outer=_surface(content, "outer"),
        inner=_surface(content, "inner"),
        effects=tuple(str(name) for name in content["effects"]) if "effects" in content else None,
        **{name: content.get(name) for name in _OF_PHOTOS},
        scan={name.removeprefix(_SCAN): value for name, value in content.items() if name.startswith(_SCAN)},
        at_centers=bool(content.get("at_centers", False)),
    )


def _surface(content: Mapping[str, np.ndarray], name: str) -> Surface | None:
    if f"{name}_vertices" not in content:
        return None
    return Surface(content[f"{name}_vertices"], content[f"{name}_faces"])


def truth_volume(phantom: Phantom, tables: PartTables, voxel_mm: float) -> Volume:
    """The attenuation that a perfect reconstruction would find, voxel by voxel."""
    nx, ny, nz = voxels(phantom, voxel_mm)
    volume = Volume.centered(np.zeros((nz, ny, nx), np.float32), np.full(3, voxel_mm))
    x, y, z = (volume.origin_mm[k] + voxel_mm * np.arange(n) for k, n in enumerate((nx, ny, nz)))
    attenuations = np.array([material.attenuation(phantom.energy_kev) for material in tables.materials])
    for index, height in enumerate(z):
        points = np.stack(np.broadcast_arrays(x[None, :], y[:, None], height), axis=-1).reshape(-1, 3)
        volume.values[index] = tables.voxel_means(points, voxel_mm, attenuations).reshape(ny, nx)
    return volume


def truth_surfaces(phantom: Phantom, tables: PartTables, spacing_mm: float) -> tuple[Surface, Surface]:
    """The outer and the inner surfaces, by marching cubes of the parts' distances `spacing_mm` apart, finer in thin
    parts. A smooth surface of curvature radius R is off by about spacing² / 8R."""
    size = np.array(phantom.size_mm)
    skin = DistanceGrid.bake(phantom.surface, size, spacing_mm)
    pieces = []
    for index, part in enumerate(phantom.parts):
        fitting = min(spacing_mm, max(0.5 * float(tables.depths[index]), _FINEST_MM))
        vertices, faces = surface_mesh(DistanceGrid.bake(part.distance, size, fitting))
        if len(faces) == 0:
            continue
        middles = vertices[faces].mean(axis=1)
        inside = tables.inside(middles)
        covered = inside[index + 1 :].any(axis=0)
        before = np.append(inside[:index][::-1], np.ones((1, len(faces)), bool), axis=0).argmax(axis=0)
        behind = np.append(tables.kinds[:index][::-1], -1)[before]
        hidden = np.abs(skin.distances(middles)) > _OUTER_MM
        pieces.append(_part_of(vertices, faces[~covered & hidden & (behind != tables.kinds[index])]))
    return Surface(*surface_mesh(skin)), joined(pieces)


def _part_of(vertices: np.ndarray, faces: np.ndarray) -> Surface:
    used, numbers = np.unique(faces, return_inverse=True)
    return Surface(vertices[used], numbers.reshape(faces.shape).astype(np.int32))


def joined(pieces: list[Surface]) -> Surface:
    """Surfaces as one; without faces if there are none."""
    starts = np.cumsum([0, *(len(piece.vertices) for piece in pieces)])
    vertices = [np.zeros((0, 3), np.float32), *(piece.vertices for piece in pieces)]
    faces = [piece.faces + start for piece, start in zip(pieces, starts[:-1], strict=True)]
    return Surface(np.concatenate(vertices), np.concatenate([np.zeros((0, 3), np.int32), *faces]).astype(np.int32))


def write_truth(path: Path, truth: Truth) -> None:
    """Writes what `read_truth` reads; see `make_capture` for the names in the file."""
    # Details of the Shepp-Logan head differ by a hundredth; averages need no more than half precision.
    values = truth.volume.values if truth.at_centers else truth.volume.values.astype(np.float16)
    arrays = {
        "volume": values,
        **({"at_centers": np.True_} if truth.at_centers else {}),
        "spacing_mm_zyx": truth.volume.spacing_mm[::-1],
        "origin_mm_zyx": truth.volume.origin_mm[::-1],
        **({} if truth.photo_to_world is None else truth.photo_to_world.to_json()),
    }
    for name in ("outer", "inner"):
        surface = getattr(truth, name)
        if surface is not None:
            arrays[f"{name}_vertices"] = (np.round(surface.vertices * _STEPS_PER_MM) / _STEPS_PER_MM).astype(np.float32)
            arrays[f"{name}_faces"] = surface.faces
    for name in ("effects", *_OF_PHOTOS):
        value = getattr(truth, name)
        if value is not None:
            arrays[name] = np.array(value, dtype="U") if name == "effects" else value
    arrays |= {f"{_SCAN}{name}": value for name, value in truth.scan.items()}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    with atomic_write(path) as stream:
        stream.write(buffer.getvalue())
