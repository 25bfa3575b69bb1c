"""The command `insideout`."""

from __future__ import annotations

import io
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape

from .bench.cli import app as bench
from .errors import Cancelled, InsideOutError, SettingError
from .progress import Reporter
from .terminal import Bars, run_table

if TYPE_CHECKING:
    from .capture.model import Finding

app = typer.Typer(
    help="One 3D Gaussian model of an object from photos and X-rays: coloured outside, true inside.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
app.add_typer(bench, name="bench")


def _show_version(wanted: bool) -> None:
    if wanted:
        version()
        raise typer.Exit


@app.callback()
def _commands(
    show_version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Prints the version.")
    ] = False,
) -> None:
    """Keeps every command a word of its own, however many there are."""


@app.command()
def run(
    capture: Annotated[Path, typer.Argument(help="Folder with photos/, xray/ or both.")],
    out: Annotated[Path, typer.Option(help="Run folder; an interrupted run is continued.")],
    preset: Annotated[
        str | None,
        typer.Option(
            help="draft (a first look), standard, or paper (long). [default: standard, or what fits the time]"
        ),
    ] = None,
    time_budget: Annotated[
        str | None, typer.Option(help="Make the best model that can be had in this time, as in 5min or 1h30min.")
    ] = None,
    until: Annotated[
        str | None,
        typer.Option(
            help="Stop each optimisation when photos that were kept back (without photos: projections) have so much, "
            "as in 32dB."
        ),
    ] = None,
    stage: Annotated[
        list[str] | None,
        typer.Option(
            help="Run only this stage (again): initialize, surface, align, internal or fuse; may be given more than "
            "once."
        ),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume/--fresh", help="Go on with a run, or start it over.")] = True,
    seed: Annotated[int, typer.Option(help="Of every random choice.")] = 0,
    kernel: Annotated[
        str, typer.Option(help="cpu, cuda (draws on an NVIDIA card) or reference (slow, to check the others by).")
    ] = "cpu",
    refine: Annotated[
        str, typer.Option(help="joint: photos and X-rays refine one model together; apart: each its half (the paper).")
    ] = "joint",
    effects: Annotated[
        str,
        typer.Option(
            help="What the capture shows besides the object: auto (look for it, use what is found), none, names as in "
            "geometry,exposure, or auto,-scatter."
        ),
    ] = "none",
) -> None:
    """Reconstructs a capture: five stages, then files, figures and report.json."""
    console = Console(stderr=True)
    with _stop_signal() as stopped, Bars(console) as bars:
        # Importing torch takes seconds; the signal is already listened to meanwhile.
        from .forecast.pace import parse_decibels, parse_duration
        from .pipeline import reconstruct

        report = reconstruct(
            capture,
            out,
            preset=preset,
            time_budget_s=None if time_budget is None else parse_duration(time_budget),
            until_db=None if until is None else parse_decibels(until),
            stages=stage or (),
            fresh=not resume,
            seed=seed,
            kernel=kernel,
            refine=refine,
            effects=effects,
            reporter=Reporter(bars.progress, stopped.is_set),
            on_stage=bars.stage,
        )
    Console().print(run_table(report))
    if "files" in report:
        typer.echo(f"Run: {out}  ({', '.join(report['files'])}, report.json)")


@app.command()
def check(capture: Annotated[Path, typer.Argument(help="Folder with photos/, xray/ or both.")]) -> None:
    """Says what a capture holds, what is wrong with it, and what to do."""
    from .capture.check import check_capture

    findings = check_capture(capture)
    _tell(findings)
    if any(finding.level == "error" for finding in findings):
        raise typer.Exit(2)


@app.command(name="bin")
def bin_command(
    scan: Annotated[Path, typer.Argument(help="Folder of a scan: a Nikon .xtekct with its .tif, or meta_data.json.")],
    out: Annotated[Path, typer.Option(help="New folder for the smaller scan, as my_object/xray.")],
    by: Annotated[
        int, typer.Option(help="Blocks of so many pixels squared become one; voxels get as much coarser.")
    ] = 4,
    every: Annotated[int, typer.Option(help="Keep one projection of so many.")] = 1,
) -> None:
    """Writes a scan with fewer pixels, projections and voxels, so that it fits into memory; the old one stays."""
    with _all_or_nothing(), _stop_signal() as stopped, Bars(Console(stderr=True)) as bars:
        from .capture.binning import bin_scan

        made = bin_scan(scan, out, by, every, Reporter(bars.progress, stopped.is_set))
    grid = " x ".join(map(str, made.voxels))
    typer.echo(f"Scan: {out}  ({made.projections} projections of {made.width} x {made.height} pixels, {grid} voxels)")
    _tell(made.findings, stderr=True)
    if made.dead:
        typer.echo(f"{made.dead} pixels saw no X-rays in any projection: blocks are the means of their other pixels")


@app.command()
def forecast(
    capture: Annotated[Path, typer.Argument(help="Folder with photos/, xray/ or both.")],
    refine: Annotated[str, typer.Option(help="joint or apart, as for run.")] = "joint",
    effects: Annotated[str, typer.Option(help="What is to be looked for, as for run.")] = "none",
    run: Annotated[
        Path | None, typer.Option(help="A finished run of this capture: what others will reach is told from it.")
    ] = None,
) -> None:
    """Says how long a run with each preset will take on this machine, and what it may reach.

    Times are from steps timed for some seconds, dB from runs of known objects, or from one of this capture.
    """
    if run is not None and refine != "joint":
        raise SettingError("--run: tells of runs with --refine joint alone; leave one of the two out.")
    console = Console(stderr=True)
    with _stop_signal() as stopped, Bars(console) as bars:
        from .capture.read import read_capture
        from .forecast.budget import preset_forecasts
        from .forecast.expected import finished_run, qualities_of
        from .forecast.text import forecast_lines

        reporter = Reporter(bars.progress, stopped.is_set)
        read = read_capture(capture, reporter.check)
        known = None if run is None else finished_run(run, read)
        found = preset_forecasts(read, refine, reporter, effects)
    for line in forecast_lines(found, qualities_of(read, refine), known):
        typer.echo(line)


@app.command()
def phantom(
    context: typer.Context,
    name: Annotated[
        str,
        typer.Argument(
            help="matryoshka, pharaoh, skull, terracotta, toy_gun, shepp_logan, or the file of a CT volume."
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder of the new capture.")],
    views: Annotated[int, typer.Option(min=1, help="Photos.")] = 44,
    angles: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Projections to train on: 50, of shepp_logan and a volume 75. An eighth more are held out, of "
            "shepp_logan 6.",
        ),
    ] = None,
    size: Annotated[int, typer.Option(help="Pixels of a photo's longer side; the detector has 58 % as many.")] = 256,
    effects: Annotated[
        str | None,
        typer.Option(
            help="Of photos: defocus, lens, rolling_shutter, motion_blur, moving_background, exposure, table; of "
            "X-rays: noise, beam_hardening, scatter, geometry, motion, focal_spot, ring, truncation; with commas "
            "between, '' for none. If not given: noise, and with Cycles table."
        ),
    ] = None,
    photos_by: Annotated[str, typer.Option(help="cycles (needs Blender), or rays (built in, plainer).")] = "cycles",
    seed: Annotated[int, typer.Option(min=0, help="Of noise, cameras and the photo frame.")] = 0,
    voxel_mm: Annotated[float, typer.Option(help="Voxels of the reconstruction grid and of the truth.")] = 0.75,
    surface_mm: Annotated[float, typer.Option(help="Triangles of the truth's surfaces.")] = 1.0,
    shells: Annotated[int | None, typer.Option(min=1, max=9, help="Of the matryoshka, 1 to 9.")] = None,
    landmarks: Annotated[
        bool | None,
        typer.Option(help="Write landmarks.json, true points for the alignment; if not given, for the matryoshka."),
    ] = None,
    fdk: Annotated[
        bool, typer.Option(help="Write fdk.npz, too: the usual CT reconstruction. Some seconds more.")
    ] = False,
) -> None:
    """Makes a synthetic capture of an object whose inside is known.

    shepp_logan is the head of the textbooks, X-rays alone in a fixed protocol; it takes angles, seed and fdk alone.
    The file of a CT volume (.nii.gz, .mha, .nrrd, .npz, .npy, .tif, or a folder of DICOM slices) is X-rayed anew: how
    few projections would do? Of the options it takes angles, size, effects (noise or '') and seed.
    """
    from .phantoms.make import PHANTOMS, CaptureSettings, make_capture, sized

    if name == "shepp_logan":
        from .phantoms.shepp_logan import SheppLoganScan, make_shepp_logan

        _refuse_all_but(context, ("angles", "seed", "fdk"), "shepp_logan")
        scan = SheppLoganScan(angles=75 if angles is None else angles, seed=seed)
        with _all_or_nothing(), _stop_signal() as stopped, Bars(Console(stderr=True)) as bars:
            make_shepp_logan(out, scan=scan, reporter=Reporter(bars.progress, stopped.is_set), with_fdk=fdk)
        typer.echo(f"Capture: {out}", err=True)
        return
    if Path(name).exists() and name not in PHANTOMS:
        _refuse_all_but(context, ("angles", "size", "effects", "seed"), f"the volume {name}")
        _scan_anew(Path(name), out, 75 if angles is None else angles, size, effects, seed)
        return
    angles = 50 if angles is None else angles
    if effects is None:
        effects = "noise,table" if photos_by == "cycles" else "noise"
    settings = CaptureSettings(
        photos=views,
        photos_by=photos_by,
        projections=angles,
        heldout_projections=angles // 8,
        effects=_names(effects),
        voxel_mm=voxel_mm,
        surface_mm=surface_mm,
        shells=shells,
        landmarks=landmarks,
        fdk=fdk,
    )
    with _all_or_nothing(), _stop_signal() as stopped, Bars(Console(stderr=True)) as bars:
        settings = sized(name, size, settings)
        make_capture(name, out, settings, seed, Reporter(bars.progress, stopped.is_set))
    typer.echo(f"Capture: {out}", err=True)


def _tell(findings: Sequence[Finding], stderr: bool = False) -> None:
    console = Console(soft_wrap=True, stderr=stderr)
    marks = {"info": "[green]ok[/]", "warning": "[yellow]warning[/]", "error": "[red]error[/]"}
    for finding in findings:
        advice = f" -> {finding.advice}" if finding.advice else ""
        text = escape(f"{finding.subject}: {finding.message}{advice}")
        console.print(f"{marks[finding.level]} {text}", highlight=False)


def _scan_anew(source: Path, out: Path, angles: int, size: int, effects: str | None, seed: int) -> None:
    from .phantoms.make import DETECTOR_SHARE
    from .phantoms.scanned import ScanSettings, make_scanned

    with _all_or_nothing(), _stop_signal() as stopped, Bars(Console(stderr=True)) as bars:
        if size < 16:
            raise SettingError(f"size is {size}; give at least 16 pixels.")
        chosen = ("noise",) if effects is None else _names(effects)
        if set(chosen) - {"noise"}:
            raise SettingError(f"--effects {effects}: of a volume there is noise alone; choose noise or ''.")
        settings = ScanSettings(
            angles=angles, heldout=angles // 8, size=round(DETECTOR_SHARE * size), noise=bool(chosen), seed=seed
        )
        findings = make_scanned(source, out, settings, Reporter(bars.progress, stopped.is_set))
    _tell(findings, stderr=True)
    typer.echo(f"Capture: {out}", err=True)


def _refuse_all_but(context: typer.Context, taken: Sequence[str], what: str) -> None:
    """Raises SettingError for an option that was given and that `what` does not take."""
    for option in context.params:
        source = context.get_parameter_source(option)
        if option not in ("name", "out", *taken) and source is not None and source.name == "COMMANDLINE":
            raise SettingError(f"--{option.replace('_', '-')}: is not for {what}; leave it out.")


def _names(listed: str) -> tuple[str, ...]:
    """Names between commas, each once."""
    return tuple(dict.fromkeys(name.strip() for name in listed.split(",") if name.strip()))


@app.command()
def compare(
    captures: Annotated[list[Path], typer.Argument(help="Capture folders; with truth.npz rows are measured by it.")],
    out: Annotated[Path, typer.Option(help="Folder of the comparison; an interrupted one is continued.")],
    methods: Annotated[
        str,
        typer.Option(
            help="Rows, with commas between; all that the captures allow. Any of 3dgs, mcmc, defocus, mask, "
            "pixel_integration, rolling_shutter, naf, x_gaussian, r2_gaussian, r2_at_our_rates, sart, fdk, additive, "
            "gs2mesh, insideout, apart."
        ),
    ] = "",
    preset: Annotated[str, typer.Option(help="draft (a first look), standard, or paper (long).")] = "standard",
    starts: Annotated[int, typer.Option(help="Random starts of the alignment; 0 for none.")] = 20,
    projections: Annotated[str, typer.Option(help="Also with fewer projections, as in 75,50,25.")] = "",
    seconds_like: Annotated[
        str, typer.Option(help="insideout: equal X-ray time for radiative rows; or none.")
    ] = "insideout",
    ablation: Annotated[
        bool, typer.Option("--ablation/--no-ablation", help="Also run InsideOut with one part switched off each.")
    ] = True,
    ablation_rows: Annotated[str, typer.Option(help="Only some of those, as in none,align,apart.")] = "",
    also: Annotated[
        list[Path] | None,
        typer.Option(
            help="tables.json of an earlier comparison: its other captures are shown beside these, its rows of the "
            "same capture are kept."
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Of every random choice.")] = 0,
    kernel: Annotated[
        str, typer.Option(help="cpu, cuda (draws on an NVIDIA card) or reference (slow, to check the others by).")
    ] = "cpu",
) -> None:
    """Runs the methods of the paper's tables and writes them beside the paper's own figures."""
    from .compare.options import compare_settings

    settings = compare_settings(
        _names(methods),
        preset,
        seed,
        kernel,
        starts,
        projections,
        seconds_like,
        ablation,
        also or (),
        _names(ablation_rows),
    )
    with _stop_signal() as stopped, Bars(Console(stderr=True)) as bars:
        from .compare.compare import compare as run_comparison

        run_comparison(captures, out, settings, Reporter(bars.progress, stopped.is_set))
    typer.echo(f"Comparison: {out}  (tables.md, tables.json, plot.png, and sections.png of each capture)")


@app.command()
def version() -> None:
    """Prints the version."""
    from .. import __version__

    typer.echo(__version__)


@contextmanager
def _stop_signal() -> Iterator[threading.Event]:
    """An event that Ctrl-C sets: work stops between two iterations and keeps its checkpoint. A second one kills."""
    stopped = threading.Event()

    def on_signal(number: int, _: Any) -> None:
        stopped.set()
        signal.signal(number, signal.SIG_DFL)

    kinds = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(kind, on_signal) for kind in kinds]
    try:
        yield stopped
    finally:
        for kind, handler in zip(kinds, before, strict=True):
            signal.signal(kind, handler)


@contextmanager
def _all_or_nothing() -> Iterator[None]:
    """For work that keeps no checkpoint: says so when it is stopped."""
    try:
        yield
    except Cancelled:
        raise Cancelled("stopped; nothing was kept, the same command starts over.") from None


def main() -> None:
    """Runs the command line: one sentence and exit code 2 for a user's mistake, 130 when stopped."""
    # What a terminal or a pipe has no letters for, as names of files from other systems, is no reason to end.
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        app(standalone_mode=True)
    except InsideOutError as error:
        print(f"insideout: {error}", file=sys.stderr)
        sys.exit(2)
    except (Cancelled, KeyboardInterrupt) as stop:
        print(f"insideout: {str(stop) or 'stopped; run the same command again to go on.'}", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    main()
