"""What a capture folder holds, read and checked: photos, projections, a volume, landmarks."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ..densities import PER_MM, Densities
from ..told import Told
from ..views import Camera, Detector
from ..volume import Volume


@dataclass(frozen=True)
class Finding:
    """One line of `insideout check`.

    Attributes:
        level: "info", "warning" or "error"; an error stops a run.
        subject: the file or folder it is about.
        message: what was found or what is wrong.
        advice: what to do about it; "" for info.
    """

    level: str
    subject: str
    message: Told
    advice: Told = Told("")


@dataclass(frozen=True)
class Lens:
    """The real, distorting lens that a photo was taken with, in pixels of the photo as stored or turned upright.

    Attributes:
        width, height: pixels that the other values belong to.
        fx, fy, cx, cy: as of Camera.
        coefficients: OpenCV's (k1, k2, p1, p2, k3, k4, k5, k6), or (k1, k2, k3, k4) of a fisheye.
        fisheye: OpenCV's equidistant fisheye model.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    coefficients: tuple[float, ...]
    fisheye: bool = False


@dataclass(frozen=True)
class Backdrop:
    """What stands still behind the object in all photos from one place, while the object turns before it.

    Attributes:
        path: an RGBA image in the pixels of the photos, before a lens is taken out; transparent where it is not known.
        color: RGB 0..1 that is shown instead.
        tolerance: largest difference of a channel in 0..1 that is still the background.
    """

    path: Path
    color: tuple[float, float, float]
    tolerance: float


@dataclass(frozen=True, eq=False)
class Photo:
    """One photo. `camera` is None until structure from motion has found it.

    Pixels are read on demand by `insideout.core.capture.photos.read_photo`, undistorted and turned upright, so
    that the pinhole `camera` fits.

    Attributes:
        lens: what the photo is undistorted with; None when its pixels are those of a pinhole already.
        upright: whether EXIF orientation is applied on reading; not so where known poses belong to stored pixels.
        backdrop: what is taken out from behind the object on reading; None for nothing.
    """

    path: Path
    camera: Camera | None
    held_out: bool = False
    lens: Lens | None = None
    upright: bool = True
    backdrop: Backdrop | None = None


@dataclass(frozen=True, eq=False)
class Photos:
    """All photos of a capture, in one frame of unknown similarity to the world.

    Attributes:
        points: (P, 3) sparse points in the photo frame, or None.
        colors: (P, 3) their colours, 0..1, or None.
    """

    photos: list[Photo]
    points: np.ndarray | None = None
    colors: np.ndarray | None = None

    @property
    def posed(self) -> bool:
        """Whether every photo has a camera."""
        return all(photo.camera is not None for photo in self.photos)


@dataclass(frozen=True)
class CountingNoise:
    """How well line integrals p are known that few photons were counted of: a variance of `per_photon`·eᵖ + `floor`, at
    most `most`.

    Attributes:
        per_photon: 1/N₀ of N₀ photons a pixel of air.
        floor: what is there whatever arrives.
        most: where hardly a photon gets through, a detector tells nearly the same of all rays.
        known: the deviation of line integrals that count as known; noisier ones weigh less in a fit
            (`core.train.losses.as_known`).
    """

    per_photon: float
    floor: float
    most: float
    known: float

    def of_means(self, pixels: float) -> CountingNoise:
        """Of the mean of so many pixels."""
        variances = {name: getattr(self, name) / pixels for name in ("per_photon", "floor", "most")}
        return replace(self, **variances)


