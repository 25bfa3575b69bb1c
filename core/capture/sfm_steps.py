"""The steps of structure from motion with pycolmap: features, pairs, matches; cancellable and with progress."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from ..files import atomic_write
from ..progress import Progress, Reporter
from ..told import Told
from ..views import Camera
from .bindings import load_pycolmap

LONGEST_SIDE = 1600
"""Features are looked for in images no larger than this: four times faster than COLMAP's 3200 on a CPU."""

MATCHING_THREADS = -1
"""All cores. On a busy machine COLMAP then found other matches in one of 42 runs, so that one seed's points differed;
with 1 it found the same in 88 of 88, but takes half as long again."""

_ALL_PAIRS_UP_TO = 120
_SEQUENCE_OVERLAP = 12
_NEIGHBOURS = 10

MOST_FEATURES = 8192
"""Of a photo, COLMAP's own number; it keeps all of the scale that passes it, so that there may be some more."""

PAIRS_AT_ONCE = 6
"""Pairs that are matched in one call, each by one thread."""

_IMAGES_AT_ONCE = 2
_BLOCK = 8

Result = TypeVar("Result")
Item = TypeVar("Item")


@dataclass(frozen=True)
class CameraGroup:
    """Images that share one camera.

    Attributes:
        names: relative to the image folder.
        model: COLMAP's name of the camera model.
        params: its parameters in pixels, comma-separated; "" when nothing is known.
    """

    names: list[str]
    model: str
    params: str


def colmap_seed(seed: int) -> int:
    """A seed of any size as COLMAP takes it, in 32 bits with a sign; those that fit stay as they are."""
    return seed % 2**31


def run_cancellable(call: Callable[[Any], Result], reporter: Reporter, progress: Callable[[], Progress]) -> Result:
    """Runs `call(token)` in a thread, reporting meanwhile; when the user cancels, the token stops pycolmap.

    Raises:
        Cancelled: the user asked to stop; the call has ended by then.
    """
    pycolmap = load_pycolmap()

    # COLMAP tells its steps on stderr; the user has the progress bar instead.
    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR)
    token = pycolmap.CancellationToken()
    results: list[Result] = []
    errors: list[BaseException] = []

    def work() -> None:
        try:
            results.append(call(token))
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    try:
        while thread.is_alive():
            thread.join(0.1)
            reporter.update(progress())
    except BaseException:
        token.cancel()
        thread.join()
        raise
    if errors:
        raise errors[0]
    return results[0]


def extract_features(
    database: Path, images: Path, groups: Sequence[CameraGroup], reporter: Reporter, span: tuple[float, float]
) -> None:
    """SIFT features of every image into the database, one camera a group.

    A peak threshold of 0.003 (COLMAP: 0.0067) finds features on smooth and dark objects.
    """
    pycolmap = load_pycolmap()

    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.max_image_size = LONGEST_SIDE
    options.sift.peak_threshold = 0.003
    options.sift.max_num_features = MOST_FEATURES
    pycolmap.Database.open(database).close()
    progress = _StepProgress(Told("features of the photos"), sum(len(group.names) for group in groups), span)
    for group in groups:
        reader = pycolmap.ImageReaderOptions(camera_model=group.model)
        if group.params:
            reader.camera_params = group.params
        # Extraction threads write in the order they finish; ids given beforehand keep a seed's result the same.
        pycolmap.import_images(database, images, pycolmap.CameraMode.SINGLE, group.names, reader)
        for names in _chunks(group.names, _IMAGES_AT_ONCE):

            def call(token: Any, names: list[str] = names, reader: Any = reader) -> None:
                pycolmap.extract_features(
                    database,
                    images,
                    names,
                    camera_mode=pycolmap.CameraMode.SINGLE,
                    reader_options=reader,
                    extraction_options=options,
                    device=pycolmap.Device.cpu,
                    cancellation_token=token,
                )

            run_cancellable(call, reporter, progress)
            progress.done += len(names)


