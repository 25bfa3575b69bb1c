"""Projections of voxels against the closed form of what they were made of."""

import numpy as np
import pytest

from insideout.core.capture.detectors import CircularScan
from insideout.core.errors import Cancelled
from insideout.core.forward_projection import forward_project
from insideout.core.gaussians import GaussianSet, Modality
from insideout.core.render import radiograph
from insideout.core.render.voxels import voxelize
from insideout.core.volume import Volume

ANGLES = np.array([0.3, 2.0, 4.0])


@pytest.mark.parametrize("parallel", [False, True])
def test_two_unlike_splats_of_voxels_look_like_the_splats(parallel):
    """Oblong voxels, a box that is not about the origin, a detector off the axis: nothing is turned or mirrored."""
    splats = GaussianSet.create(
        np.array([[5.0, -8, 3], [-6, 4, -9]]),
        np.array([[3.0, 4, 5], [4, 3, 3]]),
        density=np.array([0.03, 0.05]),
        modality=Modality.XRAY,
    )
    volume = voxelize(splats, np.array([-25.0, -28, -30]), np.array([0.5, 0.6, 0.7]), (90, 96, 104))
    scan = CircularScan(50, 40, (1.6, 1.5), 200.0, 300.0, offset_mm=(3.0, -2.0), parallel=parallel)
    detectors = scan.detectors(ANGLES)
    expected = np.stack([radiograph(splats.to_torch(), detector).numpy() for detector in detectors])
    assert forward_project(volume, detectors) == pytest.approx(expected, abs=0.015 * expected.max())


def test_a_ray_along_a_row_of_voxels_adds_them_up():
    values = np.zeros((3, 3, 5), np.float32)
    values[1, 1] = [1.0, 2.0, 3.0, 4.0, 5.0]
    scan = CircularScan(1, 1, (0.1, 0.1), 1000.0, 1500.0, parallel=True)
    found = forward_project(Volume.centered(values, np.array([0.5, 1.0, 1.0])), [scan.detector(0.0)])
    assert found[0, 0, 0] == pytest.approx(0.5 * 15.0, rel=1e-4)


def test_progress_counts_projections_and_may_stop_it():
    scan, told = CircularScan(4, 4, (1.0, 1.0), 100.0, 150.0), []
    volume = Volume.centered(np.ones((3, 3, 3), np.float32), np.ones(3))
    forward_project(volume, scan.detectors(np.linspace(0, 6, 11)), told.append)
    assert told == [8, 11]

    def stop(done):
        raise Cancelled

    with pytest.raises(Cancelled):
        forward_project(volume, scan.detectors(ANGLES), stop)
