"""Two walls of coloured patches, one behind the other, and what a lens or a rolling shutter makes of them."""

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numba
import numpy as np
import pytest
import torch

from insideout.core.gaussians import GaussianSet
from insideout.core.render import splat
from insideout.core.spherical_harmonics import rgb_to_sh
from insideout.core.views import Camera

BACKGROUND = np.array([0.74, 0.79, 0.84], np.float32)
DISTANCE, DEPTH = 200.0, 25.0


class Pictures:
    """Photos in memory, as `TrainingPhotos` gives them."""

    def __init__(self, cameras, images):
        self.cameras = list(cameras)
        self.images = [torch.from_numpy(np.ascontiguousarray(image, np.float32)) for image in images]

    def __len__(self):
        return len(self.cameras)

    def read(self, index, share=1.0):
        return self.cameras[index], self.images[index], None


def looking_at_the_middle(position, size, focal):
    forward = -position / np.linalg.norm(position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ position
    return Camera(size, size, focal, focal, size / 2, size / 2, pose)


def spiral_cameras(count, size):
    """Cameras in front of the walls, within 20 degrees of straight ahead."""
    cameras = []
    for index in range(count):
        angle, turn = 0.35 * np.sqrt((index + 0.5) / count), 2.4 * index
        azimuth, elevation = -np.pi / 2 + angle * np.cos(turn), angle * np.sin(turn)
        level = np.cos(elevation)
        toward = np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
        cameras.append(looking_at_the_middle(DISTANCE * toward, size, size * DISTANCE / 80))
    return cameras


def two_walls(patches, seed=0):
    """Walls at 25 mm before and behind the origin, beside each other for the most part."""
    rng = np.random.default_rng(seed)
    places = (np.arange(patches) + 0.5) / patches * 2 - 1
    x, z = (part.ravel() for part in np.meshgrid(places, places))
    near = np.stack([20 * x - 14, np.full_like(x, -DEPTH), 26 * z], axis=1)
    far = np.stack([22 * x + 14, np.full_like(x, DEPTH), 30 * z], axis=1)
    colors = rng.choice([0.1, 0.5, 0.95], size=(2 * len(x), 3))
    wide = 22.0 / patches
    return GaussianSet.create(
        np.concatenate([near, far]), np.tile([wide, 0.3, 1.3 * wide], (2 * len(x), 1)), opacities=0.97,
        sh=rgb_to_sh(colors).astype(np.float32)[:, None],
    )  # fmt: skip


def pinhole(gaussians, camera):
    """(H, W, 3) in 0..1 as a still camera with everything in focus sees a torch set."""
    with torch.no_grad():
        return splat(gaussians, camera, torch.from_numpy(BACKGROUND)).color.clamp(0, 1).numpy()


def to_linear(srgb):
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def to_srgb(linear):
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


def lens_views(camera, radius, focus, count):
    """Pinholes spread over a lens, each shifted so that the plane at depth `focus` stays where it is."""
    index = np.arange(count) + 0.5
    away, turn = radius * np.sqrt(index / count), index * np.pi * (3 - np.sqrt(5))
    views = []
    for right, down in zip(away * np.cos(turn), away * np.sin(turn), strict=True):
        pose = np.array(camera.world_to_camera)
        pose[:3, 3] -= [right, down, 0]
        shifted = {"cx": camera.cx + camera.fx * right / focus, "cy": camera.cy + camera.fy * down / focus}
        views.append(replace(camera, world_to_camera=pose, **shifted))
    return views


def through_lens(photo, camera, radius, focus, count=48):
    """The mean light of `photo(view)`, sRGB, over a lens."""
    light = [to_linear(photo(view)) for view in lens_views(camera, radius, focus, count)]
    return to_srgb(np.mean(light, axis=0)).astype(np.float32)


def row_by_row(photo, camera, poses):
    """Row j of `photo(view)` from pose j."""
    views = [replace(camera, world_to_camera=pose) for pose in poses]
    return np.concatenate([photo(view)[row : row + 1] for row, view in enumerate(views)])


def by_the_formula(color, alpha, radii):
    """The scatter blur, every pixel with every other, in the dtype of its arguments."""
    height, width = radii.shape
    places = torch.cartesian_prod(torch.arange(height), torch.arange(width)).to(radii)
    apart = (places[:, None] - places[None]).square().sum(-1).clamp_min(1e-30).sqrt()
    radius = radii.reshape(1, -1)
    tail = 0.5 + 0.5 * np.tanh(-4.0)
    share = ((0.5 + 0.5 * torch.tanh(4 * (radius - apart)) - tail) / (1 - tail)).clamp_min(0)
    weights = share / (radius.square() + 0.2)
    weights = weights / weights.sum(dim=1, keepdim=True)
    light = weights @ color.reshape(-1, 3).square()
    return light.sqrt().reshape(height, width, 3), (weights @ alpha.reshape(-1)).reshape(height, width)


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    """Images this small are drawn many times faster by one thread than by several that wait for each other."""
    threads = numba.get_num_threads(), torch.get_num_threads()
    numba.set_num_threads(1)
    torch.set_num_threads(1)
    yield
    numba.set_num_threads(threads[0])
    torch.set_num_threads(threads[1])


def beside(name):
    """The module `name` beside this file."""
    spec = importlib.util.spec_from_file_location(f"effects_{name}", Path(__file__).with_name(f"{name}.py"))
    sys.modules[spec.name] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def scans():
    """Exact scans of ellipsoids."""
    return beside("scans")


@pytest.fixture(scope="session")
def photographs():
    """Photos in files, and models of structure from motion."""
    return beside("photographs")


@pytest.fixture(scope="session")
def walls():
    """The walls in 14 x 14 patches, 16 cameras of 48 x 48 pixels, and a start: places to 1 mm, everything grey."""
    truth, rng = two_walls(14), np.random.default_rng(2)
    start = replace(
        truth,
        means=(truth.means + rng.normal(0, 1.0, truth.means.shape)).astype(np.float32),
        scales=np.full_like(truth.scales, 1.5),
        opacities=np.full_like(truth.opacities, 0.5),
        sh=np.zeros_like(truth.sh),
    )
    return SimpleNamespace(truth=truth, set=truth.to_torch(), cameras=spiral_cameras(16, 48), start=start)


@pytest.fixture(scope="session")
def cameras(walls):
    """Those that see the walls, with 240 x 240 pixels."""
    return [camera.resized(240, 240) for camera in walls.cameras]


@pytest.fixture(scope="session")
def optics():
    """The functions above."""
    parts = (Pictures, pinhole, through_lens, row_by_row, to_linear, to_srgb)
    return SimpleNamespace(background=BACKGROUND, **{part.__name__: part for part in parts})


@pytest.fixture(scope="session", name="by_the_formula")
def the_formula():
    return by_the_formula
