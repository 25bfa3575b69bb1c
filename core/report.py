"""The last step of a run: its files for other programs, its figures, and `report.json`."""

from __future__ import annotations

import os
import platform
import shutil
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .errors import SettingError
from .files import atomic_write, plain, write_json
from .progress import Tick
from .residual_file import RESIDUAL_FILE, load_residuals, save_residuals
from .run_folder import STAGES, RunFolder
from .settings import Settings
from .stages.context import StageContext
from .told import Told
from .volume import Volume

if TYPE_CHECKING:
    from .render.voxels import LastAverages

PHOTO_UNIT = "photo unit (arbitrary)"
"""The unit of lengths of a model that no X-ray gave a scale."""


def write_report(context: StageContext, settings: Settings) -> dict[str, Any]:
    """Measures the finished run, leaves its files at the top of the run folder and writes `report.json`.

    Files: `rgb.ply`, `xray.ply`, `fused.ply` (those that the capture allows), `volume.npz` (the model's
    attenuation on the grid of the first volume), `mesh.glb` (of a model that has a surface), `residual.npz` (how well
    the projections agree with each splat of `fused.ply`), `curve.png`.

    Returns:
        The content of `report.json`: `seconds` (of the stages), `seconds_in_all` (with reading the capture, measuring
        the machine's speed and this report), `stages`, `heldout`, `residual`, `similarity`, `chamfer_mm`, `curve`
        (see `evaluate.curve`), `versions`, `machine`, `preset`, `seed`, `time_budget_s`, `until_db`, `units`,
        `water_per_mm` (see `Densities`), `effects` (what was looked for, see `effects.choose.Choice`), `endings` (why
        optimisations ended early), `warnings` (what the capture and the stages warned of, and those endings that nobody
        wished for), `warnings_told` (the same as `Told.to_json`).

    Raises:
        Cancelled: the user asked to stop; the stages are done, the next run writes the report.
    """
    from .endings import endings
    from .evaluate.curve import draw_curve, run_curve
    from .evaluate.report import evaluate_run
    from .render.voxels import LastAverages

    run, averages = context.run, LastAverages()
    context.progress("report", part="files", fraction=0.0)
    warnings: list[Told] = []
    files = _export(context.run, warnings, context.reporter.check, averages)
    context.progress("report", part="held-out views", fraction=0.3)
    figures = evaluate_run(context, averages)
    figures["residual"] = _residuals(context, files)
    stages = {stage: run.report(stage) for stage in STAGES}
    seconds = context.reporter.seconds()
    curve = run_curve(stages, figures["heldout"], seconds)
    draw_curve(curve, run.path / "curve.png")
    kept, broken = endings(stages, context.until, seconds, settings.time_budget_s)
    warnings = _warnings(context, stages) + warnings + broken
    report = {
        "preset": settings.preset,
        "seed": settings.seed,
        "kernel": ", ".join(dict.fromkeys(stage["kernel"] for stage in stages.values() if "kernel" in stage)),
        "time_budget_s": settings.time_budget_s,
        "until_db": settings.until_db,
        "seconds": sum(stage.get("seconds", 0.0) for stage in stages.values()),
        "seconds_in_all": seconds,
        "units": _units(context),
        "water_per_mm": context.capture.densities.water_per_mm,
        "effects": context.effects.rows("photos") + context.effects.rows("xray"),
        "endings": kept + broken,
        "warnings": warnings,
        "warnings_told": [warning.to_json() for warning in warnings],
        "files": [*files, "curve.png"],
        "similarity": run.similarity().to_json() if "similarity" in stages["align"] else None,
        **figures,
        "curve": curve,
        "stages": stages,
        "versions": _versions(),
        "machine": {"system": platform.platform(), "processor": platform.machine(), "cores": os.cpu_count()},
    }
    write_json(run.path / "report.json", report)
    context.progress("report", part="done", fraction=1.0)
    return plain(report)


def _units(context: StageContext) -> dict[str, str]:
    """Only X-rays bring millimetres: photos alone have the unit their cameras came in."""
    units = {
        "length": "mm",
        "density": context.capture.densities.unit,
        "psnr": "dB",
        "seconds": "s",
        "chamfer_mm": "mm",
    }
    if not any(context.run.has_set(stage, "xray") for stage in ("internal", "surface")):
        units["length"] = PHOTO_UNIT
    return units


