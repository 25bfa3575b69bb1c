"""Densities by one factor: of a volume in any unit, and of splats that were ended early while they were trained."""

from dataclasses import replace

import numpy as np
import pytest

from insideout.core.gaussians import GaussianSet, Modality
from insideout.core.render import radiograph
from insideout.core.run_folder import RunFolder
from insideout.core.stages.context import StageContext
from insideout.core.stages.density_fit import fit_to_projections
from insideout.core.stages.initialize import InitializeSettings
from insideout.core.stages.initialize import run as initialize
from insideout.core.stages.surface import SurfaceSettings, run
from insideout.core.stages.surface.stage import XraySettings
from insideout.core.train.schedule import Decay


@pytest.fixture(scope="module")
def scanned(shells_capture, tmp_path_factory):
    """X-rays alone of the two shells, and a run of them in which `initialize` is done."""
    capture = shells_capture[0].xrays_only()
    context = StageContext(capture, RunFolder(tmp_path_factory.mktemp("scanned") / "run"))
    initialize(context, InitializeSettings(xray_splats=600))
    return context


def exact(capture, splats):
    """The capture's projections as the splats themselves have them."""
    given = capture.projections
    images = [radiograph(splats.to_torch(), detector).numpy() for detector in given.detectors]
    return replace(given, images=np.stack(images).astype(np.float32))


def test_a_set_of_another_unit_comes_back_to_its_projections(scanned):
    splats = scanned.run.read_set("initialize", "xray")
    projections = exact(scanned.capture, splats)
    found, factor = fit_to_projections(replace(splats, density=0.25 * splats.density), projections)
    assert factor == pytest.approx(4, rel=1e-5)
    np.testing.assert_allclose(found.density, splats.density, rtol=1e-5)


def test_held_out_projections_have_no_say(scanned):
    splats = scanned.run.read_set("initialize", "xray")
    projections = exact(scanned.capture, splats)
    images = np.where(projections.held_out[:, None, None], 9.0, projections.images).astype(np.float32)
    assert fit_to_projections(splats, replace(projections, images=images))[1] == pytest.approx(1, rel=1e-5)


def test_a_set_that_shares_nothing_with_the_projections_stays(scanned):
    away = GaussianSet.create(np.full((3, 3), 1e4, np.float32), 1.0, density=0.1, modality=Modality.XRAY)
    found, factor = fit_to_projections(away, scanned.capture.projections)
    assert factor == 1.0
    np.testing.assert_array_equal(found.density, away.density)


@pytest.mark.parametrize("whole", [True, None])
def test_splats_that_end_early_while_they_are_trained_weigh_what_whole_ones_do(scanned, tmp_path, whole):
    """What lies beyond 2 standard deviations, 14 % of a projected splat, its neighbours make up for."""
    start = scanned.run.read_set("initialize", "xray")
    capture = replace(scanned.capture, projections=exact(scanned.capture, start))
    folder = RunFolder(tmp_path / "run")
    folder.write_set("initialize", "xray", start)
    (folder.stage("initialize") / "volume.npz").write_bytes(
        (scanned.run.path / "initialize" / "volume.npz").read_bytes()
    )
    fit = XraySettings(
        iterations=60,
        smooth_weight=0.0,
        cutoff_sigmas=2.0,
        whole=whole,
        means_rate=Decay(0.0),
        scale_rate=Decay(0.0),
        rotation_rate=Decay(0.0),
        density_rate=Decay(0.05, 0.005),
        strategy=replace(XraySettings().strategy, start=1.0, stop=1.0),
    )
    report = run(StageContext(capture, folder), SurfaceSettings(xray=fit))
    left = fit_to_projections(folder.read_set("surface", "xray"), capture.projections)[1]
    if whole:
        assert left == pytest.approx(1, abs=1e-5)
        assert report["xray"]["density_factor"] < 0.97
    else:
        assert left < 0.97
        assert "density_factor" not in report["xray"]
