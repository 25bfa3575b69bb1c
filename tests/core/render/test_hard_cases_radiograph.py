"""A catalogue of splats and detectors that break renderers of projections, each with the line integrals that are right.

Every case runs on every kernel; `expose` checks that all values and gradients, those of the detector's pose too, are
finite and that the gradients of the float32 kernels are those of the reference in float64.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from insideout.core.errors import SettingError
from insideout.core.gaussians import GaussianSet, Modality
from insideout.core.render import radiograph
from insideout.core.rotations import normalize_quats, quats_to_matrices
from insideout.core.views import Detector

SQRT_2PI = np.sqrt(2 * np.pi)
STRAIGHT, SLANTED = (1.0, 0.0, 0.0, 0.0), (0.9, 0.1, 0.3, -0.2)
CONE = Detector(33, 25, np.array([100.0, 0, 0]), np.array([-80.0, 0, 0]), np.array([0, 1.0, 0]), np.array([0, 0, -1.0]))
PARALLEL = replace(CONE, source=np.array([-1.0, 0, 0]), parallel=True)
TILTED = replace(
    CONE, source=np.array([60.0, 70, 5]), center=np.array([-50.0, -60, 3]), u=np.array([1.2, -1, 0.3])
)  # fmt: skip
DETECTORS = pytest.mark.parametrize("detector", [CONE, PARALLEL, TILTED], ids=["cone", "parallel", "tilted"])
MIDDLE = (12, 16)


def one(scale=1.0, mean=(0.0, 0.0, 0.0), quat=STRAIGHT, density=0.5) -> GaussianSet:
    gaussians = GaussianSet.create(np.array([mean]), np.atleast_2d(scale), density=density, modality=Modality.XRAY)
    return replace(gaussians, quats=np.array([quat], np.float32))


def integrals(gaussians: GaussianSet, detector: Detector) -> np.ndarray:
    """Σ ρ·√(2π)/‖e‖·exp(−½‖f × e‖²/‖e‖²) in float64, e and f the ray and the centre's distance from it, whitened."""
    return _sum_over_splats(gaussians, detector, 1.0)


def _sum_over_splats(gaussians: GaussianSet, detector: Detector, decay: float) -> np.ndarray:
    origins, directions = detector.rays()
    total = np.zeros(origins.shape[:2])
    turns = quats_to_matrices(normalize_quats(gaussians.quats.astype(np.float64)))
    for mean, turn, scale, density in zip(gaussians.means, turns, gaussians.scales, gaussians.density, strict=True):
        away = mean.astype(np.float64) - origins
        across = away - (away * directions).sum(-1, keepdims=True) * directions
        e, f = directions @ turn / scale.astype(np.float64), across @ turn / scale.astype(np.float64)
        length = np.linalg.norm(e, axis=-1)
        distance = np.linalg.norm(np.cross(f, e / length[..., None]), axis=-1)
        total += density * SQRT_2PI / length * np.exp(-0.5 * decay * distance**2)
    return total


@pytest.fixture
def assert_integrals(kernel):
    """Whether an image is as expected: to a relative error of its largest value, and in float32 1e-6 of splats' peaks.

    The fast kernels leave out what is beyond 5.3 standard deviations, which is 8e-7 of a peak.
    """

    def check(rendered, gaussians: GaussianSet, detector: Detector, rtol: float | None = None) -> None:
        expected = integrals(gaussians, detector)
        error = np.abs(rendered["image"] - expected).max()
        cut = 1e-6 * _sum_over_splats(gaussians, detector, 0.0).max() if kernel.single else 0.0
        allowed = (rtol or kernel.rtol) * expected.max() + cut
        assert error <= allowed, f"{error:.3g} of {expected.max():.3g}, {allowed:.3g} allowed"

    return check


# Shapes


@DETECTORS
@pytest.mark.parametrize("ratio", [1e2, 1e4, 1e6])
def test_a_needle(expose, assert_integrals, detector, ratio) -> None:
    """Thinner than a pixel it is seen only by rays that hit it: at ratio 1e6 by none but the one through its centre."""
    needle = one((30.0, 30 / ratio, 30 / ratio), quat=SLANTED)
    assert_integrals(expose(needle, detector), needle, detector, rtol=1e-4)


