"""Cross-sections: which planes, what they show, and the outer contour."""

import numpy as np
import pytest

from insideout.core.errors import SettingError
from insideout.core.sections import (
    choose_planes,
    outer_contour,
    reference_section,
    section_step,
)
from insideout.core.volume import Volume

BOX = np.array([[-40.0, -50.0, -30.0], [40.0, 50.0, 30.0]])
LARGE = np.array([[0.0, 0.0, 0.0], [300.0, 600.0, 720.0]])


def of_kind(views, kind):
    return [view for view in views if view.kind == kind]


def disc(shape, center, radius):
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    return np.hypot(rows - center[0], columns - center[1]) <= radius


class TestSpacing:
    def test_small_objects_get_24_planes_an_axis(self):
        views = choose_planes(BOX)
        for kind, axis in (("axial", 2), ("coronal", 1)):
            positions = np.array([view.position_mm for view in of_kind(views, kind)])
            assert len(positions) == 24
            assert np.diff(positions) == pytest.approx((BOX[1] - BOX[0])[axis] / 24)

    def test_large_objects_are_cut_every_15_mm_as_in_the_paper(self):
        assert section_step(720.0) == 15.0
        assert np.diff([view.position_mm for view in of_kind(choose_planes(LARGE), "axial")]) == pytest.approx(15.0)

    def test_a_wanted_step_is_never_exceeded(self):
        positions = [view.position_mm for view in choose_planes(BOX, step_mm=7.0, planes=("sagittal",))]
        assert np.diff(positions).max() <= 7.0
        assert len(positions) == 12

    def test_the_box_is_covered_from_end_to_end(self):
        positions = [view.position_mm for view in of_kind(choose_planes(BOX), "coronal")]
        half = 100 / 24 / 2
        assert positions[0] - half == pytest.approx(-50)
        assert positions[-1] + half == pytest.approx(50)

    @pytest.mark.parametrize(
        "arguments",
        [
            {"step_mm": 0.0},
            {"pixel_mm": -1.0},
            {"planes": ("axil",)},
            {"box_mm": np.zeros((2, 3))},
            {"box_mm": np.array([[0, 0, 0], [1, np.nan, 1]])},
        ],
    )
    def test_impossible_settings_are_refused(self, arguments):
        with pytest.raises(SettingError):
            choose_planes(**{"box_mm": BOX, **arguments})


class TestHoldOut:
    def test_every_fifth_plane_of_each_series_is_held_out(self):
        for kind in ("axial", "coronal"):
            held = [i for i, view in enumerate(of_kind(choose_planes(BOX), kind)) if view.held_out]
            assert np.diff(held) == pytest.approx(5)
            assert len(held) == 5

    def test_held_out_planes_never_move(self):
        still = [view.position_mm for view in choose_planes(BOX) if view.held_out]
        for seed in range(5):
            assert [view.position_mm for view in choose_planes(BOX, jitter_seed=seed) if view.held_out] == still

    def test_jittered_training_planes_keep_half_a_step_from_held_out_ones(self):
        for seed in range(50):
            views = of_kind(choose_planes(BOX, jitter_seed=seed), "axial")
            held = np.array([view.position_mm for view in views if view.held_out])
            for view in views:
                if not view.held_out:
                    assert np.abs(held - view.position_mm).min() >= 0.5 * 60 / 24 - 1e-9

    def test_jitter_is_the_seeds(self):
        def positions(seed):
            return [view.position_mm for view in choose_planes(BOX, jitter_seed=seed)]

        assert positions(3) == positions(3)
        assert positions(3) != positions(4)


class TestPixels:
    def test_pixels_are_voxels(self):
        plane = of_kind(choose_planes(BOX, pixel_mm=np.array([1.0, 2.0, 0.5])), "axial")[0].plane
        assert (plane.height, plane.width) == (50, 80)
        assert np.linalg.norm(plane.u) == pytest.approx(1.0)
        assert np.linalg.norm(plane.v) == pytest.approx(2.0)

    def test_images_fill_the_box_with_up_at_the_top(self):
        for view in choose_planes(BOX, planes=("axial", "coronal", "sagittal"), pixel_mm=1.0):
            points = view.plane.points()
            assert np.all(points >= BOX[0])
            assert np.all(points <= BOX[1])
            up = 1 if view.kind == "axial" else 2
            assert points[0, 0, up] > points[-1, 0, up]

    def test_a_section_at_voxel_centres_is_the_volumes_slice(self):
        values = np.random.default_rng(0).normal(size=(6, 5, 4)).astype(np.float32)
        volume = Volume.centered(values, np.ones(3))
        views = choose_planes(volume.box_mm, step_mm=1.0, planes=("axial",), pixel_mm=1.0)
        shown = reference_section(volume, views[2])
        assert shown == pytest.approx(np.maximum(values[2, ::-1, :], 0), abs=1e-6)
        assert shown.min() == 0.0


class TestOuterContour:
    def test_the_inside_of_a_hollow_object_belongs_to_it(self):
        ring = disc((80, 80), (40, 40), 30) & ~disc((80, 80), (40, 40), 22)
        contour = outer_contour(ring.astype(float))
        assert contour.mask[40, 40]
        assert abs(contour.mask.sum() / disc((80, 80), (40, 40), 30).sum() - 1) < 0.05

    def test_only_the_outermost_of_several_edges_is_kept(self):
        shells = np.zeros((80, 80))
        for radius, value in ((30, 1.0), (22, 0.0), (15, 2.0), (8, 0.0)):
            shells[disc(shells.shape, (40, 40), radius)] = value
        edge = outer_contour(shells).edge
        rows, columns = np.nonzero(edge)
        assert np.abs(np.hypot(rows - 40, columns - 40) - 30).max() < 2.0

    def test_islands_are_kept(self):
        image = disc((100, 100), (40, 40), 25) | disc((100, 100), (80, 85), 6)
        contour = outer_contour(image.astype(float))
        assert contour.mask[80, 85]
        assert contour.mask[40, 40]

    def test_specks_under_one_percent_are_dropped(self):
        image = disc((100, 100), (40, 40), 30) | disc((100, 100), (90, 90), 1.0)
        contour = outer_contour(image.astype(float))
        assert not contour.mask[85:95, 85:95].any()

    def test_noise_does_not_move_it(self):
        random = np.random.default_rng(1)
        clean = disc((100, 100), (50, 50), 30)
        contour = outer_contour(clean * 0.04 + random.normal(0, 0.005, clean.shape), threshold=0.02)
        assert abs(contour.mask.sum() / clean.sum() - 1) < 0.06

    def test_an_object_cut_off_by_the_image_is_closed_along_its_border(self):
        image = np.zeros((60, 60))
        image[20:40, :] = 1.0
        contour = outer_contour(image)
        assert contour.mask[30, 0]
        assert contour.mask[30, 59]

    @pytest.mark.parametrize("value", [0.0, 3.0])
    def test_a_flat_section_has_none(self, value):
        contour = outer_contour(np.full((20, 20), value))
        assert not contour.mask.any()
        assert not contour.edge.any()

    def test_air_stays_empty_under_the_volumes_threshold(self):
        air = np.abs(np.random.default_rng(0).normal(0, 0.002, (50, 50)))
        assert not outer_contour(air, threshold=0.02).mask.any()
