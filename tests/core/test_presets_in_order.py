"""The presets on a small capture: `draft` is faster, `standard` is better inside."""

import pytest

from insideout.core.phantoms.make import CaptureSettings, make_capture
from insideout.core.pipeline import reconstruct
from insideout.core.settings import Settings

SMALL = CaptureSettings(
    photos=24,
    photo_width=96,
    photo_height=128,
    projections=40,
    heldout_projections=4,
    detector_width=72,
    detector_height=96,
    voxel_mm=2.0,
    surface_mm=2.0,
    shells=5,
)


@pytest.mark.slow
def test_draft_is_faster_and_standard_better_inside(tmp_path):
    """Projections that were kept back: 44.2 and 44.9 dB. Of photos nothing is asked: 7000 steps of `standard` are more
    than so few and small ones bear."""
    capture = make_capture("matryoshka", tmp_path / "capture", SMALL)
    draft, standard = (
        reconstruct(capture, tmp_path / preset, settings=Settings.of(preset)) for preset in ("draft", "standard")
    )
    assert 3 * draft["seconds_in_all"] < standard["seconds_in_all"]
    assert standard["heldout"]["projections"]["psnr"] > draft["heldout"]["projections"]["psnr"]
