"""Joint refinement: one set of Gaussians on photos, projections and sections at once, the similarity with them.

After `align` both halves lie in one frame. From then on every splat has colour, opacity and density, whichever half it
came from: photo splats learn to attenuate, radiative ones to be seen (the idea of X-Splat, SIGGRAPH Asia 2026).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from ...capture.model import Projections
from ...gaussians import GaussianSet, Modality
from ...render import radiograph, section, splat
from ...render.voxels import voxelize_block
from ...rotations import multiply_quats
from ...similarity import Similarity
from ...train.losses import d_ssim, image_loss, l1, total_variation
from ...train.parameters import Parameters, ScaleLimits
from ...train.schedule import Decay
from ..photo_series import PhotoSeries
from ..refine import train_only
from .targets import SectionSeries, shuffled

_GROUPS = ("means", "quats", "scales", "opacities", "sh_dc", "sh_rest", "density")
# Of the object's size: what a photo splat attenuates before projections say more.
_FIRST_DENSITY = 1e-3


@dataclass(frozen=True)
class JointSettings:
    """How the two halves become one model.

    Rates are those of Adam; means and the similarity's shift are multiplied by half the longest side of the box.

    Attributes:
        iterations: each one photo, one projection and one section.
        photo_weight, projection_weight, section_weight: of the three losses.
        structure_weight: λs of photos and sections.
        radiograph_structure_weight: of D-SSIM beside L1 in projections.
        smooth_weight, smooth_voxels, smooth_every: total variation of a block of voxels, as in `surface`.
        cutoff_sigmas: where a splat ends in projections while it is trained.
        photo_size: long side of the photos in pixels.
        similarity_rate: of the photo frame's rotation (rad), logarithm of scale and shift.
    """

    iterations: int = 3000
    photo_weight: float = 1.0
    projection_weight: float = 1.0
    section_weight: float = 0.1
    structure_weight: float = 0.2
    radiograph_structure_weight: float = 0.25
    smooth_weight: float = 0.5
    smooth_voxels: int = 32
    smooth_every: int = 2
    cutoff_sigmas: float = 3.0
    photo_size: int = 800
    means_rate: Decay = Decay(2e-5, 2e-6)
    rotation_rate: Decay = Decay(5e-4, 5e-5)
    scale_rate: Decay = Decay(2e-3, 2e-4)
    opacity_rate: Decay = Decay(0.02, 0.002)
    color_rate: Decay = Decay(2e-3, 2e-4)
    density_rate: Decay = Decay(4e-3, 4e-4)
    similarity_rate: Decay = Decay(2e-5, 2e-6)


def join(rgb: GaussianSet, xray: GaussianSet, density_unit: float) -> GaussianSet:
    """One numpy set: radiative splats first, then photo splats that attenuate a little, so that they can learn it."""
    born = replace(
        rgb,
        density=np.full(len(rgb), _FIRST_DENSITY * density_unit, np.float32),
        modality=np.full(len(rgb), Modality.RGB, np.uint8),
    )
    return GaussianSet.concatenate([xray, born])


class JointTrainer:
    """Fits one set to everything; see `core.train.loop.Trainer`.

    Args:
        start: numpy set in mm; see `join`.
        photos: with cameras in the world frame as `align` left them.
        projections: those not held out are trained on; None for a volume without projections.
        series: the volume's sections; display opacities follow their material.
        density_unit: mm⁻¹, the size of the object's larger attenuations.
        unit_mm: half the longest side of the box.

    Attributes:
        correction: of the photo frame, in the world: cameras are moved by it.
    """

    def __init__(
        self,
        start: GaussianSet,
        photos: PhotoSeries,
        projections: Projections | None,
        series: SectionSeries,
        settings: JointSettings,
        density_unit: float,
        unit_mm: float,
        seed: int,
        kernel: str,
    ) -> None:
        self._photos, self._projections, self._series, self._settings = photos, projections, series, settings
        self._seed, self._kernel, self._unit = seed, kernel, unit_mm
        self._training = [] if projections is None else np.flatnonzero(~projections.held_out).tolist()
        self._peak = 1.0
        if projections is not None:
            self._peak = max(float(projections.images[self._training].max(initial=0.0)), 1e-12)
        limits = ScaleLimits(1e-5 * unit_mm, unit_mm)
        self.parameters = Parameters(start, _GROUPS, density_unit=density_unit, limits=limits)
        self.correction = Similarity()
        self._moments = np.zeros((2, 7))

    def __len__(self) -> int:
        return len(self.parameters)

    def step(self, iteration: int) -> float:
        """One photo, one projection, one section."""
        settings, fraction = self._settings, iteration / self._settings.iterations
        total = self._step_photo(iteration)
        moved = self._pull_on_frame()
        total += self._step_rest(iteration)
        if not self.parameters.step(self._rates(fraction)):
            return float("nan")
        self._move_frame(moved, settings.similarity_rate.at(fraction))
        return total

    def _step_photo(self, iteration: int) -> float:
        settings = self._settings
        camera, photo = self._photos.training(iteration)
        current = self.parameters.activate()
        shown = splat(current, camera.transformed(self.correction), self._photos.background, kernel=self._kernel)
        loss = settings.photo_weight * image_loss(shown.color, photo, settings.structure_weight)
        loss.backward()
        return float(loss.detach())

    def _step_rest(self, iteration: int) -> float:
        settings, total = self._settings, 0.0
        if self._projections is not None:
            index = shuffled(self._training, iteration, self._seed)
            current = self.parameters.activate()
            lines = radiograph(
                current, self._projections.detectors[index], kernel=self._kernel, cutoff_sigmas=settings.cutoff_sigmas
            )
            target = torch.from_numpy(self._projections.images[index] / np.float32(self._peak))
            image = lines / self._peak
            loss = settings.projection_weight * (
                l1(image, target) + settings.radiograph_structure_weight * d_ssim(image, target)
            )
            loss.backward()
            total += float(loss.detach())
            self._smooth(iteration)
        if settings.section_weight > 0:
            view = self._series.view(iteration)
            solid = train_only(self.parameters.activate(), "opacities")
            occupied = section(solid, view.plane, "occupancy", kernel=self._kernel)
            target = self._series.material(view)
            loss = settings.section_weight * image_loss(occupied, target, settings.structure_weight)
            if loss.requires_grad:
                loss.backward()
            total += float(loss.detach())
        return total

    def _smooth(self, iteration: int) -> None:
        settings = self._settings
        if settings.smooth_weight <= 0 or iteration % settings.smooth_every:
            return
        box, side = self._series.volume.box_mm, settings.smooth_voxels
        voxel = float(np.mean(self._series.volume.spacing_mm))
        rng = np.random.default_rng([self._seed, 3, iteration])
        origin = box[0] + rng.random(3) * np.maximum(box[1] - box[0] - side * voxel, 0) + 0.5 * voxel
        block = voxelize_block(self.parameters.activate(), origin, voxel, (side, side, side), settings.cutoff_sigmas)
        weight = settings.smooth_weight * settings.smooth_every / self.parameters.density_unit
        (weight * total_variation(block)).backward()

    def _pull_on_frame(self) -> np.ndarray:
        """Gradient (7,) of the photo's loss by the frame's turn (rad), log scale and shift (units of `unit_mm`).

        Moving the cameras by a similarity is moving all splats by its inverse; the means' gradient says what that
        does. The splats' own turn and size count in, their colour functions do not.
        """
        means = self.parameters.raw["means"].detach().numpy().astype(np.float64)
        by_means = self.parameters.gradient("means").astype(np.float64)
        quats = self.parameters.raw["quats"].detach().numpy().astype(np.float64)
        by_quats = self.parameters.gradient("quats").astype(np.float64)
        turn = np.cross(means, by_means).sum(axis=0)
        for axis in range(3):
            half = np.zeros(4)
            half[1 + axis] = 0.5
            turn[axis] += (multiply_quats(half, quats) * by_quats).sum()
        grow = (means * by_means).sum() + self.parameters.gradient("scales").astype(np.float64).sum()
        return -np.concatenate([turn, [grow], self._unit * by_means.sum(axis=0)])

    def _move_frame(self, gradient: np.ndarray, rate: float) -> None:
        if rate <= 0 or not np.isfinite(gradient).all():
            return
        steps = self.parameters.steps
        self._moments[0] = 0.9 * self._moments[0] + 0.1 * gradient
        self._moments[1] = 0.999 * self._moments[1] + 0.001 * gradient**2
        first, second = self._moments[0] / (1 - 0.9**steps), self._moments[1] / (1 - 0.999**steps)
        step = -rate * first / (np.sqrt(second) + 1e-15)
        self.correction = _small(step, self._unit).after(self.correction)

    def measure(self) -> float | None:
        """Mean PSNR in dB over the held-out photos."""
        return None

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {"parameters": self.parameters.state()}

    def restore(self, state: dict[str, Any]) -> None:
        """From a checkpoint."""
        self.parameters.restore(state["parameters"])

    def _rates(self, fraction: float) -> dict[str, float]:
        settings = self._settings
        color = settings.color_rate.at(fraction)
        return {
            "means": settings.means_rate.at(fraction) * self._unit,
            "quats": settings.rotation_rate.at(fraction),
            "scales": settings.scale_rate.at(fraction),
            "opacities": settings.opacity_rate.at(fraction),
            "sh_dc": color,
            "sh_rest": color / 20,
            "density": settings.density_rate.at(fraction),
        }


def _small(step: np.ndarray, unit_mm: float) -> Similarity:
    """The similarity of a turn vector (rad), a log scale and a shift in units of `unit_mm`, about the origin."""
    from scipy.spatial.transform import Rotation

    return Similarity(float(np.exp(step[3])), Rotation.from_rotvec(step[:3]).as_matrix(), unit_mm * step[4:])
