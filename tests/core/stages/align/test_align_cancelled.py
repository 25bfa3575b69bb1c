"""Reading the photos that alignment looks at takes long; who cancels it is heard after the next."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from insideout.core.capture import background, photos
from insideout.core.capture.model import Capture, Photo, Photos
from insideout.core.capture.registered import save_photos
from insideout.core.errors import Cancelled
from insideout.core.progress import Reporter
from insideout.core.run_folder import RunFolder
from insideout.core.stages.align.stage import AlignSettings, _look_at_photos
from insideout.core.stages.context import StageContext
from insideout.core.views import Camera

SETTINGS = AlignSettings(outline_photos=12, outline_size=40, check_photos=4)


@pytest.fixture
def cancelled_after(tmp_path, monkeypatch):
    """`cancelled_after(module, name, calls)`: how often a function is called where someone cancels in that call."""
    found = []
    for index in range(14):
        image = np.full((30, 40, 3), 200, np.uint8)
        image[8:22, 10:30] = (30, 60, 90)
        Image.fromarray(image).save(tmp_path / f"{index:02d}.png")
        found.append(Photo(tmp_path / f"{index:02d}.png", Camera(40, 30, 50.0, 50.0, 20.0, 15.0, np.eye(4))))
    run = RunFolder(tmp_path / "run")
    run.stage("initialize")
    save_photos(run.path / "initialize" / "photos.json", Photos(found))

    def cancelled_after(module, name, calls):
        made, work = [], getattr(module, name)
        monkeypatch.setattr(module, name, lambda *given: made.append(1) or work(*given))
        reporter = Reporter(is_cancelled=lambda: len(made) >= calls)
        seen = _look_at_photos(StageContext(Capture(tmp_path), run, reporter=reporter), SETTINGS)
        return seen, len(made)

    return cancelled_after


# Of the background, of outlines, and those that splats are compared with.
@pytest.mark.parametrize("calls", [1, 9, 11, 21, 23, 25])
def test_it_is_heard_between_photos(cancelled_after, calls, monkeypatch):
    read = []
    whole = photos.read_pixels
    monkeypatch.setattr(photos, "read_pixels", lambda *given, **options: read.append(1) or whole(*given, **options))
    with pytest.raises(Cancelled):
        cancelled_after(photos, "read_photo", calls)
    assert len(read) == calls


@pytest.mark.parametrize("calls", [1, 7, 11])
def test_it_is_heard_between_masks(cancelled_after, calls, monkeypatch):
    found = []
    whole = background.foreground_mask
    monkeypatch.setattr(background, "foreground_mask", lambda *given: found.append(1) or whole(*given))
    with pytest.raises(Cancelled):
        cancelled_after(background, "foreground_mask", calls)
    assert len(found) == calls


def test_all_are_read_where_nobody_cancels(cancelled_after):
    seen, read = cancelled_after(photos, "read_photo", 1000)
    assert (len(seen.masked), len(seen.check), read) == (12, 4, 26)
    assert all(mask.any() for _, mask in seen.masked)
