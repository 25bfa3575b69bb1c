"""How many splats photos begin and end with: by their points, and by what there is to see on them."""

from dataclasses import replace

import numpy as np
import pytest

from insideout.core.capture.read import read_capture
from insideout.core.compare.methods import with_rgb
from insideout.core.forecast.detail import PhotoLook
from insideout.core.forecast.forecast import forecast
from insideout.core.forecast.speed import Speed, StepTime
from insideout.core.settings import Settings
from insideout.core.train.schedule import Growth

# Every step takes the same, whatever it is made of.
EVEN = StepTime(0.01, 0.0, 0.0)


@pytest.fixture(scope="module")
def capture(tiny_capture):
    return read_capture(tiny_capture)


PUPPET, SAMPLE = (11, 8750.0, 1166), (44, 2871.0, 13_042)


@pytest.mark.parametrize(
    ("shown", "grown"),
    [(PUPPET, {5: 15.0, 14: 64.9, 23: 106.5, 32: 120.9}), (SAMPLE, {5: 24.4, 14: 45.6, 23: 63.2, 32: 68.9})],
    ids=["puppet", "sample"],
)
def test_photo_splats_grow_with_each_densification_as_they_did_in_standard(capture, shown, grown):
    """Thousands after so many densifications."""
    for densified, thousands in grown.items():
        assert splats_at_last(capture, *shown, densified) == pytest.approx(1e3 * thousands, rel=0.3)


def test_few_photos_are_not_given_all_splats_that_there_is_detail_for(capture):
    allowed = Settings.of("standard").stages["surface"].rgb.for_photos(8).strategy.most
    assert splats_at_last(capture, 8, 1e5, 1166, 32, limited=True) == pytest.approx(allowed, rel=0.05)
    assert splats_at_last(capture, 8, 1e5, 1166, 32) > 5 * allowed


def test_where_there_is_nothing_to_see_no_splats_are_added(capture):
    assert splats_at_last(capture, 44, 0.0, 13_042, 31) == pytest.approx(13_042)


def splats_at_last(capture, count, detail, first, densified, limited=False):
    """Photo splats in the end of a training that densifies so often, told by its time.

    Args:
        limited: by how many photos there are.
    """
    shown = replace(capture, photos=replace(capture.photos, photos=capture.photos.photos[1:2] * count))
    iterations = round((densified + 0.5) / 0.45 * 100)
    settings = with_rgb(Settings.of("standard"), iterations=iterations, growth=Growth())
    unlimited = {} if limited else {"splats_per_pair": 0.0}
    settings = with_rgb(settings, passes=0, **unlimited)
    speed = Speed(StepTime(0, 1e-6, 0), EVEN, EVEN, look=PhotoLook(detail))
    seconds = forecast(shown, settings, speed, {"initialize rgb": first}).parts["surface rgb"]
    # Even growth from 5 % to half of the steps.
    return first + (seconds / (iterations * 1e-6) - first) / 0.725


def test_photos_begin_with_their_points_and_those_of_the_visual_hull(capture):
    def first(points, posed=True, covered=None, **changes):
        count = 40
        photos = [
            replace(photo, camera=photo.camera if posed else None) for photo in capture.photos.photos[1:2]
        ] * count
        known = None if points is None else np.zeros((points, 3))
        shown = replace(capture, photos=replace(capture.photos, photos=photos, points=known))
        settings, speed = Settings.of("standard"), Speed(StepTime(0, 1e-6, 0), EVEN, EVEN, look=PhotoLook(0.0, covered))
        start = replace(settings.stages["initialize"], **changes)
        settings = replace(settings, stages={**settings.stages, "initialize": start})
        steps = settings.stages["surface"].rgb.for_photos(count if posed else 35).iterations
        return forecast(shown, settings, speed).parts["surface rgb"] / (1e-6 * steps)

    assert first(20_000) == pytest.approx(20_000)
    assert first(20_000, covered=0.2) == pytest.approx(30_000)
    assert first(20_000, covered=0.2, hull_cells=0) == pytest.approx(20_000), "no hull is carved"
    assert first(None) == pytest.approx(10_000), "at random places"
    assert first(None, posed=False) == pytest.approx(40 * 130)
