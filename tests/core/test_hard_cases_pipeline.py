"""A catalogue of inputs that break everything around the renderers, each with the result that is right."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from insideout.core.capture.air import air_level, look_like_intensities
from insideout.core.capture.projections import LOWEST_TRANSMISSION, line_integrals
from insideout.core.colormap import density_colors
from insideout.core.evaluate.chamfer import chamfer, hidden_point_removal, outer_points
from insideout.core.evaluate.metrics import PSNR_LIMIT_DB, piqe, psnr
from insideout.core.evaluate.metrics import ssim as measured_ssim
from insideout.core.gaussians import GaussianSet
from insideout.core.render import radiograph, splat
from insideout.core.similarity import Similarity
from insideout.core.stages.align.global_fit import principal_axes
from insideout.core.stages.align.icp import refine, two_way_score, umeyama
from insideout.core.stages.align.kmeans import kmeans
from insideout.core.stages.align.surfaces import OuterSurface, ShellPoints
from insideout.core.train.losses import l1, total_variation, zero_one
from insideout.core.train.parameters import GROUPS, Parameters, inverse_softplus
from insideout.core.train.ssim import ssim
from insideout.core.train.strategy import DefaultStrategy, Densifier
from insideout.core.views import Camera, Detector

# The logarithm of counts


def test_zero_counts_are_the_largest_line_integral_there_is() -> None:
    """−ln 0 is infinite; a millionth of the light is the least that counts."""
    found = line_integrals(np.zeros((1, 2, 2)), flat=60000.0)
    np.testing.assert_allclose(found, -np.log(LOWEST_TRANSMISSION), rtol=1e-6)


def test_counts_under_the_dark_reading_are_taken_for_zero() -> None:
    """Noise: the transmission is negative and has no logarithm."""
    found = line_integrals(np.full((1, 2, 2), 90.0), flat=60000.0, dark=100.0)
    np.testing.assert_allclose(found, -np.log(LOWEST_TRANSMISSION), rtol=1e-6)


def test_a_saturated_detector_shows_air() -> None:
    counts = np.full((1, 2, 2), np.iinfo(np.uint16).max, np.uint16)
    assert not line_integrals(counts, flat=65535.0).any()


def test_counts_above_the_flat_field_are_slightly_negative_not_an_error() -> None:
    found = line_integrals(np.full((1, 2, 2), 63000.0), flat=60000.0)
    np.testing.assert_allclose(found, -np.log(1.05), rtol=1e-5)


@pytest.mark.parametrize("reading", [0.0, 100.0, 65535.0])
@pytest.mark.parametrize("flat", [100.0, 50.0], ids=["equal", "under"])
def test_a_dead_pixel_whose_flat_field_is_no_brighter_than_dark_is_as_its_neighbours(
    reading: float, flat: float
) -> None:
    """Divided by nothing, its logarithm would be infinite."""
    counts, bright = np.full((1, 7, 7), 30000.0), np.full((7, 7), 60000.0)
    counts[0, 3, 3], bright[3, 3] = reading, flat
    np.testing.assert_allclose(line_integrals(counts, bright, dark=100.0), -np.log(29900 / 59900), rtol=1e-5)


def test_a_blank_projection_is_neither_intensities_nor_a_division_by_its_air() -> None:
    blank = np.zeros((2, 8, 8), np.float32)
    assert not look_like_intensities(blank)
    assert np.isfinite(line_integrals(blank, air_level(blank))).all()


# Flat images


@pytest.mark.parametrize("level", [0.0, 0.3, 1.0])
def test_ssim_of_two_flat_images_is_one_and_pulls_nowhere(level: float) -> None:
    """Variances are differences of squares: what float32 leaves of them, 1e-7, counts against C₂ = 9e-4."""
    image = torch.full((20, 20), level, requires_grad=True)
    value = ssim(image, torch.full((20, 20), level))
    value.backward()
    assert value.item() == pytest.approx(1.0, abs=1e-4)
    assert image.grad.abs().max() < 1e-6


def test_ssim_of_black_and_white_is_next_to_nothing_and_pulls_to_white() -> None:
    """Far from the border it is C₁/(1 + C₁); the pull is weak but the right way."""
    image = torch.zeros(64, 64, requires_grad=True)
    value = ssim(image, torch.ones(64, 64))
    value.backward()
    assert value.item() == pytest.approx(1e-4, abs=2e-4)
    assert torch.isfinite(image.grad).all()
    assert image.grad[32, 32] > 0


def test_ssim_of_one_pixel() -> None:
    image = torch.full((1, 1), 0.5, requires_grad=True)
    ssim(image, torch.full((1, 1), 0.5)).backward()
    assert image.grad.abs().max() < 1e-6


def test_the_measured_ssim_of_a_flat_reference_says_nothing() -> None:
    assert measured_ssim(np.random.default_rng(0).random((32, 32)), np.full((32, 32), 0.4)) is None


@pytest.mark.parametrize("level", [0.0, 0.37, 1.0])
def test_piqe_of_a_flat_image_is_100(level: float) -> None:
    assert piqe(np.full((48, 40), level), 0.0, 1.0) == 100


def test_piqe_with_an_empty_grey_window_is_that_of_a_flat_image() -> None:
    assert piqe(np.random.default_rng(0).random((32, 32)) + 1, 1.0, 1.0) >= 0
    assert piqe(np.full((32, 32), 1.0), 1.0, 1.0) == 100


def test_psnr_of_equal_images_is_the_largest_that_is_reported() -> None:
    assert psnr(np.full((4, 4), 0.2), np.full((4, 4), 0.2)) == PSNR_LIMIT_DB


@pytest.mark.parametrize("level", [0.0, 0.02, 1e30])
def test_a_flat_slice_has_one_colour(level: float) -> None:
    """Normalised by its own range it would be 0 / 0."""
    colors = density_colors(np.full((4, 4), level))
    assert np.isfinite(colors).all()
    assert np.ptp(colors.reshape(-1, 3), axis=0).max() == 0


# k-means


@pytest.mark.parametrize("more", [0, 1, 100])
def test_kmeans_with_as_many_clusters_as_points_or_more_puts_each_by_itself(more: int) -> None:
    points = np.random.default_rng(0).normal(size=(50, 3))
    centroids, labels = kmeans(points, 50 + more, seed=0)
    np.testing.assert_array_equal(centroids[labels], points)
    assert len(np.unique(labels)) == 50


@pytest.mark.parametrize("count", [1, 7, 30])
def test_kmeans_of_identical_points_is_one_cluster(count: int) -> None:
    centroids, labels = kmeans(np.tile([1.0, 2.0, 3.0], (30, 1)), count, seed=0)
    np.testing.assert_array_equal(centroids, [[1, 2, 3]])
    assert not labels.any()


def test_kmeans_with_one_cluster_less_than_points_merges_the_nearest_two() -> None:
    points = np.array([[0.0, 0, 0], [10, 0, 0], [20, 0, 0], [20.1, 0, 0]])
    found = [kmeans(points, 3, seed=seed)[1] for seed in range(8)]
    assert all(len(np.unique(labels)) == 3 for labels in found)


def test_kmeans_a_kilometre_away_is_kmeans_at_the_origin() -> None:
    points = np.random.default_rng(0).normal(size=(100, 3))
    near, far = kmeans(points, 10, seed=3)[1], kmeans(points + 1e6, 10, seed=3)[1]
    assert (near[:, None] == near).tolist() == (far[:, None] == far).tolist()


# Principal axes


@pytest.mark.parametrize(
    ("variances", "first"),
    [((1, 1, 1), None), ((9, 0, 0), 0), ((0, 4, 4), None), ((0, 0, 0), None), ((0, 0, 1e-30), 2), ((1e30, 1, 1), 0)],
    ids=["sphere", "line", "plane", "point", "tiny", "huge"],
)
def test_principal_axes_are_a_rotation_whatever_the_shape(variances: tuple, first: int | None) -> None:
    """Eigenvectors of equal eigenvalues are any; what they must not be is a reflection or not a number."""
    axes = principal_axes(np.diag(np.array(variances, float)))
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1.0)
    if first is not None:
        assert abs(axes[first, 0]) == pytest.approx(1.0)


def test_principal_axes_of_what_is_not_a_number_are_a_rotation() -> None:
    axes = principal_axes(np.full((3, 3), np.nan))
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)


# Similarities and ICP


def ball(radius: float = 10.0, middle: tuple = (0.0, 0.0, 0.0), count: int = 1500) -> OuterSurface:
    normals = np.random.default_rng(0).normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = radius * normals + np.array(middle)
    faces = np.zeros((0, 3), np.int64)
    return OuterSurface(points, normals, 0.9, points, normals, faces, 0.5, 0.5)


def shell(points: np.ndarray) -> ShellPoints:
    index = np.arange(len(points))
    return ShellPoints(points, 0.9, 0.1, np.cov(points.T), index, np.ones(len(points), bool))


@pytest.mark.parametrize(
    "points",
    [np.zeros((5, 3)), np.tile([1e6, 0, 0], (5, 1)), np.ones((1, 3))],
    ids=["at the origin", "a kilometre away", "one point"],
)
def test_the_similarity_of_points_without_extent_is_a_shift(points: np.ndarray) -> None:
    found = umeyama(points, points + 3)
    np.testing.assert_array_equal(found.rotation, np.eye(3))
    assert found.scale == 1
    np.testing.assert_allclose(found.apply(points), points + 3)


@pytest.mark.parametrize("axes", [1, 2], ids=["a line", "a plane"])
def test_the_similarity_of_a_line_or_a_plane_is_no_reflection(axes: int) -> None:
    points = np.random.default_rng(0).normal(size=(30, 3))
    points[:, axes:] = 0
    found = umeyama(points, 2 * points[:, [2, 0, 1]] + 1)
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)
    np.testing.assert_allclose(found.apply(points), 2 * points[:, [2, 0, 1]] + 1, atol=1e-9)


def test_the_similarity_to_a_mirror_image_is_no_reflection() -> None:
    points = np.random.default_rng(0).normal(size=(30, 3))
    assert np.linalg.det(umeyama(points, points * [-1, 1, 1]).rotation) == pytest.approx(1.0)


@pytest.mark.parametrize("to_planes", [True, False], ids=["planes", "points"])
def test_icp_that_may_not_reach_its_goal_says_that_nothing_overlaps(to_planes: bool) -> None:
    """A kilometre apart and one iteration: finite, at a positive scale, and no overlap claimed."""
    start = Similarity(1.0, np.eye(3), np.array([1e6, 0, 0]))
    fit = refine(start, shell(ball().points), ball(), iterations=1, to_planes=to_planes)
    assert np.isfinite(fit.similarity.apply(np.eye(3))).all()
    assert fit.similarity.scale > 0
    score, overlap = two_way_score(start, shell(ball().points), ball())
    assert overlap == 0
    assert score == pytest.approx(1e6, rel=1e-3)


def test_icp_of_another_shape_does_not_overlap() -> None:
    """A needle against a ball: trimmed distances shrink the needle into a point on it unless both ways count."""
    needle = np.outer(np.linspace(-50, 50, 800), [1.0, 0, 0])
    fit = refine(Similarity(1.0, np.eye(3), np.zeros(3)), shell(needle), ball())
    assert not fit.overlaps
    assert fit.similarity.scale > 1e-3


def test_icp_does_not_collapse_the_scale() -> None:
    start = Similarity(0.5, np.eye(3), np.array([1.0, 0.0, 0.0]))
    fit = refine(start, shell(ball().points), ball(), iterations=60)
    assert fit.similarity.scale == pytest.approx(1.0, rel=0.02)
    assert fit.overlaps


def test_chamfer_of_equal_sets_and_of_single_points() -> None:
    assert chamfer(np.zeros((1, 3)), np.zeros((4, 3))).mm == 0
    assert chamfer(np.zeros((1, 3)), np.array([[3.0, 4, 0]])).mm == pytest.approx(5)


# Hidden points


def grid(size: int = 6) -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(size), np.arange(size)), axis=-1).reshape(-1, 2) @ np.eye(2, 3) - [
        2.5,
        2.5,
        0,
    ]


def test_all_points_of_a_plane_are_seen_from_in_front() -> None:
    """The plane's points and the viewpoint span a volume, but the plane alone has no hull."""
    assert hidden_point_removal(grid(), np.array([0.3, 0.2, 50.0])).all()


