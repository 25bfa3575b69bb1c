"""Photos of a phantom: rays traced through its signed distance, soft light, a plain background or a room."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ..srgb import linear_to_srgb, srgb_to_linear
from ..views import Camera
from .distance_grid import DistanceGrid
from .model import Phantom
from .shots import Shot

BACKGROUND = (0.74, 0.79, 0.84)
"""sRGB; a pale blue that no phantom wears."""

_UNTIL_STRAIGHT = cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12
# A pixel's rays along each axis where each goes through its own point of a lens, or at its own time.
_SPREAD_RAYS = 5
# A ray takes some 200 bytes: half a gigabyte, however large a photo is.
_RAYS_AT_ONCE = 2_000_000


@dataclass(frozen=True)
class Light:
    """A soft key light that casts shadows, a weak fill, and sky light, all fixed in the world.

    Attributes:
        key, fill: directions towards the lights.
        softness: radius of the key light over its distance.
        key_strength, fill_strength, sky_strength, ground_strength: linear radiance factors.
    """

    key: tuple[float, float, float] = (-0.45, -0.70, 0.75)
    fill: tuple[float, float, float] = (0.75, 0.55, 0.25)
    softness: float = 0.22
    key_strength: float = 0.62
    fill_strength: float = 0.20
    sky_strength: float = 0.52
    ground_strength: float = 0.34


def render_photo(
    phantom: Phantom, grid: DistanceGrid, shot: Shot | Camera, light: Light | None = None, supersample: int = 2
) -> np.ndarray:
    """One photo, (height, width, 3) sRGB float32 in 0..1.

    Args:
        grid: `phantom.surface`, baked.
        shot: in the world frame, mm; a camera alone is a pinhole that stands still.
        supersample: rays a pixel along each axis; at least five where a lens or a motion blurs.
    """
    shot = shot if isinstance(shot, Shot) else Shot(shot)
    camera, spread = shot.camera, shot.aperture_mm or shot.open
    supersample = max(supersample, _SPREAD_RAYS) if spread else supersample
    height = max(1, _RAYS_AT_ONCE // (camera.width * supersample**2))
    bands = (slice(top, min(top + height, camera.height)) for top in range(0, camera.height, height))
    light_in = np.concatenate([_light_in(phantom, grid, shot, light or Light(), supersample, rows) for rows in bands])
    return linear_to_srgb(np.clip(light_in * np.asarray(shot.gain or 1.0), 0, 1)).astype(np.float32)


def _light_in(
    phantom: Phantom, grid: DistanceGrid, shot: Shot, light: Light, supersample: int, rows: slice
) -> np.ndarray:
    """(rows, width, 3) linear light of some rows of pixels."""
    origins, directions = _shot_rays(shot, supersample, rows)
    reach = grid.first_hits(origins, directions)
    image = _behind(shot, supersample, rows)
    hit = np.isfinite(reach)
    if hit.any():
        points = (origins[hit] + reach[hit, None] * directions[hit]).astype(np.float32)
        image[hit] = _shade(phantom, grid, points, light)
    return image.reshape(rows.stop - rows.start, supersample, shot.camera.width, supersample, 3).mean(axis=(1, 3))


def _behind(shot: Shot, supersample: int, rows: slice) -> np.ndarray:
    """(rows · width · supersample², 3) linear light of rays that miss the object."""
    if shot.backdrop is None:
        plain = srgb_to_linear(np.asarray(BACKGROUND)).astype(np.float32)
        return np.tile(plain, ((rows.stop - rows.start) * shot.camera.width * supersample**2, 1))
    seen = srgb_to_linear(shot.backdrop[rows]).astype(np.float32)
    return seen.repeat(supersample, axis=0).repeat(supersample, axis=1).reshape(-1, 3)


def exposed(pixels: np.ndarray, gain: tuple[float, float, float]) -> np.ndarray:
    """A photo (height, width, 3) uint8 sRGB as if the light of red, green and blue had been `gain` times as much.

    What was white already stays the white that it was.
    """
    light = np.clip(srgb_to_linear(pixels / 255.0) * np.asarray(gain), 0, 1)
    return np.round(255 * linear_to_srgb(light)).astype(np.uint8)


def _shot_rays(shot: Shot, supersample: int, rows: slice) -> tuple[np.ndarray, np.ndarray]:
    """Origins and unit directions (rows · width · supersample², 3) in the world, row by row of the finer image."""
    camera, height = shot.camera, rows.stop - rows.start
    x = ((np.arange(camera.width * supersample) + 0.5) / supersample - camera.cx) / camera.fx
    fine_rows = np.arange(rows.start * supersample, rows.stop * supersample)
    y = ((fine_rows + 0.5) / supersample - camera.cy) / camera.fy
    local = np.stack(np.broadcast_arrays(x[None, :], y[:, None], 1.0), axis=-1)
    if shot.lens is not None:
        local[..., :2] = _straight(local[..., :2], shot.lens)
    lens = np.zeros_like(local)
    if shot.aperture_mm:
        lens[..., :2] = np.tile(_lens_points(shot.aperture_mm, supersample), (height, camera.width, 1))
        local = shot.focus_mm * local - lens
    local = local / np.linalg.norm(local, axis=-1, keepdims=True)
    if shot.open:
        # Each ray of a pixel has a time of its own, in another order than the points of a lens.
        times = (np.random.default_rng(1).permutation(supersample**2) + 0.5) / supersample**2
        centers, turns = (
            np.tile(part.reshape(supersample, supersample, *part.shape[1:]), (height, camera.width, *more))
            for part, more in zip(shot.poses_at(times), ((1,), (1, 1)), strict=True)
        )
    else:
        centers, turns = (np.repeat(part[rows], supersample, axis=0)[:, None] for part in shot.row_poses())
    origins = centers + np.einsum("...ij,...j->...i", turns, lens)
    return origins.reshape(-1, 3), np.einsum("...ij,...j->...i", turns, local).reshape(-1, 3)


def _straight(seen: np.ndarray, lens: tuple[float, float, float, float]) -> np.ndarray:
    """(..., 2) x / z and y / z of what a lens shows at places (..., 2)."""
    places, still = np.ascontiguousarray(seen, np.float64).reshape(-1, 1, 2), np.eye(3)
    found = cv2.undistortPointsIter(places, still, np.array(lens), None, None, _UNTIL_STRAIGHT)
    return np.asarray(found.reshape(seen.shape))


def _lens_points(diameter: float, supersample: int) -> np.ndarray:
    """(supersample, supersample, 2) points spread evenly over the lens, one for each ray of a pixel."""
    count = supersample**2
    # Which ray goes through which point is shuffled: in order, blur would depend on the place within the pixel.
    number = np.random.default_rng(0).permutation(count)
    radius, angle = 0.5 * diameter * np.sqrt((number + 0.5) / count), number * np.pi * (3 - np.sqrt(5))
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
    return points.reshape(supersample, supersample, 2)


def _shade(phantom: Phantom, grid: DistanceGrid, points: np.ndarray, light: Light) -> np.ndarray:
    normals = grid.normals(points)
    albedo = srgb_to_linear(phantom.color(points, normals))
    key, fill = _unit(light.key), _unit(light.fill)
    open_sky = grid.openness(points, normals, 9.0)[:, None]
    shadow = grid.light(points, normals, key, light.softness)
    up = 0.5 + 0.5 * normals[:, 2:3]
    ambient = (light.ground_strength + up * (light.sky_strength - light.ground_strength)) * open_sky
    direct = light.key_strength * (np.maximum(normals @ key, 0) * shadow)[:, None]
    weak = light.fill_strength * np.maximum(normals @ fill, 0)[:, None]
    return albedo * (ambient + direct + weak)


def _unit(vector: tuple[float, float, float]) -> np.ndarray:
    return np.asarray(vector) / np.linalg.norm(vector)
