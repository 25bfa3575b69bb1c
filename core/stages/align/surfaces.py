"""The two surfaces that alignment compares: the volume's outer isosurface and the shell of RGB splats."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import ndimage, sparse
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from ...capture.background import foreground_masks
from ...errors import CaptureError
from ...evaluate.histogram import fibonacci_sphere
from ...gaussians import GaussianSet
from ...progress import Tick, unstopped
from ...threshold import air_threshold
from ...views import Camera
from ...volume import Volume
from .surroundings import on_the_object


@dataclass(frozen=True, eq=False)
class OuterSurface:
    """The outside of the X-rayed object.

    Attributes:
        points: (M, 3) mm, spread evenly over what can be seen from outside.
        normals: (M, 3) unit, outward.
        spacing: typical distance between neighbouring points, mm.
        vertices, vertex_normals: (V, 3) of the isosurface, mm; normals outward.
        faces: (F, 3) its triangles.
        threshold: the isovalue, mm⁻¹.
        voxel: longest side of the voxels it was found in, mm.
    """

    points: np.ndarray
    normals: np.ndarray
    spacing: float
    vertices: np.ndarray
    vertex_normals: np.ndarray
    faces: np.ndarray
    threshold: float
    voxel: float

    @cached_property
    def tree(self) -> cKDTree:
        return cKDTree(self.points)

    @cached_property
    def extent(self) -> float:
        """Diagonal of the box around the points, mm."""
        return float(np.linalg.norm(np.ptp(self.points, axis=0)))


@dataclass(frozen=True, eq=False)
class ShellPoints:
    """The RGB splats that lie on the object, evened out to about one point a cell.

    Attributes:
        points: (P, 3) in the photo frame.
        spacing: typical distance between neighbouring points, photo frame.
        thickness: median standard deviation of the splats along their longest axis, photo frame.
        covariance: (3, 3) mean Σ + cov(μ) of the shell.
        index: (P,) which splat of the whole set each point is.
        members: (N,) bool, the splats of the whole set that belong to the object.
    """

    points: np.ndarray
    spacing: float
    thickness: float
    covariance: np.ndarray
    index: np.ndarray
    members: np.ndarray

    @cached_property
    def tree(self) -> cKDTree:
        return cKDTree(self.points)


def outer_surface(volume: Volume, count: int, seed: int, max_voxels: int = 200) -> OuterSurface:
    """The outer isosurface of a volume: at `air_threshold`, largest component, cavities filled.

    Args:
        count: how many points to sample.
        max_voxels: the volume is averaged down to at most this many voxels along an axis.

    Raises:
        CaptureError: the volume holds no object.
    """
    values, spacing, origin = _averaged(volume, max_voxels)
    values = ndimage.gaussian_filter(np.pad(values, 2), 0.7)
    origin = origin - 2 * spacing
    threshold = air_threshold(values)
    body = values > threshold
    labels, found = ndimage.label(body)
    if found == 0 or not np.isfinite(threshold) or np.ptp(values) <= 0:
        raise CaptureError("volume: is uniform, no object stands out; check the X-ray data and its units.")
    body = labels == 1 + int(np.argmax(np.bincount(labels.ravel())[1:]))
    filled = ndimage.binary_fill_holes(body)
    outside = ~ndimage.binary_dilation(filled, iterations=2)
    field = np.where(filled & ~body, np.maximum(values, 2 * abs(threshold) + threshold), values)
    field = np.where(outside | ((values > threshold) & ~filled), np.minimum(values, 0.5 * threshold), field)
    vertices_zyx, faces, _, _ = marching_cubes(field, threshold)
    vertices = vertices_zyx[:, ::-1] * spacing + origin
    normals = _vertex_normals(vertices, faces, field, spacing, origin)
    points, point_normals = _sample_mesh(vertices, faces, normals, 3 * count, seed)
    area = _triangle_areas(vertices, faces).sum()
    seen = seen_from_outside(points, cell=max(2.0 * float(np.sqrt(area / len(points))), float(spacing.max())))
    points, point_normals = points[seen], point_normals[seen]
    keep = np.random.default_rng(seed).permutation(len(points))[:count]
    points, point_normals = points[keep], point_normals[keep]
    step = float(np.median(cKDTree(points).query(points, k=min(2, len(points)))[0].reshape(len(points), -1)[:, -1]))
    return OuterSurface(
        points=points,
        normals=point_normals,
        spacing=2.0 * step,
        vertices=vertices,
        vertex_normals=normals,
        faces=faces.astype(np.int64),
        threshold=threshold,
        voxel=float(spacing.max()),
    )


def shell_points(
    rgb: GaussianSet,
    views: Sequence[tuple[Camera, np.ndarray | None]] = (),
    cells: int = 48,
    min_opacity: float = 0.1,
    seed: int = 0,
) -> ShellPoints:
    """The RGB splats that lie on the object: opaque, in the photos' foreground, no outliers, largest cluster.

    Args:
        rgb: numpy set in the photo frame.
        views: cameras of photos, each with its foreground mask (H, W) or None where the background is not plain:
            there `on_the_object` tells.
        cells: the longest side is divided into this many cells to even out the density of splats.
        seed: of what `on_the_object` draws.

    Raises:
        CaptureError: fewer than 50 splats are left.
    """
    members = (rgb.opacities > min_opacity) & np.isfinite(rgb.means).all(axis=1)
    if views:
        members &= in_foreground(rgb.means.astype(np.float64), views)
    if views and all(mask is None for _, mask in views):
        found = np.flatnonzero(members)
        members[found] = on_the_object(rgb.means[found].astype(np.float64), [camera for camera, _ in views], seed)
    index = np.flatnonzero(members)
    if len(index) >= 50:
        index = index[_dense(rgb.means[index].astype(np.float64))]
        index = index[_largest_cluster(rgb.means[index].astype(np.float64))]
    if len(index) < 50:
        raise CaptureError(
            "photos: only {count} RGB splats lie on the object; take more photos around it, or train longer.",
            count=len(index),
        )
    means = rgb.means[index].astype(np.float64)
    opacities = rgb.opacities[index].astype(np.float64)
    cell = float(np.ptp(means, axis=0).max()) / cells
    chosen, cell_of = _even_out(means, opacities, cell)
    points = means[chosen]
    # Splats inside the body are noise that no photo sees.
    seen = seen_from_outside(points, 2.0 * cell)
    even = index[chosen]
    if seen.sum() >= 50:
        points, even = points[seen], even[seen]
        index = index[seen[cell_of]]
    members = np.zeros(len(rgb), bool)
    members[index] = True
    own = rgb.select(index[:: max(1, len(index) // 5000)])
    covariance = own.covariances().astype(np.float64).mean(axis=0) + np.cov(points.T)
    thickness = float(np.median(own.scales.max(axis=1)))
    step = float(np.median(cKDTree(points).query(points, k=2)[0][:, 1]))
    return ShellPoints(points, max(step, 1e-12), thickness, covariance, even, members)


def in_foreground(points: np.ndarray, views: Sequence[tuple[Camera, np.ndarray | None]]) -> np.ndarray:
    """Which points (N, 3) project into the foreground of nearly all photos that hold them: their visual hull.

    Where the background is not plain the test is only whether most cameras hold the point in their image.
    """
    held = np.zeros(len(points))
    inside = np.zeros(len(points))
    for camera, mask in views:
        xy, depth = project(points, camera)
        in_image = (depth > 0) & (xy >= 0).all(axis=1) & (xy < [camera.width, camera.height]).all(axis=1)
        held += in_image
        if mask is None:
            inside += in_image
            continue
        grown = ndimage.binary_dilation(mask, iterations=max(1, camera.width // 200))
        columns, rows = xy[in_image].astype(np.int64).T
        inside[in_image] += grown[rows, columns]
    return (held >= 0.5 * len(views)) & (inside >= 0.85 * held)


def project(points: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Pixel positions (N, 2) and camera depths (N,) of points (N, 3)."""
    matrix = np.asarray(camera.world_to_camera, np.float64)
    local = points @ matrix[:3, :3].T + matrix[:3, 3]
    depth = local[:, 2]
    divisor = np.ones_like(depth) if camera.orthographic else np.where(np.abs(depth) > 1e-9, depth, 1e-9)
    xy = local[:, :2] / divisor[:, None] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    return xy, depth


