"""How coarse the views are that effects of X-rays are looked for in, and that effects are taken out of a scan once."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from insideout.core.capture.model import Capture
from insideout.core.effects import focal_spot
from insideout.core.effects.rays import RayEvidence, coarse_block
from insideout.core.effects.request import parse_effects
from insideout.core.forecast.forecast import _coarse_pixels
from insideout.core.run_folder import RunFolder
from insideout.core.stages import effect_gains
from insideout.core.stages.context import StageContext
from insideout.core.stages.initialize import rings
from insideout.core.stages.initialize.stage import _look_at_rays


@pytest.fixture(scope="module")
def smeared(scans):
    """Ellipsoids whose projections are soft all over, by pixels of uneven gains."""
    scan = scans.ellipsoid_scan(48, 24, 4, supersampled=1)
    soft = -np.log(gaussian_filter(np.exp(-scan.images), (0, 1.0, 1.0)))
    gains = 1 + 0.02 * np.random.default_rng(0).standard_normal(scan.images.shape[1:])
    return replace(scan, images=(soft - np.log(gains)).astype(np.float32))


@pytest.mark.parametrize(
    ("height", "width", "block"),
    [
        (40, 40, 1),
        (148, 120, 1),
        (256, 200, 2),
        (1000, 1000, 7),
        (1600, 1600, 10),
        (48, 1000, 1),
        (90, 1000, 1),
        (100, 1000, 2),
        (1000, 150, 3),
    ],
)
def test_coarse_views_have_160_pixels_at_most_unless_few_rows_or_columns_are_left(height, width, block, scans):
    assert coarse_block(height, width) == block
    assert max(height, width) / block <= 160 or min(height, width) // (block + 1) < 48
    scan = scans.ellipsoid_scan(48, 4, 1, supersampled=1)
    large = replace(
        scan,
        images=np.ones((len(scan.images), height, width), np.float32),
        detectors=[replace(detector, height=height, width=width) for detector in scan.detectors],
    )
    assert _coarse_pixels(large) == RayEvidence(large).views.images[0].size, "as forecasts count it"


def initialized(scan, folder, effects, monkeypatch):
    """The context of a run that has looked; its trials say nothing."""
    monkeypatch.setattr(effect_gains, "tell_gains_of_rays", lambda *_: None)
    context = StageContext(
        Capture(folder, projections=scan, digest="a scan"), RunFolder(folder), request=parse_effects(effects)
    )
    _look_at_rays(context)
    return context


@pytest.fixture
def sharpened(monkeypatch):
    """Sizes of scans that were sharpened."""
    sizes, usual = [], focal_spot.corrected

    def counted(projections, *rest):
        sizes.append(projections.images.size)
        return usual(projections, *rest)

    monkeypatch.setattr(focal_spot, "corrected", counted)
    return sizes


def test_what_was_looked_at_without_its_effects_is_not_corrected_again(smeared, tmp_path, monkeypatch, sharpened):
    """Sharpening a large scan takes minutes. A run that is taken up again does it once more, and gets the same."""
    context = initialized(smeared, tmp_path, "focal_spot,geometry", monkeypatch)
    found = context.projections
    assert sharpened == [smeared.images.size]
    again = StageContext(context.capture, context.run).projections
    assert len(sharpened) == 2
    np.testing.assert_array_equal(found.images, again.images)
    for one, other in zip(found.detectors, again.detectors, strict=True):
        np.testing.assert_array_equal(one.center, other.center)
    assert not np.array_equal(found.images, smeared.images)


@pytest.mark.parametrize("most_energy", [np.inf, 0.0])
def test_nor_is_it_for_pixels_that_a_fit_tells(smeared, tmp_path, monkeypatch, sharpened, most_energy):
    """Whose offsets are taken out of what is sharp already, or are not where the object leaves as much."""
    monkeypatch.setattr(rings, "STEPS", 3)
    monkeypatch.setattr(rings, "_MOST_ENERGY", most_energy)
    context = initialized(smeared, tmp_path, "focal_spot,ring", monkeypatch)
    found = context.projections
    assert sharpened == [smeared.images.size]
    assert ("ring" in context.effects.numbers) is (most_energy > 0)
    again = StageContext(context.capture, context.run).projections
    np.testing.assert_array_equal(found.images, again.images)


def test_a_view_that_takes_long_to_sharpen_can_be_stopped(smeared):
    class StoppedError(Exception):
        pass

    ticks = []

    def tick():
        ticks.append(1)
        if len(ticks) == 5:
            raise StoppedError

    one = replace(smeared, images=smeared.images[:1], detectors=smeared.detectors[:1])
    with pytest.raises(StoppedError):
        focal_spot.corrected(one, {"sigma_mm": 0.5}, tick)
