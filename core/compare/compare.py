"""All methods on all captures, then the tables: what `insideout compare` does."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ... import __version__
from ..bench.machine import machine
from ..capture.model import Capture
from ..capture.read import read_capture
from ..errors import CaptureError, RunFolderError, SettingError
from ..evaluate.shells import shell_distance
from ..files import atomic_write, exclusive, plain, write_json
from ..progress import Progress, Reporter
from ..resume import check_space, refuse_nesting
from ..settings import Settings
from ..similarity import Similarity
from .ablation import ABLATED, ABLATION, ablation_of
from .meshes import BINS, Surfaces, normals_of, true_surfaces
from .methods import METHODS, Method, choose_methods, without_repeats
from .options import CompareSettings
from .plot import draw_plot
from .score import row_figures, volume_mesh
from .sections import SectionJudge
from .sharing import read_dict
from .starts import errors_of, random_starts
from .study import FIGURES, Made, Study, kept_figures, study_folder
from .tables import markdown
from .thinning import THINNED, with_projections
from .truth import find_truth, without_truth

_FILES = ("tables.json", "tables.md", "plot.png")


def compare(
    captures: Sequence[Path], out: Path, settings: CompareSettings, reporter: Reporter | None = None
) -> dict[str, Any]:
    """Runs the methods and writes `tables.json`, `tables.md` and `plot.png` into `out`, after each row anew.

    A comparison that was killed goes on; a finished row is not run again.

    Args:
        captures: capture folders of different names.
        out: the comparison's folder; holds one folder for each capture with one for each method. One that holds a
            comparison with another preset, seed, kernel or time, or something else, is refused.

    Returns:
        The content of `tables.json`.

    Raises:
        CaptureError, SettingError, RunFolderError, DiskFullError: the user's to mend.
        Cancelled: the user asked to stop; the same call goes on.
    """
    reporter, chosen, out = reporter or Reporter(), settings.settings or Settings.of(), Path(out)
    read = _read_all(captures, out, reporter)
    methods = choose_methods(settings.methods, read)
    distinct = without_repeats(methods, chosen)
    repeated = [method.name for method in methods if method not in distinct and method.name in settings.methods]
    if repeated:
        raise SettingError(
            f"--methods {repeated[0]}: at preset {chosen.preset} it is the same as another row; leave it out."
        )
    for capture in read:
        ablation_of(chosen, capture, settings.ablation_rows)
        for count in settings.projections:
            with_projections(capture, count)
    check_space(out)
    with exclusive(out / ".lock") as ours:
        if not ours:
            raise RunFolderError(f"{out}: another comparison is writing here; wait for it, or choose another --out.")
        tables = _Tables(out, chosen, settings, [capture.path.resolve().name for capture in read])
        for capture in read:
            folder = study_folder(out, capture)
            truth = find_truth(capture, folder, reporter)
            study = Study(without_truth(capture), folder, chosen, truth, reporter, settings.same_time)
            _Comparison(study, tables.of(capture.path.resolve().name), settings, distinct, tables.write).run()
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


class _Tables:
    """What was found so far; written anew after each row."""

    def __init__(self, out: Path, chosen: Settings, settings: CompareSettings, coming: Sequence[str] = ()) -> None:
        """`coming` are the names of the captures that are compared now."""
        self._out = out
        how = {
            "preset": chosen.preset,
            "seed": chosen.seed,
            "kernel": chosen.kernel,
            "same_time": settings.same_time,
            "settings": settings_digest(chosen),
        }
        measured = {"version": __version__, "figures": FIGURES}
        earlier = _own_captures(out, how, measured, coming)
        for path in settings.also:
            earlier |= _captures_of(path, {**how, **measured})
        self.content: dict[str, Any] = {"machine": machine(), **how, **measured, "captures": earlier}

    def of(self, name: str) -> dict[str, Any]:
        """Where a capture's figures go, in place of earlier ones."""
        self.content["captures"][name] = {"methods": {}, "ablation": {}, "projections": {}}
        return self.content["captures"][name]

    def write(self) -> None:
        content = plain(self.content)
        write_json(self._out / "tables.json", content)
        with atomic_write(self._out / "tables.md", "w") as stream:
            stream.write(markdown(content))
        draw_plot(content, self._out / "plot.png")