def test_coplanar_points_seen_from_their_own_plane_are_seen_in_part_or_all() -> None:
    """Nothing spans a volume: joggled, or all visible; the nearest are seen in any case."""
    seen = hidden_point_removal(grid(), np.array([60.0, 0.0, 0.0]))
    points = grid()
    assert seen.any()
    assert seen[points[:, 0] == points[:, 0].max()].any()


@pytest.mark.parametrize(
    "points", [np.outer(np.arange(9), [1.0, 2, 3]), np.tile([1.0, 2, 3], (9, 1)), np.zeros((3, 3))]
)
def test_points_on_a_line_or_at_one_place_hide_nothing_but_themselves(points: np.ndarray) -> None:
    assert hidden_point_removal(points, np.array([100.0, -50.0, 20.0])).any()


def test_a_viewpoint_on_a_point_still_sees_the_others() -> None:
    points = ball(count=200).points
    seen = hidden_point_removal(points, points[0])
    assert seen.shape == (200,)
    assert seen[1:].any()


def test_hidden_points_of_a_ball_are_its_far_side() -> None:
    points = ball(count=800).points
    seen = hidden_point_removal(points, np.array([0, 0, 200.0]))
    assert seen[points[:, 2] > 3].mean() > 0.95
    assert seen[points[:, 2] < -3].mean() < 0.05


