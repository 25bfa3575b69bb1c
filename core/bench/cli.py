"""`insideout bench`: what it takes from the command line, and how it shows what was measured."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from ..errors import SettingError
from ..files import write_json
from ..progress import Reporter

app = typer.Typer(help="Measures speed, memory and accuracy on this machine.", no_args_is_help=True)

_Json = Annotated[Path | None, typer.Option("--json", help="Also save the rows as JSON here.")]
_Markdown = Annotated[bool, typer.Option("--markdown", help="Print Markdown tables instead.")]
_Captures = Annotated[list[Path], typer.Argument(help="Folders with photos/, xray/ or both.")]
_Runs = Annotated[Path, typer.Option(help="Folder of the runs; a measurement that was broken off is continued.")]
_Presets = Annotated[str, typer.Option(help="With commas between.")]


@app.command()
def kernels(
    kernel: Annotated[str, typer.Option(help="cpu, reference or cuda.")] = "cpu",
    renderer: Annotated[list[str] | None, typer.Option(help="Only this one; may be given more than once.")] = None,
    splats: Annotated[str, typer.Option(help="Numbers of splats, as in 1e4,5e4.")] = "",
    sizes: Annotated[str, typer.Option(help="Sides of the square image in pixels, as in 200,400.")] = "",
    threads: Annotated[str, typer.Option(help="Numbers of threads, as in 1,2, for 5e4 splats at 400.")] = "",
    repeats: Annotated[int | None, typer.Option(help="Steps timed for a row.")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Small sizes only: under a minute.")] = False,
    json: _Json = None,
    markdown: _Markdown = False,
) -> None:
    """Times forward, backward and sorting, and their share of this machine's multiply-add peak.

    With --kernel cuda, splats are drawn by gsplat as well where that is installed.
    """
    from dataclasses import replace

    from .kernels import Grid, available_threads, growth, measure
    from .tables import growth_table, kernels_table

    grid = Grid.quick() if quick else Grid(threads=tuple(range(1, available_threads() + 1)))
    given: dict[str, Any] = {
        "renderers": tuple(renderer or ()),
        "splats": _numbers("--splats", splats),
        "sides": _numbers("--sizes", sizes),
        "threads": _numbers("--threads", threads),
    }
    grid = replace(grid, kernel=kernel, **{name: value for name, value in given.items() if value})
    if repeats is not None:
        grid = replace(grid, repeats=repeats)
    grid.check()
    with Console(stderr=True).status("") as status:
        rows = measure(grid, status.update)
    _save(json, rows)
    grown = growth([row for row in rows if row["kernel"] == kernel], grid.middle)
    _show([kernels_table(rows), *([growth_table(grown)] if grown else [])], rows[0], markdown, "kernels")


@app.command()
def agreement(
    scenes: Annotated[int, typer.Option(help="Random scenes for each renderer.")] = 200,
    seed: Annotated[int, typer.Option(help="Number of the first scene; the others follow it.")] = 0,
    kernel: Annotated[str, typer.Option(help="cpu, reference (in float32) or cuda.")] = "cpu",
    renderer: Annotated[list[str] | None, typer.Option(help="Only this one; may be given more than once.")] = None,
    json: _Json = None,
    markdown: _Markdown = False,
) -> None:
    """Compares images and gradients with the float64 reference; exit code 1 when one errs by more than its bar."""
    from .agreement import measure_agreement
    from .kernels import RENDERERS
    from .machine import machine
    from .tables import agreement_table

    facts = machine()
    with Console(stderr=True).status("") as status:
        reporter = Reporter(lambda now: status.update(f"{now.part}, scene {now.iteration} of {now.iterations}"))
        found = measure_agreement(scenes, seed, renderer or RENDERERS, kernel, reporter)
    rows = [{**row.to_json(), "kernel": kernel, "seed": seed, **facts} for row in found]
    _save(json, rows)
    command = f"agreement --kernel {kernel} --scenes {scenes} --seed {seed}"
    _show([agreement_table(rows, kernel)], facts, markdown, command)
    complaints = [row.complaint for row in found if row.over_bar]
    for complaint in complaints:
        typer.echo(complaint, err=True)
    if complaints:
        raise typer.Exit(1)


@app.command()
def affine(
    splats: Annotated[int, typer.Option(help="Number of splats in the scene that is timed.")] = 50_000,
    size: Annotated[int, typer.Option(help="Side of its square radiograph in pixels.")] = 400,
    json: _Json = None,
    markdown: _Markdown = False,
) -> None:
    """Measures what the radiograph's affine mode saves in time and loses in accuracy."""
    from .affine import measure_errors, measure_times
    from .machine import machine
    from .scenes import scene
    from .tables import affine_errors_table, affine_times_table

    if min(splats, size) < 1:
        raise SettingError("bench affine: give --splats and --size of at least 1.")
    facts = machine()
    with Console(stderr=True).status(f"radiograph, {splats} splats, {size} x {size}, both modes"):
        errors, times = measure_errors(), measure_times(scene(splats, size))
    _save(json, [{**row, **facts} for row in [*times, *errors]])
    _show([affine_times_table(times), affine_errors_table(errors)], facts, markdown, "affine")


