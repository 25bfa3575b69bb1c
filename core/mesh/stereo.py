"""A mesh of photo splats through rendered stereo pairs: GS2Mesh (Wolf et al. 2024, arXiv 2404.01810).

A trained set is rendered in pairs a little apart, each pair is matched, and the depths are fused. GS2Mesh matches with
a learned network; OpenCV's semi-global matching (Hirschmüller, PAMI 30(2), 2008) stands in for it here, so the meshes
are those of its pipeline, not of its matcher.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
import torch

from ..capture.registered import load_photos
from ..gaussians import GaussianSet
from ..progress import Progress, Reporter
from ..render import splat
from ..render.options import SplatOptions
from ..run_folder import RunFolder
from ..views import Camera
from .tsdf import TsdfGrid

if TYPE_CHECKING:
    import trimesh

_MOST_VOXELS = 48_000_000


@dataclass(frozen=True)
class StereoSettings:
    """Lengths are shares of the scene's radius, 3DGS's: 1.1 times a camera's largest distance from their middle.

    Attributes:
        views: at most so many cameras, evenly chosen.
        long_side: pairs are rendered at this many pixels at most, and at twice the photo's.
        baseline: between the two cameras of a pair (GS2Mesh: 7 %).
        voxel: of the fused field (GS2Mesh: 2 / 512).
        truncation: of the fused field (GS2Mesh: 0.04).
        least_alpha: pixels that the splats cover less are background.
        tolerance_px: the disparities of the two images may differ so much.
    """

    views: int = 60
    long_side: int = 800
    baseline: float = 0.07
    voxel: float = 2 / 512
    truncation: float = 0.04
    least_alpha: float = 0.5
    tolerance_px: float = 1.0


def mesh_of_run(run: RunFolder, kernel: str = "cpu", reporter: Reporter | None = None) -> trimesh.Trimesh:
    """The mesh of a run's photo splats (stage `surface`) seen by its training cameras, in the photo frame.

    Raises:
        RunFolderError, GaussianFileError: the run lacks them.
        Cancelled: the user asked to stop.
    """
    photos = load_photos(run.path / "initialize" / "photos.json")
    cameras = [photo.camera for photo in photos.photos if photo.camera is not None and not photo.held_out]
    fitted = run.read_set("surface", "rgb")
    return stereo_mesh(fitted, cameras, kernel=kernel, reporter=reporter, options=SplatOptions.of(run))


def stereo_mesh(
    gaussians: GaussianSet,
    cameras: Sequence[Camera],
    settings: StereoSettings | None = None,
    kernel: str = "cpu",
    reporter: Reporter | None = None,
    options: SplatOptions | None = None,
) -> trimesh.Trimesh:
    """Renders a stereo pair at each camera, matches it and fuses the depths.

    Args:
        gaussians: numpy set in the cameras' frame.
        cameras: perspective.
        options: how the set is drawn; plainly if None.

    Returns:
        Vertices in the cameras' frame with colours; empty when no pair could be matched.

    Raises:
        Cancelled: the user asked to stop.
    """
    from ..stages.surface.photos import scene_extent

    settings, reporter = settings or StereoSettings(), reporter or Reporter()
    radius = scene_extent(cameras)
    chosen = np.unique(np.linspace(0, len(cameras) - 1, min(settings.views, len(cameras))).astype(int))
    tensors, views = gaussians.to_torch(), []
    for done, index in enumerate(chosen):
        reporter.update(Progress("mesh", "stereo", 0.8 * done / len(chosen), done, len(chosen)))
        camera = _sized(cameras[index], settings.long_side)
        color, depth = stereo_depth(tensors, camera, settings.baseline * radius, settings, kernel, options)
        views.append((camera, color, depth))
    points = np.concatenate([unprojected(camera, depth) for camera, _, depth in views])
    if len(points) < 100:
        import trimesh

        return trimesh.Trimesh()
    truncation = settings.truncation * radius
    low, high = np.percentile(points, [0.5, 99.5], axis=0)
    low, high = low - 2 * truncation, high + 2 * truncation
    voxel = max(settings.voxel * radius, float((np.prod(high - low) / _MOST_VOXELS) ** (1 / 3)))
    grid = TsdfGrid(low, high, voxel, truncation)
    for done, (camera, color, depth) in enumerate(views):
        reporter.update(Progress("mesh", "fusion", 0.8 + 0.2 * done / len(views), done, len(views)))
        grid.integrate(camera, depth, color)
    return grid.mesh()


def stereo_depth(
    tensors: GaussianSet,
    camera: Camera,
    baseline: float,
    settings: StereoSettings,
    kernel: str,
    options: SplatOptions | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Colours (H, W, 3) and matched camera z (H, W) of the left image of a pair; 0 where the two do not agree."""
    right = np.array(camera.world_to_camera, np.float64)
    right[0, 3] -= baseline
    drawn = vars(options or SplatOptions())
    with torch.no_grad():
        first = splat(tensors, camera, kernel=kernel, **drawn)
        second = splat(tensors, replace(camera, world_to_camera=right), kernel=kernel, **drawn).color.numpy()
    color, alpha, guess = first.color.numpy(), first.alpha.numpy(), first.depth.numpy()
    covered = (alpha > settings.least_alpha) & (guess > 0)
    nothing = np.zeros(alpha.shape, np.float32)
    if not covered.any():
        return color, nothing
    # The rendered depth only says which disparities are worth looking at.
    near, far = np.percentile(guess[covered], [1, 99])
    lowest = int(np.floor(0.8 * camera.fx * baseline / far))
    count = 16 * max(1, int(np.ceil((1.3 * camera.fx * baseline / near - lowest) / 16)))
    if camera.width <= lowest + count:
        return color, nothing
    there, back = match(_levels(color), _levels(second), lowest, count)
    columns = np.arange(camera.width)[None, :] - np.rint(there).astype(int)
    seen = (columns >= 0) & (columns < camera.width)
    returned = np.take_along_axis(back, np.clip(columns, 0, camera.width - 1), axis=1)
    agree = covered & seen & (there > max(lowest, 0)) & (np.abs(there - returned) <= settings.tolerance_px)
    return color, np.where(agree, camera.fx * baseline / np.maximum(there, 1e-6), 0.0).astype(np.float32)


