"""Numba kernels. They compile when first called (some 20 s in all) and are kept on disk from then on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ....gaussians import GaussianSet
from ....progress import Progress, Reporter
from ....views import Camera, Detector, Plane


def is_compiled() -> bool:
    """Whether an earlier run on this machine left the photo and X-ray kernels compiled on disk."""
    from . import radiograph_raster, splat_raster

    return all(_on_disk(module.rasterize_backward) for module in (splat_raster, radiograph_raster))


def warm_up(reporter: Reporter | None = None, stage: str = "initialize") -> None:
    """Compiles or loads the kernels of all three renderers, so that no iteration of a loop waits for it.

    Args:
        reporter: told "compiling kernels, once" if they are not on disk yet.
        stage: the stage that waits.
    """
    import torch

    from ... import radiograph, section, splat

    if reporter is not None and not is_compiled():
        reporter.update(Progress(stage, message="compiling kernels, once"))
    one = GaussianSet.create(np.array([[0.0, 0.0, 2.0]]), 0.1, density=1.0).to_torch()
    one = replace(one, **{name: getattr(one, name).requires_grad_() for name in _TRAINED})
    camera = Camera(2, 2, 1.0, 1.0, 1.0, 1.0, np.eye(4))
    x, y = np.array([0.1, 0.0, 0.0]), np.array([0.0, 0.1, 0.0])
    detector = Detector(2, 2, np.zeros(3), np.array([0.0, 0.0, 4.0]), x, y)
    plane = Plane(np.array([-0.1, -0.1, 2.0]), x, y, 2, 2)
    images = [splat(one, camera).color, radiograph(one, detector)]
    images += [section(one, plane, quantity) for quantity in ("density", "occupancy", "color")]
    torch.stack([image.sum() for image in images]).sum().backward()


_TRAINED = ("means", "quats", "scales", "opacities", "sh", "density")


def _on_disk(kernel: Any) -> bool:
    where = Path(kernel.stats.cache_path)
    return any(where.glob(f"{kernel.__module__.rpartition('.')[2]}.{kernel.__name__}-*.nbi"))
