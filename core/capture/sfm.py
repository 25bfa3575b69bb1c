"""Structure from motion: cameras of bare photos, and sparse points where the cameras are known (pycolmap)."""

from __future__ import annotations

import errno
import hashlib
import json
import math
import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ..errors import RunFolderError
from ..files import atomic_write, explained, write_json
from ..progress import Progress, Reporter
from ..threads import usable_cores
from ..told import Told
from ..views import Camera
from .bindings import load_pycolmap
from .colmap import photos_from, points_of
from .digest import content_digest
from .findings import CaptureProblem, name_some
from .model import Photo, Photos
from .photos import ImageFacts, fitted_size, image_facts, read_bare, read_photo
from .sfm_steps import (
    LONGEST_SIDE,
    MOST_FEATURES,
    PAIRS_AT_ONCE,
    CameraGroup,
    colmap_seed,
    count_features,
    extract_features,
    group_by,
    image_ids,
    match_pairs,
    pairs_by_name,
    pairs_by_pose,
    run_cancellable,
)

_VERSION = 1
_STEPS = ("features", "matches", "model")
_FEWEST = 3
# SQLite gives its journal back when it fails: a full disk is rarely found without a single free byte.
_NO_SPACE_BYTES = 2**20
_FEWEST_SHARE = 0.25
_TIMED_SIDE = 640


def reconstruct(photos: Photos, workdir: Path, reporter: Reporter | None = None, seed: int = 0) -> Photos:
    """Finds the cameras of bare photos and sparse points of the scene.

    SIFT with a low peak threshold, guided matching and a focal length from EXIF; of the models that the mapper
    returns the largest is taken. Photos that do not register are left out (see `left_out`) and named in a
    progress message. What is done is kept in `workdir`, so that a second call does not do it again.

    Args:
        photos: their cameras are ignored.
        workdir: a folder of the run for the database and the model.
        seed: of RANSAC; the same seed gives the same cameras up to rounding (1e-5 of the scene, seen once), because
            bundle adjustment runs on one thread.

    Returns:
        The registered photos, with cameras, every eighth held out, and points.

    Raises:
        CaptureError: too few photos register; says why that happens and what to do.
        DiskFullError, RunFolderError: `workdir` cannot be written, or COLMAP stumbles over what is in it.
        Cancelled: the user asked to stop.
    """
    reporter = reporter or Reporter()
    paths = [photo.path for photo in photos.photos]
    if len(paths) < 2:
        raise CaptureProblem(
            paths[0] if paths else "photos",
            "one photo alone cannot be placed in space",
            "take at least 20 photos all around the object, each overlapping the next",
        )
    facts = [image_facts(path) for path in paths]
    # Before 2, smaller copies had the focal length of their originals.
    inputs = {"kind": "reconstruct", "lens": 2, "seed": seed, "images": _digests(paths)}
    work = _Workdir(workdir, {**inputs, **_backdrops(photos.photos)})
    with _explained(work.path):
        images, names = _plain_images(work, photos.photos, facts, reporter)
        by_name = dict(zip(names, paths, strict=True))
        if not work.has("features"):
            work.start_database()
            groups = _lens_groups(names, facts, LONGEST_SIDE if images == work.images else None)
            extract_features(work.database, images, groups, reporter, (0.0, 0.3))
            work.finish("features")
        if not work.has("matches"):
            match_pairs(work.database, pairs_by_name(names), work.path / "pairs.txt", seed, reporter, (0.3, 0.8))
            work.finish("matches")
        if not work.has("model"):
            _map(work, images, len(names), seed, reporter)
            work.finish("model")
        result = photos_from(_read_model(work.model), by_name, upright=True)
    behind = {photo.path: photo.backdrop for photo in photos.photos}
    result = replace(result, photos=[replace(photo, backdrop=behind[photo.path]) for photo in result.photos])
    _report_left_out(photos, result, reporter)
    return result


