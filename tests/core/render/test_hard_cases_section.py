"""A catalogue of splats and planes that break renderers of cuts and slabs, each with the values that are right.

Every case runs on every kernel; `cut` checks that all values and gradients are finite and that the gradients of the
float32 kernels are those of the reference in float64.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtr

from insideout.core.errors import SettingError
from insideout.core.gaussians import GaussianSet, Modality
from insideout.core.render import section
from insideout.core.rotations import normalize_quats, quats_to_matrices
from insideout.core.spherical_harmonics import rgb_to_sh
from insideout.core.views import Plane

STRAIGHT, SLANTED = (1.0, 0.0, 0.0, 0.0), (0.9, 0.1, 0.3, -0.2)
FLAT = Plane(np.array([-8.25, -6.25, 1.0]), np.array([0.5, 0, 0]), np.array([0, 0.5, 0]), 33, 25)
TILTED = replace(FLAT, u=np.array([0.5, 0, 0.25]), origin=np.array([-8.25, -6.25, -3.0]))
"""Planes whose pixel centres float32 has exactly; that of pixel (12, 16) is (0, 0, 1) and (0, 0, 1.125)."""
PLANES = pytest.mark.parametrize("plane", [FLAT, TILTED], ids=["flat", "tilted"])
SLABS = pytest.mark.parametrize("thickness", [0.0, 0.2, 3.0], ids=["cut", "thin slab", "slab"])
QUANTITIES = pytest.mark.parametrize("quantity", ["density", "occupancy", "color"])
MIDDLE = (12, 16)


def middle_of(plane: Plane) -> np.ndarray:
    return plane.points()[MIDDLE]


def one(scale=1.0, mean=(0.0, 0.0, 1.0), quat=STRAIGHT, density=0.5, opacity=0.8, color=(0.2, 0.5, 0.7)) -> GaussianSet:
    gaussians = GaussianSet.create(
        np.array([mean]), np.atleast_2d(scale), opacities=opacity, density=density,
        sh=rgb_to_sh(np.array([color]))[:, None, :], modality=Modality.XRAY,
    )  # fmt: skip
    return replace(gaussians, quats=np.array([quat], np.float32))


def weights(gaussians: GaussianSet, plane: Plane) -> np.ndarray:
    """(N, height, width) exp(−½‖y‖²) in float64, y the whitened offset, or its mean through the slab."""
    turns = quats_to_matrices(normalize_quats(gaussians.quats.astype(np.float64)))
    result = []
    for mean, turn, scale in zip(gaussians.means, turns, gaussians.scales, strict=True):
        y = (plane.points() - mean.astype(np.float64)) @ turn / scale.astype(np.float64)
        if plane.thickness_mm == 0:
            result.append(np.exp(-0.5 * (y * y).sum(-1)))
            continue
        through = plane.normal @ turn / scale.astype(np.float64)
        length = np.linalg.norm(through)
        axis = through / length
        along, half = -np.abs(y @ axis), 0.5 * plane.thickness_mm * length
        across = np.linalg.norm(np.cross(y, axis), axis=-1)
        mean_through = (ndtr(along + half) - ndtr(along - half)) * np.sqrt(np.pi / 2) / half
        result.append(np.exp(-0.5 * across**2) * mean_through)
    return np.array(result)


@pytest.fixture
def assert_cut(kernel):
    """Whether all three quantities of a set are as expected; the fast kernels cut splats at 1e-6 of their peaks."""

    def check(cut, gaussians: GaussianSet, plane: Plane, atol: float = 2e-6, **options) -> None:
        w = weights(gaussians, plane)
        alpha = gaussians.opacities.astype(np.float64)[:, None, None] * w
        total = alpha.sum(0)[..., None]
        dc = np.maximum(0, gaussians.sh[:, 0] * 0.28209479177387814 + 0.5)
        expected = {
            "density": np.tensordot(gaussians.density.astype(np.float64), w, 1),
            "occupancy": 1 - np.prod(1 - np.minimum(alpha, 1 - 1e-6), axis=0),
            "color": np.tensordot(alpha, dc, (0, 0)) / np.maximum(total, 0.01),
        }
        for quantity, truth in expected.items():
            found = cut(gaussians, plane, quantity, **options)["image"]
            # Colour is a quotient by a hundredth at least.
            allowed = (atol if kernel.single else 1e-9) * (100 if quantity == "color" else 1)
            np.testing.assert_allclose(found, truth, rtol=2e-5 if kernel.single else 1e-7, atol=allowed)

    return check


# Shapes


@SLABS
@pytest.mark.parametrize("ratio", [1e2, 1e4, 1e6])
def test_a_needle_in_the_plane_is_a_line(cut, assert_cut, thickness, ratio) -> None:
    assert_cut(cut, one((3.0, 3 / ratio, 3 / ratio)), replace(FLAT, thickness_mm=thickness))


@SLABS
@pytest.mark.parametrize("ratio", [1e2, 1e4, 1e6])
def test_a_needle_through_the_plane_is_a_dot(cut, assert_cut, thickness, ratio) -> None:
    assert_cut(cut, one((3 / ratio, 3 / ratio, 3.0)), replace(FLAT, thickness_mm=thickness))


@SLABS
@pytest.mark.parametrize("ratio", [1e2, 1e4, 1e6])
def test_a_disc_in_the_plane_is_round(cut, assert_cut, thickness, ratio) -> None:
    assert_cut(cut, one((3.0, 3.0, 3 / ratio)), replace(FLAT, thickness_mm=thickness))


@SLABS
@pytest.mark.parametrize("ratio", [1e2, 1e4, 1e6])
def test_a_disc_across_the_plane_is_a_line(cut, assert_cut, thickness, ratio) -> None:
    assert_cut(cut, one((3.0, 3 / ratio, 3.0)), replace(FLAT, thickness_mm=thickness))


@SLABS
@pytest.mark.parametrize("ratio", [1e2, 1e4])
def test_a_slanted_disc_is_a_line_on_a_slanted_plane(cut, assert_cut, thickness, ratio) -> None:
    disc = one((3.0, 3 / ratio, 3.0), quat=SLANTED, mean=middle_of(TILTED))
    assert_cut(cut, disc, replace(TILTED, thickness_mm=thickness), atol=2e-4, gradient_rtol=None)


@PLANES
@pytest.mark.parametrize("scale", [1e-3, 1e-8])
def test_a_point_is_seen_in_the_one_pixel_it_is_at(cut, kernel, plane, scale) -> None:
    image = cut(one(scale, mean=middle_of(plane)), plane, gradient_rtol=None)["image"]
    assert image[MIDDLE] == pytest.approx(0.5, rel=1e-5)
    image[MIDDLE] = 0
    assert image.max() < 1e-30


@PLANES
@SLABS
def test_a_scale_of_1e8_is_the_same_everywhere(cut, assert_cut, plane, thickness) -> None:
    assert_cut(cut, one(1e8, quat=SLANTED), replace(plane, thickness_mm=thickness))


def test_a_splat_both_huge_and_tiny_is_a_stripe(cut, kernel) -> None:
    image = cut(one((1e8, 1e-8, 1.0)), FLAT, gradient_rtol=None)["image"]
    np.testing.assert_allclose(image[12], 0.5, rtol=1e-6)
    assert np.delete(image, 12, axis=0).max() < 1e-30


@SLABS
def test_an_axis_aligned_splat(cut, assert_cut, thickness) -> None:
    assert_cut(cut, one((3.0, 1.0, 2.0), mean=(0.5, -0.5, 2.0)), replace(FLAT, thickness_mm=thickness))


def test_a_round_splat_has_no_axes_so_a_turn_changes_nothing(cut, assert_cut) -> None:
    assert_cut(cut, one(2.0, quat=SLANTED), TILTED)
    seen = cut(one(2.0, quat=SLANTED), TILTED)
    assert np.abs(seen.grads["quats"]).max() < 1e-4 * np.abs(seen.grads["scales"]).max()


@SLABS
def test_a_zero_quaternion_means_no_rotation_and_gets_no_gradient(cut, thickness) -> None:
    plane = replace(TILTED, thickness_mm=thickness)
    seen, same = cut(one((3.0, 1.0, 2.0), quat=(0, 0, 0, 0)), plane), cut(one((3.0, 1.0, 2.0)), plane)
    np.testing.assert_array_equal(seen["image"], same["image"])
    assert not seen.grads["quats"].any()


# Planes


def test_a_plane_just_beyond_a_splats_reach_is_empty(cut) -> None:
    assert cut(one(1.0, mean=(0.0, 0.0, 7.0)), FLAT)["image"].max() < 1e-7


@pytest.mark.parametrize("thickness", [1e-12, 1e-6, 1e-3])
def test_a_slab_without_thickness_is_the_cut(cut, kernel, thickness) -> None:
    """The difference of two almost equal distribution functions, divided by almost nothing."""
    splat = one((3.0, 1.0, 2.0), quat=SLANTED)
    seen, same = cut(splat, replace(TILTED, thickness_mm=thickness)), cut(splat, TILTED)
    np.testing.assert_allclose(seen["image"], same["image"], rtol=1e-5, atol=2e-6 if kernel.single else 1e-9)


@pytest.mark.parametrize("thickness", [1e3, 1e8])
def test_a_slab_thicker_than_all_is_the_integral_over_its_thickness(cut, kernel, thickness) -> None:
    splat = one((2.0, 2.0, 2.0))
    image = cut(splat, replace(FLAT, thickness_mm=thickness), gradient_rtol=None)["image"]
    columns = np.exp(-0.5 * ((FLAT.points() - [0, 0, 1]) ** 2).sum(-1) / 4)
    expected = 0.5 * columns * np.sqrt(2 * np.pi) * 2 / thickness
    np.testing.assert_allclose(image, expected, rtol=1e-5, atol=2e-6 * expected.max())


@pytest.mark.parametrize("eta", [0.4999, 0.5001])
def test_either_side_of_where_a_slabs_series_ends(cut, assert_cut, eta) -> None:
    """Under half a standard deviation the fast kernels take the mean from its Taylor series."""
    assert_cut(cut, one((2.0, 1.5, 1.0), mean=(0.5, 0.5, 2.5)), replace(FLAT, thickness_mm=2 * eta))


def test_coordinates_of_a_kilometre_give_the_scene_at_the_origin(cut, kernel) -> None:
    """From 2²⁰ mm on, numbers of float32 are ⅛ mm apart: centres and pixels on eighths lose nothing."""
    rng = np.random.default_rng(3)
    cloud = GaussianSet.create(
        np.round(8 * rng.normal(size=(20, 3)) * 3) / 8, 10 ** rng.uniform(-0.5, 0.5, (20, 3)),
        quats=rng.normal(size=(20, 4)), density=0.3,
    )  # fmt: skip
    far = np.array([1048576.0, -1048576.0, 524288.0])
    seen = cut(replace(cloud, means=cloud.means + far), replace(TILTED, origin=TILTED.origin + far))
    same = cut(cloud, TILTED)
    np.testing.assert_allclose(seen["image"], same["image"], rtol=1e-5, atol=2e-6)


@PLANES
@pytest.mark.parametrize("size", [(1, 1), (3, 17), (1, 33), (31, 45)])
def test_a_plane_of_any_size(cut, assert_cut, plane, size) -> None:
    rng = np.random.default_rng(5)
    cloud = GaussianSet.create(
        rng.normal(size=(30, 3)) * 4, 1.5, quats=rng.normal(size=(30, 4)), density=0.3, opacities=0.4
    )
    assert_cut(cut, cloud, replace(plane, width=size[0], height=size[1]), atol=3e-5)


@pytest.mark.parametrize(("width", "height"), [(0, 25), (33, 0), (0, 0)])
def test_a_plane_without_pixels_is_refused(kernel, width, height) -> None:
    with pytest.raises(SettingError, match=f"{width} x {height}"):
        section(one().to_torch(kernel.dtype), replace(FLAT, width=width, height=height), kernel=kernel.name)


@pytest.mark.parametrize("pixel", [1e-6, 1e6])
def test_pixels_of_a_nanometre_and_of_a_kilometre(cut, assert_cut, pixel) -> None:
    plane = replace(
        FLAT, origin=np.array([-16.5 * pixel, -12.5 * pixel, 1.0]), u=2 * pixel * FLAT.u, v=2 * pixel * FLAT.v
    )
    assert_cut(cut, one((3.0, 1.0, 2.0)), plane, gradient_rtol=None)


# Amounts


def test_opacity_one_fills_its_centre_and_keeps_finite_gradients(cut) -> None:
    """1 − o·w is 0 there, and the gradient of another splat at the same place is multiplied by it."""
    many = one(2.0, opacity=1.0).select(np.zeros(50, int))
    image = cut(many, FLAT, "occupancy", gradient_rtol=None)["image"]
    assert image[MIDDLE] == pytest.approx(1.0, abs=1e-6)
    assert image.max() <= 1


def test_behind_many_opaque_splats_gradients_are_still_numbers(cut, kernel) -> None:
    """What 400 of them leave is under float32's smallest number. The kernel that trainings use leaves a little, so
    that a splat there can become clear again."""
    many = one(0.7, opacity=0.99).select(np.zeros(400, int))
    plane = Plane(np.array([-0.5, -0.5, 1.0]), np.array([1.0, 0, 0]), np.array([0, 1.0, 0]), 1, 1)
    seen = cut(many, plane, "occupancy", gradient_rtol=None)
    assert seen["image"] == 1.0
    gradients = seen.grads["opacities"]
    assert np.isfinite(gradients).all()
    assert np.abs(gradients).max() < 1e-6
    if kernel.name == "cpu":
        assert np.abs(gradients).min() > 1e-16


@QUANTITIES
def test_nothing_at_opacity_and_density_zero(cut, quantity) -> None:
    assert not cut(one(2.0, density=0.0, opacity=0.0), FLAT, quantity)["image"].any()


@pytest.mark.parametrize("density", [1e-8, 1e8])
def test_extreme_densities_only_scale_the_image(cut, kernel, density) -> None:
    found = cut(one(2.0, density=density), FLAT)["image"] / np.float64(np.float32(density))
    np.testing.assert_allclose(found, weights(one(2.0), FLAT)[0], rtol=1e-5, atol=2e-6)


def test_a_colour_below_black_is_black_and_gets_no_gradient(cut) -> None:
    seen = cut(one(2.0, color=(-5.0, -5.0, -5.0)), FLAT, "color")
    assert not seen["image"].any()
    assert not seen.grads["sh"].any()


# Numbers of splats


@QUANTITIES
@SLABS
def test_an_empty_set_is_black(cut, quantity, thickness) -> None:
    seen = cut(GaussianSet.empty(), replace(FLAT, thickness_mm=thickness), quantity)
    assert seen["image"].shape[:2] == (25, 33)
    assert not seen["image"].any()
    assert seen.grads["means"].shape == (0, 3)


def test_identical_splats_add_in_density_and_multiply_in_occupancy(cut, assert_cut) -> None:
    assert_cut(cut, one(2.0, opacity=0.02, density=0.01).select(np.zeros(100, int)), FLAT, atol=1e-5)


def test_a_million_splats_on_one_pixel_add_up_to_a_million(cut, kernel) -> None:
    """As for radiographs: in two levels, because one float32 sum is off by 0.5 %; the reference sums in float64.

    It gets a tenth of them. Its matrix product in float32 was off by 2e-4 on one processor and by 5e-4 on another.
    """
    count = 100_000 if kernel.name == "reference" else 1_000_000
    many = one(0.7, density=0.1, opacity=1e-6).select(np.zeros(count, int))
    plane = Plane(np.array([-0.5, -0.5, 1.0]), np.array([1.0, 0, 0]), np.array([0, 1.0, 0]), 1, 1)
    seen = cut(many, plane, gradient_rtol=None)
    np.testing.assert_allclose(seen["image"], 0.1 * count, rtol=3e-5)
    np.testing.assert_allclose(seen.grads["density"], 0.5, rtol=1e-6)


def test_a_thousand_faint_splats_leave_the_power_of_what_one_leaves(cut) -> None:
    many = one(0.7, opacity=1e-3).select(np.zeros(1000, int))
    plane = Plane(np.array([-0.5, -0.5, 1.0]), np.array([1.0, 0, 0]), np.array([0, 1.0, 0]), 1, 1)
    image = cut(many, plane, "occupancy")["image"]
    np.testing.assert_allclose(image, 1 - (1 - 1e-3) ** 1000, rtol=1e-4)


# Values


@QUANTITIES
@pytest.mark.parametrize("field", ["means", "quats", "scales"])
def test_a_splat_with_a_value_that_is_not_a_number_is_left_out(cut, quantity, field) -> None:
    sane = GaussianSet.concatenate([one(2.0), one(3.0, (1.0, 2.0, 3.0))])
    broken = GaussianSet.concatenate([sane, one(3.0)])
    getattr(broken, field)[2, 0] = np.nan
    seen, expected = cut(broken, FLAT, quantity), cut(sane, FLAT, quantity)
    np.testing.assert_allclose(seen["image"], expected["image"], rtol=1e-6)
    assert not seen.grads[field][2].any()


def test_clones_do_not_count_in_density_and_do_in_occupancy(cut) -> None:
    clone = replace(one(2.0), modality=np.array([Modality.CLONE], np.uint8))
    assert not cut(clone, FLAT)["image"].any()
    assert cut(clone, FLAT, "occupancy")["image"].max() == pytest.approx(0.8, rel=1e-5)
