"""The engine as a process of its own: JSON lines out, the word "cancel" in.

Blender starts `python -m insideout.core.worker ...` and reads one JSON object a line from its standard output,
told apart by `type`: progress, finding, forecast, stage, done, error, cancelled, version. An error has its `message`
and, to be translated, `template` and `values` of which it was made; findings, stages and progress have those of their
texts in `told`. A line "cancel" on standard input, or its end, cancels. Exit codes: 0 done, 2 the user's mistake, 130
cancelled, 1 a fault of the program.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import threading
import traceback
from contextlib import suppress
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from .errors import Cancelled, InsideOutError, SettingError
from .files import plain
from .progress import Progress, Reporter
from .told import Told

EXIT_USER_ERROR, EXIT_CANCELLED = 2, 130
RUN_VARIABLE = "INSIDEOUT_RUN"
"""Names the run folder from which `forecast` tells what presets may reach: engines of before it must not fail of it."""


def main(arguments: list[str] | None = None) -> int:
    """Runs one command and returns the exit code."""
    options = _parser().parse_args(arguments)
    # Libraries print to standard output; only the protocol may.
    protocol, sys.stdout = sys.stdout, sys.stderr

    def send(message: str, /, **content: Any) -> None:
        protocol.write(json.dumps(plain({"type": message, **content})) + "\n")
        protocol.flush()

    try:
        commands = {"run": _run, "check": _check, "forecast": _forecast, "version": _version}
        return commands[options.command](options, send)
    except Cancelled:
        send("cancelled")
        return EXIT_CANCELLED
    except InsideOutError as error:
        send("error", kind=_public_kind(error), message=str(error), told=error.told())
        return EXIT_USER_ERROR
    except Exception as error:
        traceback.print_exc()
        what = InsideOutError(
            "The engine failed ({kind}: {error}); report this with the log, please.",
            kind=type(error).__name__,
            error=error,
        )
        send("error", kind=type(error).__name__, message=str(what), told=what.told())
        return 1


def _public_kind(error: InsideOutError) -> str:
    """The name of the error's nearest class in `core.errors`: those are what other programs may rely on."""
    return next(kind.__name__ for kind in type(error).__mro__ if kind.__module__ == InsideOutError.__module__)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="insideout.core.worker", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    run = commands.add_parser("run")
    run.add_argument("capture", type=Path)
    run.add_argument("--out", type=Path, required=True)
    run.add_argument("--preset")
    run.add_argument("--time-budget")
    run.add_argument("--until")
    run.add_argument("--stage", action="append", default=[])
    run.add_argument("--seed", type=int, default=0)
    run.add_argument("--kernel", default="cpu")
    run.add_argument("--refine", default="joint")
    run.add_argument("--effects", default="none")
    run.add_argument("--resume", action="store_true", help="go on with what is there (the default)")
    run.add_argument("--fresh", action="store_true", help="start over")
    check = commands.add_parser("check")
    check.add_argument("capture", type=Path)
    ahead = commands.add_parser("forecast")
    ahead.add_argument("capture", type=Path)
    ahead.add_argument("--refine", default="joint")
    ahead.add_argument("--effects", default="none")
    commands.add_parser("version")
    return parser


def _run(options: argparse.Namespace, send: Any) -> int:
    cancelled = _watch_input()

    def on_progress(progress: Progress) -> None:
        _send_progress(send, progress)

    def on_stage(stage: str, state: str, report: dict[str, Any]) -> None:
        reason = report.get("skipped")
        # Of a stage that is kept it was read from a file.
        told = Told.from_json(reason).to_json() if reason else None
        details = {"seconds": report.get("seconds"), "reason": reason, "told": told}
        if state == "kept":
            from .evaluate.curve import stage_curve

            # It was measured for another listener.
            details["heldout"] = stage_curve(stage, report) or None
        send("stage", stage=stage, state=state, **{k: v for k, v in details.items() if v is not None})

    # Importing torch takes seconds; the listener above already hears a cancel meanwhile.
    from .forecast.pace import parse_decibels, parse_duration
    from .pipeline import reconstruct

    report = reconstruct(
        options.capture,
        options.out,
        preset=options.preset,
        time_budget_s=None if options.time_budget is None else parse_duration(options.time_budget),
        until_db=None if options.until is None else parse_decibels(options.until),
        stages=options.stage,
        fresh=options.fresh,
        seed=options.seed,
        kernel=options.kernel,
        refine=options.refine,
        effects=options.effects,
        reporter=Reporter(on_progress, cancelled.is_set),
        on_stage=on_stage,
    )
    send("done", run=options.out.resolve(), report=report)
    return 0


def _check(options: argparse.Namespace, send: Any) -> int:
    from .capture.check import check_capture

    findings = check_capture(options.capture)
    for finding in findings:
        told = {"message": finding.message.to_json(), "advice": finding.advice.to_json()}
        send("finding", **vars(finding), told=told)
    send("done", errors=sum(finding.level == "error" for finding in findings))
    return EXIT_USER_ERROR if any(finding.level == "error" for finding in findings) else 0


def _forecast(options: argparse.Namespace, send: Any) -> int:
    cancelled = _watch_input()
    from .capture.read import read_capture
    from .forecast.budget import preset_forecasts
    from .forecast.expected import expected, finished_run, qualities_of

    reporter = Reporter(partial(_send_progress, send), cancelled.is_set)
    capture, known = read_capture(options.capture, reporter.check), None
    if run := os.environ.get(RUN_VARIABLE):
        # It is only where the next run goes: what lies there may be another's, or none yet.
        with suppress(SettingError):
            known = finished_run(Path(run), capture)
    for found in preset_forecasts(capture, options.refine, reporter, options.effects):
        preset = found.settings.preset
        reached = expected(preset, qualities_of(capture, options.refine), known)
        send("forecast", preset=preset, seconds=found.seconds, parts=found.parts, cameras=found.cameras, psnr=reached)
    send("done", known=known is not None)
    return 0


def _send_progress(send: Any, progress: Progress) -> None:
    message = progress.message
    told = message.to_json() if isinstance(message, Told) else {"template": message, "values": {}}
    send("progress", **progress.to_json(), **({"told": told} if message else {}))


def _version(options: argparse.Namespace, send: Any) -> int:
    import torch

    from .. import __version__

    # What a run imports first: an installation that lacks it is no engine.
    for name in ("pipeline", "forecast.budget"):
        import_module(f".{name}", __package__)

    send("version", insideout=__version__, torch=torch.__version__, python=sys.version.split()[0])
    return 0


def _watch_input() -> threading.Event:
    """An event that is set when standard input says "cancel" or ends (the program that started us is gone)."""
    cancelled = threading.Event()

    def listen() -> None:
        for line in sys.stdin:
            if line.strip() == "cancel":
                break
        cancelled.set()

    threading.Thread(target=listen, name="cancel listener", daemon=True).start()
    return cancelled


if __name__ == "__main__":
    sys.exit(main())
