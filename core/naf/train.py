"""NAF's training: random rays of one projection a step, mean squared error of their line integrals."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..capture.model import Projections
from ..errors import SettingError
from ..evaluate.heldout import projection_peak, some_held_out
from ..evaluate.metrics import psnr
from ..progress import Reporter, Tick, unstopped
from ..train.loop import Measured, Task, known, optimise
from ..train.schedule import shuffled
from ..views import Detector
from ..volume import Volume
from .field import Field
from .hash_grid import HashGrid
from .rays import across_box, pixel_rays

_MEASURED_RAYS = 1024
# The logistic function's ends are never reached.
_LOWEST, _HIGHEST = 1e-4, 0.5
_POINTS_AT_ONCE = 1 << 18


@dataclass(frozen=True)
class NafSettings:
    """As NAF's code has it for 50 projections; `iterations` there is 1500 times the number of projections.

    Attributes:
        iterations: steps, one projection each.
        rays: a step, of pixels whose rays meet the box.
        samples: a ray; NAF takes 192 to 576.
        rate: Adam's.
        grid: the encoding.
        layers, hidden, skips: of the network, see `Field`.
        headroom: the sigmoid's 1 stands for this times the attenuation that the trainer is given.
        begins_at_mean: the field begins at the mean attenuation that projections tell of the box, not at half of that
            1, as NAF's does. Where a little metal sets the scale, half of it is a block of metal, bold steps away from
            that overshoot to nothing, and there the sigmoid has next to no gradient: of a skull on a steel rod nothing
            was found.
    """

    iterations: int = 75_000
    rays: int = 1024
    samples: int = 192
    rate: float = 1e-3
    grid: HashGrid = field(default_factory=HashGrid)
    layers: int = 4
    hidden: int = 32
    skips: tuple[int, ...] = (2,)
    headroom: float = 1.5
    begins_at_mean: bool = False

    def __post_init__(self) -> None:
        for name in ("iterations", "rays", "samples", "hidden"):
            if getattr(self, name) < 1:
                raise SettingError(f"{name} of NAF is {getattr(self, name)}; give 1 or more.")
        if self.layers < 2:
            raise SettingError(f"layers of NAF is {self.layers}; give 2 or more.")


BRIEF = NafSettings(rays=256, samples=96, rate=5e-3, begins_at_mean=True)
"""For minutes on a few cores instead of hours on a GPU: the published field, smaller and bolder steps.