@dataclass(frozen=True, eq=False)
class Projections:
    """X-ray projections as line integrals.

    Attributes:
        images: (M, height, width) float32 line integrals, no unit.
        detectors: M, in the world frame (mm).
        held_out: (M,) bool; those are for measuring only.
        angles_rad: (M,) gantry angles, for coverage and FDK.
        box_mm: (2, 3) the box that the object lies in.
        voxels: (nx, ny, nz) the scanner's own reconstruction grid in that box.
        source_to_axis_mm, source_to_detector_mm: DSO and DSD of a circular scan; None for free poses.
        beyond: of an object wider than the detector: how far an FDK may continue rows at either side, over their
            width; 0 where they end in air.
        noise: of pixels, where so few photons get through that a fit has to know; None elsewhere.
    """

    images: np.ndarray
    detectors: list[Detector]
    held_out: np.ndarray
    angles_rad: np.ndarray
    box_mm: np.ndarray
    voxels: tuple[int, int, int]
    source_to_axis_mm: float | None = None
    source_to_detector_mm: float | None = None
    beyond: float = 0.0
    noise: CountingNoise | None = None

    @property
    def pixel_mm(self) -> float:
        """What a detector pixel spans at the middle of the box: the mean of its sides, median over projections."""
        middle, spans = self.box_mm.mean(axis=0), []
        for detector in self.detectors:
            sides = np.linalg.norm([detector.u, detector.v], axis=1).mean()
            if not detector.parallel:
                source, normal = np.asarray(detector.source, np.float64), np.cross(detector.u, detector.v)
                sides *= abs((middle - source) @ normal) / abs((np.asarray(detector.center) - source) @ normal)
            spans.append(sides)
        return float(np.median(spans))

    def peak(self, indices: Iterable[int]) -> float:
        """The largest finite line integral of some projections: full scale; 1e-12 where all are empty."""
        images = (self.images[index] for index in indices)
        largest = (float(image.max(initial=0.0, where=np.isfinite(image))) for image in images)
        return max(1e-12, *largest, 0.0)

    def body(self, indices: Iterable[int]) -> float:
        """The mean line integral of some projections, each ray counted by its own line integral; 1e-12 where all are
        empty.

        What rays through most of an object measure: neither the air beside it nor the few rays through a screw, which
        hardly a photon gets through, tell much in it, while `peak` is theirs alone.
        """
        total = squares = 0.0
        for index in indices:
            lines = self.images[index]
            lines = np.maximum(lines[np.isfinite(lines)], 0).astype(np.float64)
            total, squares = total + float(lines.sum()), squares + float(np.square(lines).sum())
        return max(1e-12, squares / total) if total > 0 else 1e-12

    def in_blocks(self, block: int) -> Projections:
        """Projections whose pixels are means over blocks of `block` x `block` pixels; see `Detector.in_blocks`."""
        count, height, width = len(self.images), self.images.shape[1] // block, self.images.shape[2] // block
        used = self.images[:, : height * block, : width * block].reshape(count, height, block, width, block)
        detectors = [detector.in_blocks(block) for detector in self.detectors]
        noise = None if self.noise is None else self.noise.of_means(block * block)
        return replace(self, images=used.mean(axis=(2, 4), dtype=np.float32), detectors=detectors, noise=noise)


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Matching points, each (L, 3): in the photo frame and in the X-ray frame (mm)."""

    photo: np.ndarray
    xray: np.ndarray


@dataclass(frozen=True, eq=False)
class Capture:
    """A capture folder. Any of photos, projections and volume may be missing, not all.

    Attributes:
        path: the folder.
        digest: SHA-256 over names, sizes and contents of the files used: the same digest, the same capture. Landmarks
            do not count: they are picked in a run's own frame, which must still be there when they are.
        findings: what `insideout check` says.
        densities: what those of a model made of it are in: with projections in mm⁻¹, whatever the volume's are in.
        volume_densities: what the volume's own are in, while there is one.
    """

    path: Path
    photos: Photos | None = None
    projections: Projections | None = None
    volume: Volume | None = None
    landmarks: Landmarks | None = None
    digest: str = ""
    findings: list[Finding] = field(default_factory=list)
    densities: Densities = PER_MM
    volume_densities: Densities = PER_MM

    def volume_in_model(self) -> Volume | None:
        """The volume with the attenuation that a model has where both have the same Hounsfield units; as it is where
        water is the same in both, or not known."""
        own, in_model = self.volume_densities.water_per_mm, self.densities.water_per_mm
        if self.volume is None or own is None or in_model is None or own == in_model:
            return self.volume
        return replace(self.volume, values=self.volume.values * np.float32(in_model / own))

    @property
    def can_follow_volume(self) -> bool:
        """Whether a model's densities may be fitted to the volume's: those of grey values that fit no projections are
        of another scale than all that is fitted to those, and nobody knows which."""
        return self.volume is None or not self.volume_densities.relative or self.densities.relative

    @property
    def needs_fdk(self) -> bool:
        """Whether there is no volume but the FDK of the projections that sections can be measured against."""
        return self.projections is not None and (self.volume is None or not self.can_follow_volume)

    def photos_only(self) -> Capture:
        """The capture as if it had never been X-rayed; a run of it is not a run of the whole."""
        digest = f"{self.digest}, photos alone"
        alone = replace(self, projections=None, volume=None, landmarks=None, digest=digest)
        return replace(alone, densities=PER_MM, volume_densities=PER_MM)

    def xrays_only(self) -> Capture:
        """The capture as if it had never been photographed; a run of it is not a run of the whole."""
        return replace(self, photos=None, landmarks=None, digest=f"{self.digest}, X-rays alone")
