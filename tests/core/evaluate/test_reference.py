"""What held-out sections are measured against, where the user's volume lies beside projections."""

from types import SimpleNamespace

import numpy as np
import pytest

from insideout.core.capture.model import Capture, Projections
from insideout.core.densities import PER_MM, Densities
from insideout.core.evaluate.reference import make_reference, reference_volume
from insideout.core.progress import Reporter
from insideout.core.volume import Volume


@pytest.fixture
def own():
    """The user's volume."""
    return Volume.centered(np.random.default_rng(0).random((3, 4, 5), np.float32), np.ones(3))


@pytest.fixture
def context_of(own, tmp_path, monkeypatch):
    """`context_of(volume_densities)`: of a volume beside projections, whose FDK is 0.02 mm⁻¹ everywhere."""
    fdk = Volume.centered(np.full((3, 4, 5), 0.02, np.float32), np.ones(3))
    monkeypatch.setattr("insideout.core.evaluate.reference.fdk", lambda *_, **__: fdk)
    images = np.zeros((2, 4, 4), np.float32)
    projections = Projections(images, [], np.zeros(2, bool), np.zeros(2), own.box_mm, (5, 4, 3))

    def context(densities):
        capture = Capture(tmp_path, projections=projections, volume=own, volume_densities=densities)
        run = SimpleNamespace(stage=lambda name: tmp_path)
        return SimpleNamespace(capture=capture, projections=projections, run=run, reporter=Reporter())

    return context


def test_a_volume_is_measured_against(context_of, own, tmp_path):
    context = context_of(PER_MM)
    make_reference(context, 0.0, 1.0, "initialize")
    assert not list(tmp_path.iterdir()), "it is there already"
    volume, source = reference_volume(context)
    assert volume is own
    assert source == "the capture's volume"


@pytest.mark.parametrize("made", [True, False], ids=["made before", "made now"])
def test_gray_values_that_fit_no_projections_say_nothing_about_densities(context_of, tmp_path, made):
    """Decibels against another scale, which nobody knows, would be those of the scales."""
    context = context_of(Densities(relative=True))
    if made:
        make_reference(context, 0.0, 1.0, "initialize")
        assert (tmp_path / "reference.npz").is_file()
    volume, source = reference_volume(context)
    assert source == "FDK of all projections"
    np.testing.assert_array_equal(volume.values, np.float32(0.02))
