"""All methods on all captures, then the tables: what `insideout compare` does."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ... import __version__
from ..bench.machine import machine
from ..capture.model import Capture
from ..capture.read import read_capture
from ..errors import CaptureError, RunFolderError, SettingError
from ..evaluate.shells import shell_distance, shell_distances
from ..files import atomic_write, exclusive, plain, write_json
from ..progress import Progress, Reporter
from ..render.card import require_card
from ..resume import check_space, refuse_nesting
from ..settings import Settings
from ..similarity import Similarity
from .ablation import ABLATED, ABLATION
from .cells import decibels
from .earlier import other_captures, own_captures, rows_kept, with_rows_beside
from .meshes import Surfaces, true_surfaces
from .methods import METHODS, Method, choose_methods, without_repeats
from .notes import note_of
from .options import CompareSettings
from .pictures import CUT, SHEET, SHOWN, Cut, draw_sections, load_cut
from .planned import ALIGNMENT, Plan, ablated, plan_of, with_fewer
from .plot import draw_plot
from .score import row_figures, truth_figures
from .sections import SectionJudge
from .sharing import without_none
from .starts import errors_of, random_starts
from .study import FIGURES, Made, Study, kept_figures, machine_of, mark, refuse_foreign, study_folder
from .tables import markdown
from .thinning import with_projections
from .truth import find_truth, without_truth


def compare(
    captures: Sequence[Path], out: Path, settings: CompareSettings, reporter: Reporter | None = None
) -> dict[str, Any]:
    """Runs the methods and writes `tables.json`, `tables.md` and `plot.png` into `out`, after each row anew, and
    `sections.png` into each capture's folder there: sections of the truth and of some rows side by side.

    A comparison that was killed goes on; a finished row is not run again. Rows that an earlier comparison in `out` made
    of the same capture, and captures that it compared, stay in the tables where they were made and measured as now.

    Args:
        captures: capture folders of different names.
        out: the comparison's folder; holds one folder for each capture with one for each method. One that holds a
            comparison with another preset, seed, kernel or time, or something else, is refused.
        settings: what is compared, and how.
        reporter: progress out, cancel in.

    Returns:
        The content of `tables.json`.

    Raises:
        CaptureError, SettingError, RunFolderError, DiskFullError: the user's to mend.
        Cancelled: the user asked to stop; the same call goes on.
    """
    reporter, chosen, out = reporter or Reporter(), settings.settings or Settings.of(), Path(out)
    if chosen.kernel == "cuda":
        require_card()
    read = _read_all(captures, out, reporter)
    methods = choose_methods(settings.methods, read)
    distinct = without_repeats(methods, chosen)
    repeated = [method.name for method in methods if method not in distinct and method.name in settings.methods]
    if repeated:
        raise SettingError(
            f"--methods {repeated[0]}: at preset {chosen.preset} it is the same as another row; leave it out."
        )
    plans = {}
    for capture in read:
        folder = study_folder(out, capture)
        refuse_foreign(folder)
        plans[folder.name] = plan_of(capture, distinct, settings, chosen)
        for count in settings.projections:
            with_projections(capture, count)
    _refuse_rows_that_cannot_be(settings, plans.values())
    check_space(out)
    with exclusive(out / ".lock") as ours:
        if not ours:
            raise RunFolderError(f"{out}: another comparison is writing here; wait for it, or choose another --out.")
        tables = _Tables(out, chosen, settings, {name: plan.labels for name, plan in plans.items()})
        for capture in read:
            folder = study_folder(out, capture)
            mark(folder)
            truth = find_truth(capture, folder, reporter)
            study = Study(without_truth(capture), folder, chosen, truth, reporter, settings.same_time)
            _Comparison(study, plans[folder.name], settings, tables).run()
    return plain(tables.content)


def _read_all(captures: Sequence[Path], out: Path, reporter: Reporter) -> list[Capture]:
    if not captures:
        raise SettingError("compare: no capture was given; name at least one capture folder.")
    names = [Path(path).resolve().name for path in captures]
    for name in names:
        if names.count(name) > 1:
            raise SettingError(f"compare: two captures are called '{name}'; rename one of the folders.")
    read = []
    for path in captures:
        refuse_nesting(Path(path), out)
        # Beside the capture, a comparison's folder for it would be the capture itself.
        refuse_nesting(Path(path), out / Path(path).resolve().name)
        reporter.update(Progress("capture", message=f"reading {path}"))
        read.append(read_capture(Path(path), reporter.check))
    reporter.update(Progress("capture", fraction=1.0))
    return read


def _refuse_rows_that_cannot_be(settings: CompareSettings, plans: Iterable[Plan]) -> None:
    """Raises SettingError for a row of the ablation that was asked for and that none of the captures can have."""
    found = {method.name.removeprefix(ABLATED) for plan in plans for method in plan.ablation}
    for name in settings.ablation_rows if settings.ablation else ():
        if name not in found:
            raise SettingError(
                f"--ablation-rows {name}: none of these captures can have this row with these --methods; leave it out."
            )


class _Tables:
    """What was found so far; written anew after each row."""

    def __init__(
        self, out: Path, chosen: Settings, settings: CompareSettings, coming: Mapping[str, Sequence[str]] | None = None
    ) -> None:
        """`coming` are the captures that are compared now, and the labels of their rows."""
        coming = coming or {}
        self._out = out
        how = {
            "preset": chosen.preset,
            "seed": chosen.seed,
            "kernel": chosen.kernel,
            "same_time": settings.same_time,
        }
        measured = {"version": __version__, "figures": FIGURES}
        self.row_settings = row_settings(chosen)
        captures = own_captures(out, how, measured, self.row_settings, list(coming))
        self._beside: dict[str, Any] = {}
        for path in settings.also:
            for name, one in other_captures(path, {**how, **measured}, self.row_settings, out, list(coming)).items():
                (self._beside if name in coming else captures)[name] = one
        self.content: dict[str, Any] = {"machine": machine(), **how, **measured}
        self.content["coming"] = {name: list(rows) for name, rows in coming.items()}
        self.content["captures"] = captures

    def of(self, folder: Path, stamp: dict[str, Any]) -> dict[str, Any]:
        """Where the figures of the capture go whose runs are in `folder`, see `rows_kept` for `stamp`."""
        kept = rows_kept(self.content["captures"].get(folder.name), stamp, folder)
        kept = with_rows_beside(kept, self._beside.get(folder.name), stamp)
        self.content["captures"][folder.name] = {**kept, "stamp": stamp}
        return self.content["captures"][folder.name]

    def write(self, name: str, row: str) -> None:
        """Writes all files; a row of the capture `name` is there now."""
        coming = self.content["coming"].get(name, [])
        if row in coming:
            coming.remove(row)
        content = plain(self.content)
        write_json(self._out / "tables.json", content)
        with atomic_write(self._out / "tables.md", "w") as stream:
            stream.write(markdown(content))
        draw_plot(content, self._out / "plot.png")


def row_settings(settings: Settings) -> dict[str, str]:
    """A digest of every knob of each row, by its name: what a preset or a rival means changes from version to version.

    Of the stages that a row has no use for nothing counts, nor does the half of one that it does not see; of one that
    is made of another row's splats those of that. What is None, off, counts as if there were no such setting: one that
    is new changes no row that does without.
    """
    digests: dict[str, str] = {}
    for method in (*METHODS.values(), *ABLATION):
        if method.own:
            of = plain([method.own(), digests.get(method.after)])
        else:
            chosen = (method.for_iterations or method.for_count or _same)(method.change(settings), 1000)
            unused = {*method.leave_out, *(("align", "internal", "fuse") if method.modality == "photos" else ())}
            of = plain({stage: one for stage, one in chosen.stages.items() if stage not in unused})
            of["surface"].pop({"photos": "xray", "xray": "rgb"}.get(method.modality), None)
        content = json.dumps(without_none(of), sort_keys=True)
        digests[method.name] = hashlib.sha256(content.encode()).hexdigest()[:12]
    return digests


def _same(settings: Settings, count: int) -> Settings:
    return settings


class _Comparison:
    """All that is measured of one capture."""

    def __init__(self, study: Study, plan: Plan, settings: CompareSettings, tables: _Tables) -> None:
        self._study, self._plan, self._settings, self._tables = study, plan, settings, tables
        stamp = {"capture": study.capture.digest, "truth": study.truth and study.truth.digest}
        self._figures = tables.of(study.folder, stamp)
        self._judge: SectionJudge | None = None
        self._surfaces: Surfaces | None = None

    def run(self) -> None:
        """Raises as `compare`."""
        study, plan = self._study, self._plan
        self._measure_by(study)
        for method in plan.methods:
            self._figures["methods"][method.name] = self._row(study, method)
            self._write(method.label)
            self._draw_sections()
        if plan.aligned:
            self._align()
            self._write(ALIGNMENT)
        for method in plan.ablation:
            self._figures["ablation"][method.name] = self._row(study, method)
            self._write(ablated(method))
        for count, methods in plan.thinned.items():
            self._thin(count, methods)

    def _write(self, row: str) -> None:
        self._tables.write(self._study.name, row)

    def _measure_by(self, study: Study) -> None:
        truth, capture = study.truth, study.capture
        self._figures["possible"] = self._plan.possible
        self._figures["photos"] = None if capture.photos is None else len(capture.photos.photos)
        self._figures["truth"] = None
        if capture.projections is not None:
            self._figures["training_projections"] = int((~capture.projections.held_out).sum())
        if truth is None:
            return
        study.reporter.update(Progress(study.name, "truth", message="looking at what is true"))
        self._judge = SectionJudge.of(truth.volume, study.settings.kernel, study.reporter.check)
        with suppress(SettingError):
            # A volume without a surface, as of an empty scanner, still has sections.
            self._surfaces = true_surfaces(truth)
        self._figures["truth"] = truth_figures(study, truth, self._judge, self._surfaces)

    def _row(self, study: Study, method: Method) -> dict[str, Any]:
        try:
            made = study.make(method)
        except CaptureError as error:
            name, option = method.name, "--methods"
            if name.startswith(ABLATED):
                name, option = name.removeprefix(ABLATED), "--ablation-rows"
            raise CaptureError(f"{study.name}, row '{name}': {error} ({option} without {name} goes on.)") from error
        # Measuring may be interrupted, and taken up elsewhere.
        made_on = machine_of(made)
        study.reporter.update(Progress(f"{study.name}, {method.label}", "figures", 1.0))
        stamp = {
            "report": made.report,
            "budget": made.budget,
            "truth": study.truth and study.truth.digest,
            # Photo splats are brought to mm by it; it may be what the InsideOut row found.
            "frame": study.photo_frame() if method.modality == "photos" else None,
        }
        figures = kept_figures(
            made.folder / "figures.json", stamp, lambda: row_figures(study, made, self._judge, self._surfaces)
        )
        return {
            **figures,
            "label": method.label,
            "note": note_of(method, study.capture),
            "machine": made_on,
            "settings": self._tables.row_settings[method.name],
            "code": method.code,
        }

    def _draw_sections(self) -> None:
        study, judge = self._study, self._judge
        if judge is None or study.truth is None:
            return
        cuts = []
        for name in SHOWN:
            row = self._figures["methods"].get(name)
            images = load_cut(study.folder / name / CUT) if row else []
            if row and images:
                cuts.append(Cut(row["label"], decibels(row["sections"]["psnr"]), images))
        label = "the truth" if study.truth.exact else study.truth.source
        true = Cut(label, study.name, [judge.references[place] for place in judge.shown])
        pixel_mm = float(np.mean(study.truth.volume.spacing_mm))
        material = self._figures["truth"]["material_per_mm"] or judge.peak
        draw_sections(study.folder / SHEET, true, cuts, judge.peak, pixel_mm, air=judge.air, material=material)

    def _align(self) -> None:
        reference = self._study.reference()
        if not reference.report.get("similarity"):
            return
        starts = random_starts(self._study, reference, self._settings.starts)
        ambiguity = reference.report["stages"]["align"].get("ambiguity") or {}
        self._figures["alignment"] = {
            "chamfer": shell_distances(reference.run, self._study.settings.seed, self._study.reporter.check),
            "chamfer_at_truth": self._chamfer_at_truth(reference),
            "refined": reference.report["stages"]["internal"].get("mode"),
            "ambiguity": "none" if ambiguity.get("decided_by_landmarks") else ambiguity.get("kind"),
            "by_landmarks": bool(ambiguity.get("decided_by_landmarks")),
            "errors": self._similarity_errors(reference),
            "starts": starts,
        }

    def _chamfer_at_truth(self, reference: Made) -> dict[str, float] | None:
        """What a perfect alignment would have: both halves lie a little to either side of the surface."""
        truth, photos, run = self._study.truth, self._study.capture.photos, reference.run
        if truth is None or truth.similarity is None or photos is None or not photos.posed:
            return None
        rgb, xray = run.read_set("surface", "rgb").to_numpy(), run.read_set("surface", "xray").to_numpy()
        return shell_distance(run, rgb.transformed(truth.similarity), xray, self._study.settings.seed)

    def _similarity_errors(self, reference: Made) -> dict[str, float] | None:
        truth, photos, found = self._study.truth, self._study.capture.photos, reference.report.get("similarity")
        if truth is None or truth.similarity is None or photos is None or not photos.posed or found is None:
            return None
        return errors_of(Similarity.from_json(found), truth.similarity, truth.middle_mm)

    def _thin(self, count: int, methods: Sequence[Method]) -> None:
        study = self._study
        thinned = replace(
            study,
            capture=with_projections(study.capture, count),
            folder=study.folder / "projections" / str(count),
            fuller=study,
        )
        rows = self._figures["projections"].setdefault(str(count), {})
        for method in methods:
            rows[method.name] = self._row(thinned, method)
            self._write(with_fewer(count, method))