def match(left: np.ndarray, right: np.ndarray, lowest: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Disparities (H, W) in pixels of either image of a rectified pair of bytes (H, W, 3); under `lowest`: unknown.

    Args:
        lowest, count: range of disparities; `count` a multiple of 16.
    """
    matcher = cv2.StereoSGBM_create(  # type: ignore[attr-defined]
        minDisparity=lowest,
        numDisparities=count,
        blockSize=5,
        P1=8 * 3 * 5 * 5,
        P2=32 * 3 * 5 * 5,
        uniquenessRatio=5,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    there = matcher.compute(_widened(left, count + lowest), _widened(right, count + lowest))
    # Seen in a mirror, the right image is the left one.
    mirrored = (_widened(np.ascontiguousarray(image[:, ::-1]), count + lowest) for image in (right, left))
    back = matcher.compute(*mirrored)
    margin = count + lowest
    return there[:, margin:].astype(np.float32) / 16, back[:, margin:][:, ::-1].astype(np.float32) / 16


def unprojected(camera: Camera, depth: np.ndarray) -> np.ndarray:
    """(P, 3) points of the known pixels of a depth map."""
    rows, columns = np.nonzero(depth > 0)
    z = depth[rows, columns].astype(np.float64)
    local = np.stack([(columns + 0.5 - camera.cx) / camera.fx * z, (rows + 0.5 - camera.cy) / camera.fy * z, z], axis=1)
    matrix = np.asarray(camera.world_to_camera, np.float64)
    return (local - matrix[:3, 3]) @ matrix[:3, :3]


def _sized(camera: Camera, long_side: int) -> Camera:
    side = max(camera.width, camera.height)
    share = min(long_side, 2 * side) / side
    return camera.resized(max(1, round(camera.width * share)), max(1, round(camera.height * share)))


def _levels(color: np.ndarray) -> np.ndarray:
    return np.round(255 * np.clip(color, 0, 1)).astype(np.uint8)


def _widened(image: np.ndarray, margin: int) -> np.ndarray:
    """With a black margin on the left: the matcher knows no disparities in the first columns."""
    return np.pad(image, ((0, 0), (margin, 0), (0, 0)))