@app.command()
def training(
    iterations: Annotated[int, typer.Option(help="Photos shown.")] = 2000,
    splats: Annotated[int, typer.Option(help="Number of splats, from the start to the end.")] = 10_000,
    size: Annotated[int, typer.Option(help="Side of the square photos in pixels.")] = 200,
    kernel: Annotated[str, typer.Option(help="cpu or cuda.")] = "cpu",
    json: _Json = None,
    markdown: _Markdown = False,
) -> None:
    """Trains on 40 photos of a simple object and measures on 40 others."""
    from .tables import shares_table, training_table
    from .training import TrainingCase, train

    if min(iterations, splats, size) < 1:
        raise SettingError("bench training: give --iterations, --splats and --size of at least 1.")
    if kernel not in ("cpu", "cuda"):
        raise SettingError(f"--kernel {kernel}: a training is not measured with it; choose cpu or cuda.")
    with Console(stderr=True).status("") as status:
        row = train(TrainingCase(splats=splats, side=size, iterations=iterations, kernel=kernel), status.update)
    _save(json, [row])
    _show([training_table([row]), shares_table(row["share"])], row, markdown, f"training --kernel {kernel}")


@app.command()
def memory(
    renderer: Annotated[list[str] | None, typer.Option(help="Only this one; may be given more than once.")] = None,
    splats: Annotated[int, typer.Option(help="Number of splats.")] = 1_000_000,
    size: Annotated[int, typer.Option(help="Side of the square image in pixels.")] = 800,
    json: _Json = None,
    markdown: _Markdown = False,
) -> None:
    """Measures the most memory that a forward and backward pass takes."""
    from .kernels import RENDERERS, Grid
    from .memory import measure_memory
    from .tables import memory_table

    names = tuple(renderer or RENDERERS)
    Grid(renderers=names, splats=(splats,), sides=(size,)).check()
    rows = []
    with Console(stderr=True).status("") as status:
        for name in names:
            status.update(f"{name}, {splats} splats, {size} x {size}")
            rows.append(measure_memory(name, splats, size))
    _save(json, rows)
    _show([memory_table(rows)], rows[0], markdown, "memory")


@app.command()
def options(
    capture: Annotated[Path, typer.Argument(help="Folder with photos/, xray/ or both.")],
    preset: Annotated[str, typer.Option(help="draft, standard or paper.")] = "draft",
    half: Annotated[list[str] | None, typer.Option(help="Only this one: rgb (photos) or xray (projections).")] = None,
    json: _Json = None,
    markdown: _Markdown = False,
) -> None:
    """Fits a capture's photos and projections with and without the options that save steps."""
    from .options import HALVES, measure_options
    from .tables import options_table

    with Console(stderr=True).status("") as status:
        rows = measure_options(capture, preset, halves=half or HALVES, tell=status.update)
    _save(json, rows)
    _show([options_table(rows)], rows[0], markdown, f"options {capture} --preset {preset}")


@app.command()
def cut(
    splats: Annotated[str, typer.Option(help="Numbers of splats, as in 6e4,2e5.")] = "6e4,2e5,1e6",
    size: Annotated[int, typer.Option(help="Side of the square section in pixels.")] = 512,
    positions: Annotated[int, typer.Option(help="Places of the plane, evenly through the model.")] = 20,
    model: Annotated[Path | None, typer.Option(help="Also a model of your own: the .ply of a run.")] = None,
    json: _Json = None,
    markdown: _Markdown = False,
) -> None:
    """Times the section that follows a plane in Blender: numpy alone, on one core, through made-up cubes of splats."""
    from ..gaussians import GaussianSet
    from .cut import measure_cuts
    from .machine import machine
    from .tables import cuts_table

    counts = _numbers("--splats", splats)
    if min(*counts, size, positions) < 1:
        raise SettingError("bench cut: give --splats, --size and --positions of at least 1.")
    facts = machine()
    rows = []
    with Console(stderr=True).status("") as status:
        for count in counts:
            status.update(f"{count} splats, {size} x {size}")
            rows.append({**measure_cuts(count, size, positions), **facts})
        if model is not None:
            status.update(f"{model}, {size} x {size}")
            rows.append({**measure_cuts(GaussianSet.load(model), size, positions, name=model.stem), **facts})
    _save(json, rows)
    _show([cuts_table(rows)], facts, markdown, "cut")


@app.command()
def weight(
    phantom: Annotated[list[str] | None, typer.Option(help="Only this one; may be given more than once.")] = None,
    voxel_mm: Annotated[float, typer.Option(help="Side of a voxel of the phantoms' scans.")] = 0.75,
    quick: Annotated[bool, typer.Option("--quick", help="No phantoms: some seconds.")] = False,
    json: _Json = None,
    markdown: _Markdown = False,
) -> None:
    """How far mass, centre, inertia and cavities are off: bodies that have a formula, and two phantoms."""
    from .machine import machine
    from .tables import weights_table
    from .weight import PHANTOMS, measure_weights

    facts = machine()
    with Console(stderr=True).status("") as status:
        rows = measure_weights(() if quick else phantom or tuple(PHANTOMS), voxel_mm, status.update)
    _save(json, [{**row, **facts} for row in rows])
    _show([weights_table(rows)], facts, markdown, "weight")