def test_the_outer_points_of_none_are_none() -> None:
    assert len(outer_points(np.zeros((0, 3)))) == 0


# Ends of the activations


@pytest.mark.parametrize("value", [1e-30, 6e-8, 1e-3, 1.0, 88.9, 1e4, 1e30])
def test_inverse_softplus_at_both_ends(value: float) -> None:
    """log(eˣ − 1) is −∞ at 6e-8 and +∞ at 89 in float32; x + log(−expm1(−x)) is neither."""
    raw = inverse_softplus(np.float32(value))
    assert np.logaddexp(0, raw) == pytest.approx(np.float32(value), rel=1e-6)


@pytest.mark.parametrize(("opacity", "kept"), [(0.0, 1e-5), (1e-30, 1e-5), (1.0, 1 - 1e-5), (1 - 1e-8, 1 - 1e-5)])
def test_an_opacity_at_its_end_is_kept_off_it_and_still_learns(opacity: float, kept: float) -> None:
    """logit(0) is −∞ and its gradient 0: a dead parameter."""
    parameters = Parameters(GaussianSet.create(np.zeros((1, 3)), 1.0, opacities=opacity), GROUPS)
    active = parameters.activate()
    assert active.opacities.item() == pytest.approx(kept, rel=1e-2)
    active.opacities.sum().backward()
    assert parameters.gradient("opacities")[0] > 1e-6


