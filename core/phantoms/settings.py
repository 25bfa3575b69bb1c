"""How a phantom is photographed and X-rayed."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ..errors import SettingError

EFFECTS = {
    "noise": "counting noise of `photons` a detector pixel",
    "beam_hardening": "a tube's spectrum instead of one energy; the truth stays at the phantom's energy",
    "scatter": "a smooth background of scattered X-rays",
    "defocus": "a lens with an aperture: what is off the focus distance blurs",
    "lens": "a lens that bends lines like a barrel, and transforms.json does not say so; needs photos by rays",
    "rolling_shutter": "the camera moves while the rows of a photo are read out",
    "motion_blur": "the camera moves while the shutter is open",
    "moving_background": "the object turns, and the camera and a room behind it stand still; needs photos by rays",
    "exposure": "each photo is brighter or darker, and a little off in colour",
    "geometry": "the detector is off its place, turned, and shakes; the files do not say so",
    "motion": "the object slides and tips while it is X-rayed, and slips once; its truth is where it is on average",
    "focal_spot": "a wide focal spot, which blurs edges on the detector",
    "ring": "each detector pixel says a little more or less than it should",
    "truncation": "the detector is narrower than the object's shadow",
    "table": "photos on a table with a contact shadow, none from below; needs photos by Cycles",
}
"""What a capture can be made with, and what each does; off where it is not named."""


@dataclass(frozen=True)
class CaptureSettings:
    """How a phantom is photographed and X-rayed.

    Attributes:
        photos: number of photos.
        photo_width, photo_height: pixels.
        photo_quality: JPEG quality, 1 to 95.
        photos_by: "rays" (the ray caster built in) or "cycles" (Blender's renderer).
        samples: Cycles' rays a pixel, before its denoiser.
        projections: for training, evenly over the full circle.
        heldout_projections: at random angles, for measuring.
        detector_width, detector_height: pixels.
        effects: any of `EFFECTS`.
        photons: mean count of a detector pixel in air, which sets the noise.
        scatter_share: how much of what rays lose and could still get out is scattered onto the detector.
        aperture_share: diameter of the lens over the object's largest extent.
        lens_share: of "lens": how much farther from the middle a photo shows what a pinhole shows in its corner, over
            that distance; below zero for a barrel.
        shutter_share: how far the camera moves while one photo is read out, over the object's largest extent.
        blur_share: how far what the camera looks at moves across the image while the shutter is open, over the object's
            largest extent; of single photos half to one and a half times as much.
        exposure_stops: deviation of the photos' exposure; the colours' is a tenth of it.
        room_contrast: of "moving_background": standard deviation of the room's sRGB values.
        offset_px, tilt_degrees, jitter_px: of "geometry": how far the detector is to the right and down and turned in
            its plane, and the deviation of each projection's own place.
        drift_px: of "motion": how far the object has gone in the end, as large as it is seen by the detector; its rim
            turns as far.
        spot_px: standard deviation of the focal spot's shadow on the detector, of what is on the axis.
        ring_share: deviation of the detector pixels' gains.
        seen_share: of "truncation": how much of the shadow's width there are pixels for.
        voxel_mm: spacing of the reconstruction grid that the scanner suggests, and of the truth.
        table_mm: spacing of the tables that distances are read from; curves finer than a few of it are rounded.
        surface_mm: spacing of the truth's surface meshes; thin parts get a finer one.
        shells: of the matryoshka; None for its own number.
        landmarks: write landmarks.json, which points at the true places; None for objects of revolution alone.
        fdk: write fdk.npz, too, what the usual CT reconstruction makes of the training projections.
    """

    photos: int = 44
    photo_width: int = 192
    photo_height: int = 256
    photo_quality: int = 90
    photos_by: str = "rays"
    samples: int = 32
    projections: int = 50
    heldout_projections: int = 6
    detector_width: int = 120
    detector_height: int = 148
    effects: tuple[str, ...] = ("noise",)
    photons: float = 50_000.0
    scatter_share: float = 0.3
    aperture_share: float = 0.25
    lens_share: float = -0.08
    shutter_share: float = 0.06
    blur_share: float = 0.02
    exposure_stops: float = 0.3
    room_contrast: float = 0.1
    offset_px: tuple[float, float] = (1.3, 0.4)
    tilt_degrees: float = 0.4
    jitter_px: float = 0.3
    drift_px: float = 2.0
    spot_px: float = 1.5
    ring_share: float = 0.01
    seen_share: float = 0.7
    voxel_mm: float = 0.75
    table_mm: float = 0.4
    surface_mm: float = 1.0
    shells: int | None = None
    landmarks: bool | None = None
    fdk: bool = False

    def check(self) -> None:
        """Raises SettingError, which names the first setting that is out of range or does not fit the others."""
        counts = ("photos", "photo_width", "photo_height", "projections", "detector_width", "detector_height")
        for field in (*counts, "samples"):
            if getattr(self, field) < 1:
                raise SettingError(f"{field} is {getattr(self, field)}; give at least 1.")
        if self.heldout_projections < 0:
            raise SettingError(f"heldout_projections is {self.heldout_projections}; give 0 or more.")
        if not 1 <= self.photo_quality <= 95:
            raise SettingError(f"photo_quality is {self.photo_quality}; give 1 to 95.")
        lengths = ("voxel_mm", "table_mm", "surface_mm")
        shares = ("scatter_share", "aperture_share", "shutter_share", "blur_share", "exposure_stops", "spot_px")
        for field in ("photons", *shares, "ring_share", "room_contrast", *lengths):
            if not 0 < getattr(self, field) < math.inf:
                raise SettingError(f"{field} is {getattr(self, field)}; give a number above zero.")
        for value in (*self.offset_px, self.tilt_degrees, self.jitter_px, self.drift_px):
            if not math.isfinite(value):
                raise SettingError(f"offset_px, tilt_degrees, jitter_px or drift_px is {value}; give a number.")
        if not -0.12 <= self.lens_share <= 0.25:
            raise SettingError(f"lens_share is {self.lens_share}; give -0.12 to 0.25, or there are empty corners.")
        if not 0 < self.seen_share <= 1:
            raise SettingError(f"seen_share is {self.seen_share}; give a number above 0, at most 1.")
        if self.photos_by not in ("rays", "cycles"):
            raise SettingError(f"photos-by is '{self.photos_by}'; choose rays or cycles.")
        for effect in self.effects:
            if effect not in EFFECTS:
                raise SettingError(f"effect '{effect}' is not known; choose any of: {', '.join(EFFECTS)}.")
        if {"motion_blur", "rolling_shutter"} <= set(self.effects):
            raise SettingError(
                "effects motion_blur and rolling_shutter move the camera in two ways; leave one of them out."
            )
        if "lens" in self.effects and self.photos_by != "rays":
            raise SettingError("effect 'lens' needs --photos-by rays; leave it out, or choose rays.")
        if "moving_background" in self.effects:
            self._check_room()
        if "table" in self.effects and self.photos_by == "rays":
            raise SettingError("effect 'table' needs --photos-by cycles; leave it out, or choose cycles.")
        if self.shells is not None and not 1 <= self.shells <= 9:
            raise SettingError(f"shells is {self.shells}; give 1 to 9.")

    def _check_room(self) -> None:
        moving = sorted({"motion_blur", "rolling_shutter"} & set(self.effects))
        if moving:
            raise SettingError(
                f"effect moving_background needs a camera that stands still, and {moving[0]} moves it; leave one of "
                "them out."
            )
        if self.photos_by != "rays":
            raise SettingError("effect 'moving_background' needs --photos-by rays; leave it out, or choose rays.")
