"""A catalogue of splats and cameras that break renderers of photos, each with the image that is right.

Every case runs on every kernel; `photograph` checks that all values and gradients are finite and that the gradients
of the float32 kernels are those of the reference in float64. Images are held against a closed form: a splat on the
axis at depth 2 has α = o·exp(−½(a²/(100 s₁² + 0.3) + b²/(100 s₂² + 0.3))) with a, b in pixels along its axes.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from insideout.core.errors import SettingError
from insideout.core.gaussians import GaussianSet
from insideout.core.render import splat
from insideout.core.rotations import quats_to_matrices
from insideout.core.similarity import Similarity
from insideout.core.spherical_harmonics import rgb_to_sh
from insideout.core.views import Camera

CAMERA = Camera(21, 21, 20.0, 20.0, 10.5, 10.5, np.eye(4))
LOW_PASS, CAP, LEAST = 0.3, 0.99, 1 / 255
STRAIGHT = (1.0, 0.0, 0.0, 0.0)
QUARTER_ABOUT_Y = (np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0)
BLUE = [0.0, 0.0, 1.0]


def turned_about_z(degrees: float) -> tuple[float, ...]:
    half = np.radians(degrees) / 2
    return (np.cos(half), 0.0, 0.0, np.sin(half))


def one(scale=0.1, mean=(0.0, 0.0, 2.0), quat=STRAIGHT, opacity=0.8, color=(0.5, 0.5, 0.5)) -> GaussianSet:
    sh = rgb_to_sh(np.array([color]))[:, None, :]
    gaussians = GaussianSet.create(np.array([mean]), np.atleast_2d(scale), opacities=opacity, sh=sh)
    return replace(gaussians, quats=np.array([quat], np.float32))


def ellipse(first, second, degrees=0.0, opacity=0.8, middle=(10.0, 10.0), size=(21, 21)) -> np.ndarray:
    """α of a splat whose scales are `first` along `degrees` from the image's x axis and `second` across, at depth 2."""
    rows, columns = np.indices(size, dtype=float)
    x, y = columns - middle[0], rows - middle[1]
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    along, across = (c * x + s * y) ** 2, (c * y - s * x) ** 2
    power = along / (100 * first**2 + LOW_PASS) + across / (100 * second**2 + LOW_PASS)
    alpha = np.minimum(np.float32(opacity) * np.exp(-0.5 * power), CAP)
    return np.where(alpha >= LEAST, alpha, 0.0)


@pytest.fixture
def assert_alpha(kernel):
    """Whether an image's α is as expected; float32 may err by a few of its roundings times the exponent."""

    def check(rendered, expected, rtol: float | None = None) -> None:
        rtol = kernel.rtol if rtol is None and not kernel.single else rtol or 2e-5
        # Scales are float32 numbers, also in the reference in float64.
        np.testing.assert_allclose(rendered["alpha"], expected, rtol=max(rtol, 1e-6), atol=1e-7)

    return check


# Shapes


def test_one_splat_is_a_gaussian_of_its_projected_size_plus_the_low_pass(photograph, assert_alpha) -> None:
    assert_alpha(photograph(one(0.1), CAMERA), ellipse(0.1, 0.1))


@pytest.mark.parametrize("ratio", [1e2, 1e4, 1e6])
def test_a_needle_in_the_image_plane_is_a_line_as_wide_as_the_low_pass(photograph, assert_alpha, ratio) -> None:
    assert_alpha(photograph(one((0.5, 0.5 / ratio, 0.5 / ratio)), CAMERA), ellipse(0.5, 0.5 / ratio))


@pytest.mark.parametrize("ratio", [1e2, 1e4, 1e6])
def test_a_slanted_needle_is_a_slanted_line(photograph, assert_alpha, ratio) -> None:
    """Its 2D covariance is singular but for the low-pass, and xx·yy − xy² cancels."""
    needle = one((0.5, 0.5 / ratio, 0.5 / ratio), quat=turned_about_z(30))
    assert_alpha(photograph(needle, CAMERA), ellipse(0.5, 0.5 / ratio, 30))


