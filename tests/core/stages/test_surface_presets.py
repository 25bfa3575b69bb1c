"""What the presets of `surface` are."""

import pytest

from insideout.core.stages.surface import PRESETS


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


def test_few_photos_have_fewer_splats_and_steps_but_in_paper():
    """Twice as many photos see each place together in four times as many pairs."""
    standard, paper = (PRESETS[name].rgb for name in ("standard", "paper"))
    assert standard.for_photos(9).strategy.most == 20_250
    assert standard.for_photos(18).strategy.most == 81_000
    assert [standard.for_photos(count).iterations for count in (9, 18, 47)] == [1350, 2700, 7000]
    assert standard.for_photos(48) == standard
    assert (standard.for_photos(0).iterations, standard.for_photos(0).strategy.most) == (1, 1)
    assert paper.for_photos(9) == paper


def test_fewer_steps_for_few_photos_have_higher_rates():
    standard = PRESETS["standard"].rgb
    assert standard.for_photos(12).sh_rate == pytest.approx(standard.sh_rate * (7000 / 1800) ** 0.5)


def test_what_is_trained_long_ends_with_low_rates_and_a_first_look_or_the_papers_does_not():
    assert PRESETS["standard"].rgb.decay.at(1.0) < 0.5 < 1 < PRESETS["standard"].rgb.decay.at(0.0)
    assert all(PRESETS[name].rgb.decay.at(share) == 1 for name in ("draft", "paper") for share in (0.0, 0.5, 1.0))