def settings_digest(settings: Settings) -> str:
    """Of every knob of every row: what a preset or a rival means changes from version to version."""
    rows = {
        name: method.own()
        if method.own
        else (method.for_iterations or method.for_count or _same)(method.change(settings), 1000)
        for name, method in {**METHODS, **{method.name: method for method in ABLATION}}.items()
    }
    return hashlib.sha256(json.dumps(plain(rows), sort_keys=True).encode()).hexdigest()[:12]


def _same(settings: Settings, count: int) -> Settings:
    return settings


def _own_captures(out: Path, how: dict[str, Any], measured: dict[str, Any], coming: Sequence[str]) -> dict[str, Any]:
    """The captures of the comparison that is in `out` already: it will come to them again, or was given others before.

    Raises:
        RunFolderError: going on would give up its rows, which were made in another way, or captures that are not
            `coming` again and were measured in another way; or it is something else.
    """
    own = read_dict(out / "tables.json")
    if own is None or not _is_comparison(own):
        foreign = next((out / name for name in _FILES if (out / name).exists()), None)
        if foreign is not None:
            raise RunFolderError(f"{foreign}: is not of a comparison; choose another --out, nothing was changed.")
        return {}
    lost = set(own["captures"]) - set(coming)
    for name, value in {**how, **measured}.items():
        # What was measured in another way, but made in the same, is measured anew when its turn comes.
        if own.get(name) != value and (own["captures"] if name in how else lost):
            raise RunFolderError(
                f"{out}: holds a comparison made {_difference(name, own.get(name), value, how['preset'])}; choose "
                "another --out, or delete that folder, nothing was changed."
            )
    return _with_machine(own) if all(own.get(name) == value for name, value in measured.items()) else {}


def _difference(name: str, before: Any, now: Any, preset: str) -> str:
    if name in ("settings", "version", "figures"):
        return f"by another version of the program, whose preset {preset} or measures are others"
    if name == "same_time":
        return f"{'with' if before else 'without'} the same time for radiative rows"
    return f"with {name} {before}, not {now}"


def _captures_of(path: Path, how: dict[str, Any]) -> dict[str, Any]:
    """The captures of an earlier comparison that was made in the same way.

    Raises:
        SettingError: the file is no tables.json, or another preset, seed, kernel or time was chosen.
    """
    content = read_dict(path) or {}
    if not _is_comparison(content):
        raise SettingError(f"--also {path}: is no tables.json of a comparison; name that file, or leave it out.")
    for name, value in how.items():
        if content.get(name) != value:
            difference = _difference(name, content.get(name), value, how["preset"])
            raise SettingError(f"--also {path}: was made {difference}; compare like with like.")
    return _with_machine(content)


def _is_comparison(content: dict[str, Any]) -> bool:
    return isinstance(content.get("captures"), dict) and "machine" in content


def _made_on(made: Made) -> dict[str, Any]:
    """The machine that a row was made on; its figures may be measured anew on another."""
    path, of = made.folder / "machine.json", plain([made.seconds, made.budget])
    kept = read_dict(path)
    if kept is None or kept.get("of") != of:
        kept = {"of": of, "machine": machine()}
        write_json(path, kept)
    return kept["machine"]


def _with_machine(content: dict[str, Any]) -> dict[str, Any]:
    return {name: {"machine": content["machine"], **one} for name, one in content["captures"].items()}