@DETECTORS
@pytest.mark.parametrize("ratio", [1e2, 1e4, 1e6])
def test_a_disc(expose, assert_integrals, detector, ratio) -> None:
    disc = one((30.0, 30.0, 30 / ratio), quat=SLANTED)
    assert_integrals(expose(disc, detector), disc, detector)


@DETECTORS
@pytest.mark.parametrize("ratio", [1e2, 1e4, 1e6])
def test_a_point(expose, assert_integrals, detector, ratio) -> None:
    point = one(30 / ratio)
    assert_integrals(expose(point, detector), point, detector, rtol=1e-4)


def test_a_needle_along_the_central_ray_is_its_axis_integral(expose, kernel) -> None:
    image = expose(one((1000.0, 0.1, 0.1)), CONE)["image"]
    np.testing.assert_allclose(image[MIDDLE], 0.5 * SQRT_2PI * 1000, rtol=kernel.rtol)


def test_a_disc_seen_edge_on_is_a_line_as_bright_as_it_is_wide(expose, assert_integrals) -> None:
    """Other rays cross a millionth of its width."""
    disc = one((30.0, 30.0, 3e-5))
    seen = expose(disc, CONE)
    assert_integrals(seen, disc, CONE)
    assert seen["image"][MIDDLE] == pytest.approx(0.5 * SQRT_2PI * 30, rel=1e-5)
    assert np.delete(seen["image"], MIDDLE[0], axis=0).max() < 1e-6 * seen["image"].max()


@pytest.mark.parametrize("detector", [CONE, PARALLEL], ids=["cone", "parallel"])
def test_a_scale_of_1e_minus_8_is_seen_only_by_the_ray_through_it(expose, kernel, detector) -> None:
    """The central ray lies on an axis, so that float32 hits the splat too."""
    image = expose(one(1e-8), detector, gradient_rtol=None)["image"]
    expected = np.zeros((25, 33))
    expected[MIDDLE] = 0.5 * SQRT_2PI * np.float64(np.float32(1e-8))
    np.testing.assert_allclose(image, expected, rtol=max(kernel.rtol, 1e-6), atol=1e-30)


@DETECTORS
def test_a_scale_of_1e8_is_the_same_everywhere(expose, kernel, detector) -> None:
    image = expose(one(1e8, quat=SLANTED), detector)["image"]
    np.testing.assert_allclose(image, 0.5 * SQRT_2PI * 1e8, rtol=max(kernel.rtol, 1e-6))


def test_a_splat_both_huge_and_tiny_is_a_sheet(expose, assert_integrals) -> None:
    """1e8 along x and y and 1e-8 thick, at the height of the source: only the middle row's rays lie in it."""
    sheet = one((1e8, 1e8, 1e-8))
    seen = expose(sheet, CONE, gradient_rtol=None)
    assert_integrals(seen, sheet, CONE)
    assert np.delete(seen["image"], MIDDLE[0], axis=0).max() < 1e-13 * seen["image"].max()


def test_an_infinite_scale_is_the_largest_there_is(expose) -> None:
    seen = expose(one((np.inf, 1.0, 1.0), quat=SLANTED), CONE)
    same = expose(one((1e12, 1.0, 1.0), quat=SLANTED), CONE)
    np.testing.assert_allclose(seen["image"], same["image"], rtol=1e-6)
    assert seen.grads["scales"][0, 0] == 0


def test_a_scale_of_zero_is_the_smallest_there_is(expose, kernel) -> None:
    image = expose(one((0.0, 2.0, 2.0)), CONE, gradient_rtol=None)["image"]
    assert image[MIDDLE] == pytest.approx(0.5 * SQRT_2PI * 1e-12, rel=1e-4)


def test_a_round_splat_has_no_axes_so_a_turn_changes_nothing(expose, assert_integrals) -> None:
    seen = expose(one(3.0, quat=SLANTED), CONE)
    assert_integrals(seen, one(3.0), CONE)
    assert np.abs(seen.grads["quats"]).max() < 1e-4 * np.abs(seen.grads["scales"]).max()