@app.command()
def accuracy(
    capture: Annotated[Path, typer.Argument(help="Folder with photos/, xray/ or both.")],
    out: Annotated[Path, typer.Option(help="Folder of the measurement; one that was broken off is continued.")],
    preset: Annotated[str, typer.Option(help="That knobs are turned from: draft, standard or paper.")] = "draft",
    presets: Annotated[str, typer.Option(help="Measured as well, with commas between.")] = "draft,standard",
    knobs: Annotated[str, typer.Option(help="Only these, with commas between; all if not given.")] = "",
    seed: Annotated[int, typer.Option(help="Of every random choice.")] = 0,
    markdown: _Markdown = False,
) -> None:
    """What accuracy costs in time: every knob alone, and the presets, each a whole run; a table, a plot, a JSON."""
    from ..settings import Settings
    from .accuracy.measure import AccuracySettings, measure_accuracy
    from .accuracy.table import accuracy_table, presets_table

    how = AccuracySettings(Settings.of(preset, seed), _words(knobs), _words(presets))
    with _watched() as reporter:
        content = measure_accuracy(capture, out, how, reporter)
    tables = [accuracy_table(content), presets_table(content)]
    _show(tables, content["machine"], markdown, f"accuracy {capture} --preset {preset}")
    typer.echo(f"{out / 'accuracy.json'}, {out / 'accuracy.png'}", err=True)


@app.command()
def forecast(
    captures: _Captures,
    out: _Runs,
    presets: _Presets = "draft",
    json: _Json = None,
    markdown: _Markdown = False,
) -> None:
    """Whether runs take what `insideout forecast` says: the forecast of each capture, then the run itself."""
    from ..settings import Settings
    from .foretold import measure_forecasts
    from .machine import machine
    from .tables import foretold_table

    facts, settings = machine(), [Settings.of(preset) for preset in _words(presets)]
    with _watched() as reporter:
        rows = measure_forecasts(captures, settings, out, reporter)
    if json is not None:
        write_json(json, {"machine": facts, "rows": rows})
    _show([foretold_table(rows)], facts, markdown, "forecast")


@app.command()
def budget(
    captures: _Captures,
    out: _Runs,
    presets: _Presets = "draft",
    json: _Json = None,
    markdown: _Markdown = False,
) -> None:
    """Whether --time-budget is kept: each preset's run, then one with the time that it took."""
    from ..settings import Settings
    from .in_time import measure_budgets
    from .machine import machine
    from .tables import budgets_table

    facts, settings = machine(), [Settings.of(preset) for preset in _words(presets)]
    with _watched() as reporter:
        rows = measure_budgets(captures, settings, out, reporter)
    if json is not None:
        write_json(json, {"machine": facts, "rows": rows})
    _show([budgets_table(rows)], facts, markdown, "budget")


@app.command()
def reached(
    runs: Annotated[list[Path], typer.Argument(help="Folders of finished runs, each of a whole preset.")],
    json: _Json = None,
    markdown: _Markdown = False,
) -> None:
    """Collects what presets reached: `insideout forecast` tells from such rows what a run may reach."""
    from ..forecast.expected import FinishedRun
    from ..settings import PRESETS
    from .machine import machine
    from .tables import reached_table

    rows = [FinishedRun.read(run).row() for run in runs]
    rows.sort(key=lambda row: (row["capture"], PRESETS.index(row["preset"])))
    facts = machine()
    if json is not None:
        write_json(json, {"machine": facts, "rows": rows})
    _show([reached_table(rows)], facts, markdown, "reached")


@contextmanager
def _watched() -> Iterator[Reporter]:
    """A reporter of runs, whose stage and share done stand in the terminal."""
    with Console(stderr=True).status("") as status:
        yield Reporter(lambda now: status.update(f"{now.stage} {now.part} {100 * now.fraction:.0f} %"))


def _words(text: str) -> tuple[str, ...]:
    return tuple(word.strip() for word in text.split(",") if word.strip())


def _numbers(option: str, text: str) -> tuple[int, ...]:
    """Whole numbers from "1e4,5e4"; none from "".

    Raises:
        SettingError: something else is in it.
    """
    found = []
    for part in filter(None, text.split(",")):
        try:
            value = float(part)
        except ValueError:
            value = 0.5
        if not value.is_integer():
            raise SettingError(f"{option} {text}: '{part}' is not a whole number; write them as 1e4,5e4.")
        found.append(int(value))
    return tuple(found)


def _save(path: Path | None, rows: list[dict[str, Any]]) -> None:
    if path is not None:
        write_json(path, rows)


def _show(tables: list[Any], facts: dict[str, Any], markdown: bool, what: str) -> None:
    from .machine import summary

    if markdown:
        parts = [f"`insideout bench {what}`: {summary(facts)}", *(table.markdown() for table in tables)]
        typer.echo("\n\n".join(parts))
        return
    console = Console()
    console.print(summary(facts), highlight=False)
    for table in tables:
        table.show(console)
