"""What the presets of `surface` are."""

import pytest

from insideout.core.stages.internal.joint_settings import PRESETS as JOINT
from insideout.core.stages.surface import PRESETS


def test_paper_shows_as_many_photos_as_the_paper_and_each_preset_more_than_the_one_before():
    assert PRESETS["paper"].rgb.iterations == 20_000
    for counts in (
        [PRESETS[name].rgb.iterations for name in ("draft", "standard", "paper")],
        [PRESETS[name].xray.iterations for name in ("draft", "standard", "paper")],
        [PRESETS[name].rgb.long_side for name in ("draft", "standard", "paper")],
    ):
        assert counts == sorted(set(counts))
    assert all(preset.rgb.structure_weight == 0.2 for preset in PRESETS.values())


def test_paper_is_more_of_standard_at_the_rates_of_so_many_steps():
    standard, paper = PRESETS["standard"].xray, PRESETS["paper"].xray
    assert (paper.smooth_edge, paper.smooth_weight) == (standard.smooth_edge, standard.smooth_weight) == (0.1, 0.1)
    assert paper.density_rate.start == pytest.approx(standard.density_rate.start / 2**0.5)
    for name in ("standard", "paper"):
        rgb = PRESETS[name].rgb
        densified = rgb.iterations * (rgb.strategy.stop - rgb.strategy.start) / rgb.strategy.every
        assert densified == pytest.approx(31.5, rel=0.01)


def test_every_preset_smooths_as_much_in_the_joint_refinement_and_lets_edges_be():
    for name, preset in PRESETS.items():
        assert preset.xray.smooth_edge == JOINT[name].smooth_edge == 0.1
        assert preset.xray.smooth_weight == JOINT[name].smooth_weight > 0


def test_presets_fill_up_with_x_ray_splats_whatever_the_size_of_gradients():
    for preset in PRESETS.values():
        assert (preset.xray.strategy.gradient, preset.xray.strategy.budget) == (0.0, True)


def test_few_photos_have_fewer_splats_and_steps():
    """Twice as many photos see each place together in four times as many pairs."""
    standard, paper = (PRESETS[name].rgb for name in ("standard", "paper"))
    assert standard.for_photos(9).strategy.most == paper.for_photos(9).strategy.most == 20_250
    assert standard.for_photos(18).strategy.most == 81_000
    assert [standard.for_photos(count).iterations for count in (9, 18, 47)] == [1350, 2700, 7000]
    assert standard.for_photos(48) == standard
    assert (standard.for_photos(0).iterations, standard.for_photos(0).strategy.most) == (1, 1)
    assert [paper.for_photos(count).iterations for count in (9, 47, 140)] == [1350, 7050, 20_000]


def test_fewer_steps_for_few_photos_have_higher_rates():
    standard, paper = (PRESETS[name].rgb for name in ("standard", "paper"))
    assert standard.for_photos(12).sh_rate == pytest.approx(standard.sh_rate * (7000 / 1800) ** 0.5)
    assert paper.for_photos(12).sh_rate == pytest.approx(standard.for_photos(12).sh_rate)
    assert paper.for_photos(12).strategy.every == pytest.approx(standard.for_photos(12).strategy.every, abs=1)


def test_what_is_trained_long_ends_with_low_rates_and_a_first_look_does_not():
    for name in ("standard", "paper"):
        assert PRESETS[name].rgb.decay.at(1.0) < 0.5 < 1 < PRESETS[name].rgb.decay.at(0.0)
    assert all(PRESETS["draft"].rgb.decay.at(share) == 1 for share in (0.0, 0.5, 1.0))
