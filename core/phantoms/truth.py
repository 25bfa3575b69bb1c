"""What is true of a synthetic capture: attenuation, surfaces, and where the photos' frame lies. No stage reads it."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from ..files import atomic_write
from ..similarity import Similarity
from ..volume import Volume
from .model import Phantom
from .part_tables import PartTables
from .scanner import voxels


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


def write_truth(phantom: Phantom, tables: PartTables, path: Path, voxel_mm: float, to_world: Similarity) -> None:
    volume = truth_volume(phantom, tables, voxel_mm)
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        volume=volume.values.astype(np.float16),
        spacing_mm_zyx=volume.spacing_mm[::-1],
        origin_mm_zyx=volume.origin_mm[::-1],
        **to_world.to_json(),
    )
    with atomic_write(path) as stream:
        stream.write(buffer.getvalue())
