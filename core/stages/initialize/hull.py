"""The visual hull: what the silhouettes of all photos have in common (Laurentini, PAMI 16(2), 1994)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ...views import Camera

# Masks err at thin parts and soft shadows; a point seen as background by a few photos may still be the object.
_AGREEMENT = 0.96
# Squared sine of the angle between axes (0.6 degrees) below which where they meet is anybody's guess.
_PARALLEL = 1e-4


def viewed_sphere(cameras: Sequence[Camera]) -> tuple[np.ndarray, float]:
    """Centre (3,) and radius of the ball that the cameras look at, in the photo frame.

    The centre is nearest to all optical axes; the radius is half the width of a typical view there. Cameras that all
    look the same way do not tell how far: twice as far as they are apart is taken, or 1 of one camera.
    """
    centers = np.array([camera.center for camera in cameras])
    axes = np.array([np.asarray(camera.world_to_camera, np.float64)[2, :3] for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    if np.linalg.eigvalsh(across.mean(axis=0))[0] < _PARALLEL:
        apart = float(np.linalg.norm(np.ptp(centers, axis=0)))
        middle = centers.mean(axis=0) + (2 * apart or 1.0) * axes.mean(axis=0)
    else:
        middle = np.linalg.solve(across.sum(axis=0), (across @ centers[:, :, None]).sum(axis=0)[:, 0])
    depths = np.abs(((middle - centers) * axes).sum(axis=1))
    # fx is pixels a unit of length for parallel rays, whatever the depth.
    reach = [1.0 if camera.orthographic else depth for camera, depth in zip(cameras, depths, strict=True)]
    half = [0.5 * max(c.width / c.fx, c.height / c.fy) * r for c, r in zip(cameras, reach, strict=True)]
    return middle, max(float(np.median(half)), 1e-6)


def carve(
    cameras: Sequence[Camera],
    masks: Sequence[np.ndarray],
    cells: int,
    tick: Callable[[float], None],
) -> tuple[np.ndarray, np.ndarray, float]:
    """Points on the surface of the visual hull.

    A first coarse grid over the viewed ball finds the object's box, a second one of `cells` a side fills it.

    Args:
        cameras, masks: one mask (H, W) bool for each camera.
        cells: cells along the longest side of the object.
        tick: called with the fraction of the second grid that is done; may raise to stop.

    Returns:
        points (P, 3), their outward normals (P, 3), and the cell's side; no points when the masks share nothing.
    """
    middle, radius = viewed_sphere(cameras)
    low, side = middle - radius, 2 * radius
    for level, count in enumerate((32, cells)):
        step = side / count
        # The coarse grid takes no time to speak of.
        inside = _occupied(cameras, masks, low, step, count, tick if level else lambda _: tick(0.0))
        if not inside.any():
            return np.zeros((0, 3)), np.zeros((0, 3)), step
        if level == 0:
            filled = np.argwhere(inside)
            first, last = filled.min(axis=0) - 1, filled.max(axis=0) + 2
            low, side = low + first * step, float((last - first).max() * step)
    return _surface(inside, low, step)


def _occupied(
    cameras: Sequence[Camera],
    masks: Sequence[np.ndarray],
    low: np.ndarray,
    step: float,
    count: int,
    tick: Callable[[float], None],
) -> np.ndarray:
    """Which cells (count, count, count) of a grid lie in all silhouettes."""
    axis = np.arange(count) + 0.5
    points = low + step * np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    seen, covered = silhouette_votes(cameras, masks, points, tick)
    # What most cameras do not look at is not the object they were pointed at.
    enough = seen >= max(2, len(cameras) // 2)
    return (enough & (covered >= _AGREEMENT * seen)).reshape(count, count, count)


def silhouette_votes(
    cameras: Sequence[Camera],
    masks: Sequence[np.ndarray],
    points: np.ndarray,
    tick: Callable[[float], None] = lambda _: None,
) -> tuple[np.ndarray, np.ndarray]:
    """How many photos (P,) have each point in the image, and how many (P,) of those show the object there.

    Args:
        cameras, masks: one mask (H, W) bool for each camera.
        points: (P, 3).
        tick: called with the fraction of a grid that is done; may raise to stop.
    """
    seen = np.zeros(len(points), np.int32)
    covered = np.zeros(len(points), np.int32)
    for number, (camera, mask) in enumerate(zip(cameras, masks, strict=True)):
        tick(number / len(cameras))
        columns, rows, inside = camera.pixels_of(points)
        seen += inside
        covered[inside] += mask[rows[inside], columns[inside]]
    return seen, covered


def _surface(inside: np.ndarray, low: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray, float]:
    padded = np.pad(inside, 1).astype(np.float32)
    core = (slice(1, -1),) * 3
    around = np.zeros_like(inside, np.int32)
    normals = np.zeros((*inside.shape, 3))
    for axis in range(3):
        for sign in (-1, 1):
            neighbour = np.roll(padded, sign, axis)[core]
            around += neighbour > 0
            normals[..., axis] += sign * neighbour
    shell = inside & (around < 6)
    points = low + step * (np.argwhere(shell) + 0.5)
    outward = normals[shell]
    length = np.linalg.norm(outward, axis=1, keepdims=True)
    return points, outward / np.maximum(length, 1e-9), step