def test_a_slanted_needle_longer_than_the_image_is_the_same_all_along(photograph, assert_alpha) -> None:
    """A thousand units long and a thousandth wide: 10⁴ pixels against half a pixel."""
    needle = one((1e3, 1e-3, 1e-3), quat=turned_about_z(45))
    assert_alpha(photograph(needle, CAMERA), ellipse(1e3, 1e-3, 45), rtol=1e-4)


@pytest.mark.parametrize("length", [1e8, 1e12])
def test_however_long_a_needle_is_its_width_and_turn_move_the_image_alike(photograph, length) -> None:
    """Turned by 40° about the line of sight it is a strip; what its length does falls with the cube of it."""
    long, short = (photograph(one((size, 0.1, 0.2), quat=turned_about_z(40)), CAMERA).grads for size in (length, 1e4))
    np.testing.assert_allclose(long["scales"][0, 1:], short["scales"][0, 1:], rtol=1e-4)
    np.testing.assert_allclose(long["quats"], short["quats"], rtol=1e-4, atol=1e-4 * np.abs(short["quats"]).max())
    ends = [grads["scales"][0, 0] * size**3 for grads, size in ((long, length), (short, 1e4))]
    np.testing.assert_allclose(*ends, rtol=1e-4)


@pytest.mark.parametrize("ratio", [1e2, 1e4, 1e6])
def test_a_needle_along_the_line_of_sight_is_a_dot(photograph, assert_alpha, ratio) -> None:
    assert_alpha(photograph(one((0.1 / ratio, 0.1 / ratio, 0.1)), CAMERA), ellipse(0.1 / ratio, 0.1 / ratio))


@pytest.mark.parametrize("ratio", [1e2, 1e4, 1e6])
def test_a_disc_that_faces_the_camera_is_round(photograph, assert_alpha, ratio) -> None:
    assert_alpha(photograph(one((0.3, 0.3, 0.3 / ratio)), CAMERA), ellipse(0.3, 0.3))


@pytest.mark.parametrize("ratio", [1e2, 1e4, 1e6])
def test_a_disc_seen_edge_on_is_a_line(photograph, assert_alpha, ratio) -> None:
    disc = one((0.3, 0.3, 0.3 / ratio), quat=QUARTER_ABOUT_Y)
    assert_alpha(photograph(disc, CAMERA), ellipse(0.3 / ratio, 0.3))


@pytest.mark.parametrize("scale", [0.0, 1e-30, 1e-8])
def test_a_point_is_the_low_pass(photograph, assert_alpha, scale) -> None:
    assert_alpha(photograph(one(scale), CAMERA), ellipse(0.0, 0.0))


@pytest.mark.parametrize("scale", [1e8, 1e15, 3e37, 3e38])
def test_a_huge_splat_covers_the_image_evenly(photograph, assert_alpha, scale) -> None:
    """Its covariance, and more so the determinant, is beyond float32."""
    seen = photograph(one(scale, quat=(0.9, 0.1, 0.3, -0.2)), CAMERA)
    assert_alpha(seen, np.full((21, 21), np.float32(0.8)))
    assert seen.info.visible.all()


def test_a_splat_both_huge_and_tiny_is_a_stripe_across_the_image(photograph, assert_alpha) -> None:
    stripe = one((1e8, 1e-8, 1e-8), quat=turned_about_z(90))
    assert_alpha(photograph(stripe, CAMERA), ellipse(0.0, 1e8), rtol=1e-4)


def test_an_axis_aligned_splat_turns_about_no_axis_for_free(photograph, assert_alpha) -> None:
    """Eigenvector formulas are 0/0 here. A turn about the line of sight changes only the off-diagonal, by symmetry."""
    seen = photograph(one((0.4, 0.1, 0.2)), CAMERA)
    assert_alpha(seen, ellipse(0.4, 0.1))
    assert np.abs(seen.grads["quats"][0, 0]) < 1e-5


