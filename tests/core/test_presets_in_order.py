"""The presets on a small capture: each takes longer than the one before, and is better inside."""

import pytest

from insideout.core.bench.compiling import compile_kernels
from insideout.core.capture.read import read_capture
from insideout.core.phantoms.make import CaptureSettings, make_capture
from insideout.core.pipeline import reconstruct
from insideout.core.progress import Reporter
from insideout.core.settings import PRESETS, Settings

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
def test_each_preset_takes_longer_than_the_one_before_and_is_better_inside(tmp_path):
    """Of photos nothing is asked: 7000 steps of `standard` are more than so few and small ones bear."""
    capture = make_capture("matryoshka", tmp_path / "capture", SMALL)
    # In a new environment the first run would wait for them, which has nothing to do with its preset.
    compile_kernels(read_capture(capture), Settings.of(), Reporter())
    made = [reconstruct(capture, tmp_path / preset, settings=Settings.of(preset)) for preset in PRESETS]
    draft, standard, paper = (report["seconds_in_all"] for report in made)
    assert 3 * draft < standard
    assert 1.5 * standard < paper
    inside = [report["heldout"]["projections"]["psnr"] for report in made]
    assert inside == sorted(inside)
