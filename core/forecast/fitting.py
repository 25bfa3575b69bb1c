"""What comparing held-out photos with a model takes where effects are learnt with it.

Each time the photo's own few numbers, its exposure or its motion, are fitted to it (`PhotoEffects.fitted`), which takes
as long as tens of steps of a training.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..effects import Effect
    from ..settings import Settings

FORWARD = 0.4
"""A view that is only drawn takes such a share of a training step on it."""


def learnt_effects(settings: Settings) -> tuple[Effect, ...]:
    """What a run is told to learn of photos besides the object: by a script, else by name. What else they show is not
    known before they are looked at.

    Raises:
        SettingError: the settings name effects that there are not.
    """
    given: tuple[Effect, ...] = settings.stages["surface"].rgb.effects
    if given or settings.effects == "none":
        return given
    from ..effect_names import PHOTO_EFFECTS
    from ..effects import EFFECTS
    from ..effects.request import parse_effects

    asked = parse_effects(settings.effects).on
    return tuple(EFFECTS[name]() for name in PHOTO_EFFECTS if name in asked and name in EFFECTS)


def steps_to_measure(effects: Sequence[Effect]) -> float:
    """How many training steps on a photo it takes to compare it, held out, with the model.

    Args:
        effects: that are fitted to it.
    """
    if not effects:
        return FORWARD
    from ..effects.imaging import FIT_STEPS

    return FIT_STEPS * max(effect.fit_share for effect in effects) + FORWARD * (1 + sum(one.tries for one in effects))
