"""Does a user's volume show what the projections show: forward projections of it at a few angles beside them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..densities import PER_MM, Densities
from ..threshold import large_attenuation
from ..told import Told
from ..views import Detector
from ..volume import Volume
from .findings import info, warning
from .model import Finding, Projections
from .volumes import GREY_TO_PER_MM, VolumeFiles

_VIEWS = 4
_MOST_VOXELS = 64
_MOST_PIXELS = 48
_MOST_STEPS = 200

_LEAST_CORRELATION = 0.9
# Four views of a coarse copy tell a factor no better: streaks and truncation cost a few per cent, a wall thinner than
# its voxels one. What a file says of its water is more exact than that.
_TOLD_FACTOR = 1.05
# A unit that was taken wrongly costs more than water of another energy.
_MOST_FACTOR = 1.25
# A turn is worth a warning when it leaves less than this share of what the volume as it lies does not explain.
_CLEARLY_BETTER = 0.5


_FLIPS = [(x, y, z) for z in (False, True) for y in (False, True) for x in (False, True)]
_AS_IT_LIES = _FLIPS[0]


@dataclass(frozen=True)
class Agreement:
    """How well forward projections of a volume fit the measured ones.

    Attributes:
        correlation: Pearson's, over the pixels of all views compared.
        factor: what the volume is to be multiplied by to fit (least squares), in the orientation that fits best.
        flips: which of the volume's axes x, y, z are turned over in the orientation that fits best; two flips are
            half a turn about the third axis, one or three a mirror image.
        best: the correlation in that orientation.
    """

    correlation: float
    factor: float
    flips: tuple[bool, bool, bool]
    best: float

    @property
    def orientation(self) -> Told:
        """What has to be done to the volume for the best fit, "" for nothing."""
        axes = [axis for axis, flipped in zip("xyz", self.flips, strict=True) if flipped]
        if len(axes) == 2:
            return Told("turned by 180° about {axis}", axis=next(axis for axis in "xyz" if axis not in axes))
        if len(axes) == 1:
            return Told("mirrored along {axis}", axis=axes[0])
        return Told("mirrored along x and y and z") if axes else Told("")


def compare(volume: Volume, projections: Projections) -> Agreement | None:
    """Forward projects a coarse copy of the volume at four training angles, as it lies and turned or mirrored.

    Returns:
        None when no ray that measures anything meets the volume.
    """
    coarse = volume.averaged(_MOST_VOXELS)
    training = np.flatnonzero(~projections.held_out)
    some = training[np.unique(np.linspace(0, len(training), _VIEWS, endpoint=False).astype(int))]
    views = [_binned(projections.detectors[i], projections.images[i]) for i in some]
    measured = np.concatenate([image.ravel() for _, image in views]).astype(np.float64)
    rays = [_ray_samples(detector, coarse) for detector, _ in views]
    fits: dict[tuple[bool, bool, bool], tuple[float, float]] = {}
    for flips in _FLIPS:
        turned = _flipped(coarse, flips, volume.box_mm.mean(axis=0))
        projected = np.concatenate([_line_integrals(turned, *samples) for samples in rays])
        if projected.std() == 0 or measured.std() == 0:
            return None
        correlation = float(np.corrcoef(projected, measured)[0, 1])
        fits[flips] = correlation, float(projected @ measured / (projected @ projected))
    as_it_lies = fits[_AS_IT_LIES][0]
    best = max(fits, key=lambda flips: fits[flips][0])
    # Half of what is unexplained: of two orientations that fit alike, the one on disk is right.
    if 1 - fits[best][0] > _CLEARLY_BETTER * (1 - as_it_lies):
        best = _AS_IT_LIES
    return Agreement(as_it_lies, fits[best][1], best, fits[best][0])


def match_projections(source: Path, read: VolumeFiles, projections: Projections) -> VolumeFiles:
    """What was read, with what the projections say about it.

    A volume without a unit is scaled to fit the projections. One whose unit is known is never changed, and none is
    ever turned: the user is told. But a model is fitted to the projections, so that its densities are in mm⁻¹ even
    where the volume's stay relative, and water of a volume in Hounsfield units is in it what the projections show.
    """
    read = replace(read, of_model=Densities(water_per_mm=read.densities.water_per_mm))
    found = compare(read.volume, projections)
    if found is None:
        missed = warning(source, "no ray of the projections meets the volume", "check its voxel size and position")
        return _unmatched(replace(read, findings=[*read.findings, missed]))
    read = replace(read, findings=[*read.findings, _fit_finding(source, found)])
    if found.best < _LEAST_CORRELATION or found.factor <= 0:
        return _unmatched(read)
    if not read.unit_known:
        volume = replace(read.volume, values=read.volume.values * np.float32(found.factor))
        meaning = info(source, "the volume has no unit; it was scaled to mm⁻¹ so that it fits the projections")
        return replace(read, volume=volume, meaning=meaning, densities=PER_MM)
    if not 1 / _MOST_FACTOR < found.factor < _MOST_FACTOR:
        read.findings.append(
            warning(
                source,
                "the projections show {factor:.3g} times the volume's attenuation",
                "check the volume's unit (or mu_water_per_mm) and the projections' flat field",
                factor=found.factor,
            )
        )
    water = read.densities.water_per_mm
    if water is None or 1 / _TOLD_FACTOR < found.factor < _TOLD_FACTOR:
        return read
    shown = info(
        source,
        "water has {water:.3g} mm⁻¹ in the model, {factor:.3g} times the volume's, as the projections show it",
        water=water * found.factor,
        factor=found.factor,
    )
    of_model = Densities(water_per_mm=water * found.factor)
    return replace(read, findings=[*read.findings, shown], of_model=of_model)


def _unmatched(read: VolumeFiles) -> VolumeFiles:
    """Of a volume that projections say nothing about. Without a unit it is as good as grey values, whose densities are
    relative; those of the model do not follow them (`Capture.can_follow_volume`) and are not."""
    if read.unit_known:
        return read
    volume = read.volume
    if not read.densities.relative:
        # Fractions that were guessed to be mm⁻¹, but may as well be shares of the brightest grey.
        scale = np.float32(GREY_TO_PER_MM / large_attenuation(volume.values))
        volume = replace(volume, values=volume.values * scale)
    message = Told(
        "has gray values without a unit, and fits the projections too badly to be scaled to mm⁻¹; the model's "
        "densities are those of the projections"
    )
    meaning = replace(read.meaning, message=message)
    return replace(read, volume=volume, meaning=meaning, densities=Densities(relative=True))


def _fit_finding(source: Path, found: Agreement) -> Finding:
    told = Told(
        "forward projected, the volume correlates with the projections by {correlation:.3f}",
        correlation=found.correlation,
    )
    if found.orientation:
        mirrored = sum(found.flips) != 2
        return warning(
            source,
            "{told}; {orientation} it would by {best:.3f}",
            "mirror the volume, or turn the projections' rows over if those are upside down, and save it again"
            if mirrored
            else "turn the volume and save it again",
            told=told,
            orientation=found.orientation,
            best=found.best,
        )
    if found.correlation < _LEAST_CORRELATION:
        return warning(source, "{told}", "check that it is the same scan, its voxel size and its position", told=told)
    return info(source, "{told}, its attenuation times {factor:.3g}", told=told, factor=found.factor)


def _flipped(volume: Volume, flips: tuple[bool, bool, bool], middle: np.ndarray) -> Volume:
    """The volume with axes x, y, z turned over about a point."""
    values = np.flip(volume.values, tuple(2 - axis for axis in range(3) if flips[axis]))
    last = volume.origin_mm + (np.array(volume.values.shape[::-1]) - 1) * volume.spacing_mm
    return Volume(values, volume.spacing_mm, np.where(flips, 2 * middle - last, volume.origin_mm))


def _binned(detector: Detector, image: np.ndarray) -> tuple[Detector, np.ndarray]:
    """The projection on at most 48 pixels a side, each the mean of a block; what is left over is cut."""
    size = -(-max(image.shape) // _MOST_PIXELS)
    if size == 1:
        return detector, image
    height, width = (max(n // size, 1) for n in image.shape)
    used = image[: height * size, : width * size]
    rows, columns = used.shape
    u, v = np.asarray(detector.u, np.float64), np.asarray(detector.v, np.float64)
    middle = detector.center + 0.5 * (columns - detector.width) * u + 0.5 * (rows - detector.height) * v
    blocks = used.reshape(height, rows // height, width, columns // width)
    smaller = replace(
        detector, width=width, height=height, center=middle, u=u * (columns // width), v=v * (rows // height)
    )
    return smaller, blocks.mean(axis=(1, 3))


def _ray_samples(detector: Detector, volume: Volume) -> tuple[np.ndarray, float]:
    """Points (pixels, steps, 3) about a voxel apart on rays through the ball around the volume, and their distance."""
    origins, directions = (part.reshape(-1, 3) for part in detector.rays())
    low, high = volume.box_mm
    middle, radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
    step = max(float(np.min(volume.spacing_mm)), 2 * radius / _MOST_STEPS)
    nearest = ((middle - origins) * directions).sum(axis=1)
    along = np.arange(-radius, radius + step, step)
    return origins[:, None] + (nearest[:, None] + along)[..., None] * directions[:, None], step


def _line_integrals(volume: Volume, points: np.ndarray, step: float) -> np.ndarray:
    """(pixels,) sums over points (pixels, steps, 3) along the rays. Many times faster than `Volume.sample`."""
    from scipy.ndimage import map_coordinates

    index = ((points - volume.origin_mm) / volume.spacing_mm).astype(np.float32)
    return step * map_coordinates(volume.values, np.moveaxis(index[..., ::-1], -1, 0), order=1).sum(axis=1)
