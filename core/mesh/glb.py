"""Meshes as binary glTF."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..files import atomic_write
from ..srgb import srgb_to_linear

if TYPE_CHECKING:
    import trimesh

_METRES_PER_MM = 1e-3
_COLORS = "_colors"
# glTF is y up: x -> x, z -> y, y -> -z.
_Y_UP = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]], float)


def write_glb(mesh: trimesh.Trimesh, path: Path) -> None:
    """Writes a mesh (mm, z up, sRGB vertex colours) as the glTF 2.0 standard demands, atomically.

    Metres and y up, so that importers, which turn and scale back, show the true size; linear vertex colours of 16 bits
    a channel, because in 8 the 31 darkest of sRGB's 256 steps are but five; a matt, two-sided material, because glTF's
    default is metal. `asset.extras` records what was done.

    Raises:
        DiskFullError, RunFolderError: the file cannot be written.
    """
    from trimesh.visual import ColorVisuals

    out = mesh.copy()
    out.apply_transform(_Y_UP @ np.diag([_METRES_PER_MM] * 3 + [1.0]))
    colors = np.asarray(mesh.visual.vertex_colors)
    # trimesh writes colours in 8 bits, and other attributes as they are, under names that begin with an underscore.
    out.visual = ColorVisuals()
    out.vertex_attributes[_COLORS] = _linear(colors)
    content = out.export(file_type="glb", include_normals=True, tree_postprocessor=_finish)
    with atomic_write(Path(path)) as stream:
        stream.write(content)


def _finish(tree: dict[str, Any]) -> None:
    tree["asset"]["extras"] = {"unit": "metre", "source_unit": "millimetre", "source_up": "z"}
    tree["materials"] = [
        {
            "name": "InsideOut",
            "doubleSided": True,
            "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.7},
        }
    ]
    for mesh in tree["meshes"]:
        for primitive in mesh["primitives"]:
            primitive["material"] = 0
            attributes = primitive["attributes"]
            attributes["COLOR_0"] = attributes.pop(_COLORS)
            tree["accessors"][attributes["COLOR_0"]]["normalized"] = True


def _linear(rgba: np.ndarray) -> np.ndarray:
    """8-bit sRGB with opacity -> 16-bit linear, opacity as it is."""
    shares = rgba / 255.0
    return np.round(65535 * np.column_stack([srgb_to_linear(shares[:, :3]), shares[:, 3]])).astype(np.uint16)