@DETECTORS
def test_an_axis_aligned_splat(expose, assert_integrals, detector) -> None:
    """Rows and columns of its whitening are exactly parallel to those of the detector: zeros in every factorisation."""
    splat = one((3.0, 1.0, 2.0))
    assert_integrals(expose(splat, detector), splat, detector)


# Rotations


def test_a_zero_quaternion_means_no_rotation_and_gets_no_gradient(expose) -> None:
    seen, same = expose(one((3.0, 1.0, 2.0), quat=(0, 0, 0, 0)), TILTED), expose(one((3.0, 1.0, 2.0)), TILTED)
    np.testing.assert_array_equal(seen["image"], same["image"])
    assert not seen.grads["quats"].any()


@pytest.mark.parametrize("factor", [1e-5, 1e6, -1.0])
def test_a_quaternions_length_and_sign_do_not_matter(expose, factor) -> None:
    seen, same = (expose(one((3.0, 1.0, 2.0), quat=f * np.array(SLANTED)), TILTED) for f in (factor, 1.0))
    np.testing.assert_allclose(seen["image"], same["image"], rtol=1e-4, atol=1e-6)


# Places


def test_on_the_source_it_is_the_line_through_its_centre(expose, kernel) -> None:
    scale = np.array([3.0, 1.0, 0.5])
    image = expose(one(scale, mean=(100.0, 0, 0)), CONE)["image"]
    _, directions = CONE.rays()
    np.testing.assert_allclose(image, 0.5 * SQRT_2PI / np.linalg.norm(directions / scale, axis=-1), rtol=kernel.rtol)


@pytest.mark.parametrize("mean", [(99.0, 1.0, 0.5), (100.0, 0.0, 1e-3), (99.9999, 0.0, 0.0)])
def test_around_the_source_it_is_seen_everywhere(expose, assert_integrals, mean) -> None:
    around = one((4.0, 2.0, 3.0), mean, SLANTED)
    seen = expose(around, CONE)
    assert_integrals(seen, around, CONE)
    assert seen["image"].min() > 0


def test_beside_the_source_it_projects_to_infinity_and_is_still_right(expose, assert_integrals) -> None:
    """Its centre is in the plane through the source that is parallel to the detector."""
    beside = one((2.0, 1.0, 3.0), (100.0, 6.0, 2.0), SLANTED)
    assert_integrals(expose(beside, CONE), beside, CONE, rtol=1e-4)


def test_behind_the_source_it_counts_because_lines_are_infinite(expose, assert_integrals) -> None:
    behind = one((2.0, 1.0, 3.0), (130.0, 1.0, 0.0), SLANTED)
    seen = expose(behind, CONE)
    assert_integrals(seen, behind, CONE)
    assert seen["image"].max() > 1


def test_on_the_detector_it_counts_whole(expose, assert_integrals) -> None:
    on_detector = one(2.0, (-80.0, 3.0, 1.0))
    assert_integrals(expose(on_detector, CONE), on_detector, CONE)


@pytest.mark.parametrize("x", [100.0, 130.0, 99.5])
def test_affine_leaves_out_what_is_at_behind_or_close_to_the_source(expose, x) -> None:
    """Linearised there, the projection would be infinite; 1 % of the way to the detector is the limit."""
    seen = expose(one(mean=(x, 0.0, 0.0)), CONE, mode="affine")
    assert not seen["image"].any()
    assert not any(grad.any() for grad in seen.grads.values())


def test_off_the_image_by_a_million_pixels_it_is_not_seen(expose) -> None:
    seen = expose(one(5.0, mean=(0.0, 1e6, 0.0)), CONE)
    assert not seen["image"].any()


@DETECTORS
def test_coordinates_of_a_kilometre_give_the_scene_at_the_origin(expose, assert_integrals, detector) -> None:
    """From 2²⁰ mm on, numbers of float32 are ⅛ mm apart: centres on eighths lose nothing, others up to 1/16 mm.

    The detector's vectors are float64, and differences are taken before anything is rounded.
    """
    rng = np.random.default_rng(3)
    cloud = GaussianSet.create(
        np.round(8 * rng.normal(size=(20, 3)) * 5) / 8, 10 ** rng.uniform(-0.5, 0.5, (20, 3)),
        quats=rng.normal(size=(20, 4)), density=0.3,
    )  # fmt: skip
    far = np.array([1048576.0, -1048576.0, 524288.0])
    there = replace(detector, center=detector.center + far)
    if not detector.parallel:
        there = replace(there, source=detector.source + far)
    assert_integrals(expose(replace(cloud, means=cloud.means + far), there), cloud, detector)