@pytest.mark.parametrize("density", [0.0, 1e-30, 1e-9, 1e4])
def test_a_density_at_its_end_is_finite_and_still_learns(density: float) -> None:
    parameters = Parameters(GaussianSet.create(np.zeros((1, 3)), 1.0, density=density), GROUPS)
    active = parameters.activate()
    assert active.density.item() == pytest.approx(max(density, 1e-9), rel=1e-3)
    active.density.sum().backward()
    assert 0 < parameters.gradient("density")[0] <= 1


@pytest.mark.parametrize("scale", [0.0, 1e-30, 1e30, np.inf])
def test_a_scale_at_its_end_is_finite_in_its_logarithm(scale: float) -> None:
    parameters = Parameters(GaussianSet.create(np.zeros((1, 3)), scale), GROUPS)
    assert torch.isfinite(parameters.raw["scales"]).all()
    assert parameters.activate().scales[0, 0].item() == pytest.approx(np.clip(scale, 1e-12, 1e12), rel=1e-5)


@pytest.mark.parametrize("value", [0.0, 1.0, -5.0, 5.0])
def test_the_zero_one_loss_at_and_beyond_its_ends(value: float) -> None:
    values = torch.full((4,), value, requires_grad=True)
    loss = zero_one(values)
    loss.backward()
    assert loss.item() == pytest.approx(np.log(1e-3) + np.log1p(-1e-3), rel=1e-4)
    assert not values.grad.any()


# Sums over ten million terms in float32


def test_the_mean_difference_of_ten_million_pixels() -> None:
    """A running float32 sum of ten million tenths is 1,087,937."""
    image = torch.full((2000, 5000), 0.1, requires_grad=True)
    loss = l1(image, torch.zeros(2000, 5000))
    loss.backward()
    assert loss.item() == pytest.approx(0.1, rel=1e-6)
    np.testing.assert_allclose(image.grad[::500, ::500], 1e-7, rtol=1e-5)


def test_the_ssim_of_ten_million_pixels() -> None:
    rng = np.random.default_rng(0)
    tile = torch.from_numpy(rng.random((500, 500), np.float32))
    other = (tile + 0.1 * torch.from_numpy(rng.random((500, 500), np.float32))).clamp(0, 1)
    exact = np.mean([ssim(tile, other).item()])
    assert ssim(tile.repeat(7, 6), other.repeat(7, 6)).item() == pytest.approx(exact, abs=2e-3)


