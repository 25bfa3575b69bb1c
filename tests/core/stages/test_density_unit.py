"""The size of attenuations that densities, their pruning and smoothness are counted in."""

from dataclasses import replace

import numpy as np
import pytest

from insideout.core.densities import Densities
from insideout.core.evaluate.heldout import section_peak
from insideout.core.files import write_json
from insideout.core.run_folder import RunFolder
from insideout.core.stages import initialize, surface
from insideout.core.stages.context import StageContext
from insideout.core.stages.internal.joint import JointTrainer
from insideout.core.stages.internal.joint_settings import JointSettings
from insideout.core.stages.internal.targets import SectionSeries
from insideout.core.stages.surface.stage import density_unit
from insideout.core.stages.surface.xray import XraySettings, XrayTrainer
from insideout.core.volume import Volume


@pytest.fixture
def unit_of(tmp_path):
    def unit(values):
        run = RunFolder(tmp_path)
        Volume.centered(np.asarray(values, np.float32), np.ones(3)).save(run.stage("initialize") / "volume.npz")
        return density_unit(run)

    return unit


@pytest.fixture
def noise():
    return np.abs(np.random.default_rng(0).normal(0, 0.002, (60, 60, 60)))


def test_a_thin_rod_in_a_large_box_is_not_taken_for_noise(unit_of, noise):
    """It is 0.07 % of the box: the 99.9th percentile is that of the air."""
    noise[:, 30:32, 30] = 0.2
    assert unit_of(noise) == pytest.approx(0.2, rel=0.05)


def test_sections_and_their_figures_count_in_the_same(noise):
    """An empty box around a rod, as a mask leaves it, has no 99.9th percentile to speak of."""
    for air in (noise, np.zeros_like(noise)):
        air[:, 30:32, 30] = 0.2
        volume = Volume.centered(air.astype(np.float32), np.ones(3))
        assert SectionSeries(volume, ("axial",)).scale == pytest.approx(0.2, rel=0.05)
        assert section_peak(volume) == pytest.approx(0.2, rel=0.05)


def test_of_an_object_that_fills_some_of_the_box_it_is_the_larger_attenuations(unit_of, noise):
    noise[10:50, 10:50, 10:50] = 0.02
    noise[20:30, 20:30, 20:30] = 0.08
    assert unit_of(noise) == pytest.approx(0.08, rel=0.05)


@pytest.mark.parametrize("value", [0.0, 0.03])
def test_a_volume_of_one_value_has_a_unit_above_zero(unit_of, value):
    assert unit_of(np.full((8, 8, 8), value)) == pytest.approx(max(value, 1e-9))


def test_a_volume_of_another_scale_beside_projections_changes_nothing(shells_capture, tmp_path, monkeypatch):
    """The user's grey values are so many times as large as attenuations; smoothness, pruning and rates are not."""
    volume, units = RunFolder(shells_capture[1]).volume(), []

    def noted(start, projections, voxel_mm, unit, *rest):
        units.append(unit)
        return XrayTrainer(start, projections, voxel_mm, unit, *rest)

    monkeypatch.setattr("insideout.core.stages.surface.stage.XrayTrainer", noted)
    settings = surface.SurfaceSettings(xray=replace(surface.PRESETS["standard"].xray, iterations=30, smooth_every=1))

    def fitted(name, times):
        given = replace(volume, values=np.float32(times) * volume.values)
        capture = replace(shells_capture[0], photos=None, volume=given, volume_densities=Densities(relative=True))
        context = StageContext(capture, RunFolder(tmp_path / name), seed=0)
        report = initialize.run(context, replace(initialize.PRESETS["draft"], coarse_splats=400))
        write_json(context.run.stage("initialize") / "report.json", report)
        surface.run(context, settings)
        return context.run.read_set("surface", "xray")

    alike, larger = fitted("alike", 1), fitted("larger", 16)
    assert units == pytest.approx([density_unit(RunFolder(shells_capture[1]))] * 2, rel=0.25)
    # The least density of a first splat is no share of the volume's.
    assert units[0] == pytest.approx(units[1], rel=1e-3)
    np.testing.assert_allclose(larger.density, alike.density, atol=1e-3 * units[0])


@pytest.mark.parametrize("stage", ["surface", "internal"])
def test_edges_are_told_in_shares_of_it_so_that_a_denser_copy_is_smoothed_alike(shells_context, stage):
    """Twice the attenuation and twice the unit: as large a pull on the logarithms of densities, with edges or not."""
    run, projections = shells_context.run, shells_context.capture.projections
    start = run.read_set("surface", "xray")

    def pull(factor, **edge):
        denser = replace(start, density=factor * start.density)
        if stage == "surface":
            trainer = XrayTrainer(denser, projections, 4 / 3, factor * 0.08, XraySettings(**edge), 0, "cpu")
            trainer._smooth(trainer._fit, 0)
        else:
            series, colored = SectionSeries(run.volume(), ("axial",)), np.zeros(len(start), bool)
            settings = JointSettings(photos_attenuate=False, **edge)
            trainer = JointTrainer(denser, None, projections, series, settings, factor * 0.08, colored, 0, "cpu")
            trainer._smooth(0)
        return trainer.parameters.gradient("means").copy()

    plain, edged = pull(1.0), pull(1.0, smooth_edge=0.1)
    assert 0 < np.abs(edged).sum() < 0.9 * np.abs(plain).sum()
    np.testing.assert_allclose(pull(2.0, smooth_edge=0.1), edged, rtol=1e-3, atol=1e-4 * np.abs(edged).max())