def foreground_views(
    cameras: Sequence[Camera],
    images: Sequence[np.ndarray],
    background: np.ndarray | None,
    tick: Tick = unstopped,
) -> list[tuple[Camera, np.ndarray | None]]:
    """Cameras with their foreground masks, or with None where the background is not plain; `tick` is called
    between photos."""
    if background is None:
        return [(camera, None) for camera in cameras]
    return list(zip(cameras, foreground_masks(images, background, tick), strict=True))


def seen_from_outside(points: np.ndarray, cell: float, directions: int = 60) -> np.ndarray:
    """Which points (N, 3) lie in front in at least one of several parallel views from all around.

    A point is in front when no other point in its cell of the view is nearer by more than `cell`.
    """
    seen = np.zeros(len(points), bool)
    for direction in fibonacci_sphere(directions):
        side = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
        side /= np.linalg.norm(side)
        flat = np.stack([points @ side, points @ np.cross(direction, side)], axis=1)
        column = np.floor((flat - flat.min(axis=0)) / cell).astype(np.int64)
        key = column[:, 0] * (int(column[:, 1].max()) + 1) + column[:, 1]
        depth = points @ direction
        nearest = np.full(int(key.max()) + 1, np.inf)
        np.minimum.at(nearest, key, depth)
        seen |= depth <= nearest[key] + cell
    return seen