def triangulate(photos: Photos, workdir: Path, reporter: Reporter | None = None, seed: int = 0) -> Photos:
    """Sparse points of photos whose cameras are known; the cameras stay as they are.

    Held-out photos are for measuring only: points come from the others.

    Args:
        photos: all with cameras.
        workdir: a folder of the run for the database.
        seed: of RANSAC.

    Returns:
        The same photos with points (P, 3) and colours, in the frame of the cameras. P may be 0 when the photos
        show nothing to match.

    Raises:
        CaptureError: a photo has no camera or cannot be read.
        DiskFullError, RunFolderError: as `reconstruct`.
        Cancelled: the user asked to stop.
    """
    reporter = reporter or Reporter()
    training = [photo for photo in photos.photos if not photo.held_out]
    cameras = [_camera(photo) for photo in training]
    poses = hashlib.sha256(b"".join(_camera_bytes(camera) for camera in cameras)).hexdigest()
    digests = _digests([photo.path for photo in training])
    inputs = {"kind": "triangulate", "seed": seed, "images": digests, "poses": poses}
    work = _Workdir(workdir, {**inputs, **_backdrops(training)})
    with _explained(work.path):
        images, names, cameras = _pinhole_images(work, training, cameras, reporter)
        if not work.has("features"):
            _pinhole_features(work, images, names, cameras, reporter)
            work.finish("features")
        if not work.has("matches"):
            pairs = pairs_by_pose(names, cameras)
            match_pairs(work.database, pairs, work.path / "pairs.txt", seed, reporter, (0.4, 0.9))
            work.finish("matches")
        if not work.has("model"):
            _triangulate(work, images, names, cameras, seed, reporter)
            work.finish("model")
        model = _read_model(work.model)
    points, colors = points_of(model, set(model.images))
    told = Told("{count} sparse points", count=len(points))
    reporter.update(Progress("initialize", "sfm", fraction=1.0, message=told))
    return replace(photos, points=points, colors=colors)


