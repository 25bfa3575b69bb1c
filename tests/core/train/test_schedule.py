"""What rates and densification become with more or fewer iterations than a preset's."""

from dataclasses import fields, replace

import pytest

from insideout.core.settings import PRESETS, Settings
from insideout.core.stages.internal.joint_settings import joint_in_iterations
from insideout.core.train.schedule import Decay, in_iterations

# How many rates each part has, and which do not change: none is left out.
PARTS = {"rgb": 5, "xray": 6, "joint": 10}
STAY = {"xray_means_rate", "xray_rotation_rate", "xray_scale_rate", "density_rate"}


def settings_of(part, preset):
    stages = Settings.of(preset).stages
    return stages["internal"].joint if part == "joint" else getattr(stages["surface"], part)


def names_of(settings):
    return [one.name for one in fields(settings) if one.name.endswith("_rate")]


def rates_of(settings, names=None):
    """The first rate of each kind, and the last where it falls."""
    found = [getattr(settings, name) for name in names or names_of(settings)]
    return [value for rate in found for value in ((rate.start, rate.end) if isinstance(rate, Decay) else (rate,))]


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("preset", PRESETS)
def test_a_fourth_of_the_iterations_has_twice_the_rates_and_four_times_as_many_have_half(preset, part):
    settings = settings_of(part, preset)
    assert len(names_of(settings)) == PARTS[part]
    stay = sorted(STAY) if part == "joint" else []
    change = [name for name in names_of(settings) if name not in stay]
    for factor in (0.25, 4.0):
        count = round(factor * settings.iterations)
        changed = joint_in_iterations(settings, count) if part == "joint" else in_iterations(settings, count)
        assert changed.iterations == count
        assert rates_of(changed, change) == pytest.approx([rate * factor**-0.5 for rate in rates_of(settings, change)])
        assert [getattr(changed, name) for name in stay] == [getattr(settings, name) for name in stay]


@pytest.mark.parametrize("part", ["rgb", "xray"])
def test_with_a_fourth_of_the_iterations_splats_are_added_four_times_as_often(part):
    settings = settings_of(part, "standard")
    changed = in_iterations(settings, settings.iterations // 4)
    assert changed.strategy == settings.strategy.sooner(0.25)
    assert changed.strategy.every == round(settings.strategy.every / 4)


@pytest.mark.parametrize("part", PARTS)
def test_as_many_iterations_as_before_leave_everything_as_it_is(part):
    settings = settings_of(part, "standard")
    assert in_iterations(settings, settings.iterations) == settings


def test_none_are_none():
    none = replace(settings_of("joint", "draft"), iterations=0)
    assert in_iterations(none, 0) == none


def test_a_draft_has_the_rates_that_so_few_iterations_of_standard_would_have():
    draft, standard = settings_of("xray", "draft"), settings_of("xray", "standard")
    assert rates_of(draft) == pytest.approx(rates_of(in_iterations(standard, draft.iterations)), rel=0.1)
