"""What the kernels are measured on: a cube full of small splats, seen by a camera, a detector and a plane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..gaussians import GaussianSet
from ..views import Camera, Detector, Plane

MEAN_AXIS_PX = 1.5
"""Mean standard deviation of the splats along their axes, in pixels at the middle of the cube."""

_DISTANCE = 5.0
_FOCAL_PER_SIDE = 2.0
_FILLED = 0.9


@dataclass(frozen=True, eq=False)
class Scene:
    """The same splats for all three renderers, with the same number of pixels across the cube."""

    gaussians: GaussianSet
    camera: Camera
    detector: Detector
    plane: Plane


def scene(splats: int, side: int, seed: int = 0) -> Scene:
    """A cube that fills 90 % of a square image, its splats anywhere in it and turned anyhow.

    Axes are drawn one by one, lognormal, with a mean of `MEAN_AXIS_PX` pixels; opacities and densities evenly between
    0.05 and 0.95; colours of degree 3.

    Args:
        splats: N.
        side: pixels.
        seed: of everything.
    """
    rng = np.random.default_rng([seed, splats, side])
    pixel = 1 / (_FOCAL_PER_SIDE * side) * _DISTANCE
    half = 0.5 * _FILLED * side * pixel
    axes = rng.lognormal(0.0, 0.4, (splats, 3))
    gaussians = GaussianSet.create(
        rng.uniform(-half, half, (splats, 3)),
        MEAN_AXIS_PX * pixel * axes / np.exp(0.08),
        quats=rng.normal(size=(splats, 4)),
        opacities=rng.uniform(0.05, 0.95, splats),
        density=rng.uniform(0.05, 0.95, splats),
        sh=np.float32(0.3) * rng.standard_normal((splats, 16, 3), np.float32),
    )
    pose = np.eye(4)
    pose[2, 3] = _DISTANCE
    focal = _FOCAL_PER_SIDE * side
    across, down = np.array([pixel, 0.0, 0.0]), np.array([0.0, pixel, 0.0])
    return Scene(
        gaussians,
        Camera(side, side, focal, focal, side / 2, side / 2, pose),
        # Twice as far from the source as the cube, with pixels twice as large.
        Detector(side, side, np.array([0.0, 0.0, -_DISTANCE]), np.array([0.0, 0.0, _DISTANCE]), 2 * across, 2 * down),
        Plane(-0.5 * (side - 1) * (across + down), across, down, side, side),
    )