def test_the_total_variation_of_ten_million_voxels() -> None:
    """A ramp of 0.1 along x: a third of all steps, nearly."""
    ramp = torch.arange(200, dtype=torch.float32).mul(0.1).expand(220, 230, 200)
    steps = 220 * 230 * 199, 220 * 229 * 200, 219 * 230 * 200
    assert total_variation(ramp).item() == pytest.approx(0.1 * steps[0] / sum(steps), rel=1e-5)


def test_the_psnr_of_ten_million_pixels() -> None:
    assert psnr(np.full((2000, 5000), 0.1, np.float32), np.zeros((2000, 5000), np.float32)) == pytest.approx(
        20, abs=1e-5
    )


def test_the_gradient_of_a_density_that_ten_million_pixels_see() -> None:
    pixel = np.array([0, 1e-3, 0]), np.array([0, 0, -1e-3])
    detector = Detector(5000, 2000, np.array([-1.0, 0, 0]), np.array([-80.0, 0, 0]), *pixel, True)
    gaussians = GaussianSet.create(np.zeros((1, 3)), 1e6, density=0.1).to_torch()
    density = gaussians.density.requires_grad_()
    radiograph(replace(gaussians, density=density), detector).sum().backward()
    assert density.grad.item() == pytest.approx(1e7 * np.sqrt(2 * np.pi) * 1e6, rel=1e-5)


def test_the_gradient_of_an_opacity_that_ten_million_pixels_see() -> None:
    gaussians = GaussianSet.create(np.array([[0.0, 0, 2]]), 1e9, opacities=0.1).to_torch()
    opacities = gaussians.opacities.requires_grad_()
    camera = Camera(5000, 2000, 5000.0, 5000.0, 2500.0, 1000.0, np.eye(4))
    splat(replace(gaussians, opacities=opacities), camera).alpha.sum().backward()
    assert opacities.grad.item() == pytest.approx(1e7, rel=1e-5)


def test_a_step_that_looks_for_infinities_in_ten_million_gradients() -> None:
    """Their sum tells, and must not overflow itself: ten million of 1e34 are finite. Nor may Adam's squares."""
    parameters = Parameters(GaussianSet.create(np.zeros((3_333_334, 3)), 1.0), ("means",))
    parameters.gradient("means")[...] = 1e34
    assert parameters.step({"means": 1.0})
    np.testing.assert_allclose(parameters.raw["means"][::100_000].detach(), -1.0, rtol=1e-5)


# Resume in the middle of a densification


class Training:
    """A few splats fitted to a photo with the CPU kernel, cloned and split every ten iterations."""

    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        self.target = torch.from_numpy(rng.random((24, 24, 3))).float()
        start = GaussianSet.create(rng.normal(size=(12, 3)) * 0.4, 0.15, opacities=0.4)
        self.parameters = Parameters(start, ("means", "scales", "opacities", "sh_dc"))
        rule = DefaultStrategy(start=0.0, stop=1.0, every=10, gradient=1e-4, clone_size=0.1, most=60)
        self.densifier = Densifier(rule, self.parameters, 1.0, 40, seed=0)
        pose = np.eye(4)
        pose[2, 3] = 3.0
        self.camera = Camera(24, 24, 20.0, 20.0, 12.0, 12.0, pose)

    def run(self, first: int, last: int) -> Training:
        for iteration in range(first, last):
            self.parameters.zero_grad()
            image = splat(self.parameters.activate(), self.camera)
            l1(image.color, self.target).backward()
            assert self.parameters.step(dict.fromkeys(GROUPS, 0.01))
            norms = image.info.screen_grad.norm(dim=1).numpy() * 12
            self.densifier.observe(norms, image.info.visible.numpy())
            self.densifier.after_step(iteration)
        return self

    def resumed(self) -> Training:
        """Another one that goes on from this one's state."""
        other = Training()
        other.parameters.restore(self.parameters.state())
        other.densifier.restore(self.densifier.state())
        return other


@pytest.mark.parametrize("stops", [(5,), (9,), (10,), (11,), (3, 17, 29)], ids=str)
def test_resumed_amid_a_densification_it_ends_with_the_same_bits(stops: tuple[int, ...]) -> None:
    """Before, at and after the tenth step: half-gathered screen gradients and new splats' moments are part of it."""
    whole, parts = Training().run(0, 40), Training()
    for first, last in pairwise((0, *stops)):
        parts = parts.run(first, last).resumed()
    parts.run(stops[-1], 40)
    assert len(whole.parameters) == len(parts.parameters) > 12
    for name in GROUPS:
        assert torch.equal(whole.parameters.raw[name], parts.parameters.raw[name]), name
