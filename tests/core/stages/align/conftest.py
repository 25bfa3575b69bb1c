"""Bodies with a known surface: as a filled volume in mm, and as a shell of splats in a frame of its own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from insideout.core.gaussians import GaussianSet
from insideout.core.similarity import Similarity
from insideout.core.stages.align.surfaces import outer_surface
from insideout.core.volume import Volume

Body = Callable[[np.ndarray], np.ndarray]


def lump(points):
    """An asymmetric union of ellipsoids about 70 x 45 x 38 mm; under 1 inside."""
    parts = [
        ((0, 0, 0), (34, 22, 16)),
        ((18, 12, 10), (15, 12, 20)),
        ((-20, -8, 6), (14, 20, 10)),
        ((5, -16, -8), (10, 14, 14)),
    ]
    levels = [(((points - np.array(c)) / np.array(r)) ** 2).sum(axis=-1) for c, r in parts]
    return np.min(levels, axis=0)


def vase(points):
    """A body of revolution about z, 66 mm high, with another top than bottom."""
    radius = np.hypot(points[..., 0], points[..., 1])
    z = points[..., 2]
    profile = 14 + 8 * np.cos(z / 10) * (1 + 0.3 * np.tanh(z / 20))
    return np.where(np.abs(z) < 33, (radius / profile) ** 2, 9.0)


def box(points):
    """64 x 40 x 28 mm: four rotations fit."""
    return np.max(np.abs(points) / np.array([32, 20, 14]), axis=-1) ** 2


def volume_of(body: Body, size: int = 72, extent: float = 84.0) -> Volume:
    axis = (np.arange(size) + 0.5) / size * extent - extent / 2
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    level = np.sqrt(body(np.stack([x, y, z], axis=-1)))
    noise = np.random.default_rng(0).normal(0, 0.002, level.shape)
    values = 0.04 * np.clip(0.5 - (level - 1) * 15, 0, 1) + noise
    return Volume.centered(values.astype(np.float32), np.full(3, extent / size))


def shell_of(body: Body, seed: int, count: int = 5000, missing_bottom: float = 0.0, floaters: float = 0.0):
    """Splats on the surface in a random frame, and the similarity from that frame to mm."""
    random = np.random.default_rng(seed)
    directions = random.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    steps = np.linspace(60, 0, 241)
    inside = np.stack([body(step * directions) <= 1 for step in steps])
    high = steps[np.maximum(inside.argmax(axis=0) - 1, 0)]
    low = high - (steps[0] - steps[1])
    for _ in range(12):
        middle = 0.5 * (low + high)
        within = body(middle[:, None] * directions) <= 1
        low, high = np.where(within, middle, low), np.where(within, high, middle)
    points = directions * low[:, None] + random.normal(0, 0.2, (count, 3))
    if missing_bottom:
        points = points[points[:, 2] > np.quantile(points[:, 2], missing_bottom)]
    if floaters:
        points = np.concatenate([points, random.uniform(-80, 80, (int(floaters * len(points)), 3))])
    truth = Similarity(
        float(10 ** random.uniform(-1, 2)),
        Rotation.random(random_state=seed).as_matrix(),
        random.uniform(-50, 50, 3),
    )
    return GaussianSet.create(truth.inverse().apply(points), 0.5 / truth.scale, opacities=0.8), truth


@dataclass(frozen=True)
class Errors:
    scale_percent: float
    degrees: float
    mm: float

    @property
    def on_target(self) -> bool:
        return self.scale_percent < 0.5 and self.degrees < 1.0 and self.mm < 0.5


def errors_of(found: Similarity, truth: Similarity, points: np.ndarray) -> Errors:
    points = points.astype(np.float64)
    return Errors(
        100 * abs(found.scale / truth.scale - 1),
        float(np.degrees(Rotation.from_matrix(found.rotation @ truth.rotation.T).magnitude())),
        float(np.linalg.norm(found.apply(points) - truth.apply(points), axis=1).mean()),
    )


@pytest.fixture(scope="session")
def bodies():
    """The bodies and how to make volumes, shells and errors of them."""
    return SimpleNamespace(lump=lump, vase=vase, box=box, volume=volume_of, shell=shell_of, errors=errors_of)


@pytest.fixture(scope="session")
def lump_surface():
    return outer_surface(volume_of(lump), 8000, seed=0)


@pytest.fixture(scope="session")
def vase_surface():
    return outer_surface(volume_of(vase), 8000, seed=0)


@pytest.fixture(scope="session")
def box_surface():
    return outer_surface(volume_of(box), 8000, seed=0)
