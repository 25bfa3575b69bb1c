"""First splats from the photos: sparse points, and the visual hull where the background is plain."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from ...capture.background import foreground_masks
from ...capture.model import Photo, Photos
from ...capture.photos import read_photo
from ...capture.registered import save_photos
from ...errors import CaptureError
from ...evaluate.photos import photo_background
from ...gaussians import GaussianSet
from ...spherical_harmonics import rgb_to_sh
from ...told import Told
from ...views import Camera
from ..context import StageContext
from ..photo_effects import without_background, without_lens
from .hull import carve, silhouette_votes, viewed_sphere

View = tuple[Camera, np.ndarray, np.ndarray]
"""Camera, photo (H, W, 3) in 0..1 and the object's mask (H, W)."""

_HULL_PHOTOS = 60
_HULL_PIXELS = 400
RANDOM_POINTS = 10_000
FEW_POINTS = 500
# Points of the surface lie on the very outline in some photos, and just beside it by error.
_POINT_AGREEMENT = 0.9


def place_photos(context: StageContext) -> tuple[Photos, str]:
    """The photos with cameras and sparse points: as they came, triangulated, or found by structure from motion, a
    background that stands still and a lens taken out where effects are asked for.

    Leaves `initialize/photos.json`.

    Returns:
        The photos, and why there are no sparse points, "" when there are.

    Raises:
        CaptureError: too few photos register.
        Cancelled: the user asked to stop.
    """
    from ...capture import sfm

    photos = context.capture.photos
    if photos is None:
        raise AssertionError("called for captures with photos only")
    photos = without_background(context, photos)
    workdir, note = context.run.stage("initialize") / "sfm", ""
    reporter = context.reporter.within(0.0, 0.5)

    def triangulate(some: Photos, place: Path) -> Photos:
        return sfm.triangulate(some, place, reporter, context.seed)

    photos = without_lens(context, photos, triangulate)
    if not photos.posed:
        photos = sfm.reconstruct(photos, workdir, reporter, context.seed)
    elif photos.points is None:
        try:
            photos = triangulate(photos, workdir)
        except CaptureError as error:
            # Smooth objects have nothing to match; their cameras are known all the same.
            note = error.text
        if not note and (photos.points is None or len(photos.points) == 0):
            note = Told("the photos share no features from which points could be triangulated")
        if note:
            context.progress("initialize", part="sfm", fraction=0.5, message=note)
    save_photos(context.run.stage("initialize") / "photos.json", photos)
    return photos, note


def first_splats(
    context: StageContext, photos: Photos, cells: int, most: int, opacity: float, seed: int
) -> tuple[GaussianSet, dict[str, Any]]:
    """Splats at sparse points and, with a plain background, on the visual hull.

    Scales are the mean distance to the three nearest others (3DGS). Without hull and with hardly any point, random
    points fill the ball that the cameras look at.

    Args:
        cells: of the visual hull along the object's longest side; 0 for no hull.
        most: at most so many splats.

    Returns:
        The set in the photo frame, and how many points came from where.
    """
    known = [photo for photo in photos.photos if photo.camera is not None]
    training = [photo for photo in known if not photo.held_out] or known
    background = photo_background(photos, tick=context.reporter.check)
    points = np.zeros((0, 3)) if photos.points is None else np.asarray(photos.points, np.float64)
    colors = np.full((len(points), 3), 0.5) if photos.colors is None else np.asarray(photos.colors, np.float64)
    found: dict[str, Any] = {"sparse": len(points), "hull": 0, "random": 0, "plain_background": background is not None}
    if background is not None and cells:
        views = _silhouettes(context, training, background)
        hull_points, hull_colors = _hull(context, views, cells)
        found["hull"] = len(hull_points)
        if len(hull_points):
            keep = _shows_object(views, points) & _within_reach(points, hull_points)
            found["sparse"] = int(keep.sum())
            points = np.concatenate([points[keep], hull_points])
            colors = np.concatenate([colors[keep], hull_colors])
    rng = np.random.default_rng([seed, 11])
    if len(points) < FEW_POINTS:
        middle, radius = viewed_sphere([_camera(photo) for photo in training])
        direction = rng.normal(size=(RANDOM_POINTS, 3))
        direction *= (rng.random((RANDOM_POINTS, 1)) ** (1 / 3)) / np.linalg.norm(direction, axis=1, keepdims=True)
        points = np.concatenate([points, middle + 0.5 * radius * direction])
        colors = np.concatenate([colors, np.full((RANDOM_POINTS, 3), 0.5)])
        found["random"] = RANDOM_POINTS
    if len(points) > most:
        chosen = np.sort(rng.choice(len(points), most, replace=False))
        points, colors = points[chosen], colors[chosen]
    scales = neighbour_distance(points)
    sh = rgb_to_sh(colors).astype(np.float32)[:, None, :]
    return GaussianSet.create(points, scales[:, None], opacities=opacity, sh=sh), found