def _warnings(context: StageContext, stages: dict[str, dict[str, Any]]) -> list[Told]:
    """What `check` warned of, and what the stages did."""
    found = [one for one in context.capture.findings if one.level != "info"]
    of_capture = [Told("{subject}: {message}", subject=one.subject, message=one.message) for one in found]
    return of_capture + [warning for report in stages.values() for warning in _of_stage(report)]


def _of_stage(report: dict[str, Any]) -> list[Told]:
    """What a stage's report warns of; English alone where a number in it was none."""
    try:
        return [Told.from_json(told) for told in report["warnings_told"]]
    except (KeyError, TypeError, ValueError):
        return [Told.from_json(text) for text in report.get("warnings", ())]


def _export(run: RunFolder, warnings: list[Told], tick: Tick, averages: LastAverages) -> list[str]:
    """Leaves the files and returns their names; says in `warnings` which could not be made."""
    left = []
    for name, stages in {
        "rgb": ("internal", "align", "surface"),
        "xray": ("internal", "surface"),
        "fused": ("fuse",),
    }.items():
        stage = next((stage for stage in stages if run.has_set(stage, name)), None)
        if stage:
            _copy(run.path / stage / f"{name}.ply", run.path / f"{name}.ply")
            left.append(f"{name}.ply")
    if any(run.has_set(stage, "xray") for stage in ("internal", "surface")):
        volume = _model_volume(run, tick, averages)
        volume.save(run.path / "volume.npz", run.densities, tick)
        left.append("volume.npz")
        try:
            _write_mesh(run, volume)
            left.append("mesh.glb")
        except SettingError as error:
            # Projections of next to nothing, or of a wire thinner than a voxel: all else is there all the same.
            (run.path / "mesh.glb").unlink(missing_ok=True)
            warnings.append(Told("there is no mesh: {error}", error=error.text))
    return left


def _model_volume(run: RunFolder, tick: Tick, averages: LastAverages) -> Volume:
    """The model's attenuation on the grid of the run's volume: what the fit refined, without FDK's streaks."""
    stage = "internal" if run.has_set("internal", "xray") else "surface"
    return averages(run.read_set(stage, "xray"), run.volume(), tick)


def _write_mesh(run: RunFolder, volume: Volume) -> None:
    from .mesh import color_mesh, extract_mesh, write_glb

    stage = next((stage for stage in ("internal", "align") if run.has_set(stage, "rgb")), None)
    mesh = color_mesh(extract_mesh(volume), run.read_set(stage, "rgb") if stage else None, volume)
    write_glb(mesh, run.path / "mesh.glb")


def _residuals(context: StageContext, files: list[str]) -> dict[str, Any]:
    """Leaves `residual.npz`, unless it is there from before and the splats are still the same, and returns its
    figures."""
    from .evaluate.residual import residual_figures, splat_residuals

    run, projections = context.run, context.projections
    fused = run.read_set("fuse", "fused") if run.has_set("fuse", "fused") else None
    if projections is None or fused is None or not (fused.density > 0).any():
        (run.path / RESIDUAL_FILE).unlink(missing_ok=True)
        return {"mean": None, "p95": None, "note": "there are no projections that the model could be compared with"}
    ply = run.path / "fused.ply"
    percent = load_residuals(run.path, ply, len(fused))
    if percent is None:

        def tick() -> None:
            context.progress("report", part="residuals", fraction=0.95)

        percent = splat_residuals(fused, projections, context.kernel, tick)
        save_residuals(run.path, percent, ply)
    files.append(RESIDUAL_FILE)
    return residual_figures(percent, fused)


def _copy(source: Path, target: Path) -> None:
    with atomic_write(target) as stream, open(source, "rb") as content:
        shutil.copyfileobj(content, stream, 1 << 20)


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for name in ("insideout", "torch", "numba", "numpy", "pycolmap", "scikit-image", "itk-rtk", "trimesh"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "missing"
    return found
