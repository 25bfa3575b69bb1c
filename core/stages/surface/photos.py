"""Photos in memory as they are trained on: bytes, at several sizes."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch

from ...capture.background import foreground_mask
from ...capture.model import Photo
from ...capture.photos import read_photo
from ...views import Camera


class TrainingPhotos:
    """Reads photos once, keeps them as bytes, and gives them at any share of their size.

    Args:
        photos: with cameras.
        long_side: largest side in pixels.
        background: (3,) the plain colour behind the object in 0..1, or None. With it each photo has a mask.

    Raises:
        CaptureError: a photo cannot be read.
    """

    def __init__(self, photos: Sequence[Photo], long_side: int, background: np.ndarray | None) -> None:
        behind = np.zeros(3) if background is None else background
        self._full: list[tuple[Camera, np.ndarray]] = []
        for photo in photos:
            image, camera = read_photo(photo, long_side, (float(behind[0]), float(behind[1]), float(behind[2])))
            planes = [np.round(255 * image).astype(np.uint8)]
            if background is not None:
                planes.append(255 * foreground_mask(image, background)[..., None].astype(np.uint8))
            self._full.append((camera, np.concatenate(planes, axis=-1)))
        self._smaller: dict[tuple[int, float], tuple[Camera, np.ndarray]] = {}

    def __len__(self) -> int:
        return len(self._full)

    @property
    def cameras(self) -> list[Camera]:
        """Cameras at full size."""
        return [camera for camera, _ in self._full]

    def read(self, index: int, share: float = 1.0) -> tuple[Camera, torch.Tensor, torch.Tensor | None]:
        """Camera, pixels (H, W, 3) in 0..1 and mask (H, W) in 0..1 or None, at a share of the full side length."""
        camera, planes = self._full[index] if share >= 1 else self._shrunk(index, share)
        values = torch.from_numpy(planes.astype(np.float32) / 255)
        return camera, values[..., :3].contiguous(), values[..., 3].contiguous() if planes.shape[-1] == 4 else None

    def _shrunk(self, index: int, share: float) -> tuple[Camera, np.ndarray]:
        key = (index, share)
        if key not in self._smaller:
            camera, planes = self._full[index]
            size = max(1, round(camera.width * share)), max(1, round(camera.height * share))
            small = cv2.resize(planes, size, interpolation=cv2.INTER_AREA)
            self._smaller[key] = camera.resized(*size), small
        return self._smaller[key]


def scene_extent(cameras: Sequence[Camera]) -> float:
    """Radius of the scene as 3DGS has it: 1.1 times the largest distance of a camera from the cameras' middle."""
    centers = np.array([camera.center for camera in cameras])
    return float(1.1 * np.linalg.norm(centers - centers.mean(axis=0), axis=1).max(initial=0.0)) or 1.0
