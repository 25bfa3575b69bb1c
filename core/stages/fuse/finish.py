"""The finish: display opacities and colours of the fused set on the photos. No shape, no density changes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ...gaussians import GaussianSet, Modality
from ...rotations import quats_to_matrices
from ...spherical_harmonics import C0
from ...train.losses import image_loss
from ..photo_series import PhotoSeries

# Neighbouring photo splats that are asked where the surface is.
_NEIGHBOURS = 8
# An exponent beyond which a splat is of no effect at the surface anyway.
_FAR = 40.0
# A splat that accounts for this many pixels of a training photo on average is part of what they show.
_SEEN_PIXELS = 0.5


class FinishLoss:
    """One photo an iteration: (1 − λs) L1 + λs D-SSIM, and display opacities pulled to what `internal` found.

    The pull decides where photos do not: what they cannot see is as solid as the sections say.

    Args:
        fused: the numpy set before its opacities were limited.
        colored: (N,) bool, splats whose colours may change.
        photos: to train on.
        structure_weight: λs.
        keep_weight: of the mean squared distance from the display opacities of `fused`.
        kernel: of the renderer.
    """

    def __init__(
        self,
        fused: GaussianSet,
        colored: np.ndarray,
        photos: PhotoSeries,
        structure_weight: float,
        keep_weight: float,
        kernel: str,
    ) -> None:
        self._radiative = torch.from_numpy(fused.modality == Modality.XRAY)
        self._colored = torch.from_numpy(colored)
        start = fused.to_torch()
        self._opacities, self._sh = start.opacities, start.sh
        self._photos, self._kernel = photos, kernel
        self._structure_weight, self._keep_weight = structure_weight, keep_weight

    def restricted(self, gaussians: GaussianSet) -> GaussianSet:
        """The set (torch) in which only opacities of radiative splats and the colours chosen may differ."""
        return replace(
            gaussians,
            opacities=torch.where(self._radiative, gaussians.opacities, self._opacities),
            sh=torch.where(self._colored[:, None, None], gaussians.sh, self._sh),
        )

    def __call__(self, gaussians: GaussianSet, iteration: int) -> Tensor:
        current = self.restricted(gaussians)
        index, camera, photo = self._photos.training(iteration)
        shown = self._photos.draw_training(current, index, camera, self._kernel).color
        share = self._structure_weight
        total = image_loss(shown, photo, share)
        change = (current.opacities - self._opacities)[self._radiative]
        return total + self._keep_weight * change.square().mean()


def limit_display(xray: GaussianSet, surface: np.ndarray, shown: float) -> GaussianSet:
    """The numpy set with display opacities so low that no splat shows more than `shown` at the surface.

    A splat of opacity 1 is seen up to three standard deviations from its centre, which makes a solid of fat splats
    swell out of its own surface and over the finer photo splats on it. With q the least squared distance of the
    nearest surface points in standard deviations, o ≤ shown · exp(q / 2).

    Args:
        surface: (M, 3) points on the surface, such as the photo splats' centres.
        shown: 0..1.
    """
    if len(surface) == 0 or len(xray) == 0:
        return xray
    from scipy.spatial import cKDTree

    count = min(_NEIGHBOURS, len(surface))
    _, nearest = cKDTree(surface).query(xray.means, k=count)
    offsets = surface[nearest.reshape(len(xray), count)] - xray.means[:, None, :]
    whitened = np.einsum("nkj,nji->nki", offsets, quats_to_matrices(xray.quats)) / xray.scales[:, None, :]
    squared = np.minimum(np.square(whitened).sum(-1).min(axis=1), _FAR)
    limit = np.minimum(shown * np.exp(0.5 * squared), 1.0)
    return replace(xray, opacities=np.minimum(xray.opacities, limit).astype(np.float32))


def seen_by_photos(gaussians: GaussianSet, photos: PhotoSeries, kernel: str, tick: Callable[[], None]) -> np.ndarray:
    """(N,) bool, the splats that are part of what the training photos show; see `pixels_seen`."""
    return pixels_seen(gaussians, photos, kernel, tick) > _SEEN_PIXELS * len(photos)


def pixels_seen(gaussians: GaussianSet, photos: PhotoSeries, kernel: str, tick: Callable[[], None]) -> np.ndarray:
    """How many pixels of all training photos each splat accounts for, Σ α·T, (N,) float32.

    It is the gradient of the summed image with respect to a splat's colour.

    Args:
        gaussians: numpy set in the world frame.
        tick: called between photos; may raise to stop.
    """
    grey = torch.zeros(len(gaussians), 1, 3, requires_grad=True)
    view = replace(gaussians.to_torch(), sh=grey)
    for index in range(len(photos)):
        tick()
        camera, _ = photos.read_training(index)
        half = camera.resized(max(1, camera.width // 2), max(1, camera.height // 2))
        shown = photos.draw(view, half, kernel).color
        if shown.requires_grad:
            (4 * shown[..., 0].sum()).backward()
    return np.zeros(len(gaussians), np.float32) if grey.grad is None else grey.grad[:, 0, 0].numpy() / C0
