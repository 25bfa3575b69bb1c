"""Colours of broken faces from what is inside: the density on each wall. Numpy alone, no bpy."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import replace

import numpy as np

from ...core.colormap import density_colors
from ...core.gaussians import GaussianSet
from ...core.render.section_numpy import SectionSplats, section_density
from ...core.views import Plane
from .cells import Wall
from .meshes import Surface

# Pixels of the section through a wall, in each direction, for one distance between the wall's vertices.
_FINER = 2
_MOST_PIXELS = 1024
_GREY = 0.6
_SHARE_OF_AIR = 0.02


def color_in_steps(
    parts: Sequence[Surface],
    walls: Sequence[Wall],
    gaussians: GaussianSet,
    spacing_mm: float,
    window: tuple[float, float] | None = None,
) -> Generator[float, None, list[Surface]]:
    """The parts with their broken faces in the colours of the density there; yields the share that is done.

    Args:
        gaussians: numpy, mm, in the frame of the parts.
        spacing_mm: between the vertices on walls.
        window: mm⁻¹, shown darkest and brightest; by default 0 and the 99.5th percentile of the material on all walls.
            Where nothing has density walls are grey.
    """
    splats = SectionSplats(gaussians)
    found = [np.zeros((len(part.faces), 3)) for part in parts]
    for number, wall in enumerate(walls):
        yield number / len(walls)
        on_it = [part.wall == number for part in parts]
        if not any(mask.any() for mask in on_it):
            continue
        places = [part.vertices[part.faces[mask]] for part, mask in zip(parts, on_it, strict=True)]
        values = wall_density(splats, wall, np.concatenate(places).reshape(-1, 3), spacing_mm).reshape(-1, 3)
        start = 0
        for densities, mask in zip(found, on_it, strict=True):
            count = np.count_nonzero(mask)
            densities[mask] = values[start : start + count]
            start += count
    broken = np.concatenate([densities[part.wall >= 0].ravel() for densities, part in zip(found, parts, strict=True)])
    top = float(broken.max(initial=0.0))
    if window is None and top > 0:
        window = (0.0, float(np.percentile(broken[broken > _SHARE_OF_AIR * top], 99.5)))
    colored = []
    for part, densities in zip(parts, found, strict=True):
        colors = part.colors.copy()
        mask = part.wall >= 0
        colors[mask] = _GREY if window is None else density_colors(densities[mask], *window)
        colored.append(replace(part, colors=colors))
    return colored


def wall_density(splats: SectionSplats, wall: Wall, points: np.ndarray, spacing_mm: float) -> np.ndarray:
    """(P,) attenuation in mm⁻¹ at points (P, 3) of a plane, between the pixels of a section through it."""
    first = np.cross(wall.normal, [1.0, 0, 0] if abs(wall.normal[0]) < 0.9 else [0, 1.0, 0])
    first /= np.linalg.norm(first)
    second = np.cross(wall.normal, first)
    flat = np.stack([points @ first, points @ second], axis=1)
    low, extent = flat.min(axis=0), np.ptp(flat, axis=0)
    pixel = max(spacing_mm / _FINER, float(extent.max()) / _MOST_PIXELS, 1e-6)
    # One pixel more at each end, so that every point lies between middles of pixels.
    corner = low - pixel
    width, height = (int(np.ceil(side / pixel)) + 2 for side in extent)
    origin = wall.offset * wall.normal + corner[0] * first + corner[1] * second
    image = section_density(splats, Plane(origin, pixel * first, pixel * second, width, height))
    return _between_pixels(image, (flat - corner) / pixel - 0.5)


def _between_pixels(image: np.ndarray, places: np.ndarray) -> np.ndarray:
    """(P,) bilinear values at (P, 2) columns and rows, counted from the first pixel's middle."""
    size = np.array([image.shape[1], image.shape[0]])
    places = np.clip(places, 0, size - 1)
    left, top = np.minimum(places.astype(np.int64), size - 2).T
    across, down = (places - np.stack([left, top], axis=1)).T
    upper = image[top, left] * (1 - across) + image[top, left + 1] * across
    lower = image[top + 1, left] * (1 - across) + image[top + 1, left + 1] * across
    return upper * (1 - down) + lower * down