def test_a_source_at_a_hundred_kilometres_is_a_parallel_beam(expose, assert_integrals) -> None:
    rng = np.random.default_rng(4)
    cloud = GaussianSet.create(rng.normal(size=(20, 3)) * 4, 1.5, quats=rng.normal(size=(20, 4)), density=0.3)
    far = replace(CONE, source=np.array([1e8, 0.0, 0.0]))
    assert_integrals(expose(cloud, far), cloud, PARALLEL, rtol=1e-5)


# Amounts


def test_density_zero_shows_nothing_but_can_still_grow(expose) -> None:
    clear, full = expose(one(2.0, density=0.0), CONE), expose(one(2.0, density=1.0), CONE)
    assert not clear["image"].any()
    np.testing.assert_allclose(clear.grads["density"], full.grads["density"], rtol=1e-5)
    assert clear.grads["density"][0] > 0
    assert not any(clear.grads[name].any() for name in ("means", "quats", "scales", "source"))


@pytest.mark.parametrize("density", [1e-8, 1e8])
def test_extreme_densities_only_scale_the_image(expose, assert_integrals, density) -> None:
    splat = one((3.0, 1.0, 2.0), quat=SLANTED, density=density)
    assert_integrals(expose(splat, CONE), splat, CONE)


@pytest.mark.parametrize(("raw", "density"), [(-1e4, 0.0), (-100.0, 0.0), (0.0, np.log(2)), (1e4, 1e4)])
def test_a_raw_density_at_the_ends_of_softplus(kernel, raw, density) -> None:
    """log(1 + eˣ) overflows at 89 and its gradient is 0/0 or ∞/∞ when written out."""
    leaf = torch.tensor([raw], dtype=kernel.dtype, device=kernel.device, requires_grad=True)
    splat = replace(one().to_torch(kernel.dtype, kernel.device), density=torch.nn.functional.softplus(leaf))
    image = radiograph(splat, CONE, kernel.name)
    image.sum().backward()
    assert image[MIDDLE].item() == pytest.approx(density * SQRT_2PI, rel=1e-5, abs=1e-30)
    assert torch.isfinite(leaf.grad).all()


# Numbers of splats


def test_an_empty_set_is_a_black_image_and_its_gradients_are_empty(expose) -> None:
    seen = expose(GaussianSet.empty(), CONE)
    assert seen["image"].shape == (25, 33)
    assert not seen["image"].any()
    assert seen.grads["means"].shape == (0, 3)
    assert not seen.grads["center"].any()


@DETECTORS
def test_one_splat(expose, assert_integrals, detector) -> None:
    splat = one((3.0, 1.0, 2.0), (1.0, -2.0, 0.5), SLANTED)
    assert_integrals(expose(splat, detector), splat, detector)


def test_a_thousand_identical_splats_are_one_of_a_thousand_times_the_density(expose, assert_integrals) -> None:
    splat = one((3.0, 1.0, 2.0), quat=SLANTED)
    seen = expose(splat.select(np.zeros(1000, int)), CONE)
    assert_integrals(seen, replace(splat, density=1000 * splat.density), CONE, rtol=2e-5)
    np.testing.assert_allclose(seen.grads["density"], seen.grads["density"][0], rtol=1e-6)


@DETECTORS
def test_a_million_splats_on_one_pixel_add_up_to_a_million(expose, kernel, detector) -> None:
    """A running float32 sum of a million like terms is off by 0.5 %, one in two levels of a thousand by 2e-5.

    The reference in plain torch gets a tenth of them.
    """
    count = 100_000 if kernel.name == "reference" else 1_000_000
    pixel = replace(detector, width=1, height=1)
    many = one(1e-3, density=0.1).select(np.zeros(count, int))
    seen = expose(replace(many, scales=many.scales * 3e3), pixel, gradient_rtol=None)
    expected = count * integrals(one(3.0, density=0.1), pixel)
    np.testing.assert_allclose(seen["image"], expected, rtol=3e-5)
    np.testing.assert_allclose(seen.grads["density"], seen.grads["density"][0], rtol=1e-6)


