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
# glTF is y up: x -> x, z -> y, y -> -z.
_Y_UP = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]], float)


def write_glb(mesh: trimesh.Trimesh, path: Path) -> None:
    """Writes a mesh (mm, z up, sRGB vertex colours) as the glTF 2.0 standard demands, atomically.

    Metres and y up, so that importers, which turn and scale back, show the true size; linear vertex colours; a
    matt, two-sided material, because glTF's default is metal. `asset.extras` records what was done.

    Raises:
        DiskFullError, RunFolderError: the file cannot be written.
    """
    out = mesh.copy()
    out.apply_transform(_Y_UP @ np.diag([_METRES_PER_MM] * 3 + [1.0]))
    colors = np.asarray(mesh.visual.vertex_colors)
    out.visual.vertex_colors = np.column_stack([_linear(colors[:, :3]), colors[:, 3]])
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


def _linear(srgb: np.ndarray) -> np.ndarray:
    """8-bit sRGB -> 8-bit linear."""
    return np.round(255 * srgb_to_linear(srgb / 255.0)).astype(np.uint8)
