"""Photos of a phantom: rays traced through its signed distance, soft light, a plain background."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..similarity import Similarity
from ..views import Camera
from .distance_grid import DistanceGrid
from .model import Phantom

BACKGROUND = (0.74, 0.79, 0.84)
"""sRGB; a pale blue that no phantom wears."""


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


def camera_ring(count: int, size_mm: float, width: int, height: int, rng: np.random.Generator) -> list[Camera]:
    """Cameras on a sphere around the origin, from 40° below to 72° above, evenly by the golden angle.

    Args:
        size_mm: the largest extent of the object; it fills about 80 % of the image's height.
    """
    distance = 4.0 * size_mm
    focal = 0.86 * height * distance / (1.12 * size_mm)
    cameras = []
    for index in range(count):
        share = (index + 0.5) / count
        elevation = np.arcsin(np.sin(np.radians(-40)) + share * (np.sin(np.radians(72)) - np.sin(np.radians(-40))))
        azimuth = index * np.pi * (3 - np.sqrt(5)) + 0.1 * rng.standard_normal()
        toward = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
        position = distance * (1 + 0.03 * rng.standard_normal()) * toward
        cameras.append(
            Camera(
                width,
                height,
                focal,
                focal,
                width / 2,
                height / 2,
                _look_at(position, 0.02 * size_mm * rng.standard_normal(3)),
            )
        )
    return cameras


def render_photo(
    phantom: Phantom, grid: DistanceGrid, camera: Camera, light: Light | None = None, supersample: int = 2
) -> np.ndarray:
    """One photo, (height, width, 3) sRGB float32 in 0..1.

    Args:
        grid: `phantom.surface`, baked.
        camera: in the world frame, mm.
        supersample: rays a pixel along each axis.
    """
    fine = camera.resized(camera.width * supersample, camera.height * supersample)
    origins, directions = _camera_rays(fine)
    reach = grid.first_hits(origins, directions)
    image = np.tile(_to_linear(np.asarray(BACKGROUND)).astype(np.float32), (len(reach), 1))
    hit = np.isfinite(reach)
    if hit.any():
        points = (origins[hit] + reach[hit, None] * directions[hit]).astype(np.float32)
        image[hit] = _shade(phantom, grid, points, light or Light())
    blocks = image.reshape(camera.height, supersample, camera.width, supersample, 3)
    return _to_srgb(np.clip(blocks.mean(axis=(1, 3)), 0, 1)).astype(np.float32)


def opengl_camera_to_world(camera: Camera) -> np.ndarray:
    """The (4, 4) camera-to-world matrix with OpenGL camera axes (x right, y up, z backward)."""
    return np.linalg.inv(np.asarray(camera.world_to_camera, np.float64)) @ np.diag([1.0, -1.0, -1.0, 1.0])


def transforms(cameras: list[Camera], names: list[str], to_photo: Similarity) -> dict[str, object]:
    """Content of transforms.json: cameras moved from the world to the photo frame by `to_photo`."""
    first = cameras[0]
    frames = [
        {"file_path": name, "transform_matrix": opengl_camera_to_world(camera.transformed(to_photo)).tolist()}
        for name, camera in zip(names, cameras, strict=True)
    ]
    return {
        "camera_model": "PINHOLE",
        "w": first.width,
        "h": first.height,
        "fl_x": first.fx,
        "fl_y": first.fy,
        "cx": first.cx,
        "cy": first.cy,
        "frames": frames,
    }


def _look_at(position: np.ndarray, target: np.ndarray) -> np.ndarray:
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, -rotation @ position
    return matrix


def _camera_rays(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    local = np.stack(np.broadcast_arrays(x[None, :], y[:, None], 1.0), axis=-1).reshape(-1, 3)
    local /= np.linalg.norm(local, axis=1, keepdims=True)
    directions = local @ np.asarray(camera.world_to_camera)[:3, :3]
    return np.broadcast_to(camera.center, directions.shape), directions


def _shade(phantom: Phantom, grid: DistanceGrid, points: np.ndarray, light: Light) -> np.ndarray:
    normals = grid.normals(points)
    albedo = _to_linear(phantom.color(points, normals))
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


def _to_linear(srgb: np.ndarray) -> np.ndarray:
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def _to_srgb(linear: np.ndarray) -> np.ndarray:
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)
