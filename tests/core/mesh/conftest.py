from __future__ import annotations

import numpy as np
import pytest

from insideout.core.volume import Volume


@pytest.fixture
def ball_volume():
    """A function: the volume of a ball or a hollow ball, each voxel the mean over itself."""

    def make(radius=10.0, cavity=0.0, center=(1.0, 2.0, -1.0), attenuation=0.05, spacing=0.5, half=14.0):
        count = round(2 * half / spacing)
        volume = Volume.centered(np.zeros((count,) * 3, np.float32), np.full(3, spacing))
        axis = volume.origin_mm[0] + spacing * np.arange(count)
        z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
        distance = np.sqrt((x - center[0]) ** 2 + (y - center[1]) ** 2 + (z - center[2]) ** 2)
        solid = np.clip(0.5 - (distance - radius) / spacing, 0, 1)
        hollow = np.clip(0.5 - (distance - cavity) / spacing, 0, 1) if cavity else 0.0
        volume.values[:] = attenuation * (solid - hollow)
        return volume

    return make
