"""The camera of a detector sees every point where the detector does."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from insideout.core.capture.detectors import CircularScan, project_points
from insideout.core.capture.pinhole import camera_of
from insideout.core.errors import CaptureError
from insideout.core.gaussians import GaussianSet
from insideout.core.render import splat
from insideout.core.rotations import normalize_quats, quats_to_matrices
from insideout.core.views import Detector

RANDOM = np.random.default_rng(3)
POINTS = RANDOM.uniform(-40, 40, (50, 3))


def pixels(camera, points):
    matrix = np.asarray(camera.world_to_camera)
    local = points @ matrix[:3, :3].T + matrix[:3, 3]
    depth = 1.0 if camera.orthographic else local[:, 2]
    assert (local[:, 2] > 0).all()
    return np.stack([camera.fx * local[:, 0] / depth + camera.cx, camera.fy * local[:, 1] / depth + camera.cy], -1)


def tilted(detector, seed):
    """The detector turned by about 20 degrees about its middle and moved."""
    quats = np.array([[1.0, 0, 0, 0]]) + np.random.default_rng(seed).normal(0, 0.1, (1, 4))
    turn = quats_to_matrices(normalize_quats(quats))[0]
    center = detector.center + np.array([5.0, -9.0, 4.0])
    return replace(detector, u=turn @ detector.u, v=turn @ detector.v, center=center)


@pytest.mark.parametrize("angle", [0.0, 1.1, 4.0])
def test_a_cone_beam_with_offset_tilt_and_unequal_pitches(angle):
    scan = CircularScan(64, 48, (1.5, 2.5), 300.0, 480.0, offset_mm=(12.0, -7.0))
    for detector in (scan.detector(angle), tilted(scan.detector(angle), 1), tilted(scan.detector(angle), 2)):
        assert pixels(camera_of(detector), POINTS) == pytest.approx(project_points(detector, POINTS), abs=1e-6)


@pytest.mark.parametrize("angle", [0.0, 1.1, 4.0])
def test_a_parallel_beam_also_onto_a_detector_that_leans_along_its_rows_or_columns(angle):
    scan = CircularScan(64, 48, (1.5, 2.5), 300.0, 480.0, offset_mm=(12.0, -7.0), parallel=True)
    upright = scan.detector(angle)
    leaning = replace(upright, u=upright.u + 0.4 * np.asarray(upright.source))
    for detector in (upright, leaning, replace(upright, v=upright.v - 0.7 * np.asarray(upright.source))):
        camera = camera_of(detector)
        assert camera.orthographic
        assert pixels(camera, POINTS) == pytest.approx(project_points(detector, POINTS), abs=1e-6)


@pytest.mark.parametrize("parallel", [False, True])
def test_a_small_splat_is_drawn_where_the_detector_has_it(parallel):
    scan = CircularScan(64, 48, (2.5, 2.5), 300.0, 480.0, offset_mm=(6.0, 5.0), parallel=parallel)
    detector = scan.detector(0.8)
    point = np.array([[9.0, -14.0, 11.0]])
    drawn = splat(GaussianSet.create(point, 0.5).to_torch(torch.float64), camera_of(detector), kernel="reference")
    weights = drawn.alpha.numpy()
    rows, columns = np.indices(weights.shape) + 0.5
    center = [(weights * columns).sum() / weights.sum(), (weights * rows).sum() / weights.sum()]
    assert center == pytest.approx(project_points(detector, point)[0], abs=0.02)


def test_what_no_camera_shows_is_refused_in_a_sentence():
    cone = CircularScan(8, 8, (1.0, 1.0), 300.0, 480.0).detector(0.0)
    beam = CircularScan(8, 8, (1.0, 1.0), 300.0, 480.0, parallel=True).detector(0.0)
    for detector in (cone, beam):
        with pytest.raises(CaptureError, match="not at right angles"):
            camera_of(replace(detector, u=np.asarray(detector.u) + 0.1 * np.asarray(detector.v)))
        with pytest.raises(CaptureError, match="mirror image"):
            camera_of(replace(detector, u=-np.asarray(detector.u)))
    edge_on = Detector(8, 8, cone.center + 100 * np.asarray(cone.u), cone.center, cone.u, cone.v)
    with pytest.raises(CaptureError, match="along its detector"):
        camera_of(edge_on)
    with pytest.raises(CaptureError, match="along its detector"):
        camera_of(replace(beam, source=np.asarray(beam.u)))
