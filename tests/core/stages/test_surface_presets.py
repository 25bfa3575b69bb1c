"""What the presets of `surface` are."""

import numpy as np

from insideout.core.capture.model import Projections
from insideout.core.stages.surface import PRESETS
from insideout.core.stages.surface.xray import body_scale


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


def test_full_scale_of_the_shorter_presets_is_the_body_s_not_a_screw_s():
    """Half of a toy gun's rays measure a 25th of what a few through its steel do."""
    images = np.full((1, 40, 40), 0.4, np.float32)
    images[0, 0, :2] = 10.0
    plain = np.full((1, 40, 40), 0.4, np.float32)
    box = np.array([[-4.0] * 3, [4.0] * 3])
    with_steel, without = (Projections(i, [], np.zeros(1, bool), np.zeros(1), box, (8, 8, 8)) for i in (images, plain))
    assert body_scale(with_steel, [0]) < 2.0
    assert body_scale(without, [0]) == without.peak([0])
    assert all(PRESETS[name].xray.full_scale == "body" for name in ("draft", "standard"))
