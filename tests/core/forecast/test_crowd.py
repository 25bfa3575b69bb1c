"""Where an object lies in the scanned box, told by some of its projections."""

from dataclasses import replace

import numpy as np
import pytest

from insideout.core.capture.model import Projections
from insideout.core.forecast.crowd import crowded, even_cells, object_cells
from insideout.core.views import Detector

BOX = np.array([[-20.0, -20.0, -20.0], [20.0, 20.0, 20.0]])
CENTER, RADIUS = np.array([6.0, -4.0, 8.0]), 7.0
SIDE, PIXEL = 96, 0.9


def detectors(parallel, width=SIDE):
    """Twelve around the axis; of a cone they are twice as far from the source as the axis is."""
    found = []
    for angle in 2 * np.pi * np.arange(12) / 12:
        outward, along = np.array([np.cos(angle), np.sin(angle), 0.0]), np.array([-np.sin(angle), np.cos(angle), 0.0])
        pixel = PIXEL / 2 if parallel else PIXEL
        source = -outward if parallel else 150 * outward
        down = np.array([0.0, 0.0, -pixel])
        found.append(Detector(width, SIDE, source, -150 * outward, pixel * along, down, parallel))
    return found


def shadow(detector):
    """Line integrals of a ball: how long rays are in it, mm, times 0.02 mm⁻¹."""
    rows, columns = np.mgrid[: detector.height, : detector.width] + 0.5
    across, down = columns - detector.width / 2, rows - detector.height / 2
    places = detector.center + across[..., None] * detector.u + down[..., None] * detector.v
    rays = np.broadcast_to(detector.source, places.shape) if detector.parallel else places - detector.source
    off = np.linalg.norm(np.cross(rays, CENTER - places), axis=-1) / np.linalg.norm(rays, axis=-1)
    return 0.02 * 2 * np.sqrt(np.maximum(RADIUS**2 - off**2, 0))


def scan(parallel=False, width=SIDE):
    views = detectors(parallel, width)
    images = np.array([shadow(view) for view in views], np.float32)
    return Projections(images, views, np.zeros(12, bool), 2 * np.pi * np.arange(12) / 12, BOX, (64, 64, 64))


def away(cells):
    """How far each cell's middle is from the ball's."""
    even = even_cells(BOX)
    index = np.argwhere(np.ones(cells.shape, bool))[:, ::-1]
    return np.linalg.norm(even.origin_mm + index * even.spacing_mm - CENTER, axis=1).reshape(cells.shape)


def is_the_ball(cells, rim=0.5):
    """All cells of the ball but for its rim, mm, and few that are not: hulls of eight views have corners."""
    distance = away(cells)
    assert cells[distance < RADIUS - rim].all()
    assert (distance < RADIUS - rim).sum() > 300
    return cells.sum() < 2.0 * (distance < RADIUS + 1).sum()


@pytest.mark.parametrize("parallel", [False, True])
def test_the_object_is_where_all_views_show_it(parallel):
    assert is_the_ball(object_cells(scan(parallel)))


def test_a_little_steel_does_not_make_air_of_what_lies_around_it():
    projections = scan()
    images = projections.images.copy()
    images[:, 40, 40] = 25 * images.max()
    assert is_the_ball(object_cells(replace(projections, images=images)), rim=1.5)


def test_thin_walls_between_the_middles_of_cells_count():
    """One pixel in three shows something."""
    projections = scan()
    images = projections.images.copy()
    images[:, :, ::3] = images[:, :, 1::3] = 0
    assert is_the_ball(object_cells(replace(projections, images=images)), rim=1.5)


def test_pixels_without_a_value_show_no_air():
    projections = scan()
    for value in (np.nan, np.inf, -np.inf):
        images = projections.images.copy()
        images[:, 30:40] = value
        found = object_cells(replace(projections, images=images))
        assert found[away(found) < RADIUS - 0.5].all()


def test_what_no_detector_sees_may_hold_something():
    """Cells beside a narrow detector in all views: the box's corners."""
    found = object_cells(scan(width=20))
    assert found[:, 0, 0].any()
    assert not object_cells(scan())[:, 0, 0].any()


def test_views_that_agree_on_next_to_nothing_tell_nothing():
    projections = scan()
    assert object_cells(replace(projections, images=np.zeros_like(projections.images))).all()
    elsewhere = projections.images.copy()
    elsewhere[::2] = np.roll(elsewhere[::2], 40, axis=1)
    assert object_cells(replace(projections, images=elsewhere)).all()


def test_splats_crowd_in_the_cells_that_are_given():
    cells = np.zeros(even_cells(BOX).values.shape, bool)
    cells[3:5, 10:14, 20:30] = True
    splats = crowded(BOX, 500, cells)
    assert len(splats) == 500
    spacing = even_cells(BOX).spacing_mm
    index = np.floor((splats.means - BOX[0]) / spacing).astype(int)
    assert cells[index[:, 2], index[:, 1], index[:, 0]].all()
    assert len(np.unique(index, axis=0)) > 0.95 * cells.sum()
    # Together they have the room of the cells.
    assert 500 * (splats.scales[0] / 0.5).prod() == pytest.approx(cells.sum() * spacing.prod(), rel=1e-4)