In 25 s of one core, on 50 projections of 64² pixels of the Shepp-Logan head, it reached 31.8 dB on held-out projections
in 262 steps from half of the scale; the published steps made 45 and had hardly begun (0.2 dB).
"""


class NafTrainer:
    """Fits a field to projections; see `core.train.loop.Trainer`.

    The box becomes the unit cube. NAF's samples are stratified, one at random in each of equal parts of a ray's way
    through the box; each counts for its part, so that the sum has no bias (NAF weighs a sample by the way to the
    next).

    Args:
        projections: those that are not held out are trained on.
        attenuation: mm⁻¹, the size of the object's larger attenuations.
        settings: see there.
        seed: of the field's first numbers and of the rays.

    Raises:
        SettingError: an attenuation that is not above 0.
    """

    def __init__(self, projections: Projections, attenuation: float, settings: NafSettings, seed: int) -> None:
        if not attenuation > 0:
            raise SettingError(f"the attenuation NAF counts in is {attenuation}; give mm⁻¹ above 0.")
        self._projections, self._settings, self._seed = projections, settings, seed
        self.field = Field(settings.grid, settings.layers, settings.hidden, settings.skips, seed)
        self.training = np.flatnonzero(~projections.held_out)
        self._low, high = np.asarray(projections.box_mm, np.float64)
        self._sides = high - self._low
        self._scale = settings.headroom * attenuation
        # Of σ of the whole field over the box's longest side, so that errors have the size they have in NAF.
        self._full = self._scale * float(self._sides.max())
        self._pixels = {int(index): self._across(int(index)) for index in self.training}
        if settings.begins_at_mean:
            self.field.begin_at(float(np.clip(self._mean() / self._scale, _LOWEST, _HIGHEST)))

    def __len__(self) -> int:
        """A field has no splats."""
        return 0

    def step(self, iteration: int) -> float:
        """Rays of one projection."""
        rng = np.random.default_rng([self._seed, 29, iteration])
        index = self._choose(iteration)
        pixels = self._pixels[index]
        pixels = rng.choice(pixels, min(self._settings.rays, len(pixels)), replace=False)
        places = rng.random((len(pixels), self._settings.samples))
        found = self._integrals(self._projections.detectors[index], pixels, places)
        wanted = torch.from_numpy(self._projections.images[index].ravel()[pixels] / np.float32(self._full))
        loss = ((found - wanted) ** 2).mean()
        loss.backward()
        return float(loss.detach()) if self.field.step(self._settings.rate) else float("nan")

    def measure(self, tick: Tick = unstopped) -> Measured:
        """Of some held-out projections, up to 1024 pixels each, spread over the image."""
        peak, values = projection_peak(self._projections), []
        for index in some_held_out(self._projections):
            tick()
            wanted = self._projections.images[index].ravel()
            pixels = np.unique(np.linspace(0, wanted.size - 1, _MEASURED_RAYS).astype(np.int64))
            values.append(psnr(self._line_integrals(int(index), pixels), wanted[pixels], peak))
        return known({"projections": float(np.mean(values)) if values else None})

    def volume(self, reporter: Reporter | None = None, at_centers: bool = False) -> Volume:
        """The field on the voxels of the capture's own grid, mm⁻¹: averages (of 2 x 2 x 2 points in each), or the
        values at their centres."""
        counts, fine = np.array(self._projections.voxels), 1 if at_centers else 2
        spacing = self._sides / counts
        found = Volume(np.zeros(counts[::-1], np.float32), spacing, self._low + 0.5 * spacing)
        x, y, z = ((np.arange(fine * count) + 0.5) / (fine * count) for count in counts)
        for index, layer in enumerate(found.values):
            if reporter is not None:
                reporter.check()
            heights = z[fine * index : fine * (index + 1)]
            points = np.stack(np.broadcast_arrays(x, y[:, None], heights[:, None, None]), axis=-1)
            values = self._values(points.reshape(-1, 3)).reshape(fine, counts[1], fine, counts[0], fine)
            layer[:] = self._scale * values.mean(axis=(0, 2, 4))
        return found

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return self.field.state()

    def restore(self, state: dict[str, Any]) -> None:
        """From a checkpoint."""
        self.field.restore(state)

    def _integrals(self, detector: Detector, pixels: np.ndarray, places: np.ndarray) -> torch.Tensor:
        """(R,) Σσδ over the longest side; `places` (R, S) in 0..1 say where in its part of the ray a sample lies."""
        origins, directions = pixel_rays(detector, pixels)
        near, far = across_box(origins, directions, self._projections.box_mm)
        part = (far - near) / places.shape[1]
        distances = near[:, None] + part[:, None] * (np.arange(places.shape[1]) + places)
        points = origins[:, None] + distances[..., None] * directions[:, None]
        unit = ((points - self._low) / self._sides).reshape(-1, 3).astype(np.float32)
        values = self.field(torch.from_numpy(unit)).reshape(places.shape)
        return values.sum(dim=1) * torch.from_numpy((part / self._sides.max()).astype(np.float32))

    def _line_integrals(self, index: int, pixels: np.ndarray) -> np.ndarray:
        samples = self._settings.samples
        found = np.zeros(len(pixels), np.float32)
        at_once = max(1, _POINTS_AT_ONCE // samples)
        for first in range(0, len(pixels), at_once):
            some = pixels[first : first + at_once]
            with torch.no_grad():
                sums = self._integrals(
                    self._projections.detectors[index], some, np.full((len(some), samples), 0.5)
                ).numpy()
            found[first : first + at_once] = np.float32(self._full) * sums
        return found

    def _values(self, points: np.ndarray) -> np.ndarray:
        parts = [points[i : i + _POINTS_AT_ONCE] for i in range(0, len(points), _POINTS_AT_ONCE)]
        with torch.no_grad():
            return np.concatenate([self.field(torch.from_numpy(part.astype(np.float32))).numpy() for part in parts])

    def _across(self, index: int) -> np.ndarray:
        """Pixels (K,) whose rays meet the box.

        NAF leaves out those that are not above 0. Where air has no noise it would then learn nothing of it.
        """
        image = self._projections.images[index].ravel()
        near, far = across_box(
            *pixel_rays(self._projections.detectors[index], np.arange(image.size)), self._projections.box_mm
        )
        return np.flatnonzero((far > near) & np.isfinite(image))

    def _mean(self) -> float:
        """mm⁻¹ along all rays of the training projections through the box."""
        integrals = ways = 0.0
        for index, pixels in self._pixels.items():
            near, far = across_box(*pixel_rays(self._projections.detectors[index], pixels), self._projections.box_mm)
            integrals += float(self._projections.images[index].ravel()[pixels].sum(dtype=np.float64))
            ways += float((far - near).sum())
        return integrals / max(ways, 1e-12)

    def _choose(self, iteration: int) -> int:
        return int(shuffled(self.training, iteration, self._seed, 2))


def naf(
    projections: Projections,
    attenuation: float,
    settings: NafSettings | None = None,
    seed: int = 0,
    reporter: Reporter | None = None,
    checkpoint: Path | None = None,
    at_centers: bool = False,
) -> tuple[Volume, dict[str, Any]]:
    """The volume that NAF finds in projections, and how it went (`train.loop.optimise`).

    Args:
        projections, attenuation: see `NafTrainer`.
        checkpoint: file to go on from, as bits; 200 MB at the default settings. None for none.
        at_centers: see `NafTrainer.volume`.

    Raises:
        SettingError: a setting out of range.
        Cancelled: through `reporter`; the checkpoint is kept.
    """
    settings, reporter = settings or NafSettings(), reporter or Reporter()
    trainer = NafTrainer(projections, attenuation, settings, seed)
    task = Task("surface", "naf", settings.iterations, checkpoint=checkpoint)
    history = optimise(trainer, task, reporter)
    return trainer.volume(reporter, at_centers), history
