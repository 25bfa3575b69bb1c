"""Refining the similarity by outlines: the X-rayed surface seen from the photos' cameras against their masks.

Centres of RGB splats lie a little inside or outside of the surface, so that ICP on them is biased in scale; the
outlines in the photos are not.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from ...compiled import njit
from ...similarity import Similarity
from ...views import Camera
from .icp import Anchors, moved_by, picked_rows, turn_between
from .surfaces import OuterSurface, project

# Neighbouring rim points err alike: a view counts as this many independent measurements.
_INDEPENDENT = 10
# How far (voxels) an isosurface may well lie off the true one.
_OFFSET_SIGMA = 0.25
# How far (pixels) a rim point may lie from the edge of its own silhouette to count as outline.
_RIM_PX = 1.5


@dataclass(frozen=True, eq=False)
class Outline:
    """One photo's foreground.

    Attributes:
        camera: in the photo frame.
        mask: (H, W) bool.
        distance: (H, W) signed distance to the mask's edge in pixels, positive outside.
    """

    camera: Camera
    mask: np.ndarray
    distance: np.ndarray

    @classmethod
    def of(cls, camera: Camera, mask: np.ndarray) -> Outline:
        return cls(camera, mask, signed_distance(mask))


@dataclass(frozen=True, eq=False)
class OutlineFit:
    """What the refinement found.

    Attributes:
        similarity: refined.
        overlap_before, overlap_after: mean intersection over union of silhouettes and masks.
        residual_px: median distance of the rim from the masks' edges at the end.
        offset_mm: by how much the photographed surface lies outside of the isosurface. An isovalue set a little
            too high or low shifts all of the surface; told apart from scale, it no longer spoils it.
        accepted: the outlines fit better and the step was small; else `similarity` is the one it started from.
    """

    similarity: Similarity
    overlap_before: float
    overlap_after: float
    residual_px: float
    offset_mm: float
    accepted: bool


def signed_distance(mask: np.ndarray) -> np.ndarray:
    """(H, W) distance in pixels to the edge between mask and background, positive outside, slope 1 across it."""
    if mask.all() or not mask.any():
        return np.full(mask.shape, -1e3 if mask.all() else 1e3)
    outside = ndimage.distance_transform_edt(~mask)
    inside = ndimage.distance_transform_edt(mask)
    return np.where(mask, 0.5 - inside, outside - 0.5)


def refine_by_outlines(
    start: Similarity,
    surface: OuterSurface,
    outlines: Sequence[Outline],
    iterations: int = 10,
    least_gain: float = 0.002,
    landmarks: Anchors | None = None,
    on_iteration: Callable[[float], None] = lambda fraction: None,
) -> OutlineFit:
    """Gauss-Newton on the distance of the surface's rim from the masks' edges.

    Eight unknowns: those of the similarity, and an offset of the isosurface along its normals. A round body cannot
    tell the offset from the scale, so it is held near 0 by a prior of a quarter of a voxel. The rim of each view
    (where the surface turns away) is recomputed in each iteration.

    Args:
        start: photo frame to mm, good to a few pixels.
        least_gain: by how much the overlap has to grow for the outlines to be believed.
        landmarks: picked pairs that hold a body of revolution, and its scale against the offset.
        on_iteration: called with the fraction done; may raise to stop.
    """
    edges = _edges(surface.faces)
    inverse = start.inverse()
    before = mean_overlap(start, surface, outlines)
    gate, offset, residuals = 12.0, 0.0, []
    for iteration in range(iterations):
        hessian, gradient, errors = np.zeros((8, 8)), np.zeros(8), [np.zeros(0)]
        middle = inverse.apply(surface.points.mean(axis=0))
        size = surface.extent * inverse.scale
        for number, outline in enumerate(outlines):
            on_iteration((iteration + number / len(outlines)) / iterations)
            rows, error = _view_equations(inverse, offset, surface, edges, outline, middle, size, gate)
            weights = 1.0 / np.maximum(1.0, np.abs(error))
            hessian += (rows * weights[:, None]).T @ rows
            gradient += (rows * weights[:, None]).T @ error
            errors.append(error)
        together = np.abs(np.concatenate(errors))
        if len(together) < 50:
            break
        residuals.append(float(np.median(together)))
        noise = max(0.5, residuals[-1])
        # What is known beside the outlines, in units of their variance.
        unit = len(together) / (_INDEPENDENT * len(outlines)) * noise**2
        prior = unit / (_OFFSET_SIGMA * surface.voxel) ** 2
        hessian[7, 7] += prior * surface.extent**2
        gradient[7] += prior * offset * surface.extent
        if landmarks is not None:
            held, error = picked_rows(inverse, landmarks.target, landmarks.source, middle, size)
            sharpness = unit * (size / (landmarks.sigma_mm * inverse.scale)) ** 2
            hessian[:7, :7] += sharpness * held.T @ held
            gradient[:7] += sharpness / size * held.T @ error
        # Where outlines leave a direction open (a body of revolution) the start keeps it.
        hessian += np.eye(8) * 1e-5 * np.trace(hessian) / 8
        step = -np.linalg.solve(hessian, gradient)
        offset = float(np.clip(offset + step[7] * surface.extent, -0.02 * surface.extent, 0.02 * surface.extent))
        inverse = moved_by(inverse, step[:3], step[3:6] * size, step[6], middle)
        gate = max(4.0, 0.7 * gate)
        if np.abs(step).max() < 2e-5:
            break
    refined = inverse.inverse()
    after = mean_overlap(refined, surface, outlines, offset)
    better = len(residuals) > 1 and residuals[-1] < 0.9 * residuals[0] and after > before + least_gain
    small = abs(np.log(refined.scale / start.scale)) < 0.15 and turn_between(refined, start) < 20.0
    accepted = bool(better and small)
    residual = residuals[-1] if residuals else float("nan")
    return OutlineFit(refined if accepted else start, before, after, residual, offset if accepted else 0.0, accepted)


def mean_overlap(
    similarity: Similarity, surface: OuterSurface, outlines: Sequence[Outline], offset_mm: float = 0.0
) -> float:
    """Mean intersection over union, 0..1, of the masks with the silhouettes of the surface moved out by an offset."""
    vertices = similarity.inverse().apply(surface.vertices + offset_mm * surface.vertex_normals)
    shares = []
    for outline in outlines:
        silhouette = silhouette_of(vertices, surface.faces, outline.camera)
        union = (silhouette | outline.mask).sum()
        shares.append((silhouette & outline.mask).sum() / max(union, 1))
    return float(np.mean(shares)) if shares else 0.0


def silhouette_of(vertices: np.ndarray, faces: np.ndarray, camera: Camera) -> np.ndarray:
    """(H, W) bool: pixels whose centre a triangle covers; triangles behind the camera are left out."""
    xy, depth = project(vertices, camera)
    mask = np.zeros((camera.height, camera.width), np.bool_)
    _fill(xy, depth, faces, mask)
    return mask


@njit(cache=True)
def _fill(xy, depth, faces, mask):  # type: ignore[no-untyped-def]
    height, width = mask.shape
    for face in range(faces.shape[0]):
        a, b, c = faces[face]
        if depth[a] <= 0 or depth[b] <= 0 or depth[c] <= 0:
            continue
        ax, ay, bx, by, cx, cy = xy[a, 0], xy[a, 1], xy[b, 0], xy[b, 1], xy[c, 0], xy[c, 1]
        low_x, high_x = min(ax, bx, cx), max(ax, bx, cx)
        low_y, high_y = min(ay, by, cy), max(ay, by, cy)
        if high_x < 0 or high_y < 0 or low_x > width or low_y > height:
            continue
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        sign = 1.0 if area >= 0 else -1.0
        for row in range(max(0, int(low_y - 0.5)), min(height, int(high_y + 0.5) + 1)):
            for column in range(max(0, int(low_x - 0.5)), min(width, int(high_x + 0.5) + 1)):
                x, y = column + 0.5, row + 0.5
                if (
                    sign * ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) >= -1e-9
                    and sign * ((cx - bx) * (y - by) - (cy - by) * (x - bx)) >= -1e-9
                    and sign * ((ax - cx) * (y - cy) - (ay - cy) * (x - cx)) >= -1e-9
                ):
                    mask[row, column] = True


def _edges(faces: np.ndarray) -> np.ndarray:
    """(E, 2) vertex indices of the mesh's edges, each once."""
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    return np.unique(np.sort(pairs, axis=1), axis=0)


