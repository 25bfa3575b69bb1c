"""What the command line shows while it works, and of a run in the end."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Column, Table

from .digits import decimals, fixed
from .progress import Progress as StageProgress


class Bars:
    """One progress bar a stage."""

    def __init__(self, console: Console) -> None:
        self._console = console
        # Of 80 columns the times and the rest need 30: a comparison's rows have names as long as all that is left.
        name = Column(min_width=10, max_width=max(console.width - 60, 20), no_wrap=True, overflow="ellipsis")
        self._bars = Progress(
            TextColumn("{task.fields[stage]}", table_column=name),
            BarColumn(bar_width=20 if console.width >= 100 else 8),
            TextColumn("{task.percentage:>3.0f}%", table_column=Column(min_width=4, no_wrap=True)),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[note]}", markup=False, table_column=Column(ratio=1, overflow="fold")),
            console=console,
            expand=True,
        )
        self._tasks: dict[str, TaskID] = {}

    def __enter__(self) -> Bars:
        self._bars.start()
        return self

    def __exit__(self, *_: Any) -> None:
        self._bars.stop()

    def progress(self, progress: StageProgress) -> None:
        task = self._task(progress.stage)
        note = [progress.part]
        if progress.iterations:
            note.append(f"{progress.iteration}/{progress.iterations}")
        if progress.splats is not None:
            note.append(f"{progress.splats} splats")
        if progress.loss is not None:
            note.append(f"loss {progress.loss:.4f}")
        if progress.heldout_psnr is not None:
            self._console.print(
                f"{progress.stage} {progress.part}: held-out {progress.heldout_psnr:.1f} dB", highlight=False
            )
        if progress.message:
            note.append(progress.message)
        self._bars.update(task, completed=progress.fraction, note="  ".join(filter(None, note)))

    def stage(self, stage: str, state: str, report: dict[str, Any]) -> None:
        note = {"skipped": f"skipped: {report.get('skipped', '')}", "done": "done", "kept": "was done"}.get(state, "")
        self._bars.update(self._task(stage), completed=float(state != "started"), note=note)

    def _task(self, stage: str) -> TaskID:
        if stage not in self._tasks:
            self._tasks[stage] = self._bars.add_task("", total=1.0, stage=stage, note="")
        return self._tasks[stage]


def run_table(report: dict[str, Any]) -> Table:
    """The run's figures: seconds and splats a stage, then held-out quality by model."""
    table = Table(title="InsideOut", title_justify="left", show_header=False)
    table.add_column("what")
    table.add_column("figure", overflow="fold")
    for name, stage in report.get("stages", {}).items():
        if "skipped" in stage:
            table.add_row(name, escape(f"skipped: {stage['skipped']}"))
        else:
            splats = stage.get("splats")
            table.add_row(name, f"{stage['seconds']:.1f} s" + (f", splats: {_splats(splats)}" if splats else ""))
    table.add_section()
    for what, figures in (report.get("heldout") or {}).items():
        quality = _quality(figures or {})
        if quality:
            table.add_row(f"held-out {what}", quality)
    residual = report.get("residual") or {}
    if residual.get("mean") is not None:
        table.add_row("residual", f"mean {residual['mean']:.2g}, 95 % under {residual['p95']:.2g} {residual['unit']}")
    similarity = report.get("similarity")
    if similarity:
        scale = similarity["scale"]
        table.add_row("photo frame", f"1 unit = {fixed(scale, decimals(scale, 4, 3))} mm")
    elif (report.get("units") or {}).get("length", "mm") != "mm":
        table.add_row("lengths", "in the photos' arbitrary unit: without X-rays there are no millimetres")
    for effect in report.get("effects") or ():
        table.add_row(f"effect {effect['name']}", escape(("used: " if effect["used"] else "") + effect["reason"]))
    # Those that nobody wished for are among the warnings.
    warnings = report.get("warnings") or ()
    for ending in report.get("endings") or ():
        if ending not in warnings:
            table.add_row("ended", escape(ending))
    for warning in warnings:
        table.add_row("warning", escape(warning))
    steps = [f"{k} {v:.3g}" for k, v in (report.get("chamfer_mm") or {}).items() if isinstance(v, float)]
    if steps:
        table.add_row("chamfer (mm)", ", ".join(steps))
    return table


def _splats(splats: Any) -> str:
    if isinstance(splats, dict):
        return ", ".join(f"{name} {count}" for name, count in splats.items())
    return str(splats)


def _quality(figures: dict[str, Any]) -> str:
    rows = [("final", figures), ("rgb alone", figures.get("rgb")), ("xray alone", figures.get("xray"))]
    units = {"psnr": "{:.2f} dB", "ssim": "SSIM {:.3f}", "piqe": "PIQE {:.1f}"}
    parts = []
    for name, row in rows:
        values = [text.format(row[key]) for key, text in units.items() if row and row.get(key) is not None]
        if values:
            parts.append(f"{name}: {', '.join(values)}")
    return "\n".join(parts)
