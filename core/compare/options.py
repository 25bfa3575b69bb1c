"""What `insideout compare` was asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ..errors import SettingError
from ..settings import Settings


@dataclass(frozen=True)
class CompareSettings:
    """What is compared, and how.

    Attributes:
        methods: names of rows; all that the captures allow if empty.
        settings: preset, seed and kernel, or every knob.
        same_time: methods that go by time get the X-ray seconds of the InsideOut row.
        starts: random starts of the alignment; 0 for none.
        projections: numbers of training projections to thin to.
        ablation: also run the ablation.
        ablation_rows: names of its rows; all if empty.
        also: tables.json of earlier comparisons, whose other captures are shown beside these, and whose other rows of
            the same captures stay.
    """

    methods: tuple[str, ...] = ()
    settings: Settings | None = None
    same_time: bool = True
    starts: int = 20
    projections: tuple[int, ...] = ()
    ablation: bool = True
    ablation_rows: tuple[str, ...] = ()
    also: tuple[Path, ...] = ()


def compare_settings(
    methods: Sequence[str],
    preset: str,
    seed: int,
    kernel: str,
    starts: int,
    projections: str,
    seconds_like: str,
    ablation: bool,
    also: Sequence[Path] = (),
    ablation_rows: Sequence[str] = (),
) -> CompareSettings:
    """The options of the command line.

    Raises:
        SettingError: one of them cannot be read or is out of range; of methods' names see `choose_methods`, of the
            ablation's `ablation_of`.
    """
    if seconds_like not in ("insideout", "none"):
        raise SettingError(f"--seconds-like {seconds_like}: choose insideout or none.")
    if starts < 0:
        raise SettingError(f"--starts {starts}: is below 0; choose 0 for none, or any positive whole number.")
    if ablation_rows and not ablation:
        raise SettingError("--ablation-rows: --no-ablation leaves them all out; leave out one of the two.")
    if ablation_rows and methods and "insideout" not in methods:
        raise SettingError("--ablation-rows: the ablation is of the row insideout; add it to --methods.")
    return CompareSettings(
        methods=tuple(methods),
        settings=Settings.of(preset, seed, kernel),
        same_time=seconds_like == "insideout",
        starts=starts,
        projections=_counts(projections),
        ablation=ablation,
        ablation_rows=tuple(ablation_rows),
        also=tuple(also),
    )


def _counts(text: str) -> tuple[int, ...]:
    try:
        counts = tuple(int(word) for word in text.split(",") if word.strip())
    except ValueError:
        raise SettingError(f"--projections {text}: give whole numbers, as in 75,50,25.") from None
    if any(count < 3 for count in counts):
        raise SettingError(f"--projections {text}: give numbers of 3 or more.")
    return counts
