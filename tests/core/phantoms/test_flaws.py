"""Each flaw of a scanner, and of a camera's exposure, is in the images as it is in the truth, and not in the files."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter

from insideout.core.capture.detectors import CircularScan
from insideout.core.errors import SettingError
from insideout.core.phantoms.flaws import ScanFlaws, true_detectors
from insideout.core.phantoms.make import make_capture
from insideout.core.phantoms.part_tables import PartTables
from insideout.core.phantoms.photos import exposed
from insideout.core.phantoms.projections import project
from insideout.core.phantoms.scanner import scan_geometry
from insideout.core.phantoms.spectrum import monochromatic
from insideout.core.phantoms.truth import read_truth
from insideout.core.srgb import srgb_to_linear

# What float16 leaves of line integrals below 8.
HALF = {"rtol": 2e-3, "atol": 2e-3}


@pytest.fixture
def made(tmp_path, only_ball, ball_settings):
    """`made(effect, **settings)`: all projections (M, height, width), what is true of the scan, and the scanner."""

    def make(*effects, **changes):
        folder = tmp_path / "-".join(("capture", *effects))
        make_capture("ball", folder, replace(ball_settings, projections=8, effects=effects, **changes))
        meta = json.loads((folder / "xray" / "meta_data.json").read_text())
        frames = [*meta["proj_train"], *meta["proj_test"]]
        images = np.stack([np.load(folder / "xray" / frame["file_path"]).astype(float) for frame in frames])
        return images, read_truth(folder), meta["scanner"], np.array([frame["angle"] for frame in frames])

    return make


@pytest.fixture
def clean(ball, ball_settings):
    """`clean(angles)`: the projections of the ideal scanner."""
    tables = PartTables.bake(ball, ball_settings.table_mm)
    scan = scan_geometry(ball, 24, 24)
    return lambda angles: project(tables, scan.detectors(angles), monochromatic(ball.energy_kev))


def test_a_detector_off_its_place_sees_what_is_beside(made, clean):
    """Two pixels to the right and one down; the files say that it is in the middle."""
    images, truth, scanner, angles = made("geometry", offset_px=(2.0, 1.0), tilt_degrees=0.0, jitter_px=0.0)
    np.testing.assert_allclose(images[:, :-1, :-2], clean(angles)[:, 1:, 2:], **HALF)
    np.testing.assert_array_equal(truth.scan["offset_px"], (2, 1))
    assert scanner["offDetector"] == [0, 0]


def test_a_turned_detector_turns_from_its_rows_towards_its_columns(made, clean):
    images, truth, _, angles = made("geometry", offset_px=(0.0, 0.0), tilt_degrees=90.0, jitter_px=0.0)
    np.testing.assert_allclose(images, np.rot90(clean(angles), axes=(1, 2)), **HALF)
    assert truth.scan["tilt_rad"] == pytest.approx(np.pi / 2)


def test_each_projection_shakes_by_itself(made, clean):
    """The shadow's middle moves against the detector; so few pixels tell it to a tenth."""
    images, truth, _, angles = made("geometry", offset_px=(0.0, 0.0), tilt_degrees=0.0, jitter_px=0.3)
    jitter = truth.scan["jitter_px"]
    assert jitter.shape == (9, 2)
    assert len(np.unique(jitter)) == 18
    np.testing.assert_allclose(middles(images) - middles(clean(angles)), -jitter, atol=0.15)


