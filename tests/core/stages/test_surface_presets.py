"""What the presets of `surface` are."""

import pytest

from insideout.core.stages.surface import PRESETS
from insideout.core.stages.surface.stage import in_iterations
from insideout.core.train.schedule import Decay

RATES = {
    "rgb": ("means_rate", "sh_rate", "opacity_rate", "scale_rate", "rotation_rate"),
    "xray": ("means_rate", "density_rate", "scale_rate", "rotation_rate", "opacity_rate", "intensity_rate"),
}


def rates_of(half, settings):
    """The first rate of each kind, and the last where it falls."""
    found = [getattr(settings, name) for name in RATES[half]]
    return [value for rate in found for value in ((rate.start, rate.end) if isinstance(rate, Decay) else (rate,))]


def test_presets_follow_the_paper_where_it_says_how():
    assert PRESETS["paper"].rgb.iterations == 20_000
    assert PRESETS["paper"].xray.iterations == 5000
    counts = [PRESETS[name].rgb.iterations for name in ("draft", "standard", "paper")]
    assert counts == sorted(counts)
    assert all(preset.rgb.structure_weight == 0.2 for preset in PRESETS.values())
    paper = PRESETS["paper"].xray
    assert (paper.squares_weight, paper.structure_weight, paper.smooth_weight) == (None, 0.25, 0.05)


def test_shorter_presets_fill_up_with_x_ray_splats_whatever_the_size_of_gradients():
    for name in ("draft", "standard"):
        strategy = PRESETS[name].xray.strategy
        assert (strategy.gradient, strategy.budget) == (0.0, True)


@pytest.mark.parametrize("half", RATES)
@pytest.mark.parametrize("preset", PRESETS)
def test_a_fourth_of_the_iterations_has_twice_the_rates_and_four_times_as_many_have_half(preset, half):
    settings = getattr(PRESETS[preset], half)
    usual = rates_of(half, settings)
    for factor in (0.25, 1.0, 4.0):
        count = round(factor * settings.iterations)
        changed = in_iterations(settings, count)
        assert changed.iterations == count
        assert rates_of(half, changed) == pytest.approx([rate * factor**-0.5 for rate in usual])
        assert changed.strategy == settings.strategy.sooner(factor)
    assert in_iterations(settings, settings.iterations) == settings


def test_a_draft_has_the_rates_that_so_few_iterations_of_standard_would_have():
    draft, standard = PRESETS["draft"].xray, PRESETS["standard"].xray
    asked = in_iterations(standard, draft.iterations)
    assert rates_of("xray", draft) == pytest.approx(rates_of("xray", asked), rel=0.1)
