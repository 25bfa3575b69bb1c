"""A run that ends in a given time: what is left of it is fitted into what is left of the time, part by part."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace

from ..errors import SettingError

# What is aimed at, of the time: forecasts err, and nobody minds a run that is done a little early.
_AIM = 0.95
# Parts whose steps can be fewer or more.
_SCALES = (
    "surface rgb",
    "surface xray",
    "internal xray",
    "internal rgb",
    "internal display",
    "internal joint",
    "fuse finish",
)
# Steps are never fewer or more than these shares of a preset's.
_LEAST, _MOST = 0.02, 4.0
# A forecast that seems to err by more than this factor was disturbed, and the rest is not expected to be.
_ODD = 3.0
_DURATION = re.compile(r"(?:(\d+(?:\.\d+)?)h)?(?:(\d+(?:\.\d+)?)m(?:in)?)?(?:(\d+(?:\.\d+)?)s)?")
_SHORTEST_S = 20.0


def parse_duration(text: str) -> float:
    """Seconds of "5min", "5m", "1h30min", "90s" or "90".

    Raises:
        SettingError: it is none of these, or shorter than 20 s, in which nothing can be made.
    """
    bare = text.strip().lower().replace(" ", "")
    # A number after a unit has to have its own: nobody who writes 1h30 means 30 s.
    found = _DURATION.fullmatch(bare + "s" if bare.replace(".", "", 1).isdigit() else bare)
    if found is None or not any(found.groups()):
        raise SettingError("--time-budget {text}: is no time; write it as 5min, 90s or 1h30min.", text=text)
    seconds = sum(float(part or 0) * unit for part, unit in zip(found.groups(), (3600.0, 60.0, 1.0), strict=True))
    if seconds < _SHORTEST_S:
        raise SettingError(
            "--time-budget {text}: is too short for any model; give {least:g} s or more.", text=text, least=_SHORTEST_S
        )
    return seconds


def parse_decibels(text: str) -> float:
    """The number of "32dB" or "32".

    Raises:
        SettingError: it is none, or not above 0.
    """
    try:
        value = float(text.strip().lower().removesuffix("db"))
    except ValueError:
        value = 0.0
    if not 0 < value < 200:
        raise SettingError("--until {text}: is no PSNR; write it as 32dB.", text=text)
    return value


def measuring_of(part: str) -> str:
    """The name of what measuring held-out photos on the way of a part takes: of its time, however many its steps."""
    return f"{part} measuring"


def least_seconds(parts: Mapping[str, float]) -> float:
    """What a run takes that makes next to no steps."""
    return sum(seconds * (_LEAST if name in _SCALES else 1.0) for name, seconds in parts.items())


def least_steps(planned: int) -> int:
    """Of a part that has so many in its preset: with none it would leave what it began with."""
    return max(1, round(_LEAST * planned))


def most_seconds(parts: Mapping[str, float]) -> float:
    """What a run takes that makes as many steps as are of any use."""
    return sum(seconds * (_MOST if name in _SCALES else 1.0) for name, seconds in parts.items())


@dataclass(frozen=True)
class _Begun:
    """How a part began: after how many seconds, with which share of its preset's iterations, on a machine how slow;
    and, once it has ended, how many of its measurements were made, as a share."""

    seconds: float
    share: float
    slowness: float
    measured: float = 1.0


@dataclass
class Pace:
    """Chooses the iterations of each part when it begins, by what the parts before it took.

    Attributes:
        budget_s: of the whole run.
        parts: seconds that parts are forecast to take with their preset's iterations, in the order of the run.
        seconds: of the run until now.
        effects: of photos that the forecast counts.
        anew: the forecast with some effects of photos and some numbers of splats, and with what else is known of the
            run by now: how far splats of photos grow their training tells better than any guess; None to keep the
            first one.
        splats: that parts ended with, as far as their stage is not done.
        before: seconds of the run that earlier processes took.
    """

    budget_s: float
    parts: Mapping[str, float]
    seconds: Callable[[], float]
    effects: frozenset[str] = frozenset()
    anew: Callable[[frozenset[str], Mapping[str, int]], Mapping[str, float]] | None = None
    splats: dict[str, int] = field(default_factory=dict)
    before: float = 0.0
    # What this process took until it went on with a part that an earlier one began: no part is the slower for it. Of
    # restarts before this one nobody knows; they count as if steps had taken that long.
    _pause: float = 0.0
    _begun: dict[str, _Begun] = field(default_factory=dict)

    def expect(self, effects: Iterable[str]) -> None:
        """Counts the effects of photos that a run turned out to use: steps that draw a moving camera take as many
        times longer, which nobody knew before the photos were looked at."""
        self.effects = frozenset(effects)

    def iterations(self, part: str, planned: int) -> int:
        """Of a part that begins now, in place of its preset's.

        What parts took so far over what they were forecast to take, with as many iterations as they had and as many
        splats as came of them, corrects the rest of the forecast: one that is off on this machine is mostly off by
        one factor.

        Raises:
            SettingError: the time was gone before the first part with steps, or is needed for all but these: of them
                there would be no model.
        """
        if part not in self.parts or planned < 1:
            return planned
        if self.anew is not None:
            self.parts = self.anew(self.effects, self.splats)
        now, slowness = self.seconds(), self._slowness(part)
        ahead = self._between(part, None)
        scaled = sum(seconds for name, seconds in ahead.items() if name in _SCALES)
        left = _AIM * self.budget_s - now - slowness * (sum(ahead.values()) - scaled)
        share = min(max(left / max(slowness * scaled, 1e-9), _LEAST), _MOST)
        if left < _LEAST * slowness * scaled and part == next(name for name in self.parts if name in _SCALES):
            raise SettingError(
                "--time-budget {budget:g}s: {gone:.0f} s are gone before the first training, and what is no training "
                "takes {rest:.0f} s more; what was found is kept, run it again with more time.",
                budget=self.budget_s,
                gone=now,
                rest=slowness * (sum(ahead.values()) - scaled),
            )
        self._begun[part] = _Begun(now, share, slowness)
        return max(1, round(share * planned))

    def deadline(self, part: str) -> float:
        """Seconds of the run by which a part that has begun must end, whatever it has reached: the parts after it
        need theirs. However late it is, `least_steps` are made."""
        begun = self._begun.get(part)
        if begun is None:
            # Nobody foresaw it; it must not take what the report needs.
            return self.budget_s - self.parts.get("report", 0.0)
        # Those after it would rather make half as many steps than see this one end in the middle of its schedule.
        return max(self.budget_s - begun.slowness * self._later(part, 0.5 * begun.share), begun.seconds)

    def aim(self, part: str) -> float | None:
        """Seconds of the run by which a part that has begun must end for those after it to make as large a share of
        their iterations; None for one that has no forecast."""
        begun = self._begun.get(part)
        return None if begun is None else _AIM * self.budget_s - begun.slowness * self._later(part, begun.share)

    def measuring(self, part: str) -> float:
        """Seconds that measuring held-out photos on the way of a part, as often as it does, will take as far as is
        known when it begins; 0 for one that has no forecast, or where nothing is fitted to photos."""
        begun = self._begun.get(part)
        return 0.0 if begun is None else begun.slowness * self.parts.get(measuring_of(part), 0.0)

    def made(self, part: str, share: float, measured: float = 1.0) -> None:
        """A part ended after this share of the iterations that it began with, and of its measurements: what it took was
        for so many."""
        begun = self._begun.get(part)
        if begun is not None:
            self._begun[part] = replace(begun, share=share * begun.share, measured=measured)

    def begun(self, part: str) -> dict[str, float]:
        """How a part began, for `take_up`; {} for one that has no forecast."""
        return asdict(self._begun[part]) if part in self._begun else {}

    def take_up(self, part: str, begun: Mapping[str, float]) -> None:
        """Knows of a part that an earlier process began: the parts after it are fitted in by what it takes."""
        if begun and part not in self._begun:
            if not self._begun:
                self._pause = self.seconds() - self.before
            self._begun[part] = _Begun(**begun)

    def _slowness(self, part: str) -> float:
        """Seconds taken over seconds forecast, from the first part with steps until this one begins; 1 before any."""
        if not self._begun:
            return 1.0
        first = next(iter(self._begun))
        made = {name: begun.share for name, begun in self._begun.items()}
        made |= {measuring_of(name): begun.measured for name, begun in self._begun.items()}
        expected = sum(seconds * made.get(name, 1.0) for name, seconds in self._between(first, part).items())
        taken = self.seconds() - self._begun[first].seconds - self._pause
        return min(max(taken / expected, 1 / _ODD), _ODD) if expected > 0 and taken > 0 else 1.0

    def _later(self, part: str, share: float) -> float:
        """The forecast of what comes after a part and what it measures, with that share of the iterations."""
        own = part, measuring_of(part)
        later = {name: seconds for name, seconds in self._between(part, None).items() if name not in own}
        return sum(seconds * (share if name in _SCALES else 1.0) for name, seconds in later.items())

    def _between(self, first: str, stop: str | None) -> dict[str, float]:
        """The forecast from one part until before another, or to the end."""
        names = list(self.parts)
        chosen = names[names.index(first) : None if stop is None else names.index(stop)]
        return {name: self.parts[name] for name in chosen}