def test_an_object_that_slides_and_tips_gives_way_once_and_is_where_it_should_be_on_average(made, clean, ball):
    images, truth, _, angles = made("motion", drift_px=3.0)
    drift, turn, order = truth.scan["drift_mm"], truth.scan["turn_rad"], np.argsort(angles)
    np.testing.assert_allclose(drift[:8].mean(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(turn[:8].mean(axis=0), 0, atol=1e-12)
    way = np.linalg.norm(drift - drift[0], axis=1)[order]
    assert way[0] == 0
    assert (np.diff(way) > 0).all()
    # What goes up goes up on the detector, whose rows count downwards; a ball about the origin only slides.
    moved = middles(images) - middles(clean(angles))
    seen = 1.5 / scan_geometry(ball, 24, 24).pixel_mm[1]
    np.testing.assert_allclose(moved[:, 1], -drift[:, 2] * seen, atol=0.15)
    assert way[-1] * seen == pytest.approx(3.0, rel=0.1)
    assert np.linalg.norm(turn[order[-1]] - turn[0]) == pytest.approx(way[-1] * 1.5 / (12 * 1.5 / seen), rel=0.01)


def test_a_turned_object_is_seen_turned():
    """A turn about z and a way are a scan that begins elsewhere, of a scanner that is elsewhere."""
    scan = CircularScan(24, 24, (1.0, 1.0), 200.0, 300.0)
    flaws = ScanFlaws(drift_mm=np.array([[0.0, 0.0, 2.0]]), turn_rad=np.array([[0.0, 0.0, 0.3]]))
    (seen,), (other,) = true_detectors(scan, np.array([0.7]), flaws), scan.detectors(np.array([0.4]))
    np.testing.assert_allclose(seen.source, np.asarray(other.source) - [0, 0, 2], atol=1e-9)
    np.testing.assert_allclose(seen.center, np.asarray(other.center) - [0, 0, 2], atol=1e-9)
    np.testing.assert_allclose(seen.u, other.u, atol=1e-9)
    np.testing.assert_allclose(seen.v, other.v, atol=1e-9)


def test_a_wide_spot_blurs_what_arrives(made, clean):
    images, truth, _, angles = made("focal_spot", spot_px=1.5)
    arrives, sharp = np.exp(-images), np.exp(-clean(angles).astype(float))
    blurred = gaussian_filter(sharp, (0, 1.5, 1.5))
    inner = (slice(None), slice(4, -4), slice(4, -4))
    assert np.abs(arrives - blurred)[inner].max() < 0.25 * np.abs(sharp - blurred)[inner].max()
    assert arrives[inner].mean() == pytest.approx(blurred[inner].mean(), rel=0.01)
    assert truth.scan["spot_mm"] > 0


def test_pixels_answer_alike_in_all_projections_and_each_in_its_own_way(made, clean):
    images, truth, _, angles = made("ring", ring_share=0.05)
    gain = truth.scan["log_gain"]
    assert gain.shape == (24, 24)
    assert gain.std() == pytest.approx(0.05, rel=0.15)
    np.testing.assert_allclose(images, clean(angles) - gain, **HALF)


def test_a_narrow_detector_has_the_middle_of_the_shadow(made, clean):
    images, truth, scanner, angles = made("truncation", seen_share=0.5)
    np.testing.assert_allclose(images, clean(angles)[:, :, 6:18], **HALF)
    assert scanner["nDetector"] == [24, 12]
    assert (images[:, :, [0, -1]].max(axis=1) > 0.1).all()
    assert not truth.scan


def test_photos_have_an_exposure_and_a_white_balance_of_their_own(made, tmp_path):
    """Background and object alike, but for what is too bright for the camera."""
    _, truth, *_ = made("exposure")
    made()
    assert truth.exposure_gain.shape == (2, 3)
    stops = np.log2(truth.exposure_gain)
    assert np.ptp(stops.mean(axis=1)) > 2 * np.ptp(stops, axis=1).max()
    for number, gain in enumerate(truth.exposure_gain):
        name = f"photos/{number:03d}.jpg"
        own, plain = (_light(tmp_path / folder / name) for folder in ("capture-exposure", "capture"))
        # JPEG smears colours at edges.
        kept = (own[..., 1] < 0.9) & (plain[..., 1] > 0.1)
        assert np.median(own[kept, 1] / plain[kept, 1]) == pytest.approx(gain[1], rel=0.05)


def test_exposing_twice_as_long_doubles_the_light_that_is_not_clipped():
    pixels = np.array([[[40, 80, 250]]], np.uint8)
    twice = exposed(pixels, (2.0, 2.0, 2.0))
    np.testing.assert_allclose(
        srgb_to_linear(twice / 255.0)[0, 0, :2], 2 * srgb_to_linear(pixels / 255.0)[0, 0, :2], rtol=0.02
    )
    assert twice[0, 0, 2] == 255
    np.testing.assert_array_equal(exposed(pixels, (1.0, 1.0, 1.0)), pixels)


def test_flaws_change_no_draw_of_chance_of_what_is_not_chosen(made):
    """Held-out angles, and the noise that comes after."""
    noisy, _, _, angles = made("noise")
    ringed, truth, _, same = made("noise", "exposure", "ring")
    np.testing.assert_array_equal(angles, same)
    np.testing.assert_allclose(ringed, noisy - truth.scan["log_gain"], **HALF)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"ring_share": 0.0}, "ring_share is 0.0; give a number above zero"),
        ({"seen_share": 1.5}, "seen_share is 1.5; give a number above 0, at most 1"),
        ({"jitter_px": float("nan")}, "jitter_px or drift_px is nan; give a number"),
    ],
)
def test_numbers_that_are_none_are_named(ball_settings, changes, message):
    with pytest.raises(SettingError, match=message):
        replace(ball_settings, **changes).check()


def middles(images):
    """(M, 2) where the shadow's middle is, column and row."""
    weights = np.maximum(images, 0)
    total = weights.sum(axis=(1, 2))
    rows, columns = np.indices(images.shape[1:])
    return np.stack([(weights * columns).sum(axis=(1, 2)) / total, (weights * rows).sum(axis=(1, 2)) / total], axis=1)


def _light(path):
    return srgb_to_linear(np.asarray(Image.open(path)) / 255.0)
