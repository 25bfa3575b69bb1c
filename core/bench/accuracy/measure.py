"""The rows of `insideout bench accuracy`: each a whole run, what rows have in common made once."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...capture.read import read_capture
from ...compare.methods import Method
from ...compare.score import row_figures
from ...compare.sections import SectionJudge
from ...compare.starts import errors_of
from ...compare.study import Made, Study, kept_figures, machine_of
from ...compare.truth import find_truth, without_truth
from ...errors import CaptureError, RunFolderError
from ...files import exclusive, plain, write_json
from ...progress import Progress, Reporter
from ...resume import check_space, refuse_nesting
from ...settings import Settings
from ...similarity import Similarity
from ..compiling import compile_kernels
from ..machine import machine
from .knobs import KNOBS, Position, positions
from .plot import draw_front

FILE = "accuracy.json"
QUALITIES = ("sections", "photos", "projections")
"""What is measured over seconds."""


@dataclass(frozen=True)
class AccuracySettings:
    """What is measured.

    Attributes:
        settings: that knobs are turned from.
        knobs: names, see `knobs.KNOBS`; all if empty.
        presets: measured beside that of `settings`.
    """

    settings: Settings
    knobs: tuple[str, ...] = ()
    presets: tuple[str, ...] = ("draft", "standard")


def measure_accuracy(
    capture: Path, out: Path, how: AccuracySettings, reporter: Reporter | None = None
) -> dict[str, Any]:
    """Runs a row for each position of each knob; writes `accuracy.json` and `accuracy.png` into `out` after each.

    One that was broken off goes on: finished rows are kept, and stages that rows have in common are made once. A row's
    seconds are those of all its stages, those it shares included.

    Returns:
        The content of `accuracy.json`: `machine`, `capture`, `preset`, `seed`, `kernel`, `truth` (what sections are
        compared with), `exact` (whether that is true: an FDK's streaks and noise are not), `rows` [{`knob`, `value`,
        `seconds`, `stages` {seconds by stage}, `machine` (that the row was made on), `splats`, `sections`, `photos`,
        `projections` (dB), `scale_percent`, `rotation_deg`, `translation_mm` (the photo frame's errors, where the
        truth is known)}].

    Raises:
        CaptureError, SettingError, RunFolderError, DiskFullError: the user's to mend.
        Cancelled: the user asked to stop; the same call goes on.
    """
    reporter, out, name = reporter or Reporter(), Path(out), Path(capture).resolve().name
    refuse_nesting(Path(capture), out)
    # Beside the capture, its runs would lie in it.
    refuse_nesting(Path(capture), out / name)
    read = read_capture(Path(capture), reporter.check)
    check_space(out)
    with exclusive(out / ".lock") as ours:
        if not ours:
            raise RunFolderError(f"{out}: another measurement is writing here; wait for it, or choose another --out.")
        chosen = how.settings
        made = {"capture": name, "preset": chosen.preset, "seed": chosen.seed, "kernel": chosen.kernel}
        _refuse_other(out / FILE, made)
        truth = find_truth(read, out, reporter)
        study = Study(without_truth(read), out / name, how.settings, truth, reporter)
        compile_kernels(read, how.settings, reporter)
        judge = None
        if truth is not None:
            judge = SectionJudge.of(truth.volume, how.settings.kernel, reporter.check)
        content: dict[str, Any] = {
            "machine": machine(),
            **made,
            "truth": None if truth is None else truth.source,
            "exact": truth is not None and truth.exact,
            "rows": [],
        }
        for position in positions(how.settings, read, how.knobs, how.presets):
            content["rows"].append(_row(study, position, judge))
            write_json(out / FILE, plain(content))
            draw_front(content, out / "accuracy.png")
    return plain(content)


def _refuse_other(file: Path, made: dict[str, Any]) -> None:
    """Raises RunFolderError for a measurement that was made otherwise: its rows would be given up."""
    try:
        before = json.loads(file.read_text("utf-8"))
    except (OSError, ValueError):
        return
    for name, value in made.items():
        # Older files have no seed and no kernel.
        if isinstance(before, dict) and before.get(name, value) != value:
            raise RunFolderError(
                f"{file.parent}: holds a measurement with {name} {before[name]}, not {value}; choose another --out, or "
                "delete that folder, nothing was changed."
            )


def _row(study: Study, position: Position, judge: SectionJudge | None) -> dict[str, Any]:
    method = Method(position.folder, f"{position.knob}: {position.value}", "both", position.change)
    photos = study.capture.photos
    if photos is not None and not photos.posed:
        # Cameras are found once, of all photos: those of fewer would be in a frame of their own.
        study.reference()
    seen = study.seen_by(method)
    if position.thin is not None:
        seen = position.thin(seen)
    folder = study.folder / method.name
    try:
        changed = position.change(study.settings)
        made = Made(method, folder, study.run(folder, seen, changed, title=method.label, code=method.code))
    except CaptureError as error:
        hint = f" (--knobs without {position.knob} goes on.)" if position.knob in KNOBS else ""
        raise CaptureError(f"row '{method.label}': {error}{hint}") from error
    # Before figures are measured: that may be interrupted, and taken up elsewhere.
    made_on = machine_of(made)
    study.reporter.update(Progress(method.label, "figures", 1.0))
    stamp = {"report": made.report, "truth": study.truth and study.truth.digest}
    figures = kept_figures(made.folder / "figures.json", stamp, lambda: row_figures(study, made, judge, None))
    row = {
        "knob": position.knob,
        "value": position.value,
        "seconds": made.seconds,
        "stages": {name: stage["seconds"] for name, stage in made.report["stages"].items()},
        "machine": made_on,
        "splats": figures["splats"],
        **{name: (figures[name] or {}).get("psnr") for name in QUALITIES},
    }
    if judge is None:
        row["sections"] = made.report["heldout"]["sections"].get("psnr")
    return {**row, **_frame_errors(study, made)}


def _frame_errors(study: Study, made: Made) -> dict[str, float]:
    truth, photos, found = study.truth, study.capture.photos, made.report.get("similarity")
    if truth is None or truth.similarity is None or photos is None or not photos.posed or found is None:
        return {}
    errors = errors_of(Similarity.from_json(found), truth.similarity, truth.middle_mm)
    return {name: errors[name] for name in ("scale_percent", "rotation_deg", "translation_mm")}
