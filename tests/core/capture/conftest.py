"""Small captures made on the spot: three balls in a scanner, and photos of a textured corner of a room."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from insideout.core.capture.detectors import CircularScan
from insideout.core.views import Camera, Detector

BALLS = (  # center mm, radius mm, attenuation 1/mm: no mirror image of this is a turned copy of it
    ((10.0, 0.0, 0.0), 4.0, 0.05),
    ((0.0, 6.0, 3.0), 3.0, 0.08),
    ((-2.0, -3.0, 8.0), 2.5, 0.12),
)


def radiograph_of_balls(detector: Detector) -> np.ndarray:
    """Exact line integrals: chord length times attenuation, summed."""
    origins, directions = detector.rays()
    total = np.zeros(origins.shape[:2])
    for center, radius, attenuation in BALLS:
        to_center = np.asarray(center) - origins
        along = (to_center * directions).sum(-1)
        miss = (to_center**2).sum(-1) - along**2
        total += attenuation * 2 * np.sqrt(np.maximum(radius**2 - miss, 0))
    return total.astype(np.float32)


@pytest.fixture
def values():
    """(4, 5, 6) attenuation with one bright corner, lowest z, lowest y, highest x."""
    array = np.full((4, 5, 6), 0.01, np.float32)
    array[0, 0, 5] = 0.07
    array[0, 1, 5] = 0.05
    return array


@pytest.fixture
def radiograph() -> Callable[[Detector], np.ndarray]:
    return radiograph_of_balls


@pytest.fixture
def scan() -> CircularScan:
    return CircularScan(32, 28, (1.6, 1.6), source_to_axis_mm=60.0, source_to_detector_mm=90.0)


@pytest.fixture
def write_xray(scan: CircularScan) -> Callable[..., Path]:
    """Writes an R²-Gaussian folder; `change(meta)` may spoil the geometry, `image(array, i)` the projections."""

    def write(
        folder: Path,
        change: Callable[[dict], object] | None = None,
        image: Callable[[np.ndarray, int], np.ndarray] = lambda array, index: array,
        test: int = 3,
    ) -> Path:
        meta: dict = {
            "scanner": {
                "mode": "cone",
                "DSD": 90.0,
                "DSO": 60.0,
                "nDetector": [28, 32],
                "sDetector": [28 * 1.6, 32 * 1.6],
                "nVoxel": [16, 16, 16],
                "sVoxel": [30.0, 30.0, 24.0],
                "offOrigin": [0, 0, 0],
                "offDetector": [0, 0],
            },
            "proj_train": [],
            "proj_test": [],
        }
        for index, angle in enumerate(np.arange(24) * 2 * np.pi / 24):
            part = "proj_test" if index % 8 == 1 and index // 8 < test else "proj_train"
            name = f"{part}/{index:04d}.npy"
            (folder / part).mkdir(parents=True, exist_ok=True)
            np.save(folder / name, image(radiograph_of_balls(scan.detector(float(angle))), index))
            meta[part].append({"file_path": name, "angle": float(angle)})
        if change is not None:
            change(meta)
        (folder / "meta_data.json").write_text(json.dumps(meta), "utf-8")
        return folder

    return write


def looking_at(center: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """(4, 4) world to camera, OpenCV axes."""
    forward = (target - center) / np.linalg.norm(target - center)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    matrix[:3, 3] = -matrix[:3, :3] @ center
    return matrix


def corner_cameras(count: int) -> list[Camera]:
    """Cameras on an arc in front of the corner where three walls meet at the origin."""
    cameras = []
    for azimuth, height in zip(np.linspace(0.35, 1.2, count), 1.3 + 0.5 * np.sin(np.arange(count)), strict=True):
        center = np.array([3.2 * np.cos(azimuth), 3.2 * np.sin(azimuth), height])
        matrix = looking_at(center, np.array([0.45, 0.45, 0.45]), np.array([0.0, 0.0, 1.0]))
        cameras.append(Camera(320, 240, 330.0, 330.0, 160.0, 120.0, matrix))
    return cameras


def photo_of_corner(camera: Camera) -> np.ndarray:
    """(H, W, 3) uint8: three textured walls, cast ray by ray."""
    walls = np.random.default_rng(7).integers(30, 226, (3, 24, 24, 3))
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones_like(rows)], axis=-1)
    rays = rays @ camera.world_to_camera[:3, :3]
    image = np.full(rays.shape, 128, np.uint8)
    nearest = np.full(rays.shape[:2], np.inf)
    for axis in range(3):
        reach = -camera.center[axis] / rays[..., axis]
        hit = camera.center + reach[..., None] * rays
        others = [k for k in range(3) if k != axis]
        cell = np.floor(hit[..., others] / 1.6 * 24).astype(int)
        seen = (reach > 0) & (reach < nearest) & np.all((cell >= 0) & (cell < 24), axis=-1)
        nearest[seen] = reach[seen]
        image[seen] = walls[axis][cell[seen][:, 0], cell[seen][:, 1]]
    return image


@pytest.fixture
def write_corner_photos() -> Callable[..., list[Camera]]:
    """Writes photos of the corner and returns their true cameras."""

    def write(folder: Path, count: int = 8) -> list[Camera]:
        folder.mkdir(parents=True, exist_ok=True)
        cameras = corner_cameras(count)
        for index, camera in enumerate(cameras):
            Image.fromarray(photo_of_corner(camera)).save(folder / f"{index:02d}.png")
        return cameras

    return write


@pytest.fixture
def write_transforms() -> Callable[..., Path]:
    """Writes transforms.json (OpenGL axes) for cameras whose images are <index>.png."""

    def write(folder: Path, cameras: list[Camera], **more: object) -> Path:
        flip = np.diag([1.0, -1.0, -1.0, 1.0])
        first = cameras[0]
        content = {
            "fl_x": first.fx,
            "fl_y": first.fy,
            "cx": first.cx,
            "cy": first.cy,
            "w": first.width,
            "h": first.height,
            "frames": [
                {
                    "file_path": f"{index:02d}.png",
                    "transform_matrix": (np.linalg.inv(camera.world_to_camera) @ flip).tolist(),
                }
                for index, camera in enumerate(cameras)
            ],
            **more,
        }
        path = folder / "transforms.json"
        path.write_text(json.dumps(content), "utf-8")
        return path

    return write


@pytest.fixture(scope="module")
def corner_photos(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Camera]]:
    """A folder of eight photos of the corner, shared by a module's tests, and their true cameras."""
    folder = tmp_path_factory.mktemp("corner")
    cameras = corner_cameras(8)
    for index, camera in enumerate(cameras):
        Image.fromarray(photo_of_corner(camera)).save(folder / f"{index:02d}.png")
    return folder, cameras