class _Comparison:
    """All that is measured of one capture."""

    def __init__(
        self,
        study: Study,
        figures: dict[str, Any],
        settings: CompareSettings,
        methods: Sequence[Method],
        write: Callable[[], None],
    ) -> None:
        self._study, self._figures, self._settings, self._write = study, figures, settings, write
        self._methods = [method for method in methods if method.reason_not_for(study.capture) is None]
        self._judge: SectionJudge | None = None
        self._surfaces: Surfaces | None = None

    def run(self) -> None:
        """Rows first, the InsideOut row before the others, whose time it sets."""
        study = self._study
        self._measure_by(study)
        for method in sorted(self._methods, key=lambda method: method.name != "insideout"):
            self._figures["methods"][method.name] = self._row(study, method)
            self._write()
        if study.truth is not None and any(method.name == "insideout" for method in self._methods):
            if study.capture.photos is not None and study.reference().report.get("similarity"):
                self._align()
            if self._settings.ablation:
                self._ablate()
        for count in self._settings.projections:
            self._thin(count)

    def _measure_by(self, study: Study) -> None:
        truth, capture = study.truth, study.capture
        self._figures["photos"] = None if capture.photos is None else len(capture.photos.photos)
        self._figures["truth"] = None
        if capture.projections is not None:
            self._figures["training_projections"] = int((~capture.projections.held_out).sum())
        if truth is None:
            return
        study.reporter.update(Progress(study.name, "truth", message="looking at what is true"))
        self._judge = SectionJudge.of(truth.volume, study.settings.kernel, study.reporter.check)
        self._surfaces = true_surfaces(truth)
        self._figures["truth"] = {
            "source": truth.source,
            "exact": truth.exact,
            "voxel_mm": truth.volume.spacing_mm,
            "held_out_sections": len(self._judge.held_out),
            "peak_per_mm": self._judge.peak,
            "sections": self._judge.truth(),
            "box_diagonal_mm": float(np.linalg.norm(self._surfaces.outer.extents)),
            "normals": {str(bins): normals_of(self._surfaces.whole, bins) for bins in BINS},
            # What voxels of that size can tell at all; nothing to say where the surfaces were taken from them.
            "mesh": None if truth.outer is None else volume_mesh(truth.volume, self._surfaces),
        }

    def _row(self, study: Study, method: Method) -> dict[str, Any]:
        try:
            made = study.make(method)
        except CaptureError as error:
            name, option = method.name, "--methods"
            if name.startswith(ABLATED):
                name, option = name.removeprefix(ABLATED), "--ablation-rows"
            raise CaptureError(f"{study.name}, row '{name}': {error} ({option} without {name} goes on.)") from error
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
        return {**figures, "label": method.label, "note": method.note, "machine": _made_on(made)}

    def _align(self) -> None:
        reference = self._study.reference()
        starts = random_starts(self._study, reference, self._settings.starts)
        ambiguity = reference.report["stages"]["align"].get("ambiguity") or {}
        self._figures["alignment"] = {
            "chamfer": reference.report.get("chamfer"),
            "chamfer_at_truth": self._chamfer_at_truth(reference),
            "refined": reference.report["stages"]["internal"].get("mode"),
            "ambiguity": "none" if ambiguity.get("decided_by_landmarks") else ambiguity.get("kind"),
            "by_landmarks": bool(ambiguity.get("decided_by_landmarks")),
            "errors": self._similarity_errors(reference),
            "starts": starts,
        }
        self._write()

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

    def _ablate(self) -> None:
        for method in ablation_of(self._study.settings, self._study.capture, self._settings.ablation_rows):
            self._figures["ablation"][method.name] = self._row(self._study, method)
            self._write()

    def _thin(self, count: int) -> None:
        study = self._study
        thinned = replace(
            study, capture=with_projections(study.capture, count), folder=study.folder / "projections" / str(count)
        )
        rows = self._figures["projections"].setdefault(str(count), {})
        for method in self._methods:
            if method.name in THINNED:
                rows[method.name] = self._row(thinned, method)
                self._write()
