"""The same time for every method: the iterations that take a given time, found by making them."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from ..errors import SettingError
from ..files import plain, write_json

# A try that takes such a share of the time is the last, and how many are made. At least all of its time, and at most as
# much more as repeats of one run differ by: with 17 % more a row had 1 dB more.
ENOUGH, MOST, _MOST_TRIES = 1.0, 1.1, 4
_AIM = 1.05


class TooLong(Exception):
    """A try was broken off since it took longer than it may.

    Attributes:
        seconds: that all of its iterations would take at that pace.
    """

    def __init__(self, seconds: float) -> None:
        super().__init__(f"it would take {seconds:.0f} s")
        self.seconds = seconds


def iterations_in_time(
    seconds: float,
    first: Callable[[], int],
    taken: Callable[[int, float], float],
    kept: Path,
    made_with: Any = None,
    least: int = 2,
    most: int = 1_000_000,
) -> dict[str, Any]:
    """Runs a method with more or fewer iterations until it takes 100 to 110 % of its time, four times at most.

    A few iterations timed beforehand do not tell: densification compressed into them makes other splats, and caches
    are cold. Rows that were planned that way took 60 to 70 % of their time. The last run is the one that counts; what
    it leaves is that of the number returned. Where the fourth missed, the number is made once more that took the least
    time of those that took enough, else the most.

    Args:
        seconds: all iterations are to take, or up to a tenth more.
        first: the number to begin with; asked once, a run taken up again hears its answer.
        taken: makes a run of that many iterations and returns its seconds; where it takes more than the second number,
            so that it cannot be the last, it may raise `TooLong`. It is resumable: taken up again after a break, it
            counts what it took before.
        kept: JSON file of the tries so far; one made for another time, other limits or `made_with` is begun anew.
        made_with: what else the tries depend on, as JSON can hold it.
        least, most: limits of the number.

    Returns:
        `iterations` of the last try, `seconds` allowed, `tries` [[iterations, seconds], ...], of those that were broken
        off the seconds that they would have taken.

    Raises:
        SettingError: a time that is not above 0, or limits that leave no number.
        Cancelled: by `first` or `taken`; the tries that ended are kept.
    """
    if not seconds > 0 or not 1 <= least <= most:
        raise SettingError(
            "a budget of {seconds} s for {least} to {most} iterations leaves nothing to do; give a time above 0 and "
            "limits from 1 on, the lower first.",
            seconds=seconds,
            least=least,
            most=most,
        )
    asked = plain({"seconds": float(seconds), "least": least, "most": most, "of": made_with})
    begun, tries, broken = _read(kept, asked)

    def keep() -> None:
        write_json(kept, {"asked": asked, "first": begun, "tries": tries, "broken_off": broken})

    if begun is None:
        begun = first()
        keep()
    while not _ended(tries, seconds):
        guess = next_guess(tries, _AIM * seconds) if tries else begun
        count = min(max(guess, least), most)
        if tries and count == tries[-1][0]:
            break
        try:
            took = taken(count, MOST * seconds)
        except TooLong as error:
            took = error.seconds
            broken.append(count)
        tries.append((count, took))
        keep()
    best = _best(tries, seconds)
    if best in broken or (len(tries) <= _MOST_TRIES and best != tries[-1][0]):
        tries.append((best, taken(best, math.inf)))
        broken = [count for count in broken if count != best]
        keep()
    return {"iterations": tries[-1][0], "seconds": float(seconds), "tries": [list(one) for one in tries]}


def last_number(kept: Path) -> int | None:
    """The iterations that another search ended with, from its file; a good number to begin one like it with."""
    try:
        return int(json.loads(kept.read_text(encoding="utf-8"))["tries"][-1][0])
    except (OSError, ValueError, LookupError, TypeError):
        return None


def next_guess(tries: Sequence[tuple[int, float]], seconds: float) -> int:
    """The iterations that would take `seconds`, from tries (iterations, seconds taken).

    Seconds grow as a power of the iterations: that of the tries on either side of the time, else that of the last
    two, at least as fast as the iterations and no faster than their cube: the more of them, the more splats and the
    slower each. A guess is at most three times the try that it starts from: the nearest above the time, else the last.
    """
    below = [one for one in tries if one[1] < seconds]
    above = [one for one in tries if one[1] >= seconds]
    (before, took_before), (count, took) = tries[-min(2, len(tries))], tries[-1]
    if below and above:
        before, took_before = max(below, key=lambda one: one[1])
        count, took = min(above, key=lambda one: one[1])
    took, power = max(took, 1e-9), 1.0
    if before != count:
        power = math.log(took / max(took_before, 1e-9)) / math.log(count / before)
        power = min(max(power, 1.0), 3.0)
    guess = count * min((seconds / took) ** (1 / power), 3.0)
    if below and above and before < count:
        guess = min(max(guess, before), count)
    return max(2, round(guess))


def _best(tries: Sequence[tuple[int, float]], seconds: float) -> int:
    """The number that took least of those that took enough, else the one that took most."""
    enough = [one for one in tries if one[1] >= ENOUGH * seconds]
    return (min if enough else max)(enough or tries, key=lambda one: one[1])[0]


def _ended(tries: Sequence[tuple[int, float]], seconds: float) -> bool:
    if not tries:
        return False
    return len(tries) >= _MOST_TRIES or ENOUGH <= tries[-1][1] / seconds <= MOST


def _read(kept: Path, asked: dict[str, Any]) -> tuple[int | None, list[tuple[int, float]], list[int]]:
    """The first number, the tries and which of them were broken off, in a file made for the same; none where there is
    no such file or it is damaged."""
    try:
        content = json.loads(kept.read_text(encoding="utf-8"))
        if content["asked"] != asked:
            return None, [], []
        tries = [(int(count), float(took)) for count, took in content["tries"]]
        return int(content["first"]), tries, [int(count) for count in content["broken_off"]]
    except (OSError, ValueError, KeyError, TypeError):
        return None, [], []
