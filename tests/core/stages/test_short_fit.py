"""Short fits by which effects are tried."""

from dataclasses import replace

from insideout.core.stages import short_fit
from insideout.core.stages.surface import PRESETS


def test_their_smoothness_is_not_that_of_a_preset_that_may_change(monkeypatch):
    """The limits of trials were measured with it."""
    usual, draft = short_fit.short_settings(300), PRESETS["draft"]
    other = replace(draft, xray=replace(draft.xray, smooth_weight=0.7, smooth_edge=0.3))
    monkeypatch.setattr(short_fit, "PRESETS", {"draft": other})
    assert short_fit.short_settings(300) == usual
    assert (usual.iterations, usual.strategy.most) == (300, short_fit.MOST_SPLATS)
    assert usual.structure_weight == draft.xray.structure_weight