def _view_equations(
    inverse: Similarity,
    offset: float,
    surface: OuterSurface,
    edges: np.ndarray,
    outline: Outline,
    middle: np.ndarray,
    size: float,
    gate: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Rows (R, 8) of d(signed distance) / d(turn, shift / size, log scale, offset / extent), distances (R,); px."""
    camera = outline.camera
    vertices = inverse.apply(surface.vertices + offset * surface.vertex_normals)
    normals = surface.vertex_normals @ inverse.rotation.T
    rim, rim_normal = _rim(vertices, normals, edges, camera)
    xy, depth = project(rim, camera)
    in_image = (depth > 0) & (xy >= 1).all(axis=1) & (xy <= [camera.width - 1, camera.height - 1]).all(axis=1)
    own = signed_distance(silhouette_of(vertices, surface.faces, camera))
    keep = np.flatnonzero(in_image)
    keep = keep[_look_up(own, xy[keep]) > -_RIM_PX]
    rim, rim_normal, xy, depth = rim[keep], rim_normal[keep], xy[keep], depth[keep]
    error = _look_up(outline.distance, xy)
    slope_rows, slope_columns = np.gradient(ndimage.gaussian_filter(outline.distance, 1.0))
    slope = np.stack([_look_up(slope_columns, xy), _look_up(slope_rows, xy)], axis=1)
    rotation = np.asarray(camera.world_to_camera, np.float64)[:3, :3]
    outward = rim_normal @ rotation.T[:, :2]
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-12)
    good = (np.abs(error) < gate) & ((slope * outward).sum(axis=1) > 0.5)
    rim, rim_normal, xy, depth = rim[good], rim_normal[good], xy[good], depth[good]
    error, slope = error[good], slope[good]
    # Gradient of the distance with respect to the rim point: slope · d(xy)/d(point).
    divisor = np.ones_like(depth) if camera.orthographic else depth
    local = np.zeros((len(rim), 3))
    local[:, 0] = slope[:, 0] * camera.fx / divisor
    local[:, 1] = slope[:, 1] * camera.fy / divisor
    if not camera.orthographic:
        local[:, 2] = -(slope * (xy - [camera.cx, camera.cy])).sum(axis=1) / depth
    pull = local @ rotation
    arm = rim - middle
    rows = [
        np.cross(arm, pull),
        pull * size,
        (arm * pull).sum(axis=1, keepdims=True),
        (rim_normal * pull).sum(axis=1, keepdims=True) * size,
    ]
    return np.concatenate(rows, axis=1), error


def _rim(vertices: np.ndarray, normals: np.ndarray, edges: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Points on the edges at which the surface turns away from the camera, and their normals."""
    if camera.orthographic:
        sight = np.broadcast_to(np.asarray(camera.world_to_camera, np.float64)[2, :3], vertices.shape)
    else:
        sight = vertices - camera.center
    facing = (normals * sight).sum(axis=1)
    first, second = facing[edges[:, 0]], facing[edges[:, 1]]
    crossing = first * second < 0
    pairs = edges[crossing]
    part = (first[crossing] / (first[crossing] - second[crossing]))[:, None]
    points = vertices[pairs[:, 0]] * (1 - part) + vertices[pairs[:, 1]] * part
    between = normals[pairs[:, 0]] * (1 - part) + normals[pairs[:, 1]] * part
    return points, between / np.maximum(np.linalg.norm(between, axis=1, keepdims=True), 1e-12)


def _look_up(image: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Bilinear values (N,) at pixel positions (N, 2)."""
    return ndimage.map_coordinates(image, [xy[:, 1] - 0.5, xy[:, 0] - 0.5], order=1, mode="nearest")
