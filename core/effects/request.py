"""Which effects a user asks for, as `--effects` has it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from ..effect_names import NOT_TOGETHER, PHOTO_EFFECTS, XRAY_EFFECTS
from ..errors import SettingError

if TYPE_CHECKING:
    from ..capture.model import Capture


@dataclass(frozen=True)
class Request:
    """Attributes:
    auto: effects that are neither on nor off are looked for, and used where they are found.
    on: used whatever is found.
    off: not even looked for.
    """

    auto: bool
    on: frozenset[str]
    off: frozenset[str]

    def __str__(self) -> str:
        """In the words of `parse_effects`, always in the same order."""
        left_out = (f"-{name}" for name in sorted(self.off))
        return ",".join([*(["auto"] if self.auto else []), *sorted(self.on), *left_out]) or "none"

    def wants(self, name: str) -> bool:
        """Whether an effect is to be looked for or used."""
        return name in self.on or (self.auto and name not in self.off)

    def without(self, name: str) -> Request:
        """The same wish without an effect, whether that was asked for or found."""
        return Request(self.auto, self.on - {name}, self.off | {name} if self.auto else self.off)

    def using(self, name: str) -> Request:
        """The same wish with an effect that is used whatever is found."""
        return Request(self.auto, self.on | {name}, self.off - {name})

    def concerns(self, half: str) -> bool:
        """Whether any effect of "photos" or of "xray" is to be looked for or used."""
        return any(self.wants(name) for name in (PHOTO_EFFECTS if half == "photos" else XRAY_EFFECTS))

    def check(self, capture: Capture) -> None:
        """Raises SettingError for an effect that is asked for by name and that nothing in the capture can have."""
        for name in sorted(self.on):
            if name in PHOTO_EFFECTS and capture.photos is None:
                raise SettingError(
                    "--effects: {name} is an effect of photos, and the capture has none; leave it out.", name=name
                )
            if name in XRAY_EFFECTS and capture.projections is None:
                raise SettingError(
                    "--effects: {name} is an effect of X-ray projections, and the capture has none; leave it out.",
                    name=name,
                )
        if "lens" in self.on and capture.photos is not None:
            if not capture.photos.posed:
                raise SettingError(
                    "--effects: lens is for cameras that are given; of these photos structure from motion finds the "
                    "lens with the cameras; leave it out."
                )
            if all(photo.lens is not None for photo in capture.photos.photos):
                raise SettingError(
                    "--effects: lens is for cameras whose file says nothing of it; this one does, and the lens is "
                    "taken out as it says; leave it out."
                )


def parse_effects(text: str) -> Request:
    """ "auto", "none", names with commas between, or both: "auto,-scatter" leaves one out, "auto,exposure" uses
    one whatever is found.

    Raises:
        SettingError: a name that is not known; one left out without "auto" or asked for, too; "none" beside others; two
            that cannot be learned at once.
    """
    words = [word.strip() for word in text.split(",") if word.strip()]
    if not words:
        raise SettingError("--effects is empty; give auto, none, or names of effects with commas between.")
    if "none" in words and len(words) > 1:
        raise SettingError("--effects {text}: 'none' stands alone; leave it out, or all others.", text=text)
    auto = "auto" in words
    on = frozenset(word for word in words if word not in ("auto", "none") and not word.startswith("-"))
    off = frozenset(word[1:] for word in words if word.startswith("-"))
    for name in sorted(on | off):
        if name not in PHOTO_EFFECTS + XRAY_EFFECTS:
            raise SettingError(
                "--effects {text}: there is no effect '{name}'; choose of photos {photos}; of X-rays {xrays}; auto; or "
                "none.",
                text=text,
                name=name,
                photos=", ".join(PHOTO_EFFECTS),
                xrays=", ".join(XRAY_EFFECTS),
            )
    if off and not auto:
        raise SettingError(
            "--effects {text}: '-{name}' leaves one out of auto; write auto,-{name}.", text=text, name=min(off)
        )
    if on & off:
        raise SettingError(
            "--effects {text}: {name} is asked for and left out; choose one of the two.", text=text, name=min(on & off)
        )
    for one, other in sorted(NOT_TOGETHER):
        if {one, other} <= on:
            raise SettingError(
                "--effects {text}: {one} and {other} cannot be learned at once; ask for one of them, or write auto, "
                "which looks for both and uses one.",
                text=text,
                one=one,
                other=other,
            )
    return Request(auto, on, off)