def _averaged(volume: Volume, max_voxels: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Values averaged over blocks so that no axis is longer than `max_voxels`, with spacing and origin (x, y, z).

    Blocks are as near to cubes as voxels allow: slices 5 mm thick are not averaged because their pixels are 0.5 mm.
    Where they do not divide the voxels, air is put behind the last ones: what they leave may be a fifth of a volume.
    """
    whole = replace(volume, values=np.nan_to_num(np.asarray(volume.values, np.float32)))
    counts, spacing = np.array(whole.values.shape[::-1]), np.asarray(volume.spacing_mm, np.float64)
    factors = -(-counts // max_voxels)
    side = float((factors * spacing)[factors > 1].max(initial=0.0))
    factors = np.minimum(np.maximum(factors, np.floor(side / spacing * (1 + 1e-9)).astype(int)), counts)
    left = (-counts % factors)[::-1]
    if left.any():
        whole = replace(whole, values=np.pad(whole.values, [(0, more) for more in left.tolist()]))
    found = whole.blocks(factors[::-1].tolist()) if factors.max() > 1 else whole
    return found.values, np.asarray(found.spacing_mm, np.float64), np.asarray(found.origin_mm, np.float64)


def _vertex_normals(
    vertices: np.ndarray, faces: np.ndarray, field: np.ndarray, spacing: np.ndarray, origin: np.ndarray
) -> np.ndarray:
    """Outward unit normals: against the gradient of the smoothed field, by the triangles where that vanishes."""
    smooth = ndimage.gaussian_filter(field, 0.8)
    gradient = np.stack(np.gradient(smooth), axis=-1)[..., ::-1] / spacing
    index = ((vertices - origin) / spacing)[:, ::-1].T
    normals = -np.stack([ndimage.map_coordinates(gradient[..., axis], index, order=1) for axis in range(3)], axis=1)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    by_faces = np.zeros_like(vertices)
    crosses = np.cross(vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]])
    for corner in range(3):
        np.add.at(by_faces, faces[:, corner], crosses)
    if (by_faces * normals).sum() < 0:
        by_faces = -by_faces
    normals = np.where(length > 1e-12, normals, by_faces)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)


def _triangle_areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def _sample_mesh(
    vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray, count: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """`count` points spread by area (stratified along the triangles, so evenly), with normals."""
    random = np.random.default_rng(seed)
    cumulative = np.cumsum(_triangle_areas(vertices, faces))
    picks = np.searchsorted(cumulative, (np.arange(count) + random.random(count)) / count * cumulative[-1])
    triangles = faces[np.minimum(picks, len(faces) - 1)]
    u, v = random.random((2, count))
    flip = u + v > 1
    u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
    shares = np.stack([1 - u - v, u, v], axis=1)[..., None]
    points = (vertices[triangles] * shares).sum(axis=1)
    directions = (normals[triangles] * shares).sum(axis=1)
    return points, directions / np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-30)


def _dense(points: np.ndarray) -> np.ndarray:
    """Which points have neighbours as near as most have: drops floaters."""
    distance = cKDTree(points).query(points, k=min(9, len(points)))[0][:, 1:].mean(axis=1)
    size = np.log(np.maximum(distance, 1e-12))
    middle = np.median(size)
    deviation = 1.4826 * np.median(np.abs(size - middle)) + 0.05
    return size < middle + 3.5 * deviation


def _largest_cluster(points: np.ndarray) -> np.ndarray:
    """Which points belong to the largest connected part, or to one at least a fifth as large."""
    distance, neighbor = cKDTree(points).query(points, k=min(9, len(points)))
    reach = 4.0 * np.percentile(distance[:, -1], 75)
    near = distance[:, 1:] < reach
    rows = np.repeat(np.arange(len(points)), near.sum(axis=1))
    graph = sparse.coo_matrix((np.ones(len(rows)), (rows, neighbor[:, 1:][near])), shape=(len(points),) * 2)
    labels = sparse.csgraph.connected_components(graph, directed=False)[1]
    sizes = np.bincount(labels)
    return sizes[labels] >= 0.2 * sizes.max()


def _even_out(points: np.ndarray, weights: np.ndarray, cell: float) -> tuple[np.ndarray, np.ndarray]:
    """The index of one point a cell, the one nearest to the weighted mean, and the cell each point is in.

    The mean itself would lie inside a curved surface and make the object look smaller.
    """
    column = np.floor((points - points.min(axis=0)) / max(cell, 1e-12)).astype(np.int64)
    cell_of = np.unique(column, axis=0, return_inverse=True)[1].reshape(-1)
    total = np.bincount(cell_of, weights)
    means = np.stack([np.bincount(cell_of, weights * points[:, axis]) for axis in range(3)], axis=1)
    distance = np.linalg.norm(points - (means / total[:, None])[cell_of], axis=1)
    order = np.lexsort((distance, cell_of))
    return order[np.unique(cell_of[order], return_index=True)[1]], cell_of