def neighbour_distance(points: np.ndarray) -> np.ndarray:
    """Mean distance (N,) to the three nearest other points, never 0; 1 for a point alone."""
    if len(points) < 2:
        return np.ones(len(points))
    neighbours = min(4, len(points))
    distances = cKDTree(points).query(points, k=neighbours)[0][:, 1:].mean(axis=1)
    spread = float(np.ptp(points, axis=0).max()) or 1.0
    return np.maximum(distances, 1e-5 * spread)


def _silhouettes(context: StageContext, photos: list[Photo], background: np.ndarray) -> list[View]:
    """Small versions of up to sixty photos, with masks."""
    step = max(1, -(-len(photos) // _HULL_PHOTOS))
    seen = []
    behind = (float(background[0]), float(background[1]), float(background[2]))
    for photo in photos[::step]:
        context.reporter.check()
        seen.append(read_photo(photo, _HULL_PIXELS, behind))
    masks = foreground_masks([image for image, _ in seen], background, context.reporter.check)
    return [(camera, image, mask) for (image, camera), mask in zip(seen, masks, strict=True)]


def _hull(context: StageContext, views: list[View], cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (P, 3) of the visual hull's surface and the colours (P, 3) that the best placed photos show there."""

    def tick(fraction: float) -> None:
        context.progress("initialize", part="hull", fraction=0.5 + 0.2 * fraction)

    points, normals, _ = carve([v[0] for v in views], [v[2] for v in views], cells, tick)
    best = np.full(len(points), -np.inf)
    colors = np.full((len(points), 3), 0.5)
    for camera, image, mask in views:
        columns, rows, inside = camera.pixels_of(points)
        towards = camera.center - points
        facing = (normals * towards).sum(axis=1) / np.maximum(np.linalg.norm(towards, axis=1), 1e-12)
        better = inside & mask[rows, columns] & (facing > best)
        best[better] = facing[better]
        colors[better] = image[rows[better], columns[better]]
    return points, colors


def _shows_object(views: list[View], points: np.ndarray) -> np.ndarray:
    """Which points (P, 3) hardly any photo sees in front of the plain background; the others are wrong matches."""
    seen, covered = silhouette_votes([v[0] for v in views], [v[2] for v in views], points)
    return (seen > 0) & (covered >= _POINT_AGREEMENT * seen)


def _within_reach(points: np.ndarray, hull: np.ndarray) -> np.ndarray:
    """Which points lie in the hull's box or a tenth of its size around it; one far behind the object, on the line of
    sight of the only photo that sees it, is in that photo's silhouette too."""
    low, high = hull.min(axis=0), hull.max(axis=0)
    margin = 0.1 * (high - low).max()
    return np.all((points >= low - margin) & (points <= high + margin), axis=1)


def _camera(photo: Photo) -> Camera:
    if photo.camera is None:
        raise AssertionError("only photos with cameras get here")
    return photo.camera
