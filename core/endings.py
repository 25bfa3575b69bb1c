"""What a figure that was wanted and a time that was given did to a run, in sentences."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from .told import Told

if TYPE_CHECKING:
    from .train.schedule import Until

# A run this much over its time has not kept it; nobody minds less.
_LATE = 1.1
_KINDS = {"photos": Told("photos"), "projections": Told("projections")}


def endings(
    stages: Mapping[str, Mapping[str, Any]], until: Until | None, seconds: float, budget_s: float | None
) -> tuple[list[Told], list[Told]]:
    """Why optimisations ended before their last step, and what became of the figure and the time, a sentence each.

    Args:
        stages: the stages' reports by name.
        until: what the user asked for.
        seconds: of the whole run.
        budget_s: what it was to take.

    Returns:
        What the user got as it was asked for, and what not.
    """
    kept: list[Told] = []
    broken: list[Told] = []
    histories = [found for stage, report in stages.items() for found in _histories(stage, report)]
    reached = False
    if until is not None:
        points = [point for _, history in histories for point in history.get("heldout", ())]
        # Of an image that was not finite the figure is null.
        seen = [point[until.kind] for point in points if point.get(until.kind) is not None]
        reached = max(seen, default=0.0) >= until.psnr
        if not seen:
            broken.append(Told("--until {psnr:g}dB: {why}", psnr=until.psnr, why=cannot_tell(until.kind)))
        elif not reached:
            best = "--until {psnr:g}dB: not reached; the best of held-out {kind} on the way was {best:.1f} dB"
            broken.append(Told(best, psnr=until.psnr, kind=_KINDS[until.kind], best=max(seen)))
    for name, history in histories:
        ended = history.get("ended", "")
        # What one stage gave up a later one may have reached.
        as_asked = reached if until is not None and f"of {until.kind}:" in ended else ended.endswith("reached")
        if ended:
            told = kept if as_asked else broken
            why = "{part}: ended after {steps} steps, {why}"
            told.append(Told(why, part=name, steps=history["iterations"], why=_why(ended)))
        made, left_out = history["iterations"], history.get("left_out")
        if left_out and made + left_out == history.get("planned"):
            fewer = "{part}: {made} of {steps} steps were made, to the end of the schedule, for the time that was given"
            kept.append(Told(fewer, part=name, made=made, steps=history["planned"]))
    if budget_s is not None and seconds > _LATE * budget_s:
        late = "--time-budget {budget:g}s: the run took {seconds:.0f} s; give it more time"
        broken.append(Told(late, budget=budget_s, seconds=seconds))
    return kept, broken


def cannot_tell(kind: str) -> Told:
    """Why nothing says whether a figure of this kind, "photos" or "projections", is reached."""
    return Told(
        "no photos are held out that could tell whether it is reached; all steps are made"
        if kind == "photos"
        else "no projections are held out that could tell whether it is reached; all steps are made"
    )


def _why(ended: str) -> Told | str:
    """What `train.loop.optimise` said when it ended, with what it was made of, as far as it is known."""
    if ended == "its time was up":
        return Told("its time was up")
    wanted, _, verdict = ended.partition(": ")
    psnr, _, kind = wanted.partition(" dB of ")
    if kind not in _KINDS or verdict not in ("reached", "out of reach"):
        return ended
    return Told(
        "{psnr} dB of {kind}: reached" if verdict == "reached" else "{psnr} dB of {kind}: out of reach",
        psnr=psnr,
        kind=_KINDS[kind],
    )


def _histories(name: str, report: Mapping[str, Any]) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """The optimisations in a report by "stage part", those inside of others included."""
    for part, history in report.items():
        if isinstance(history, dict):
            if "losses" in history:
                yield f"{name} {part}", history
            yield from _histories(f"{name} {part}", history)
