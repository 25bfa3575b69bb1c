"""Photos in files, of the two walls and of phantoms, and the model that structure from motion would leave of them."""

import json

import numpy as np
from PIL import Image

from insideout.core.capture.model import Photo
from insideout.core.phantoms.distance_grid import DistanceGrid
from insideout.core.phantoms.photos import render_photo
from insideout.core.phantoms.settings import CaptureSettings
from insideout.core.phantoms.shots import plan_shots, transforms
from insideout.core.similarity import Similarity


def saved(folder, cameras, images):
    """Photos (H, W, 3) in 0..1 as files that lose nothing."""
    folder.mkdir(parents=True, exist_ok=True)
    photos = []
    for index, (camera, image) in enumerate(zip(cameras, images, strict=True)):
        path = folder / f"{index:03d}.png"
        Image.fromarray(np.round(255 * np.clip(image, 0, 1)).astype(np.uint8)).save(path)
        photos.append(Photo(path, camera))
    return photos


def of_phantom(folder, phantom, size, count, effects=(), seed=0):
    """The folder of two captures of photos with cameras: `seen` with the effects, and `plain` by pinholes that stand
    still, before the plain background that phantoms have."""
    grid = DistanceGrid.bake(phantom.surface, np.array(phantom.size_mm), 1.0)
    settings = CaptureSettings(photos=count, photo_width=size, photo_height=size, effects=effects)
    shots = plan_shots(max(phantom.size_mm), settings, np.random.default_rng(seed))
    names = [f"{index:03d}.png" for index in range(count)]
    poses = transforms([shot.camera for shot in shots], names, Similarity(1.0, np.eye(3), np.zeros(3)))
    for kind in ("seen", "plain"):
        photos = folder / kind / "photos"
        images = [render_photo(phantom, grid, shot if kind == "seen" else shot.camera) for shot in shots]
        saved(photos, [shot.camera for shot in shots], images)
        (photos / "transforms.json").write_text(json.dumps(poses))
    return folder


def write_model(folder, cameras, points, seen=None, shown=None):
    """A COLMAP model of points (P, 3) that are seen by all cameras, or by those for which `seen` (P, N) is true.

    Args:
        shown: (N, P, 2) where, column and row in pixels; the middle of the pixel of each point if not given.
    """
    import pycolmap

    model = pycolmap.Reconstruction()
    first = cameras[0]
    params = [first.fx, first.fy, first.cx, first.cy]
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model="PINHOLE", width=first.width, height=first.height, params=params)
    )
    places = [camera.pixels_of(points) for camera in cameras]
    inside = np.array([place[2] for place in places])
    inside &= True if seen is None else seen.T
    if shown is None:
        shown = [np.stack([columns, rows], axis=1) + 0.5 for columns, rows, _ in places]
    for index, (camera, where) in enumerate(zip(cameras, shown, strict=True)):
        image = pycolmap.Image(name=f"{index}.jpg", camera_id=1, image_id=index + 1)
        image.points2D = pycolmap.Point2DList(
            [pycolmap.Point2D(where[place]) for place in np.flatnonzero(inside[index])]
        )
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.asarray(camera.world_to_camera)[:3]))
    number = np.cumsum(inside, axis=1) - 1
    for place, point in enumerate(points):
        track = pycolmap.Track()
        for index in np.flatnonzero(inside[:, place]):
            track.add_element(index + 1, int(number[index, place]))
        if track.length() >= 2:
            model.add_point3D(point, track, np.zeros(3, np.uint8))
    folder.mkdir(parents=True, exist_ok=True)
    model.write(folder)
    return folder
