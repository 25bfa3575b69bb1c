"""Joint refinement: one set of Gaussians on photos, projections and sections at once, the similarity with them.

After `align` both halves lie in one frame. From then on every splat has colour, opacity and density, whichever half it
came from: radiative splats learn to be seen and, if asked to, photo splats to attenuate (the idea of X-Splat, SIGGRAPH
Asia 2026). Without photos the projections are all there is.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from ...capture.model import Projections
from ...compiled import work_clock
from ...evaluate.heldout import projection_figures, some_held_out, some_of
from ...files import plain
from ...gaussians import GaussianSet, Modality
from ...progress import Tick, unstopped
from ...render import radiograph, section
from ...rotations import multiply_quats
from ...similarity import Similarity
from ...train.loop import Measured, Task, known, optimise
from ...train.losses import image_loss, projection_loss
from ...train.parameters import Parameters, ScaleLimits, Separate
from ...train.schedule import shuffled
from ...train.smoothness import block_variation
from ..context import StageContext
from ..fuse.finish import limit_display, seen_by_photos
from ..fuse.transfer import color_as_photos, fuse_sets
from ..measures import WITH_EFFECTS
from ..photo_series import PhotoSeries
from ..refine import train_only
from ..surface.stage import density_unit, smooth_share
from ..surface.xray import body_scale
from .joint_settings import JointSettings, joint_in_iterations, without_photos
from .targets import SectionSeries, unit_length

_GROUPS = ("means", "quats", "scales", "opacities", "sh_dc", "sh_rest", "density")
_RADIATED = ("means", "quats", "scales", "density")
# Share of the larger attenuations that a photo splat has before projections say more.
_FIRST_DENSITY = 1e-2
# What neither photos nor projections notice is dropped in the end.
_LEAST_OPACITY, _LEAST_DENSITY = 0.005, 1e-4


def join(rgb: GaussianSet, xray: GaussianSet, density: float) -> GaussianSet:
    """One numpy set: radiative splats first, then photo splats of this `density` in mm⁻¹."""
    born = replace(
        rgb,
        density=np.full(len(rgb), density, np.float32),
        modality=np.full(len(rgb), Modality.RGB, np.uint8),
    )
    return GaussianSet.concatenate([xray, born])


def refine_jointly(
    context: StageContext,
    settings: JointSettings,
    series: SectionSeries,
    photos: PhotoSeries | None,
    rgb: GaussianSet | None,
    xray: GaussianSet,
    first: float,
    last: float,
) -> tuple[GaussianSet, dict[str, Any]]:
    """One set of the aligned halves, fitted to photos, projections and sections together.

    Args:
        photos, rgb: photos to train on and the numpy set of their splats in mm; None for X-rays alone.
        xray: numpy set in mm, for photos with display opacities.
        first, last: the fractions of the stage that are done before and after.

    Returns:
        The set, radiative splats (modality XRAY) first and photo splats (modality RGB) after them, without those that
        neither photos nor projections see; and `losses`, `trained_with` (the settings, for as many iterations as there
        was time for), `xray_seconds` (of `seconds`, those of projections and sections), figures of training views
        `before` and `after`; with photos also `undecided` (the share of radiative splats whose display opacity is
        neither near 0 nor near 1), `correction` (a `Similarity` in the world frame by which the photo frame moved) and
        `moved` (how far).

    Raises:
        Cancelled: the user asked to stop; a checkpoint is kept.
    """
    projections, unit = context.projections, density_unit(context.run)
    if projections is None:
        raise AssertionError("only called where there are projections")
    if photos is None:
        settings = without_photos(settings)
    settings = replace(settings, smooth_weight=settings.smooth_weight * smooth_share(context.run))
    start, colored = _start(context, settings, photos, rgb, xray, unit)
    task = Task(
        "internal",
        "joint",
        settings.iterations,
        first=first,
        last=last,
        checkpoint=context.checkpoint("internal", "joint"),
        # What photos show besides the object takes long to fit to those that are held out.
        measures=WITH_EFFECTS["internal joint"] if photos is not None and photos.effects else 4,
        message="projections" if photos is None else "photos, projections and sections together",
        renderers=context.compiled("radiograph", *(() if photos is None else ("section", "splat"))),
    )
    task = context.paced(task)
    settings = joint_in_iterations(settings, task.iterations)
    trainer = JointTrainer(start, photos, projections, series, settings, unit, colored, context.seed, context.kernel)
    before = _figures(context, photos, projections, trainer)
    history = optimise(trainer, task, context.reporter)
    result = trainer.parameters.to_set()
    report = {**history, "before": before, "after": _figures(context, photos, projections, trainer)}
    report["trained_with"] = plain(settings)
    attenuates = result.density >= _LEAST_DENSITY * unit
    if photos is None:
        return result.select(attenuates), {**report, "xray_seconds": history["seconds"]}
    radiative = result.opacities[result.modality == Modality.XRAY]
    report |= {
        "xray_seconds": trainer.xray_seconds,
        "undecided": float(np.mean((radiative > 0.1) & (radiative < 0.9))) if len(radiative) else 0.0,
        "correction": trainer.correction,
        "moved": trainer.moved(),
    }
    return result.select(attenuates | (result.opacities >= _LEAST_OPACITY)), report


def _start(
    context: StageContext,
    settings: JointSettings,
    photos: PhotoSeries | None,
    rgb: GaussianSet | None,
    xray: GaussianSet,
    unit: float,
) -> tuple[GaussianSet, np.ndarray]:
    """The set to start from, and which splats (N,) have a colour to learn."""
    if photos is None or rgb is None:
        return xray, np.zeros(len(xray), bool)
    fusion = fuse_sets(rgb, xray)
    limited = limit_display(fusion.fused.select(slice(0, len(xray))), fusion.surface, settings.shown_at_surface)
    start = join(rgb, limited, _FIRST_DENSITY * unit if settings.photos_attenuate else 0.0)
    seen = seen_by_photos(start, photos, context.kernel, context.reporter.check)[: len(xray)]
    fusion = color_as_photos(fusion, seen)
    sh = start.sh.copy()
    sh[: len(xray)] = fusion.fused.sh[: len(xray)]
    return replace(start, sh=sh), np.concatenate([fusion.near_surface, np.ones(len(rgb), bool)])


def _figures(
    context: StageContext, photos: PhotoSeries | None, projections: Projections, trainer: JointTrainer
) -> dict[str, float | None]:
    """PSNR in dB on some training views of each kind."""
    current, tick = trainer.parameters.to_set(), context.reporter.check
    figures: dict[str, float | None] = {}
    if photos is not None:
        seen = current.transformed(trainer.correction.inverse())
        figures["training_photos_psnr"] = photos.measure_training(seen, context.kernel, tick)["psnr"]
    training = np.flatnonzero(~projections.held_out)
    some = training[some_of(len(training))]
    found = projection_figures(current, projections, context.kernel, tick, views=some)
    return {**figures, "training_projections_psnr": found["psnr"]}


class JointTrainer:
    """Fits one set to everything; see `core.train.loop.Trainer`.

    Args:
        start: numpy set in mm; see `join`.
        photos: with cameras in the world frame as `align` left them; None for X-rays alone.
        projections: those not held out are trained on.
        series: the volume's sections; display opacities follow their material.
        density_unit: mm⁻¹, the size of the object's larger attenuations.
        colored: (N,) bool, splats whose colours are learnt. What no photo sees would only pick up noise.

    Attributes:
        correction: of the photo frame, in the world: cameras are moved by it.
        xray_seconds: spent on projections and sections by `work_clock`, those before a break included.
    """

    def __init__(
        self,
        start: GaussianSet,
        photos: PhotoSeries | None,
        projections: Projections,
        series: SectionSeries,
        settings: JointSettings,
        density_unit: float,
        colored: np.ndarray,
        seed: int,
        kernel: str,
    ) -> None:
        self._photos, self._projections, self._series, self._settings = photos, projections, series, settings
        self._seed, self._kernel, self._hidden = seed, kernel, ~colored
        # Radiative splats come first. Photo splats that do not attenuate are not drawn in X-rays: what next to no
        # density has for a gradient would still move those that no photo holds.
        self._rows = int((np.asarray(start.modality) == Modality.XRAY).sum())
        self._attenuating = slice(0, len(start) if settings.photos_attenuate else self._rows)
        low, high = series.volume.box_mm
        self._pivot, self._unit = 0.5 * (low + high), unit_length(series.volume)
        self._training = np.flatnonzero(~projections.held_out).tolist()
        self._full_scale = body_scale(projections, self._training)
        # Photo splats of what lies behind the object may be larger than the X-rays' box.
        limits = ScaleLimits(1e-5 * self._unit, max(self._unit, float(np.max(start.scales, initial=0.0))))
        separate = Separate(self._rows, _RADIATED, settings.memory) if not settings.photos_shape_xray else None
        self.parameters = Parameters(start, _GROUPS, density_unit=density_unit, limits=limits, separate=separate)
        self.correction, self.xray_seconds, self._rest = Similarity(), 0.0, {"projection": 0.0, "section": 0.0}
        self._moments = np.zeros((2, 7))
        self._thinnest = max(limits.least, settings.least_pixels * projections.pixel_mm)
        self._keep_thickness()

    def __len__(self) -> int:
        return len(self.parameters)

    def step(self, iteration: int) -> float:
        """One photo, and where it is their turn one projection and one section, of what there is."""
        settings, fraction = self._settings, iteration / self._settings.iterations
        total, pull = 0.0, np.zeros(7)
        if self._photos is not None:
            total = self._step_photo(self._photos, iteration)
            pull = self._pull_on_frame()
        finite, started = True, work_clock()
        turn, pause = divmod(iteration, settings.xray_every)
        if not settings.photos_shape_xray:
            # Photos tell by the shape of radiative splats where the frame lies, but do not change that shape.
            for name in ("means", "quats", "scales"):
                self.parameters.gradient(name)[: self._rows] = 0.0
        if pause == 0:
            self._step_projection(turn)
            finite = self.parameters.step_separate(self._xray_rates(fraction))
        cut, left = divmod(iteration, settings.section_every)
        if fraction >= settings.section_until:
            self._rest["section"] = 0.0
        elif left == 0 and settings.section_weight > 0:
            self._step_section(cut)
        self.xray_seconds += work_clock() - started
        # In between, the last that was known: a curve of photos now and all then would jump.
        total += sum(self._rest.values())
        stepped = self.parameters.step(self._rates(fraction))
        if pause == 0 or settings.photos_shape_xray:
            self._keep_thickness()
        if stepped and self._photos is not None:
            self._move_frame(pull, settings.similarity_rate.at(fraction))
        return total if finite and stepped else float("nan")

    def _step_photo(self, photos: PhotoSeries, iteration: int) -> float:
        settings = self._settings
        index, camera, photo = photos.training(iteration)
        current = self.parameters.activate()
        shown = photos.draw_training(current, index, camera.transformed(self.correction), self._kernel)
        loss = settings.photo_weight * image_loss(shown.color, photo, settings.structure_weight)
        loss.backward()
        for name in ("sh_dc", "sh_rest"):
            self.parameters.gradient(name)[self._hidden] = 0.0
        return float(loss.detach())

    def _step_projection(self, turn: int) -> None:
        settings = self._settings
        index = shuffled(self._training, turn, self._seed)
        current = self.parameters.activate(harmonics=False).select(self._attenuating)
        detector, cutoff = self._projections.detectors[index], settings.ray_cutoff_sigmas or settings.cutoff_sigmas
        lines = radiograph(current, detector, kernel=self._kernel, cutoff_sigmas=cutoff)
        target = torch.from_numpy(self._projections.images[index] / np.float32(self._full_scale))
        loss = settings.projection_weight * projection_loss(
            lines / self._full_scale,
            target,
            settings.squares_weight,
            settings.radiograph_structure_weight,
            settings.straight_from,
            self._projections.noise,
            self._full_scale,
        )
        (settings.xray_every * loss).backward()
        self._note("projection", loss)
        self._smooth(turn)

    def _step_section(self, turn: int) -> None:
        settings = self._settings
        view = self._series.view(turn)
        solid = train_only(self.parameters.activate(harmonics=False), "opacities")
        occupied = section(solid, view.plane, "occupancy", self._kernel, settings.cutoff_sigmas)
        target = self._series.material(view)
        if self._photos is not None:
            # What the surface shows is the photos' to tell: there coarse radiative splats would be seen through fine
            # ones of photos. What pixels next to the skin have in common with it (D-SSIM) still pulls at it a little.
            decided = ~(self._series.skin(view) & (target > 0.5))
            target = torch.where(decided, target, occupied.detach())
        loss = settings.section_weight * image_loss(occupied, target, settings.structure_weight)
        (settings.section_every * loss).backward()
        self._note("section", loss)

    def _note(self, kind: str, loss: torch.Tensor) -> None:
        value = float(loss.detach())
        self._rest[kind] = value if np.isfinite(value) else self._rest[kind]

    def _keep_thickness(self) -> None:
        """Photo splats may be sheets; radiative ones that thin would be bright lines in a section."""
        scales = self.parameters.raw["scales"].detach().numpy()
        scales[: self._rows] = np.maximum(scales[: self._rows], np.log(self._thinnest))

    def _smooth(self, turn: int) -> None:
        settings = self._settings
        if settings.smooth_weight <= 0 or turn % settings.smooth_every:
            return
        weight = settings.smooth_weight * settings.smooth_every * settings.xray_every
        volume, rng = self._series.volume, np.random.default_rng([self._seed, 3, turn])
        voxel_mm, unit = float(np.mean(volume.spacing_mm)), self.parameters.density_unit
        current = self.parameters.activate(harmonics=False).select(self._attenuating)
        edge = None if settings.smooth_edge is None else settings.smooth_edge * unit
        cut = settings.smooth_voxels, settings.cutoff_sigmas
        rough = block_variation(current, volume.box_mm, voxel_mm, *cut, rng, edge)
        (weight / unit * rough).backward()

    def _pull_on_frame(self) -> np.ndarray:
        """Gradient (7,) of the photo's loss by the frame's turn (rad), log scale and shift (units of `unit_mm`).

        Moving the cameras by a similarity is moving all splats by its inverse; the means' gradient says what that
        does. The splats' own turn and size count in, their colour functions do not.
        """
        raw, gradient = self.parameters.raw, self.parameters.gradient
        by_means = gradient("means").astype(np.float64)
        # All that is asked of products of a splat's numbers and their gradients are sums over splats.
        means = (raw["means"].detach().numpy() - self._pivot).T @ by_means
        quats = raw["quats"].detach().numpy().astype(np.float64).T @ gradient("quats").astype(np.float64)
        turn = np.array([means[1, 2] - means[2, 1], means[2, 0] - means[0, 2], means[0, 1] - means[1, 0]])
        for axis, half in enumerate(0.5 * np.eye(4)[1:]):
            turn[axis] += (multiply_quats(half, np.eye(4)) * quats).sum()
        grow = np.trace(means) + gradient("scales").sum(dtype=np.float64)
        return -np.concatenate([turn, [grow], self._unit * by_means.sum(axis=0)])

    def _move_frame(self, gradient: np.ndarray, rate: float) -> None:
        if rate <= 0 or not np.isfinite(gradient).all():
            return
        steps = self.parameters.steps
        self._moments[0] = 0.9 * self._moments[0] + 0.1 * gradient
        self._moments[1] = 0.999 * self._moments[1] + 0.001 * gradient**2
        first, second = self._moments[0] / (1 - 0.9**steps), self._moments[1] / (1 - 0.999**steps)
        step = -rate * first / (np.sqrt(second) + 1e-15)
        if not self._settings.frame_grows:
            step[3] = 0.0
        self.correction = self._small(step).after(self.correction)

    def _small(self, step: np.ndarray) -> Similarity:
        """The similarity of a turn vector (rad), a log scale and a shift (7,), about the middle of the box."""
        turn, scale = Rotation.from_rotvec(step[:3]).as_matrix(), float(np.exp(step[3]))
        return Similarity(scale, turn, self._unit * step[4:] + self._pivot - scale * turn @ self._pivot)

    def moved(self) -> dict[str, float]:
        """How far the photo frame went: in turn, size and, at the middle of the box, place."""
        turn = Rotation.from_matrix(self.correction.rotation).magnitude()
        shift = float(np.linalg.norm(self.correction.apply(self._pivot) - self._pivot))
        return {"turn_deg": float(np.degrees(turn)), "scale": self.correction.scale, "shift_mm": shift}

    def measure(self, tick: Tick = unstopped) -> Measured:
        """Of held-out photos, if there are any, and projections."""
        current, found = self.parameters.to_set(), {}
        if self._photos is not None:
            seen = current.transformed(self.correction.inverse())
            found["photos"] = self._photos.measure_some(seen, self._kernel, tick)["psnr"]
        found["projections"] = projection_figures(
            current, self._projections, self._kernel, tick, views=some_held_out(self._projections)
        )["psnr"]
        return known(found)

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        frame = self.correction.to_json()
        kept = {name: torch.tensor(value, dtype=torch.float64) for name, value in frame.items()}
        return {
            "parameters": self.parameters.state(),
            "frame": kept,
            "moments": torch.from_numpy(self._moments.copy()),
            "xray_seconds": self.xray_seconds,
            "rest": dict(self._rest),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """From a checkpoint."""
        self.parameters.restore(state["parameters"])
        self.correction = Similarity.from_json({name: value.numpy() for name, value in state["frame"].items()})
        self._moments = state["moments"].numpy().copy()
        self.xray_seconds, self._rest = float(state["xray_seconds"]), dict(state["rest"])

    def _xray_rates(self, fraction: float) -> dict[str, float]:
        settings = self._settings
        return {
            "means": settings.xray_means_rate.at(fraction) * self._unit,
            "quats": settings.xray_rotation_rate.at(fraction),
            "scales": settings.xray_scale_rate.at(fraction),
            "density": settings.density_rate.at(fraction),
        }

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
