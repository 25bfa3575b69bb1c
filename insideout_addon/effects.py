"""Effects that a run can look for, as the sidebar asks for them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from bpy.app.translations import pgettext_n as n_

from ..core.capture.layout import find_colmap, find_parts, find_transforms
from ..core.capture.projections import find_projections
from ..core.effect_names import NOT_TOGETHER, PHOTO_EFFECTS, XRAY_EFFECTS
from ..core.errors import CaptureError
from .remembered import remembered

if TYPE_CHECKING:
    from .properties import InsideOutSettings

EFFECT_TEXTS = {
    "moving_background": (
        n_("Room Behind a Turntable"),
        n_("The object stood on a turntable, and the room behind it stood still; it is taken out of the photos"),
    ),
    "lens": (
        n_("Distortion by the Lens"),
        n_("Photos whose cameras are given by a file that says nothing of a lens that bends straight lines"),
    ),
    "exposure": (n_("Exposure"), n_("Photos of different brightness and white balance")),
    "rolling_shutter": (n_("Rolling Shutter"), n_("Photos of a moving camera that reads one row after the other")),
    "defocus": (n_("Defocus"), n_("Photos with a shallow depth of field")),
    "motion_blur": (n_("Motion Blur"), n_("Photos of a camera, or an object, that moves while the shutter is open")),
    "pixel_integration": (n_("Pixel Area"), n_("Splats are averaged over each pixel of a photo; slower")),
    "truncation": (n_("Truncation"), n_("X-rays of an object that is wider than the detector")),
    "scatter": (n_("Scatter"), n_("X-rays that the object scatters onto the detector")),
    "focal_spot": (n_("Focal Spot"), n_("X-rays from a wide spot, whose half-shadows blur edges")),
    "beam_hardening": (n_("Beam Hardening"), n_("Thick parts seem less dense, for soft X-rays are lost first")),
    "motion": (n_("Motion"), n_("An object that moves slowly, or slips once, while it is X-rayed")),
    "geometry": (n_("Geometry"), n_("A detector that does not stand where the files say")),
    "ring": (n_("Rings"), n_("Detector pixels that answer unevenly, which makes rings in sections")),
    "noise": (n_("Noise"), n_("Too few photons: the noisier a pixel, the less it tells the model")),
}
"""Name and tooltip of each effect."""


@remembered
def possible_effects(capture: str) -> tuple[str, ...]:
    """The effects that a capture folder can have, by what lies in it; none is looked at, the engine does that.

    Args:
        capture: the folder, as an absolute path; "" for none yet, where all are possible.
    """
    if not capture:
        return PHOTO_EFFECTS + XRAY_EFFECTS
    try:
        photos, xray = find_parts(Path(capture))
        projections = None if xray is None else find_projections(xray)
        # A lens is looked for where cameras are given; it is found together with those that are not.
        places = () if photos is None else (photos, Path(capture))
        posed = any(find_transforms(place) or find_colmap(place) for place in places)
    except (OSError, CaptureError):
        # The engine says which file is one too many, or cannot be read, when it looks at the capture.
        return ()
    if photos is None:
        of_photos: tuple[str, ...] = ()
    else:
        of_photos = tuple(name for name in PHOTO_EFFECTS if posed or name != "lens")
    return of_photos + (() if projections is None else XRAY_EFFECTS)


def cannot_be_together(settings: InsideOutSettings, possible: Sequence[str]) -> bool:
    """Whether two effects are ticked that cannot be learned at once, of those that the capture can have."""
    ticked = {name for name in possible if getattr(settings.named_effects, name)}
    return any(ticked.issuperset(pair) for pair in NOT_TOGETHER)


def effects_request(settings: InsideOutSettings, capture: str) -> str:
    """What the settings ask for, as `--effects` of the command line has it; names that the capture cannot have, or
    none at all, ask for nothing.

    Args:
        capture: see `possible_effects`.
    """
    if settings.effects != "NAMED":
        return {"NONE": "none", "AUTO": "auto"}[settings.effects]
    return ",".join(name for name in possible_effects(capture) if getattr(settings.named_effects, name)) or "none"