def test_a_round_splat_has_no_axes_so_a_turn_changes_nothing(photograph, assert_alpha) -> None:
    seen = photograph(one(0.2, quat=(0.9, 0.1, 0.3, -0.2)), CAMERA)
    assert_alpha(seen, ellipse(0.2, 0.2))
    assert np.abs(seen.grads["quats"]).max() < 1e-3 * np.abs(seen.grads["scales"]).max()


# Rotations


def test_a_zero_quaternion_means_no_rotation_and_gets_no_gradient(photograph, assert_alpha) -> None:
    seen = photograph(one((0.4, 0.1, 0.2), quat=(0.0, 0.0, 0.0, 0.0)), CAMERA)
    assert_alpha(seen, ellipse(0.4, 0.1))
    assert not seen.grads["quats"].any()


@pytest.mark.parametrize("factor", [1e-5, 1e6, -1.0])
def test_a_quaternions_length_and_sign_do_not_matter(photograph, kernel, factor) -> None:
    quat = np.array([0.9, 0.1, 0.3, -0.2])
    seen, same = (photograph(one((0.4, 0.1, 0.2), quat=q), CAMERA) for q in (factor * quat, quat))
    np.testing.assert_allclose(seen["alpha"], same["alpha"], rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(factor * seen.grads["quats"], same.grads["quats"], rtol=1e-3, atol=1e-4)


# Places


@pytest.mark.parametrize("depth", [-2.0, -1e-30, 0.0, 1e-30, 0.0099, 0.01])
def test_a_splat_behind_at_or_before_the_near_plane_is_not_drawn(photograph, depth) -> None:
    """Also one that reaches around the camera: what counts is its centre."""
    seen = photograph(one(1.0, mean=(0.0, 0.0, np.float32(depth))), replace(CAMERA, near=np.float32(0.01)))
    assert not seen["alpha"].any()
    assert not seen.info.visible.any()
    assert not any(seen.grads[name].any() for name in ("means", "scales", "opacities", "sh", "pose"))


def test_a_splat_just_beyond_the_near_plane_fills_the_image(photograph, assert_alpha) -> None:
    """At depth 0.0101 a splat of 1 is two thousand pixels wide."""
    seen = photograph(one(1.0, mean=(0.0, 0.0, 0.0101)), CAMERA)
    assert_alpha(seen, ellipse(2 / 0.0101, 2 / 0.0101), rtol=1e-4)


@pytest.mark.parametrize("scale", [5e33, 1e38])
def test_a_huge_splat_just_beyond_the_near_plane_is_too_large_for_a_float_in_pixels(
    photograph, assert_alpha, scale
) -> None:
    """Its half axes end somewhere near 1e39 pixels, and with them the rows that a kernel looks for."""
    near = Camera(21, 21, 1000.0, 1000.0, 10.5, 10.5, np.eye(4))
    assert_alpha(photograph(one(scale, mean=(0.0, 0.0, 0.011), opacity=0.3), near), np.full((21, 21), 0.3))


def test_a_splat_around_the_camera_whose_centre_is_in_front_is_seen_everywhere(photograph) -> None:
    seen = photograph(one((5.0, 4.0, 3.0), mean=(0.1, -0.1, 0.5), opacity=0.6), CAMERA)
    np.testing.assert_allclose(seen["alpha"], 0.6, rtol=0.02)


def test_a_splat_on_the_camera_is_not_drawn_in_an_orthographic_view_either(photograph) -> None:
    seen = photograph(one(1.0, mean=(0.0, 0.0, 0.0)), replace(CAMERA, orthographic=True))
    assert not seen["alpha"].any()


def test_a_splat_beside_the_camera_is_not_smeared_over_the_image(photograph) -> None:
    """At a slope of 40 the unclamped Jacobian would stretch it over everything."""
    seen = photograph(one(0.05, mean=(0.8, 0.0, 0.02)), CAMERA)
    assert not seen["alpha"].any()
    assert not seen.info.visible.any()


def test_a_splat_outside_the_image_by_less_than_its_reach_is_cut_off_at_the_edge(photograph, assert_alpha) -> None:
    seen = photograph(one(0.2, mean=(1.2, 0.0, 2.0)), CAMERA)
    # Off the axis the Jacobian also shears: along x the variance grows by (1 + slope²), which is clamped at 0.6825.
    slope = min(0.6, 0.5 * 1.3 * 21 / 20)
    assert_alpha(seen, ellipse(0.2 * np.sqrt(1 + slope**2), 0.2, middle=(22.0, 10.0)))


def test_coordinates_of_a_kilometre_give_the_scene_at_the_origin(photograph, kernel) -> None:
    """From 2²⁰ mm on, numbers of float32 are ⅛ mm apart: centres that lie on eighths lose nothing, others up to 1/16.

    The pose's translation is as large, but it is float64, and so is what is left when the two cancel: 1e-10 mm.
    """
    far = np.array([1048576.0, -1048576.0, 524288.0])
    cloud = cloud_on_eighths()
    turn = quats_to_matrices(np.array([[0.9, 0.3, -0.3, 0.1]]))[0]
    for camera in (CAMERA, CAMERA.transformed(Similarity(1.0, turn, np.array([0, 0, 40]) - turn @ [0, 0, 40]))):
        seen, same = photograph(replace(cloud, means=cloud.means + far), moved(camera, far)), photograph(cloud, camera)
        assert same["alpha"].max() > 0.9
        for name in ("color", "alpha", "depth"):
            np.testing.assert_allclose(seen[name], same[name], rtol=max(kernel.rtol, 1e-7), atol=1e-6)


def cloud_on_eighths() -> GaussianSet:
    rng = np.random.default_rng(2)
    means = np.round(8 * (rng.normal(size=(40, 3)) * 6 + [0, 0, 40])) / 8
    return GaussianSet.create(means, 10 ** rng.uniform(-1, 0.5, (40, 3)), quats=rng.normal(size=(40, 4)), opacities=0.5)


def moved(camera: Camera, shift: np.ndarray) -> Camera:
    pose = np.array(camera.world_to_camera, np.float64)
    pose[:3, 3] -= pose[:3, :3] @ shift
    return replace(camera, world_to_camera=pose)


# Opacities


def test_opacity_zero_is_not_drawn_and_gets_no_gradient(photograph) -> None:
    seen = photograph(one(opacity=0.0), CAMERA, BLUE)
    np.testing.assert_array_equal(seen["color"], np.broadcast_to(BLUE, (21, 21, 3)))
    assert not any(grad.any() for grad in seen.grads.values())


def test_opacity_one_is_capped_at_99_percent_and_passes_no_gradient_there(photograph, assert_alpha) -> None:
    seen = photograph(one(1e4, opacity=1.0), CAMERA)
    assert_alpha(seen, np.full((21, 21), 0.99))
    assert not seen.grads["opacities"].any()
    assert seen.grads["sh"].any()


def test_opacity_just_above_one_part_in_255_shows_in_one_pixel(photograph, assert_alpha) -> None:
    expected = np.zeros((21, 21))
    expected[10, 10] = np.float32(0.00393)
    assert_alpha(photograph(one(0.01, opacity=0.00393), CAMERA), expected)


def test_opacity_just_under_one_part_in_255_is_not_drawn(photograph) -> None:
    seen = photograph(one(opacity=0.00392), CAMERA)
    assert not seen["alpha"].any()
    assert not seen.info.visible.any()


@pytest.mark.parametrize(("logit", "alpha"), [(-1e4, 0.0), (-89.0, 0.0), (17.0, CAP), (89.0, CAP), (1e4, CAP)])
def test_saturated_logits_are_clear_or_capped_and_pass_no_gradient(kernel, logit, alpha) -> None:
    """σ(17) is 1 in float32 and σ(−89) a denormal; the gradient of either is zero, not NaN."""
    raw = torch.tensor([logit], dtype=kernel.dtype, device=kernel.device, requires_grad=True)
    scene = replace(one(10.0).to_torch(kernel.dtype, kernel.device), opacities=torch.sigmoid(raw))
    image = splat(scene, CAMERA, kernel=kernel.name)
    (image.color.sum() + image.alpha.sum() + image.depth.sum()).backward()
    np.testing.assert_allclose(image.alpha.detach().cpu()[10, 10], alpha, rtol=1e-6)
    assert raw.grad is None or raw.grad.item() == 0


# Numbers of splats


def test_an_empty_set_is_the_background_and_its_gradients_are_empty(photograph) -> None:
    seen = photograph(GaussianSet.empty(3), CAMERA, BLUE)
    np.testing.assert_array_equal(seen["color"], np.broadcast_to(BLUE, (21, 21, 3)))
    assert not seen["alpha"].any()
    assert not seen["depth"].any()
    assert seen.grads["means"].shape == (0, 3)
    assert not seen.grads["pose"].any()


def test_all_identical_splats_let_through_the_power_of_one(photograph, kernel) -> None:
    many = one(1e6, opacity=0.05).select(np.zeros(100, int))
    seen = photograph(many, CAMERA)
    left = (1 - np.float64(np.float32(0.05))) ** 100
    np.testing.assert_allclose(seen["alpha"], 1 - left, rtol=kernel.rtol)
    np.testing.assert_allclose(seen["depth"], 2.0, rtol=kernel.rtol)


def test_identical_places_are_blended_in_the_order_of_the_set(photograph, kernel) -> None:
    both = GaussianSet.concatenate([one(1e4, opacity=0.6, color=(1, 0, 0)), one(1e4, opacity=0.5, color=(0, 1, 0))])
    seen = photograph(both, CAMERA, BLUE)
    np.testing.assert_allclose(seen["color"][10, 10], [0.6, 0.2, 0.2], rtol=max(kernel.rtol, 1e-6))


def test_a_million_splats_on_one_pixel_stop_before_the_light_falls_under_one_in_ten_thousand(
    photograph, kernel
) -> None:
    """Half of the light at each: 13 leave 1.2e-4, the fourteenth would leave less, and 999,987 are not looked at.

    The reference in plain torch looks at all of them, so it gets a tenth.
    """
    count = 100_000 if kernel.name == "reference" else 1_000_000
    many = one(1e-3, opacity=0.5).select(np.zeros(count, int))
    seen = photograph(many, Camera(1, 1, 20.0, 20.0, 0.5, 0.5, np.eye(4)), gradient_rtol=None)
    np.testing.assert_allclose(seen["alpha"], 1 - 0.5**13, rtol=kernel.rtol)
    assert seen.grads["opacities"][:13].all()
    assert not seen.grads["opacities"][13:].any()


def test_a_million_faint_splats_on_64_pixels_fade_to_the_same_limit(photograph, kernel) -> None:
    """0.98ⁿ with the largest n that leaves 1e-4 (455), in each pixel; a splat's neighbours see less than 1/255 of it.

    15,625 splats for a pixel on the fast kernels, 500 in plain torch.
    """
    count = 64 * (500 if kernel.name == "reference" else 15_625)
    pixel = np.random.default_rng(0).permutation(count) % 64
    places = np.stack([pixel % 8 - 3.5, pixel // 8 - 3.5, np.full(count, 2.0)], axis=1) * [100.0, 100.0, 1.0]
    many = GaussianSet.create(places, 1e-3, opacities=0.02)
    seen = photograph(many, Camera(8, 8, 0.02, 0.02, 4.0, 4.0, np.eye(4)), gradient_rtol=None)
    np.testing.assert_allclose(seen["alpha"], 1 - 0.98**455, rtol=kernel.rtol if kernel.single else 1e-8)


# Images


@pytest.mark.parametrize(("width", "height"), [(0, 21), (21, 0), (0, 0)])
def test_an_image_without_pixels_is_refused(kernel, width, height) -> None:
    with pytest.raises(SettingError, match=f"{width} x {height}"):
        splat(one().to_torch(kernel.dtype), replace(CAMERA, width=width, height=height), kernel=kernel.name)


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (40, 1), (3, 17), (15, 17), (16, 16), (33, 31)])
def test_an_image_of_any_size_is_a_part_of_a_larger_one(photograph, kernel, size) -> None:
    rng = np.random.default_rng(1)
    many = GaussianSet.create(
        rng.normal(0, 1, (60, 3)) + np.array([0, 0, 5]), 0.2, quats=rng.normal(size=(60, 4)), opacities=0.6
    )
    # Orthographic, because the clamp of a perspective's Jacobian goes with the field of view.
    small = Camera(*size, 10.0, 10.0, 0.5 * size[0], 0.5 * size[1], np.eye(4), orthographic=True)
    large = replace(small, width=size[0] + 40, height=size[1] + 40, cx=small.cx + 20, cy=small.cy + 20)
    part, whole = photograph(many, small, BLUE), photograph(many, large, BLUE)
    assert part["color"].shape == (size[1], size[0], 3)
    for name in ("color", "alpha", "depth"):
        np.testing.assert_allclose(part[name], whole[name][20:-20, 20:-20], rtol=10 * kernel.rtol, atol=1e-6)


def test_a_principal_point_far_outside_the_image_sees_nothing(photograph) -> None:
    assert not photograph(one(), replace(CAMERA, cx=1e7))["alpha"].any()


def test_a_single_pixel_that_sees_everything(photograph, kernel) -> None:
    """A focal length of 1e-6 pixels: all splats are points in the middle of the one pixel."""
    seen = photograph(one(0.1), Camera(1, 1, 1e-6, 1e-6, 0.5, 0.5, np.eye(4)))
    np.testing.assert_allclose(seen["alpha"], np.float32(0.8), rtol=max(kernel.rtol, 1e-6))


# Values


@pytest.mark.parametrize("field", ["means", "quats", "scales", "opacities", "sh"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_splat_with_a_value_that_is_not_finite_is_left_out(photograph, field, value) -> None:
    sane = GaussianSet.concatenate([one(0.2, opacity=0.5), one(0.3, mean=(0.1, 0.1, 3.0), opacity=0.5)])
    broken = GaussianSet.concatenate([sane, one(0.3, mean=(0.0, 0.1, 1.0))])
    getattr(broken, field).reshape(3, -1)[2, 0] = value
    seen, expected = photograph(broken, CAMERA), photograph(sane, CAMERA)
    np.testing.assert_array_equal(seen["color"], expected["color"])
    assert seen.info.visible.tolist() == [True, True, False]
    assert not seen.grads[field][2].any()


def test_a_colour_below_black_is_black_and_gets_no_gradient(photograph) -> None:
    seen = photograph(one(0.3, color=(-5.0, -5.0, -5.0)), CAMERA)
    assert not seen["color"].any()
    assert not seen.grads["sh"].any()


def test_a_colour_far_above_white_is_not_clipped(photograph, kernel, assert_alpha) -> None:
    seen = photograph(one(0.3, color=(1e6, 1e6, 1e6)), CAMERA, gradient_rtol=1e-3)
    np.testing.assert_allclose(seen["color"][..., 0], 1e6 * seen["alpha"], rtol=max(10 * kernel.rtol, 1e-6))


def test_the_depth_of_what_is_barely_seen_is_its_depth(photograph, kernel) -> None:
    """Where α is one part in 255, depth is a quotient of two small numbers."""
    seen = photograph(one(0.3, opacity=0.01), CAMERA)
    drawn = seen["alpha"] > 0
    assert drawn.any()
    assert not drawn.all()
    np.testing.assert_allclose(seen["depth"][drawn], 2.0, rtol=max(kernel.rtol, 1e-6))


def test_a_colour_looked_up_from_the_splats_own_place_is_finite(photograph) -> None:
    """Orthographic colours need no direction to the camera; perspective ones of a splat at 0.02 do."""
    rng = np.random.default_rng(0)
    near = replace(one(0.001, mean=(0.0, 0.0, 0.02)), sh=rng.normal(size=(1, 16, 3)).astype(np.float32))
    from_afar = replace(near, means=near.means * 100, scales=near.scales * 100)
    seen, same = photograph(near, CAMERA), photograph(from_afar, CAMERA)
    np.testing.assert_allclose(seen["color"], same["color"], rtol=1e-4, atol=1e-6)