def match_pairs(
    database: Path,
    pairs: Sequence[tuple[str, str]],
    pair_file: Path,
    seed: int,
    reporter: Reporter,
    span: tuple[float, float],
) -> None:
    """Guided matching of image pairs, verified by two-view geometry."""
    pycolmap = load_pycolmap()

    options = pycolmap.FeatureMatchingOptions()
    options.use_gpu = False
    options.num_threads = MATCHING_THREADS
    options.guided_matching = True
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = colmap_seed(seed)
    progress = _StepProgress(Told("matching photos"), len(pairs), span)
    for block in _chunks(_by_block(pairs), PAIRS_AT_ONCE):
        with atomic_write(pair_file, "w") as stream:
            stream.writelines(f"{first} {second}\n" for first, second in block)
        pairing = pycolmap.ImportedPairingOptions(match_list_path=pair_file)

        def call(token: Any, pairing: Any = pairing) -> None:
            pycolmap.match_image_pairs(
                database,
                matching_options=options,
                pairing_options=pairing,
                verification_options=verification,
                device=pycolmap.Device.cpu,
                cancellation_token=token,
            )

        run_cancellable(call, reporter, progress)
        progress.done += len(block)


def pairs_by_name(names: Sequence[str]) -> list[tuple[str, str]]:
    """Every pair of up to 120 photos; of more, neighbours in name order and all pairs of a coarse subset."""
    names = sorted(names)
    if len(names) <= _ALL_PAIRS_UP_TO:
        return list(combinations(names, 2))
    pairs = {
        (names[i], names[j])
        for i in range(len(names))
        for j in range(i + 1, min(i + 1 + _SEQUENCE_OVERLAP, len(names)))
    }
    every = -(-len(names) // (_ALL_PAIRS_UP_TO // 2))
    pairs.update(combinations(names[::every], 2))
    return sorted(pairs)


def pairs_by_pose(names: Sequence[str], cameras: Sequence[Camera]) -> list[tuple[str, str]]:
    """Each photo with its ten nearest in position among those that look within 75° of the same way."""
    centers = np.stack([camera.center for camera in cameras])
    forward = np.stack([np.asarray(camera.world_to_camera)[2, :3] for camera in cameras])
    distance = np.linalg.norm(centers[:, None] - centers[None], axis=-1)
    distance[forward @ forward.T < np.cos(np.deg2rad(75))] = np.inf
    np.fill_diagonal(distance, np.inf)
    pairs = set()
    for i, row in enumerate(distance):
        for j in np.argsort(row, kind="stable")[:_NEIGHBOURS]:
            if np.isfinite(row[j]):
                pairs.add((min(names[i], names[j]), max(names[i], names[j])))
    return sorted(pairs)


def image_ids(database: Path) -> dict[str, int]:
    """The database's image id of each name."""
    return {image.name: image.image_id for image in _images(database)}


def count_features(database: Path) -> dict[str, int]:
    """How many features each image in the database has, by name."""
    pycolmap = load_pycolmap()

    with pycolmap.Database.open(database) as link:
        return {image.name: link.num_keypoints_for_image(image.image_id) for image in link.read_all_images()}


def group_by(items: Iterable[tuple[str, tuple[str, str]]]) -> list[CameraGroup]:
    """Groups names by (model, params), in order of first appearance."""
    groups: dict[tuple[str, str], list[str]] = {}
    for name, key in items:
        groups.setdefault(key, []).append(name)
    return [CameraGroup(names, model, params) for (model, params), names in groups.items()]


@dataclass
class _StepProgress:
    """Progress of a step; `done` items of `total` are finished. Says its message once."""

    message: str
    total: int
    span: tuple[float, float]
    done: int = 0
    _said: bool = False

    def __call__(self) -> Progress:
        share = min(self.done / max(self.total, 1), 1.0)
        message, self._said = "" if self._said else self.message, True
        fraction = self.span[0] + share * (self.span[1] - self.span[0])
        return Progress("initialize", "sfm", fraction, iteration=self.done, iterations=self.total, message=message)


def _by_block(pairs: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
    """Pairs ordered so that neighbours in the list share images, whose features are then read once."""
    rank = {name: i // _BLOCK for i, name in enumerate(sorted({name for pair in pairs for name in pair}))}
    return sorted(pairs, key=lambda pair: (rank[pair[0]], rank[pair[1]], pair))


def _chunks(items: Sequence[Item], size: int) -> Iterator[list[Item]]:
    for start in range(0, len(items), size):
        yield list(items[start : start + size])


def _images(database: Path) -> list[Any]:
    # Never through Python's sqlite3: two SQLite libraries on one file in one process drop each other's locks.
    pycolmap = load_pycolmap()

    with pycolmap.Database.open(database) as link:
        return list(link.read_all_images())
