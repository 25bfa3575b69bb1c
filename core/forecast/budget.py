"""The settings of a run that is to end in a given time."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from ..capture.model import Capture
from ..errors import SettingError
from ..progress import Progress, Reporter
from ..run_folder import RunFolder
from ..settings import PRESETS, Settings
from ..told import Told
from .fitting import learnt_effects
from .forecast import Forecast, forecast
from .pace import Pace, least_seconds, most_seconds

if TYPE_CHECKING:
    from ..stages.surface.rgb import RgbSettings
    from .speed import Speed

# A preset with less than this share of its steps is worse than the next shorter one with more than all of its: with
# half of them `standard` had 35.2 dB of the sample's projections in the time in which `draft` has 42.2.
_ENOUGH = 0.9
_AREA = "pixel_integration"


def fit_into_time(
    capture: Capture,
    run: RunFolder,
    settings: Settings,
    choose: bool,
    seconds: Callable[[], float],
    reporter: Reporter,
    stays: Sequence[str] = (),
    fresh: bool = False,
    before: float = 0.0,
) -> tuple[Settings, Pace]:
    """Settings for `settings.time_budget_s`, and the pace that makes the run end in it.

    Args:
        choose: a preset; one that a run with this time was begun with is kept. Else the settings are what they are.
        seconds: of the run until now, this measurement and the stages that stay included.
        stays: stages that are done and are not made again.
        fresh: what the folder holds is given up.
        before: seconds of the run that earlier processes took.

    Raises:
        SettingError: the capture cannot be reconstructed in so short a time.
    """
    from ..render.kernels.cpu import is_compiled
    from .speed import drawn_with

    budget = settings.time_budget_s
    if budget is None:
        raise AssertionError("only called for runs with a time")
    if settings.kernel != "cpu":
        raise SettingError(
            "--time-budget: steps of --kernel {kernel} are not timed; leave one of both out.", kernel=settings.kernel
        )
    kept = None if fresh else _begun_with(run, budget, bool(stays))
    compiled = is_compiled(drawn_with(capture))
    if choose:
        # One that was begun before goes on with its preset.
        presets = PRESETS if kept is None or kept not in PRESETS else (kept,)
        found: list[Forecast] = []
        for one in _in_turn(capture, [settings.with_preset(preset) for preset in presets], reporter):
            found.append(one)
            # Longer ones are not measured, which takes some of the time, too.
            if not _enough(one, budget - seconds()):
                break
        expected = choose_forecast(found, budget - seconds())
    else:
        expected = forecasts(capture, [settings], reporter)[0]
    ahead = {part: value for part, value in expected.parts.items() if part.split()[0] not in stays}
    least = least_seconds(ahead) + seconds()
    # A run that was begun in this time is ended in any case: what there is of it would be lost.
    if budget < least and kept is None:
        if not compiled:
            raise SettingError(
                "--time-budget {budget:g}s: is too short; this capture takes some {least:.0f} s on this machine this "
                "time, in which kernels had to be compiled, whatever is left out, give more.",
                budget=budget,
                least=least,
            )
        raise SettingError(
            "--time-budget {budget:g}s: is too short; this capture takes some {least:.0f} s on this machine whatever "
            "is left out, give more.",
            budget=budget,
            least=least,
        )
    preset, whole = expected.settings.preset, expected.seconds / 60
    told = Told(
        "preset {preset}, which would take about {whole:.1f} min, fitted into {budget:.1f} min, of which it needs "
        "less: more steps would not help"
        if most_seconds(ahead) + seconds() < budget
        else "preset {preset}, which would take about {whole:.1f} min, fitted into {budget:.1f} min",
        preset=preset,
        whole=whole,
        budget=budget / 60,
    )
    reporter.update(Progress("capture", fraction=1.0, message=told))
    chosen, trained = expected.settings, _trained_as(expected.settings, capture)
    counted = frozenset(effect.name for effect in trained.effects) | ({_AREA} if trained.pixel_integration else set())
    speeds = {counted: expected.speed}

    def anew(effects: frozenset[str], splats: Mapping[str, int]) -> Mapping[str, float]:
        used = chosen if effects == counted else replace(chosen, effects=",".join(sorted(effects)) or "none")
        if effects not in speeds:
            speeds[effects] = forecasts(capture, [used], reporter.silent(), expected.speed)[0].speed
        return forecast(capture, used, speeds[effects], {**run.splats(), **splats}).parts

    return chosen, Pace(budget, expected.parts, seconds, counted, anew, before=before)


def forecasts(
    capture: Capture, settings: Sequence[Settings], reporter: Reporter, known: Speed | None = None
) -> list[Forecast]:
    """What runs with each of these settings would take on this machine; kernels are compiled first if need be.

    Args:
        known: what was measured of the capture already: only steps on photos, and what these show, are measured then.
    """
    return list(_in_turn(capture, settings, reporter, known))


def _in_turn(
    capture: Capture, settings: Sequence[Settings], reporter: Reporter, known: Speed | None = None
) -> Iterator[Forecast]:
    """`forecasts`, each measured when it is asked for."""
    from ..render.kernels.cpu import announce, warm_up
    from .speed import drawn_with, measure_speed, trained_size

    renderers = drawn_with(capture)
    if capture.photos is not None and any(_trained_as(one, capture).pixel_integration for one in settings):
        renderers = (*renderers, "splat_effects")
    announce(reporter, Progress("capture", "speed"), renderers)
    warm_up(renderers)
    # Photos are no larger than they are, so that presets mostly share a speed.
    speeds: dict[tuple[object, ...], Speed] = {}
    for one in settings:
        rgb = _trained_as(one, capture)
        long_side = trained_size(capture, rgb.long_side)
        drawn = long_side, rgb.degree, rgb.effects, rgb.pixel_integration
        if drawn not in speeds:
            speeds[drawn] = measure_speed(capture, long_side, reporter.check, known, rgb)
            known = speeds[drawn]
        yield forecast(capture, one, speeds[drawn])


def _trained_as(settings: Settings, capture: Capture) -> RgbSettings:
    """How photos are trained, with the effects that are asked for by name, and the one that is found by the photos'
    size alone; what else they show is not known before they are looked at."""
    rgb: RgbSettings = settings.stages["surface"].rgb
    if settings.effects == "none":
        return rgb
    from ..effects.pixel_integration import THRESHOLD
    from ..effects.request import parse_effects
    from .speed import photo_size

    request = parse_effects(settings.effects)
    asked = request.on
    if capture.photos is not None and request.wants(_AREA) and not rgb.mip_filter:
        larger = max(photo_size(capture.photos.photos[0])) / rgb.long_side
        asked |= {_AREA} if larger >= THRESHOLD else set()
    pixel_integration = rgb.pixel_integration or _AREA in asked
    return replace(rgb, effects=learnt_effects(settings), pixel_integration=pixel_integration)


def preset_forecasts(capture: Capture, refine: str, reporter: Reporter, effects: str = "none") -> list[Forecast]:
    """What a run with each preset would take on this machine.

    Args:
        effects: to look for and to use, as `pipeline.reconstruct` has it.

    Raises:
        SettingError: there are no such effects, or none in this capture.
    """
    if effects != "none":
        from ..effects.request import parse_effects

        parse_effects(effects).check(capture)
    settings = [replace(Settings.of(preset, refine=refine), effects=effects) for preset in PRESETS]
    return forecasts(capture, settings, reporter)


def choose_forecast(found: Sequence[Forecast], budget_s: float) -> Forecast:
    """The most thorough of which the time allows nearly all, else the first; they are in the order of presets."""
    allowed = [one for one in found if _enough(one, budget_s)]
    return allowed[-1] if allowed else found[0]


def _enough(one: Forecast, budget_s: float) -> bool:
    return _ENOUGH * one.seconds <= budget_s


def _begun_with(run: RunFolder, budget_s: float, stays: bool) -> str | None:
    """The preset of the run that this folder holds, if it has the same time, or less and stages of it stay."""
    try:
        content = json.loads((run.path / "settings.json").read_text("utf-8"))
        time_s = content["time_budget_s"]
        return str(content["preset"]) if time_s == budget_s or (stays and time_s < budget_s) else None
    except (OSError, ValueError, KeyError, TypeError):
        return None
