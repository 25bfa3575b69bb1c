"""Imaging effects of photos, learnt with the splats: what a capture does not show is not chosen and costs nothing.

`RgbSettings.effects` takes any of the settings `Defocus` and `RollingShutter`. A training turns them into
`PhotoEffects`, which draw each training photo as that camera saw it; the splats stay sharp and still.
"""

from .defocus import Defocus
from .imaging import Draw, Effect, Imaging, PhotoEffects
from .rolling_shutter import RollingShutter

__all__ = ["Defocus", "Draw", "Effect", "Imaging", "PhotoEffects", "RollingShutter"]
