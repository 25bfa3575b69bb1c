"""Which effects a user asks for, as `--effects` has it."""

from __future__ import annotations

from dataclasses import dataclass

from ..errors import SettingError
from .finding import PHOTO_EFFECTS, XRAY_EFFECTS


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

    def wants(self, name: str) -> bool:
        """Whether an effect is to be looked for or used."""
        return name in self.on or (self.auto and name not in self.off)


def parse_effects(text: str) -> Request:
    """ "auto", "none", names with commas between, or both: "auto,-motion_blur" leaves one out, "auto,ring" uses one
    whatever is found.

    Raises:
        SettingError: a name that is not known; one left out without "auto" or asked for, too; "none" beside others.
    """
    words = [word.strip() for word in text.split(",") if word.strip()]
    if not words:
        raise SettingError("--effects is empty; give auto, none, or names of effects with commas between.")
    if "none" in words and len(words) > 1:
        raise SettingError(f"--effects {text}: 'none' stands alone; leave it out, or all others.")
    auto = "auto" in words
    on = frozenset(word for word in words if word not in ("auto", "none") and not word.startswith("-"))
    off = frozenset(word[1:] for word in words if word.startswith("-"))
    for name in sorted(on | off):
        if name not in PHOTO_EFFECTS + XRAY_EFFECTS:
            raise SettingError(
                f"--effects {text}: there is no effect '{name}'; choose of photos {', '.join(PHOTO_EFFECTS)}; of "
                f"X-rays {', '.join(XRAY_EFFECTS)}; auto; or none."
            )
    if off and not auto:
        raise SettingError(f"--effects {text}: '-{min(off)}' leaves one out of auto; write auto,-{min(off)}.")
    if on & off:
        raise SettingError(f"--effects {text}: {min(on & off)} is asked for and left out; choose one of the two.")
    return Request(auto, on, off)
