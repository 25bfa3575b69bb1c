"""SART: better than FDK from few views, positive, in any geometry, and it can be left at any time."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

from insideout.core import fdk_process
from insideout.core.capture.detectors import CircularScan
from insideout.core.capture.model import Projections
from insideout.core.errors import Cancelled, CaptureError, SettingError
from insideout.core.fdk import fdk
from insideout.core.phantoms.shepp_logan import (
    PEAK_PER_MM,
    UNIT_PER_MM,
    SheppLoganScan,
    head_projection,
    shepp_logan_projections,
    volume_psnr,
)
from insideout.core.progress import Reporter
from insideout.core.sart import SartSettings, sart

FEW = SheppLoganScan(angles=20, heldout=2, detector=48, voxels=24)


@pytest.fixture(scope="module")
def head():
    return shepp_logan_projections(FEW)


def test_few_views_give_a_better_volume_than_fdk(head):
    settings = SartSettings(iterations=6)
    found = sart(head, settings=settings)
    best_fdk = max(volume_psnr(fdk(head, window=window)) for window in ("ramp", "hann"))
    assert volume_psnr(found) > best_fdk + 1.0
    assert found.values.min() >= 0
    assert np.array_equal(found.values, sart(head, settings=settings).values)


def test_more_iterations_explain_the_projections_better_and_held_out_ones_are_not_used(head):
    values = [volume_psnr(sart(head, settings=SartSettings(iterations=n))) for n in (1, 4)]
    assert values[1] > values[0] + 0.5
    spoilt = replace(head, images=np.where(head.held_out[:, None, None], np.float32(9), head.images))
    assert np.array_equal(sart(spoilt).values, sart(head).values)


def test_noise_of_rays_that_graze_the_box_stays_out_of_it(head):
    noise = np.random.default_rng(0).normal(0.0, 0.02 * head.images.max(), head.images.shape)
    noisy = replace(head, images=(head.images + noise).astype(np.float32))
    found, without_margin = sart(noisy), sart(noisy, settings=SartSettings(margin=0))
    assert outermost(without_margin).max() > PEAK_PER_MM
    assert outermost(found).max() < 0.1 * PEAK_PER_MM
    assert volume_psnr(found) > volume_psnr(without_margin)


def test_the_margin_changes_neither_the_box_nor_the_grid(head):
    box = np.array([[-120.0, -110.0, -90.0], [125.0, 120.0, 100.0]])
    for margin in (0, 1, 3):
        found = sart(replace(head, box_mm=box), voxels=(20, 22, 18), settings=SartSettings(margin=margin))
        assert found.values.shape == (18, 22, 20)
        assert np.allclose(found.box_mm, box)
        # The head's middle is brain.
        middle = found.sample(np.zeros((1, 3)))[0]
        assert 0.5 * UNIT_PER_MM < middle < 1.5 * UNIT_PER_MM


def outermost(volume):
    values = volume.values.copy()
    values[1:-1, 1:-1, 1:-1] = 0
    return values


def test_place_and_attenuation_are_right_with_offset_tilt_and_parallel_beams(head):
    angles = np.arange(24) * 2 * np.pi / 24
    scan = CircularScan(64, 48, (6.4, 8.0), 1000.0, 1536.0, offset_mm=(9.0, 5.0))
    tilted = []
    for detector in scan.detectors(angles):
        u, v = np.asarray(detector.u), np.asarray(detector.v)
        turned = [np.cos(0.2) * u + np.sin(0.2) * v * 6.4 / 8, np.cos(0.2) * v - np.sin(0.2) * u * 8 / 6.4]
        tilted.append(replace(detector, u=turned[0], v=turned[1]))
    parallel = CircularScan(64, 48, (4.2, 5.4), 1000.0, 1536.0, parallel=True).detectors(angles[:12])
    for detectors in (tilted, parallel):
        images = np.stack([head_projection(detector) for detector in detectors])
        scene = Projections(
            images, list(detectors), np.zeros(len(detectors), bool), angles[: len(detectors)], head.box_mm, head.voxels
        )
        assert volume_psnr(sart(scene, settings=SartSettings(iterations=6))) > 19.0


def test_progress_comes_after_each_iteration_and_cancel_stops_it(head):
    heard = []
    sart(head, reporter=Reporter(heard.append), settings=SartSettings(iterations=2), stage="compare")
    assert {progress.stage for progress in heard} == {"compare"}
    assert heard[-1].fraction == 1.0
    asked = []

    def is_cancelled():
        asked.append(1)
        return len(asked) > 3

    # Without an end it would go on for a minute.
    start = time.monotonic()
    with pytest.raises(Cancelled):
        sart(head, reporter=Reporter(is_cancelled=is_cancelled), settings=SartSettings(iterations=1000))
    assert len(asked) == 4
    assert time.monotonic() - start < 10


def test_in_the_other_process_it_is_the_same_and_cancel_ends_at_once(head):
    assert np.array_equal(fdk_process.sart(head).values, sart(head).values)
    start = time.monotonic()
    endless = SartSettings(iterations=100_000)
    with pytest.raises(Cancelled):
        fdk_process.sart(head, settings=endless, reporter=Reporter(is_cancelled=lambda: time.monotonic() - start > 0.5))
    assert time.monotonic() - start < 2.0
    assert fdk_process._process is None


def test_mistakes_are_named(head):
    with pytest.raises(SettingError, match="iterations of SART is 0"):
        sart(head, settings=SartSettings(iterations=0))
    with pytest.raises(SettingError, match="relaxation of SART is 2"):
        sart(head, settings=SartSettings(relaxation=2.0))
    with pytest.raises(SettingError, match="margin of SART is -1"):
        sart(head, settings=SartSettings(margin=-1))
    with pytest.raises(SettingError, match="three counts"):
        sart(head, voxels=(4, 4))
    with pytest.raises(CaptureError, match="at least two projections"):
        sart(head, subset=np.arange(22) == 3)


@pytest.mark.slow
def test_it_scores_what_is_quoted_for_it():
    assert volume_psnr(sart(shepp_logan_projections(SheppLoganScan(heldout=0)))) == pytest.approx(26.8, abs=0.1)
