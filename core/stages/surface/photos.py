"""Photos in memory as they are trained on: bytes, at several sizes."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from functools import cached_property

import cv2
import numpy as np
import torch

from ...capture.background import UsualObject, foreground_mask
from ...capture.model import Photo
from ...capture.photos import read_photo
from ...compiled import njit, prange
from ...evaluate.photos import spread
from ...progress import Tick, unstopped
from ...threads import Alone, loops_only
from ...views import Camera

_CACHE_BYTES = 1 << 30
# Bytes a task turns into numbers, and how many are turned before other threads are awake.
_CHUNK = 1 << 16
_FEW = 1_000_000
# Photos, and their pixels, that tell what the object usually looks like.
_SEEN, _SEEN_PX = 10, 200


class TrainingPhotos:
    """Photos as bytes, at any share of their size; what does not fit into a gigabyte is read again when needed.

    Args:
        photos: with cameras.
        long_side: largest side in pixels.
        background: (3,) the plain colour behind the object in 0..1, or None. With it each photo has a mask.
        cache_bytes: how much is kept in memory.
        tick: called between photos while all are read; may raise to stop.

    Attributes:
        cameras: at full size.

    Raises:
        CaptureError: a photo cannot be read.
    """

    def __init__(
        self,
        photos: Sequence[Photo],
        long_side: int,
        background: np.ndarray | None,
        cache_bytes: int = _CACHE_BYTES,
        tick: Tick = unstopped,
    ) -> None:
        self._photos, self._long_side, self._background = list(photos), long_side, background
        self._cache_bytes, self._kept_bytes = cache_bytes, 0
        self._kept: OrderedDict[tuple[int, float], tuple[Camera, np.ndarray]] = OrderedDict()
        self.cameras: list[Camera] = []
        for index in range(len(self._photos)):
            tick()
            self.cameras.append(self._at(index, 1.0)[0])

    def __len__(self) -> int:
        return len(self._photos)

    def read(self, index: int, share: float = 1.0) -> tuple[Camera, torch.Tensor, torch.Tensor | None]:
        """Camera, pixels (H, W, 3) in 0..1 and mask (H, W) in 0..1 or None, at a share of the full side length."""
        camera, levels = self._at(index, min(share, 1.0))
        values = np.empty(levels.size, np.float32)
        with Alone(levels.size < _FEW):
            unit_values(levels, values)
        pixels = camera.height * camera.width
        color = torch.from_numpy(values[: 3 * pixels].reshape(camera.height, camera.width, 3))
        if self._background is None:
            return camera, color, None
        return camera, color, torch.from_numpy(values[3 * pixels :].reshape(camera.height, camera.width))

    def _at(self, index: int, share: float) -> tuple[Camera, np.ndarray]:
        """Camera and bytes: the colours pixel by pixel, then the mask if there is one."""
        key = (index, share)
        if key not in self._kept:
            found = self._shrunk(index, share) if share < 1 else self._from_file(index)
            self._kept[key] = found
            self._kept_bytes += found[1].nbytes
        self._kept.move_to_end(key)
        while self._kept_bytes > self._cache_bytes and len(self._kept) > 1:
            self._kept_bytes -= self._kept.popitem(last=False)[1][1].nbytes
        return self._kept[key]

    def _from_file(self, index: int) -> tuple[Camera, np.ndarray]:
        image, camera = read_photo(self._photos[index], self._long_side, self._behind)
        planes = [np.round(255 * image).astype(np.uint8)]
        if self._background is not None:
            mask = foreground_mask(image, self._background, lambda: self._usual_object)
            planes.append(255 * mask.astype(np.uint8))
        return camera, np.concatenate([plane.ravel() for plane in planes])

    @cached_property
    def _usual_object(self) -> UsualObject:
        """Photos are read for it, once, where one is of another exposure."""
        some = (read_photo(photo, _SEEN_PX, self._behind)[0] for photo in spread(self._photos, _SEEN))
        return UsualObject.of(some, np.array(self._behind))

    @property
    def _behind(self) -> tuple[float, float, float]:
        """The colour behind what is transparent."""
        red, green, blue = (0.0, 0.0, 0.0) if self._background is None else self._background.tolist()
        return red, green, blue

    def _shrunk(self, index: int, share: float) -> tuple[Camera, np.ndarray]:
        camera, levels = self._at(index, 1.0)
        size = max(1, round(camera.width * share)), max(1, round(camera.height * share))
        pixels = camera.height * camera.width
        planes = [levels[: 3 * pixels].reshape(camera.height, camera.width, 3)]
        if self._background is not None:
            planes.append(levels[3 * pixels :].reshape(camera.height, camera.width))
        smaller = [cv2.resize(plane, size, interpolation=cv2.INTER_AREA) for plane in planes]
        return camera.resized(*size), np.concatenate([plane.ravel() for plane in smaller])


@njit(parallel=loops_only(), cache=True, error_model="numpy")
def unit_values(levels, values):  # type: ignore[no-untyped-def]
    """Bytes as 0..1 in float32."""
    for chunk in prange((levels.size + _CHUNK - 1) // _CHUNK):
        for i in range(np.uint64(chunk * _CHUNK), np.uint64(min((chunk + 1) * _CHUNK, levels.size))):
            values[i] = np.float32(levels[i]) / np.float32(255)


def scene_extent(cameras: Sequence[Camera]) -> float:
    """Radius of the scene as 3DGS has it: 1.1 times the largest distance of a camera from the cameras' middle."""
    centers = np.array([camera.center for camera in cameras])
    return float(1.1 * np.linalg.norm(centers - centers.mean(axis=0), axis=1).max(initial=0.0)) or 1.0
