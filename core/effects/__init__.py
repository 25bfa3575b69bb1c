"""Imaging effects of photos, learnt with the splats: what a capture does not show is not chosen and costs nothing.

`RgbSettings.effects` takes any of the settings `Defocus`, `Exposure`, `MotionBlur` and `RollingShutter`. A training
turns them into `PhotoEffects`, which draw each training photo as that camera saw it; the splats stay sharp and still.
"""

from collections.abc import Iterable

from ..errors import SettingError
from .defocus import Defocus
from .exposure import Exposure
from .imaging import Draw, Effect, Imaging, PhotoEffects
from .motion_blur import MotionBlur
from .rolling_shutter import RollingShutter

__all__ = [
    "EFFECTS",
    "Defocus",
    "Draw",
    "Effect",
    "Exposure",
    "Imaging",
    "MotionBlur",
    "PhotoEffects",
    "RollingShutter",
    "effects_named",
]

EFFECTS: dict[str, type[Defocus] | type[Exposure] | type[MotionBlur] | type[RollingShutter]] = {
    effect.name: effect for effect in (Defocus, Exposure, MotionBlur, RollingShutter)
}
"""Settings by name."""


def effects_named(names: Iterable[str]) -> tuple[Effect, ...]:
    """The effects of these names with their usual settings. Raises SettingError for one that does not exist."""
    chosen: list[Effect] = []
    for name in names:
        if name not in EFFECTS:
            raise SettingError(
                "effects: there is no effect '{name}'; choose {names}.", name=name, names=", ".join(EFFECTS)
            )
        chosen.append(EFFECTS[name]())
    return tuple(chosen)
