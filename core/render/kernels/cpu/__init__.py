"""Numba kernels. They compile when first called (about a minute in all) and are kept on disk from then on."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ....gaussians import GaussianSet
from ....progress import Progress, Reporter
from ....views import Camera, Detector, Plane


def is_compiled(renderers: Iterable[str] = ("splat", "radiograph")) -> bool:
    """Whether an earlier run on this machine left the kernels of these renderers, forward and backward, on disk.

    Args:
        renderers: of "splat", "radiograph", "section", and "splat_effects" for masks and pixel integration.
    """
    from importlib import import_module

    modules = (import_module(f".{renderer}_raster", __name__) for renderer in renderers)
    return all(_on_disk(module.rasterize_backward) for module in modules)


def announce(reporter: Reporter, progress: Progress, renderers: Iterable[str]) -> None:
    """Tells the user what the first use of these renderers waits for, if their kernels are not on disk yet.

    Args:
        progress: where the work stands; sent on with a message.
    """
    if not is_compiled(renderers):
        reporter.update(replace(progress, message="compiling kernels, once"))


def warm_up(renderers: Iterable[str] = ("splat", "radiograph", "section")) -> None:
    """Compiles or loads the kernels of these renderers, so that no measured step waits for it."""
    import torch

    from ... import radiograph, section, splat

    one = GaussianSet.create(np.array([[0.0, 0.0, 2.0]]), 0.1, density=1.0).to_torch()
    one = replace(one, **{name: getattr(one, name).requires_grad_() for name in _TRAINED})
    camera = Camera(2, 2, 1.0, 1.0, 1.0, 1.0, np.eye(4))
    x, y = np.array([0.1, 0.0, 0.0]), np.array([0.0, 0.1, 0.0])
    detector = Detector(2, 2, np.zeros(3), np.array([0.0, 0.0, 4.0]), x, y)
    plane = Plane(np.array([-0.1, -0.1, 2.0]), x, y, 2, 2)
    draw: dict[str, Callable[[], list[torch.Tensor]]] = {
        "splat": lambda: [splat(one, camera).color],
        "splat_effects": lambda: [splat(one, camera, pixel_integration=True).color],
        "radiograph": lambda: [radiograph(one, detector)],
        "section": lambda: [section(one, plane, quantity) for quantity in ("density", "occupancy", "color")],
    }
    images = [image for renderer in renderers for image in draw[renderer]()]
    torch.stack([image.sum() for image in images]).sum().backward()


_TRAINED = ("means", "quats", "scales", "opacities", "sh", "density")


def _on_disk(kernel: Any) -> bool:
    where = Path(kernel.stats.cache_path)
    return any(where.glob(f"{kernel.__module__.rpartition('.')[2]}.{kernel.__qualname__}-*.nbi"))
