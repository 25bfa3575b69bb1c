"""How fast the section follows a plane in Blender's process, where there is numpy alone."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from ..errors import GaussianFileError
from ..gaussians import GaussianSet
from ..render.section_numpy import CUTOFF_SIGMAS, MOVING_SIGMAS, SectionSplats, section_density
from ..views import Plane
from .scenes import scene

# A plane reaches beyond the model by a tenth on either side.
_MARGIN = 1.2


def measure_cuts(
    of: int | GaussianSet, side: int = 512, positions: int = 20, seed: int = 0, name: str = "cube"
) -> dict[str, Any]:
    """A plane goes through a model, a section at each place.

    Args:
        of: a set of splats, which the plane covers and goes through along y; or how many a made-up cube of
            `bench.scenes` is to have, whose splats are a pixel or two wide.
        name: of the set, for the table.

    Returns:
        `of`; `splats` that attenuate; `width`, `height`; `prepare_ms`, once for a model; `exact_ms` and `moving_ms`,
        means over the places, of the section at rest and of the one shown while the plane moves; `updates` of the
        latter a second; `rms_difference` and `largest_difference` of the two in parts of the exact section's highest
        value.

    Raises:
        GaussianFileError: a set in which nothing attenuates.
    """
    if isinstance(of, GaussianSet):
        gaussians, planes = of, _planes_through(of, side, positions, name)
    else:
        gaussians, planes = _cube(of, side, positions, seed)
    begin = time.perf_counter()
    source = SectionSplats(gaussians)
    prepare = time.perf_counter() - begin
    exact, exact_s = _drawn(planes, lambda plane: section_density(source, plane, CUTOFF_SIGMAS))
    moving, moving_s = _drawn(planes, lambda plane: section_density(source, plane, MOVING_SIGMAS))
    peak = float(exact.max())
    return {
        "of": name,
        "splats": len(source),
        "width": side,
        "height": side,
        "prepare_ms": 1e3 * prepare,
        "exact_ms": 1e3 * exact_s,
        "moving_ms": 1e3 * moving_s,
        "updates": 1 / moving_s,
        "rms_difference": float(np.sqrt(np.mean((moving - exact) ** 2))) / peak,
        "largest_difference": float(np.abs(moving - exact).max()) / peak,
    }


def _cube(splats: int, side: int, positions: int, seed: int) -> tuple[GaussianSet, list[Plane]]:
    made = scene(splats, side, seed)
    depth = 0.9 * float(np.abs(made.gaussians.means[:, 2]).max())
    heights = np.linspace(-depth, depth, positions)
    planes = [replace(made.plane, origin=made.plane.origin + np.array([0.0, 0.0, height])) for height in heights]
    return made.gaussians, planes


def _planes_through(gaussians: GaussianSet, side: int, positions: int, name: str) -> list[Plane]:
    means = gaussians.means[gaussians.density != 0].astype(np.float64)
    if not len(means):
        raise GaussianFileError("{name} has no splats that attenuate; give a run's fused.ply or xray.ply.", name=name)
    # A splat far off would make all others small.
    low, high = np.percentile(means, (0.5, 99.5), axis=0)
    middle, reach = 0.5 * (low + high), 0.5 * _MARGIN * float((high - low)[[0, 2]].max())
    step = 2 * reach / side
    planes = []
    for y in middle[1] + 0.45 * (high - low)[1] * np.linspace(-1, 1, positions):
        corner = np.array([middle[0] - reach + 0.5 * step, y, middle[2] + reach - 0.5 * step])
        planes.append(Plane(corner, np.array([step, 0.0, 0.0]), np.array([0.0, 0.0, -step]), side, side))
    return planes


def _drawn(planes: list[Plane], draw: Callable[[Plane], np.ndarray]) -> tuple[np.ndarray, float]:
    """The sections (P, height, width), and seconds a section."""
    # A process that has just started gets its memory page by page.
    for plane in planes:
        draw(plane)
    begin = time.perf_counter()
    sections = [draw(plane) for plane in planes]
    return np.stack(sections), (time.perf_counter() - begin) / len(planes)
