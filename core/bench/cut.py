"""How fast the section follows a plane in Blender's process, where there is numpy alone."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from ..render.section_numpy import CUTOFF_SIGMAS, MOVING_SIGMAS, SectionSplats, section_density
from ..views import Plane
from .scenes import scene


def measure_cuts(splats: int, side: int = 512, positions: int = 20, seed: int = 0) -> dict[str, Any]:
    """A plane goes through a cube full of splats (`bench.scenes`), a section at each place.

    Returns:
        `splats`, `width`, `height`; `prepare_ms`, once for a model; `exact_ms` and `moving_ms`, means over the places,
        of the section at rest and of the one shown while the plane moves; `updates` of the latter a second;
        `rms_difference` and `largest_difference` of the two in parts of the exact section's highest value.
    """
    made = scene(splats, side, seed)
    begin = time.perf_counter()
    source = SectionSplats(made.gaussians)
    prepare = time.perf_counter() - begin
    depth = 0.9 * float(np.abs(made.gaussians.means[:, 2]).max())
    planes = [
        replace(made.plane, origin=made.plane.origin + np.array([0.0, 0.0, height]))
        for height in np.linspace(-depth, depth, positions)
    ]
    exact, exact_s = _drawn(planes, lambda plane: section_density(source, plane, CUTOFF_SIGMAS))
    moving, moving_s = _drawn(planes, lambda plane: section_density(source, plane, MOVING_SIGMAS))
    peak = float(exact.max())
    return {
        "splats": splats,
        "width": side,
        "height": side,
        "prepare_ms": 1e3 * prepare,
        "exact_ms": 1e3 * exact_s,
        "moving_ms": 1e3 * moving_s,
        "updates": 1 / moving_s,
        "rms_difference": float(np.sqrt(np.mean((moving - exact) ** 2))) / peak,
        "largest_difference": float(np.abs(moving - exact).max()) / peak,
    }


def _drawn(planes: list[Plane], draw: Callable[[Plane], np.ndarray]) -> tuple[np.ndarray, float]:
    """The sections (P, height, width), and seconds a section."""
    # A process that has just started gets its memory page by page.
    for plane in planes:
        draw(plane)
    begin = time.perf_counter()
    sections = [draw(plane) for plane in planes]
    return np.stack(sections), (time.perf_counter() - begin) / len(planes)
