"""The scanner's geometry: which way is up, right and round, proven on an object that is not its own mirror image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from insideout.core.capture.detectors import project_points, unseen_fraction, visible_box
from insideout.core.views import Detector


def test_at_angle_zero_the_source_is_on_the_x_axis_and_the_detector_behind_the_object(scan):
    detector = scan.detector(0.0)
    assert np.allclose(detector.source, [60, 0, 0])
    assert np.allclose(detector.center, [-30, 0, 0])


@pytest.mark.parametrize("angle", [0.0, 0.7, 3.0])
def test_a_point_up_the_axis_is_seen_in_a_higher_row(scan, angle):
    middle, up = project_points(scan.detector(angle), np.array([[0, 0, 0], [0, 0, 5.0]]))
    assert np.allclose(middle, [16, 14])
    assert np.allclose(up - middle, [0, -5.0 * 1.5 / 1.6])


def test_seen_from_the_source_the_rows_run_to_the_right(scan):
    # Standing at +x and looking at the origin with z up, +y is on the right.
    point = project_points(scan.detector(0.0), np.array([0, 4.0, 0]))
    assert point[0] == pytest.approx(16 + 4.0 * 1.5 / 1.6)


def test_an_offset_detector_sees_the_axis_off_its_middle(scan):
    moved = replace(scan, offset_mm=(3.2, 1.6))
    assert np.allclose(project_points(moved.detector(1.1), np.zeros(3)), [16 - 2, 14 + 1])


@pytest.mark.parametrize("parallel", [False, True])
def test_a_point_projects_to_the_pixel_whose_ray_passes_through_it(scan, parallel):
    detector = replace(scan, parallel=parallel, offset_mm=(1.0, -2.0)).detector(0.4)
    origins, directions = detector.rays()
    point = origins[20, 5] + (70.0 if not parallel else -25.0) * directions[20, 5]
    assert np.allclose(project_points(detector, point), [5.5, 20.5], atol=1e-9)


def test_a_sheared_detector_is_projected_onto_exactly():
    detector = Detector(
        10, 10, np.array([50.0, 0, 0]), np.array([-20.0, 1, 2]), np.array([0.1, 1, 0.2]), np.array([0, 0.3, -1])
    )
    origins, directions = detector.rays()
    assert np.allclose(project_points(detector, origins[3, 7] + 40 * directions[3, 7]), [7.5, 3.5])


def test_the_visible_box_is_seen_whole_and_a_larger_one_is_not(scan):
    detectors = scan.detectors(np.linspace(0, 6, 7))
    box = visible_box(detectors)
    assert unseen_fraction(detectors, 0.6 * box) == 0
    assert unseen_fraction(detectors, 2 * box) > 0.2


def test_a_detector_set_off_to_one_side_sees_more_over_a_full_turn_alone(scan):
    """Half fan: the axis is seen near one edge, and all of the object in two projections together."""
    half = replace(scan, offset_mm=(0.4 * 32 * 1.6, 0.0))
    turn = visible_box(half.detectors(np.linspace(0, 2 * np.pi, 16, endpoint=False)))
    part = visible_box(half.detectors(np.linspace(0, 2.0, 16)))
    assert turn[1, 0] == pytest.approx(9 * part[1, 0], rel=0.01)
    full = half.detectors(np.linspace(0, 2 * np.pi, 16, endpoint=False))
    assert unseen_fraction(full, 0.5 * turn) == 0
    assert unseen_fraction(full[:5], 0.5 * turn) > 0.2
    beside = replace(scan, offset_mm=(0.6 * 32 * 1.6, 0.0))
    for end in (2.0, 2 * np.pi):
        with pytest.raises(ValueError, match="does not see the axis"):
            visible_box(beside.detectors(np.linspace(0, end, 16, endpoint=False)))


def sart(images, detectors, grid, rounds=4):
    """A reconstruction of its own, of nothing but `project_points`: pixel-driven SART with nearest neighbours."""
    shape = grid.shape[:3]
    volume = np.zeros(shape)
    lookups = []
    for detector in detectors:
        pixel = np.floor(project_points(detector, grid)).astype(int)
        inside = np.all((pixel >= 0) & (pixel < [detector.width, detector.height]), axis=-1)
        lookups.append(
            (np.clip(pixel[..., 1], 0, detector.height - 1), np.clip(pixel[..., 0], 0, detector.width - 1), inside)
        )
    step = grid[1, 0, 0, 0] - grid[0, 0, 0, 0]

    def forward(lookup, size):
        rows, columns, inside = lookup
        total = np.zeros(size)
        np.add.at(total, (rows[inside], columns[inside]), volume[inside])
        count = np.zeros(size)
        np.add.at(count, (rows[inside], columns[inside]), 1.0)
        return total, count

    for _ in range(rounds):
        for image, lookup in zip(images, lookups, strict=True):
            total, count = forward(lookup, image.shape)
            # Voxels are spread over pixels in proportion to the chord: count·step³/area is the chord's length.
            residual = np.where(count > 0, image - total * step**3 / 1.1, 0) / np.maximum(count * step**3 / 1.1, 1e-9)
            rows, columns, inside = lookup
            volume += 0.3 * np.where(inside, residual[rows, columns], 0)
            np.maximum(volume, 0, out=volume)
    errors = [
        image - forward(lookup, image.shape)[0] * step**3 / 1.1 for image, lookup in zip(images, lookups, strict=True)
    ]
    return volume, float(np.sqrt(np.mean(np.square(errors))) / np.sqrt(np.mean(np.square(images))))


@pytest.fixture
def grid():
    axis = np.arange(-14.5, 15, 1.0)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)


def test_backprojection_finds_the_balls_where_they_are(scan, radiograph, grid):
    detectors = scan.detectors(np.arange(24) * 2 * np.pi / 24)
    volume, _ = sart([radiograph(d) for d in detectors], detectors, grid)
    for center in ((10, 0, 0), (0, 6, 3), (-2, -3, 8)):
        at = np.linalg.norm(grid - center, axis=-1) < 2
        mirrored = np.linalg.norm(grid - np.array(center) * [1, -1, 1] - [0, 0, 0.01], axis=-1) < 2
        assert volume[at].mean() > 0.02
        if center[1]:
            assert volume[at].mean() > 5 * volume[mirrored].mean()


def test_turning_the_wrong_way_round_does_not_explain_the_projections(scan, radiograph, grid):
    angles = np.arange(24) * 2 * np.pi / 24
    images = [radiograph(d) for d in scan.detectors(angles)]
    _, right = sart(images, scan.detectors(angles), grid)
    _, reversed_turn = sart(images, scan.detectors(-angles), grid)
    _, flipped_rows = sart([image[:, ::-1] for image in images], scan.detectors(angles), grid)
    assert right < 0.7 * reversed_turn
    assert right < 0.7 * flipped_rows


def test_only_the_convention_tells_an_object_from_its_mirror_image(scan, radiograph, grid):
    # Upside-down projections reconstruct as well as upright ones, as the mirrored object. So a file's row order
    # cannot be checked from the projections alone: photos have to decide.
    angles = np.arange(24) * 2 * np.pi / 24
    detectors = scan.detectors(angles)
    images = [radiograph(d) for d in detectors]
    upright, error = sart(images, detectors, grid)
    upside_down, same_error = sart([image[::-1] for image in images], detectors, grid)
    assert same_error == pytest.approx(error, rel=0.05)
    assert np.corrcoef(upside_down[:, :, ::-1].ravel(), upright.ravel())[0, 1] > 0.98
