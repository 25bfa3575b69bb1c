"""What the presets of `surface` are."""

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