# Detectors


@pytest.mark.parametrize(("width", "height"), [(0, 25), (33, 0), (0, 0)])
def test_a_detector_without_pixels_is_refused(kernel, width, height) -> None:
    with pytest.raises(SettingError, match=f"{width} x {height}"):
        radiograph(one().to_torch(kernel.dtype), replace(CONE, width=width, height=height), kernel.name)


@DETECTORS
@pytest.mark.parametrize("size", [(1, 1), (3, 17), (1, 33), (31, 45)])
def test_a_detector_of_any_size(expose, assert_integrals, detector, size) -> None:
    rng = np.random.default_rng(5)
    cloud = GaussianSet.create(rng.normal(size=(30, 3)) * 5, 2.0, quats=rng.normal(size=(30, 4)), density=0.3)
    view = replace(detector, width=size[0], height=size[1])
    assert_integrals(expose(cloud, view), cloud, view)


def test_a_detector_almost_along_the_rays(expose, assert_integrals) -> None:
    """Tilted by 89.9°, its pixels are seen under a thousandth of their size."""
    angle = np.radians(89.9)
    grazing = replace(CONE, u=np.array([np.sin(angle), np.cos(angle), 0.0]))
    splat = one((3.0, 1.0, 2.0), quat=SLANTED)
    assert_integrals(expose(splat, grazing, gradient_rtol=5e-3), splat, grazing)


def test_a_left_handed_detector_is_the_mirror_image(expose, kernel) -> None:
    splat = one((3.0, 1.0, 2.0), (1.0, -2.0, 0.5), SLANTED)
    seen, same = expose(splat, replace(CONE, u=-CONE.u)), expose(splat, CONE)
    np.testing.assert_allclose(seen["image"][:, ::-1], same["image"], rtol=1e-4, atol=4e-6)


@pytest.mark.parametrize("length", [1e-6, 1e6])
def test_a_parallel_beams_direction_need_not_be_a_unit_vector(expose, assert_integrals, length) -> None:
    splat = one((3.0, 1.0, 2.0), quat=SLANTED)
    beam = replace(PARALLEL, source=length * PARALLEL.source)
    assert_integrals(expose(splat, beam), splat, PARALLEL)


@pytest.mark.parametrize("pixel", [1e-6, 1e6])
def test_pixels_of_a_nanometre_and_of_a_kilometre(expose, assert_integrals, pixel) -> None:
    splat = one((3.0, 1.0, 2.0), quat=SLANTED)
    view = replace(CONE, u=pixel * CONE.u, v=pixel * CONE.v)
    assert_integrals(expose(splat, view, gradient_rtol=None), splat, view)


# Values


@pytest.mark.parametrize("field", ["means", "quats", "density"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_splat_with_a_value_that_is_not_finite_is_left_out(expose, field, value) -> None:
    sane = GaussianSet.concatenate([one(2.0), one(3.0, (1.0, 2.0, 3.0))])
    broken = GaussianSet.concatenate([sane, one(3.0)])
    getattr(broken, field).reshape(3, -1)[2, 0] = value
    seen, expected = expose(broken, CONE), expose(sane, CONE)
    np.testing.assert_allclose(seen["image"], expected["image"], rtol=1e-6)
    assert not seen.grads[field][2].any()


def test_a_scale_that_is_not_a_number_is_left_out(expose) -> None:
    broken = GaussianSet.concatenate([one(2.0), one(3.0)])
    broken.scales[1, 2] = np.nan
    np.testing.assert_allclose(expose(broken, CONE)["image"], expose(one(2.0), CONE)["image"], rtol=1e-6)


def test_clones_are_left_out_and_get_no_gradient(expose) -> None:
    both = GaussianSet.concatenate([one(2.0), replace(one(2.0), modality=np.array([Modality.CLONE], np.uint8))])
    seen = expose(both, CONE)
    np.testing.assert_allclose(seen["image"], expose(one(2.0), CONE)["image"], rtol=1e-6)
    assert not seen.grads["density"][1]
