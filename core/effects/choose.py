"""Looking for the effects that a user asks for, and what is made of those that are needed."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

from ..capture.model import Photos, Projections
from ..effect_names import BEFORE_CAMERAS, BEFORE_SPLATS, NOT_LEARNT, NOT_TOGETHER, PHOTO_EFFECTS, TOLD, XRAY_EFFECTS
from ..progress import Tick, unstopped
from ..told import Told
from .finding import EffectFinding, say, unsay
from .photos import PhotoEvidence
from .rays import RayEvidence
from .request import Request

if TYPE_CHECKING:
    from .moving_background import BareEvidence

ASKED = Told("It is used because you asked for it.")
_NOTHING = Told("There is nothing to take out.")
_UNMEASURED = Told("It is not used: it could not be measured.")
_OTHERS_GIVEN = Told("It is not used: the script gives the effects to learn itself.")
# Matches are lost where photos are bent: what the first points tell is not all.
_LENS_ROUNDS, _LENS_SETTLED_PX = 4, 0.05
_MEASURED = ("found", "strength", "unit", "threshold", "error")


@dataclass
class Choice:
    """What was looked for and what is used.

    Attributes:
        rows: one for each effect that was looked for or asked for, as `report.json` has it: name, half ("photos" or
            "xray"), found, used, chosen_by ("auto" or "user"), strength, unit, threshold, error, reason, seconds; where
            it was tried, gain_db and, of photos, times_as_long (`core.stages.effect_gains`). "told" is the reason's
            sentences as `core.told.Told.to_json`.
        numbers: what each effect of X-rays in use works with, by its name.
        without: the projections that were looked at, at full size, without those effects; None where they were not
            kept.
    """

    rows: list[dict[str, Any]] = field(default_factory=list)
    numbers: dict[str, Mapping[str, Any]] = field(default_factory=dict)
    without: Projections | None = None

    def add(self, found: EffectFinding, request: Request, seconds: float) -> bool:
        """Notes a finding; whether its effect is used."""
        asked = found.name in request.on
        half = "photos" if found.name in PHOTO_EFFECTS else "xray"
        # What is learnt needs no numbers; what is taken out does.
        used = (found.found is True or asked) and (half == "photos" or bool(found.numbers))
        measured = {name: getattr(found, name) for name in _MEASURED}
        row = {"name": found.name, "half": half, **measured, "used": used, "chosen_by": "user" if asked else "auto"}
        row |= {"reason": str(found.reason), "told": [found.reason.to_json()], "seconds": seconds}
        if asked and not found.found:
            say(row, ASKED if used else _why_not(found.found))
        self.rows.append(row)
        if used and half == "xray":
            self.numbers[found.name] = found.numbers
        return used


def effect_module(name: str) -> ModuleType:
    """The module of an effect that is looked for; of X-rays nothing of the others is loaded."""
    return import_module(f".{name}", __package__)


def look_at_rays(request: Request, evidence: RayEvidence) -> Choice:
    """Looks for effects of X-rays, each in projections from which those before are taken out.

    Raises:
        CaptureError: the projections cannot be reconstructed.
        Cancelled: through the evidence's reporter.
    """
    choice = Choice()
    for name in filter(request.wants, XRAY_EFFECTS):
        evidence.reporter.check()
        started, module = time.monotonic(), effect_module(name)
        found = module.detect(evidence)
        if choice.add(found, request, time.monotonic() - started):
            evidence = evidence.after(module.corrected(evidence.projections, found.numbers, evidence.reporter.check))
    # Sharpening a large scan takes minutes: whoever goes on with it need not do that again.
    choice.without = evidence.projections
    return choice


def look_at_background(request: Request, evidence: BareEvidence, folder: Path) -> tuple[Choice, Photos]:
    """Looks for a background that stands still, and takes it out where it is needed or asked for.

    Args:
        folder: where the backdrops are left.

    Returns:
        What was found, and the photos: those that were given, or with backdrops.

    Raises:
        CaptureError: a photo cannot be read.
        DiskFullError, RunFolderError: the folder cannot be written.
        Cancelled: through the evidence's tick.
    """
    from . import moving_background

    choice, started = Choice(), time.monotonic()
    used = choice.add(moving_background.detect(evidence), request, 0.0)
    row, photos = choice.rows[0], evidence.photos
    if used and row["strength"] is None:
        # What is plain is left as it is.
        leave(row, _why_not(row["found"]))
    elif used:
        taken = moving_background.taken_out(evidence, folder)
        if isinstance(taken, moving_background.Left):
            leave(row, taken.reason)
            row["found"] = None if taken.unsure else row["found"]
        else:
            out = len(photos.photos) - len(taken.photos)
            if out:
                told = "Left out, before another background: {out} of {count} photos."
                say(row, Told(told, out=out, count=len(photos.photos)))
            photos = taken
    row["seconds"] = time.monotonic() - started
    return choice, photos


def look_at_lens(
    request: Request, evidence: PhotoEvidence, again: Callable[[Photos], Path | None]
) -> tuple[Choice, Photos]:
    """Looks for a lens that the cameras' files do not tell, and takes it out where it is needed or asked for.

    Points are looked for anew in photos from which what was found is taken out, and tell the rest, until nothing
    changes: so a lens so strong that few points survive it is found, too.

    Args:
        evidence: of the photos with the cameras that were given.
        again: the folder of a model of points of the photos that it is given; None where there are none.

    Returns:
        What was found, and the photos: those that were given, or with lenses and without points.

    Raises:
        Cancelled: through the evidence's tick, or by `again`.
    """
    from . import lens

    choice, started, photos = Choice(), time.monotonic(), evidence.photos
    found = lens.look(evidence)
    for _ in range(_LENS_ROUNDS):
        if not found.more:
            break
        before = found.numbers
        model = again(replace(photos, photos=lens.taken_out(evidence.training, before), points=None, colors=None))
        if model is None:
            break
        found = lens.look(replace(evidence, model=model), before)
        changed = lens.apart(evidence.training, before, found.numbers, evidence.long_side)
        if changed <= max(_LENS_SETTLED_PX, found.finding.error or 0.0):
            break
    used, numbers = choice.add(found.finding, request, 0.0), found.numbers
    row = choice.rows[0]
    if used and not numbers:
        leave(row, _why_not(row["found"]))
    elif used:
        photos = replace(photos, photos=lens.taken_out(photos.photos, numbers), points=None, colors=None)
    row["seconds"] = time.monotonic() - started
    return choice, photos


def look_at_photos(request: Request, evidence: PhotoEvidence, given: bool = False) -> Choice:
    """Looks for effects of photos whose cameras are known.

    Args:
        given: whether a script gives the effects to learn itself, whatever is found: none of these is then used.

    Raises:
        CaptureError: a photo cannot be read.
        Cancelled: through the evidence's tick.
    """
    choice = Choice()
    for name in filter(request.wants, PHOTO_EFFECTS):
        if name in BEFORE_CAMERAS + BEFORE_SPLATS:
            continue
        evidence.tick()
        started = time.monotonic()
        choice.add(effect_module(name).detect(evidence), request, time.monotonic() - started)
    if not given:
        _part(choice.rows)
    # How photos are rendered is no effect that is learnt.
    for row in choice.rows if given else []:
        if row["used"] and row["name"] not in NOT_LEARNT:
            leave(row, _OTHERS_GIVEN)
    return choice


def _why_not(found: bool | None) -> Told:
    """Why an effect that was asked for is not used, by what was found of it."""
    return _UNMEASURED if found is None else _NOTHING


def leave(row: dict[str, Any], why: Told) -> None:
    """Notes that an effect which was to be used is not, after all, and why."""
    row["used"] = False
    unsay(row, ASKED)
    say(row, why)


def _part(rows: list[dict[str, Any]]) -> None:
    """Of effects that cannot be learned at once, those that the user asks for stay in use, else the first of a pair."""
    used = {row["name"]: row for row in rows if row["used"]}
    for first in sorted({first for first, _ in NOT_TOGETHER} & used.keys()):
        others = [name for name in used if (first, name) in NOT_TOGETHER]
        asked = [name for name in others if used[name]["chosen_by"] == "user"]
        kept, left = (asked[0], [first]) if asked else (first, others)
        for name in left:
            leave(used[name], Told("It is not used: {other} is, and not both can be.", other=TOLD[kept]))


def without_effects(
    projections: Projections, numbers: Mapping[str, Mapping[str, Any]], tick: Tick = unstopped
) -> Projections:
    """The projections with all effects in use taken out that can be; themselves where there are none.

    Args:
        numbers: of `Choice`.
        tick: called now and then; may raise to stop.
    """
    for name in XRAY_EFFECTS:
        if name in numbers:
            projections = effect_module(name).corrected(projections, numbers[name], tick)
    return projections


def flat(numbers: Mapping[str, Mapping[str, Any]]) -> dict[str, np.ndarray]:
    """All numbers as arrays under "effect.name", for an archive."""
    return {f"{effect}.{name}": np.asarray(value) for effect, held in numbers.items() for name, value in held.items()}


def unflat(arrays: Mapping[str, np.ndarray], used: Sequence[str]) -> dict[str, dict[str, Any]]:
    """What `flat` was made of; single numbers come back as Python's own.

    Args:
        used: the names of the effects; one that works without numbers is in no array.
    """
    found: dict[str, dict[str, Any]] = {name: {} for name in used}
    for key, value in arrays.items():
        effect, name = key.split(".", 1)
        found[effect][name] = value if value.ndim else value.item()
    return found