def time_features(pair: tuple[Photo, Photo], workdir: Path, reporter: Reporter) -> tuple[float, float]:
    """Seconds that `triangulate` takes to find a photo's features, and to match those of two: tried with a pair.

    Features are looked for in 640 pixels at most, for a second or so, and taken to be as many more as a photo has more
    pixels; matching each of one photo with each of the other takes that much longer.

    Args:
        pair: with cameras.
        workdir: an empty folder.

    Raises:
        As `triangulate`.
    """
    cameras = [_camera(photo) for photo in pair]
    sides = [max(camera.width, camera.height) for camera in cameras]
    more_pixels = [(min(side, LONGEST_SIDE) / min(side, _TIMED_SIDE)) ** 2 for side in sides]
    work = _Workdir(workdir, {"kind": "time"})
    with _explained(work.path):
        begin = time.perf_counter()
        # Reading takes as long as it does, however small the copies are.
        images, names, cameras = _pinhole_images(work, pair, cameras, reporter, _TIMED_SIDE)
        read = time.perf_counter()
        _pinhole_features(work, images, names, cameras, reporter)
        found = time.perf_counter()
        # The second time there is nothing left to match: that is the call's own time, which a whole block shares.
        first, again = (_match_alone(work, names, reporter) for _ in range(2))
        counts = count_features(work.database)
        more_matches = _more_matches([counts[name] for name in names], more_pixels)
    rounds = -(-PAIRS_AT_ONCE // usable_cores())
    block = again + max(first - again, 0.0) * more_matches * rounds
    photo = (read - begin) / len(pair) + (found - read) * sum(more_pixels) / len(pair) ** 2
    return photo, block / PAIRS_AT_ONCE


def _match_alone(work: _Workdir, names: list[str], reporter: Reporter) -> float:
    """Seconds of matching two images."""
    begin = time.perf_counter()
    match_pairs(work.database, [(names[0], names[1])], work.path / "pairs.txt", 0, reporter, (0.4, 0.9))
    return time.perf_counter() - begin


def _more_matches(counts: Sequence[int], more_pixels: Sequence[float]) -> float:
    """How many times as many pairs of features two images with so many times as many pixels have."""
    there = [(count, more) for count, more in zip(counts, more_pixels, strict=True) if count]
    return math.prod(max(min(count * more, MOST_FEATURES) / count, 1.0) for count, more in there)


def left_out(before: Photos, after: Photos) -> list[Path]:
    """The photos that structure from motion could not register."""
    registered = {photo.path for photo in after.photos}
    return [photo.path for photo in before.photos if photo.path not in registered]


@contextmanager
def _explained(folder: Path) -> Iterator[None]:
    """Turns what COLMAP says about its folder into a sentence with advice; it reports a full disk as anything."""
    with explained(folder):
        try:
            yield
        except RuntimeError as error:
            if shutil.disk_usage(folder).free < _NO_SPACE_BYTES or "is full" in str(error):
                raise OSError(errno.ENOSPC, "No space left on device") from error
            raise RunFolderError(
                "{folder}: structure from motion failed there ({error}); delete this folder and run the same command "
                "again, or bring known poses as transforms.json or sparse/0.",
                folder=folder,
                error=error,
            ) from error


class _Workdir:
    """The database and model of one set of photos; a step is done when `state.json` says so for this key."""

    def __init__(self, path: Path, inputs: dict[str, Any]) -> None:
        pycolmap = load_pycolmap()

        self.path = Path(path)
        self.database = self.path / "database.db"
        self.model = self.path / "model"
        self.images = self.path / "images"
        whole = {**inputs, "version": _VERSION, "pycolmap": pycolmap.__version__, "side": LONGEST_SIDE}
        self._key = hashlib.sha256(json.dumps(whole, sort_keys=True).encode()).hexdigest()
        self._state = self.path / "state.json"
        self.path.mkdir(parents=True, exist_ok=True)
        if self._read().get("key") != self._key:
            self._clear()
            write_json(self._state, {"key": self._key, "done": ""})

    def has(self, step: str) -> bool:
        done = self._read().get("done", "")
        return done in _STEPS and _STEPS.index(done) >= _STEPS.index(step)

    def finish(self, step: str) -> None:
        write_json(self._state, {"key": self._key, "done": step})

    def start_database(self) -> None:
        """Removes what a killed run may have left half written."""
        for suffix in ("", "-journal", "-wal", "-shm"):
            self.database.with_name(self.database.name + suffix).unlink(missing_ok=True)

    def _read(self) -> dict[str, str]:
        try:
            return json.loads(self._state.read_text("utf-8"))
        except (OSError, ValueError):
            return {}

    def _clear(self) -> None:
        self.start_database()
        for folder in (self.model, self.images):
            shutil.rmtree(folder, ignore_errors=True)


def _backdrops(photos: Sequence[Photo]) -> dict[str, Any]:
    """What a workdir's key has of the backgrounds that are taken out; nothing where none is."""
    behind = [photo.backdrop for photo in photos]
    if not any(behind):
        return {}
    return {"backdrops": [one and [content_digest(one.path), one.color, one.tolerance] for one in behind]}


def _digests(paths: Sequence[Path]) -> list[str]:
    return [content_digest(path) for path in paths]


def _plain_images(
    work: _Workdir, photos: Sequence[Photo], facts: list[ImageFacts], reporter: Reporter
) -> tuple[Path, list[str]]:
    """The folder and names to give to pycolmap: the photos themselves, or copies where any is turned, has a backdrop to
    take out, or a name that COLMAP would not find."""
    paths = [photo.path for photo in photos]
    readable = all(path.suffix.lower() in (".jpg", ".jpeg", ".png") for path in paths)
    folder = _common_folder(paths)
    names = [path.relative_to(folder).as_posix() for path in paths]
    given = not any(fact.turned or fact.alpha for fact in facts) and all(photo.backdrop is None for photo in photos)
    if readable and given and all(_in_pair_list(name) for name in names):
        return folder, names
    copies = [f"{index:05d}.jpg" for index in range(len(paths))]
    for photo, fact, copy in zip(photos, facts, copies, strict=True):
        reporter.check()
        if not (work.images / copy).exists():
            size = fitted_size(*fact.upright, LONGEST_SIDE)
            _write_jpeg(work.images / copy, read_bare(photo, LONGEST_SIDE, size))
    return work.images, copies


def _in_pair_list(name: str) -> bool:
    """Whether COLMAP finds a photo by its name in a list of pairs: words of a text, in which # begins a remark."""
    return not name.startswith("#") and name.isprintable() and " " not in name


def _pinhole_images(
    work: _Workdir, photos: Sequence[Photo], cameras: list[Camera], reporter: Reporter, long_side: int = LONGEST_SIDE
) -> tuple[Path, list[str], list[Camera]]:
    """Undistorted images no larger than needed, written once, and the cameras that fit them."""
    names = [f"{index:05d}.jpg" for index in range(len(photos))]
    sized = []
    for photo, camera, name in zip(photos, cameras, names, strict=True):
        reporter.check()
        if not (work.images / name).exists():
            _write_jpeg(work.images / name, read_photo(photo, long_side)[0])
        sized.append(camera.resized(*fitted_size(camera.width, camera.height, long_side)))
    return work.images, names, sized


def _pinhole_features(
    work: _Workdir, images: Path, names: list[str], cameras: list[Camera], reporter: Reporter
) -> None:
    work.start_database()
    groups = group_by((name, ("PINHOLE", _pinhole_params(c))) for name, c in zip(names, cameras, strict=True))
    extract_features(work.database, images, groups, reporter, (0.0, 0.4))


def _write_jpeg(path: Path, pixels: np.ndarray) -> None:
    with atomic_write(path) as stream:
        image = Image.fromarray((np.clip(pixels, 0, 1) * 255 + 0.5).astype(np.uint8))
        image.save(stream, "JPEG", quality=97, subsampling=0)


def _lens_groups(names: list[str], facts: list[ImageFacts], long_side: int | None) -> list[CameraGroup]:
    """Photos of one size, camera and zoom share a camera, with the focal length from EXIF as its start; in pixels of
    the images that are given, no larger than `long_side`."""
    keyed = {}
    for name, fact in zip(names, facts, strict=True):
        keyed[name] = (fact.upright, fact.camera_name, round(fact.focal_px or 0.0, 1))
    groups = []
    for key in dict.fromkeys(keyed.values()):
        size, _, focal = key
        width, height = fitted_size(*size, long_side)
        members = [name for name in names if keyed[name] == key]
        params = f"{focal * max(width, height) / max(size)},{width / 2},{height / 2},0" if focal else ""
        groups.append(CameraGroup(members, "SIMPLE_RADIAL", params))
    return groups


def _map(work: _Workdir, images: Path, count: int, seed: int, reporter: Reporter) -> None:
    pycolmap = load_pycolmap()

    options = _pipeline_options(seed)
    options.min_model_size = max(_FEWEST, min(10, count // 2))
    options.max_num_models = 10
    registered = [0]

    def next_image() -> None:
        registered[0] += 1

    def progress() -> Progress:
        share = min(registered[0] / count, 1.0)
        return Progress("initialize", "sfm", 0.8 + 0.2 * share, iteration=registered[0], iterations=count)

    attempts = work.path / "attempts"
    attempts.mkdir(exist_ok=True)
    models = run_cancellable(
        lambda token: pycolmap.incremental_mapping(
            work.database,
            images,
            attempts,
            options=options,
            next_image_callback=next_image,
            cancellation_token=token,
        ),
        reporter,
        progress,
    )
    shutil.rmtree(attempts, ignore_errors=True)
    best = max(models.values(), key=lambda m: (m.num_reg_images(), m.num_points3D()), default=None)
    _check_enough(0 if best is None else best.num_reg_images(), count)
    assert best is not None
    work.model.mkdir(exist_ok=True)
    best.write_binary(work.model)


def _pipeline_options(seed: int) -> Any:
    """Options that give the same result for the same seed: several threads add up in another order every time."""
    pycolmap = load_pycolmap()

    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = colmap_seed(seed)
    return options


def _check_enough(registered: int, count: int) -> None:
    if registered >= max(_FEWEST, int(np.ceil(_FEWEST_SHARE * count))):
        return
    raise CaptureProblem(
        "photos",
        "none of the {count} photos could be matched with another"
        if registered == 0
        else "only {registered} of the {count} photos could be placed in space",
        "photograph one still object from all around, each photo overlapping the next by two thirds, sharp and with "
        "texture in view (not straight ahead down a street); where the object was turned while camera and room stood "
        "still, run with --effects moving_background; or bring known poses as transforms.json or sparse/0",
        registered=registered,
        count=count,
    )


def _triangulate(
    work: _Workdir, images: Path, names: list[str], cameras: list[Camera], seed: int, reporter: Reporter
) -> None:
    pycolmap = load_pycolmap()

    options = _pipeline_options(seed)
    reconstruction = _known_cameras(work.database, names, cameras)
    work.model.mkdir(exist_ok=True)
    run_cancellable(
        lambda token: pycolmap.triangulate_points(
            reconstruction, work.database, images, work.model, options=options, cancellation_token=token
        ),
        reporter,
        lambda: Progress("initialize", "sfm", fraction=0.9),
    )


def _known_cameras(database: Path, names: list[str], cameras: list[Camera]) -> Any:
    """A reconstruction without points whose ids are the database's."""
    pycolmap = load_pycolmap()

    poses = {image_ids(database)[name]: camera for name, camera in zip(names, cameras, strict=True)}
    reconstruction = pycolmap.Reconstruction()
    with pycolmap.Database.open(database) as link:
        for camera in link.read_all_cameras():
            reconstruction.add_camera(camera)
        for rig in link.read_all_rigs():
            reconstruction.add_rig(rig)
        for frame in link.read_all_frames():
            image_id = next(data.id for data in frame.data_ids)
            matrix = np.asarray(poses[image_id].world_to_camera, np.float64)
            frame.rig_from_world = pycolmap.Rigid3d(
                pycolmap.Rotation3d(matrix[:3, :3]), np.ascontiguousarray(matrix[:3, 3])
            )
            reconstruction.add_frame(frame)
        for image in link.read_all_images():
            reconstruction.add_image(image)
        for frame_id in list(reconstruction.frames):
            reconstruction.register_frame(frame_id)
    return reconstruction


def _read_model(path: Path) -> Any:
    pycolmap = load_pycolmap()

    return pycolmap.Reconstruction(path)


def _report_left_out(before: Photos, after: Photos, reporter: Reporter) -> None:
    missing = [path.name for path in left_out(before, after)]
    told = Told(
        "{found} of {count} photos registered; left out: {names}"
        if missing
        else "{found} of {count} photos registered",
        found=len(after.photos),
        count=len(before.photos),
        names=name_some(missing),
    )
    reporter.update(Progress("initialize", "sfm", fraction=1.0, message=told))


def _camera(photo: Photo) -> Camera:
    if photo.camera is None:
        raise CaptureProblem(photo.path, "has no camera", "run structure from motion first")
    return photo.camera


def _camera_bytes(camera: Camera) -> bytes:
    inner = [camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy]
    return np.concatenate([inner, np.asarray(camera.world_to_camera, np.float64).ravel()]).tobytes()


def _pinhole_params(camera: Camera) -> str:
    return f"{camera.fx!r},{camera.fy!r},{camera.cx!r},{camera.cy!r}"


def _common_folder(paths: Sequence[Path]) -> Path:
    folder = paths[0].parent
    while not all(path.is_relative_to(folder) for path in paths):
        folder = folder.parent
    return folder
