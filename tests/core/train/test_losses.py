"""Losses: the right value, the right gradient, and nothing that is not finite."""

from dataclasses import replace

import numba
import numpy as np
import pytest
import torch

from insideout.core.capture.model import CountingNoise
from insideout.core.train.losses import (
    _FEW,
    as_known,
    d_ssim,
    image_loss,
    l1,
    masked_loss,
    projection_loss,
    total_variation,
    zero_one,
)
from insideout.core.train.ssim import compare_rows, ssim


def images(shape=(37, 29, 3), seed=0):
    rng = np.random.default_rng(seed)
    first = torch.tensor(rng.random(shape), dtype=torch.float32)
    return first.requires_grad_(True), torch.tensor(rng.random(shape), dtype=torch.float32)


def plain_ssim(x, y):
    """SSIM with torch's convolution in float64."""
    weights = torch.tensor(np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2))
    weights = weights / weights.sum()
    window = (weights[:, None] * weights)[None, None]

    def blur(image):
        return torch.nn.functional.conv2d(image.permute(2, 0, 1)[:, None], window, padding=5)

    a, b, aa, bb, ab = blur(x), blur(y), blur(x * x), blur(y * y), blur(x * y)
    top = (2 * a * b + 1e-4) * (2 * (ab - a * b) + 9e-4)
    return (top / ((a * a + b * b + 1e-4) * (aa - a * a + bb - b * b + 9e-4))).mean()


@pytest.mark.parametrize("shape", [(37, 29, 3), (11, 64, 1), (3, 5, 3), (1, 1, 3)])
def test_ssim_and_its_gradient_agree_with_torch_s_convolution(shape):
    image, target = images(shape)
    value = ssim(image, target)
    value.backward()
    twin = image.detach().double().requires_grad_(True)
    expected = plain_ssim(twin, target.double())
    expected.backward()
    assert float(value.detach()) == pytest.approx(float(expected.detach()), abs=2e-6)
    np.testing.assert_allclose(image.grad, twin.grad, atol=2e-6 * float(twin.grad.abs().max()) + 1e-9, rtol=1e-4)


def test_ssim_of_equal_images_is_one_and_has_no_gradient():
    image, _ = images()
    value = ssim(image, image.detach().clone())
    value.backward()
    assert float(value.detach()) == pytest.approx(1.0, abs=1e-6)
    assert float(image.grad.abs().max()) < 1e-6


@pytest.mark.parametrize("level", [0.0, 0.5, 1.0])
def test_flat_images_give_one_and_finite_gradients(level):
    image = torch.full((20, 20), level, requires_grad=True)
    loss = d_ssim(image, torch.full((20, 20), level))
    loss.backward()
    assert float(loss.detach()) == pytest.approx(0.0, abs=1e-5)
    assert torch.isfinite(image.grad).all()


def test_ssim_refuses_images_of_different_size():
    with pytest.raises(ValueError, match="same size"):
        ssim(torch.zeros(4, 4), torch.zeros(4, 5))


def test_l1_is_the_mean_difference():
    assert float(l1(torch.tensor([1.0, 2.0]), torch.tensor([0.0, 4.0]))) == 1.5


@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
def test_the_image_loss_is_the_sum_of_its_terms_and_so_is_its_gradient(weight):
    image, target = images()
    (3 * image_loss(image, target, weight)).backward()
    twin = image.detach().clone().requires_grad_(True)
    expected = (1 - weight) * l1(twin, target) + weight * d_ssim(twin, target)
    (3 * expected).backward()
    assert float(image_loss(image, target, weight).detach()) == pytest.approx(float(expected.detach()), rel=1e-6)
    np.testing.assert_allclose(image.grad, twin.grad, rtol=1e-5, atol=1e-10)


def plain_loss(x, y, weight):
    return (1 - weight) * (x - y).abs().mean() + weight * (1 - plain_ssim(x, y))


@pytest.mark.parametrize("shape", [(37, 29, 3), (12, 8, 3), (11, 64, 1), (2, 3, 3), (1, 1, 1)])
@pytest.mark.parametrize("mask_weight", [0.0, 0.1])
def test_the_masked_loss_is_the_plain_formula_in_float64(shape, mask_weight):
    image, target = images(shape)
    alpha, mask = images(shape[:2], seed=1)
    # Equal values pass no gradient of L1.
    target[1:2] = image.detach()[1:2]
    mask[1:2] = alpha.detach()[1:2]
    loss = masked_loss(image, target, 0.2, alpha, mask, mask_weight)
    (3 * loss).backward()
    twins = [part.detach().double().requires_grad_(True) for part in (image, alpha)]
    expected = plain_loss(twins[0], target.double(), 0.2) + mask_weight * (twins[1] - mask.double()).abs().mean()
    (3 * expected).backward()
    assert float(loss.detach()) == pytest.approx(float(expected.detach()), abs=2e-6)
    for part, twin in zip((image, alpha), twins, strict=True):
        np.testing.assert_allclose(part.grad, twin.grad, atol=2e-6 * float(twin.grad.abs().max()) + 1e-9, rtol=1e-4)


def test_the_masked_loss_takes_images_in_float64_too():
    image, target = images()
    alpha, mask = images((37, 29), seed=1)
    single = masked_loss(image, target, 0.2, alpha, mask, 0.1)
    double = masked_loss(
        *(part.detach().double() if torch.is_tensor(part) else part for part in (image, target, 0.2, alpha, mask, 0.1))
    )
    assert float(double) == pytest.approx(float(single.detach()), rel=1e-5)


@pytest.mark.parametrize("height", [1, 2, 9, 10, 11, 12, 13, 21, 40])
def test_rows_do_not_depend_on_how_the_image_is_cut_into_bands(height):
    rng = np.random.default_rng(height)
    x, y = rng.random((2, height, 21), dtype=np.float32)
    found = set()
    for bands in range(1, height + 3):
        sums, differences, gradient = np.empty(height), np.empty(height), np.empty_like(x)
        compare_rows(x, y, 3, np.float32(0.7), np.float32(0.3), bands, sums, differences, gradient)
        found.add(sums.tobytes() + differences.tobytes() + gradient.tobytes())
    assert len(found) == 1


@pytest.mark.parametrize("count", [1, 4095, 4097, _FEW - 1, _FEW, _FEW + 1])
def test_l1_has_the_same_bits_on_any_number_of_threads(count):
    """Also where it changes from the calling thread alone to all of them."""
    image, target = images((1, count))
    threads, found = numba.get_num_threads(), set()
    try:
        for some in (1, threads):
            numba.set_num_threads(some)
            image.grad = None
            value = l1(image, target)
            value.backward()
            assert numba.get_num_threads() == some
            found.add((float(value.detach()), image.grad.numpy().tobytes()))
    finally:
        numba.set_num_threads(threads)
    assert len(found) == 1
    assert found.pop()[0] == pytest.approx(float((image.detach() - target).double().abs().mean()), rel=1e-5)


@pytest.mark.parametrize("loss", [l1, ssim, lambda image, target: image_loss(image, target, 0.2)])
def test_a_loss_can_be_gone_back_through_several_times(loss):
    """What it keeps is not what it gave away to be added to."""
    image, target = images()
    value = loss(image, target)
    value.backward(retain_graph=True)
    once = image.grad.clone()
    for _ in range(2):
        value.backward(retain_graph=True)
    np.testing.assert_allclose(image.grad, 3 * once, rtol=1e-6)


def test_the_image_loss_takes_images_in_float64_too():
    image, target = images()
    single = image_loss(image, target, 0.2)
    double = image_loss(image.detach().double(), target.double(), 0.2)
    assert float(double) == pytest.approx(float(single.detach()), rel=1e-5)


def test_zero_one_falls_towards_both_ends_and_is_finite_there():
    values = torch.tensor([0.0, 1.0, 0.5, 0.2], requires_grad=True)
    zero_one(values).backward()
    assert torch.isfinite(values.grad).all()
    assert values.grad[3] > 0, "a step against the gradient lowers 0.2"
    assert float(zero_one(torch.tensor([0.01]))) < float(zero_one(torch.tensor([0.5])))
    assert float(zero_one(torch.zeros(0))) == 0.0


def test_total_variation_of_a_step_is_its_height_over_the_number_of_pairs():
    block = torch.zeros(2, 2, 2)
    block[1] = 3.0
    assert float(total_variation(block)) == pytest.approx(4 * 3.0 / 12)
    assert float(total_variation(torch.ones(1, 1, 1))) == 0.0


def test_streaks_count_as_in_total_variation_where_edges_are_let_be_and_an_edge_as_much_whatever_its_height():
    def of(height, edge=None):
        block = torch.zeros(2, 2, 2, dtype=torch.float64)
        block[1] = height
        block.requires_grad_()
        rough = total_variation(block, edge)
        rough.backward()
        return float(rough.detach()), float(block.grad[1, 0, 0])

    for found, plain in zip(of(0.001, edge=0.1), of(0.001), strict=True):
        assert found == pytest.approx(plain, rel=0.03)
    assert of(0.1, edge=0.1)[0] == pytest.approx(of(0.05)[0]), "at the edge it counts half"
    assert of(20.0, edge=0.1)[0] == pytest.approx(of(0.1)[0], rel=0.01)
    assert of(1.0, edge=0.1)[1] < 0.01 * of(1.0)[1], "nothing is won by making it lower"


def test_projections_are_compared_by_l1_or_by_squares_and_by_structure():
    image, target = torch.tensor([[0.0, 0.2], [0.4, 1.0]]), torch.tensor([[0.0, 0.1], [0.4, 0.7]])
    assert float(projection_loss(image, target, 30.0, 0.0)) == pytest.approx(30 * (0.01 + 0.09) / 4)
    assert float(projection_loss(image, target, None, 0.0)) == pytest.approx((0.1 + 0.3) / 4)
    structure = float(d_ssim(image, target))
    assert structure > 0.01
    assert float(projection_loss(image, target, 30.0, 0.1)) == pytest.approx(30 * 0.1 / 4 + 0.1 * structure)


def test_large_differences_of_projections_count_straight_on():
    image = torch.tensor([[0.0, 0.01], [0.4, 1.0]], requires_grad=True)
    target = torch.tensor([[0.0, 0.0], [0.4, 0.7]])
    loss = projection_loss(image, target, 50.0, 0.0, straight_from=0.1)
    # 50 d² up to 0.1, then with the slope 10 that it has there.
    assert float(loss.detach()) == pytest.approx((50 * 0.01**2 + 50 * 0.1**2 + 10 * 0.2) / 4)
    loss.backward()
    assert image.grad.numpy().ravel() == pytest.approx([0, 100 * 0.01 / 4, 0, 10 / 4])


class TestAsKnown:
    NOISE = CountingNoise(per_photon=1e-3, floor=1e-4, most=0.01, known=0.02)

    def test_without_noise_it_is_the_target_itself(self):
        image, target = images((5, 7))
        assert as_known(image, target, None, 2.0) is target

    def test_differences_shrink_to_the_share_that_is_known_of_what_is_rendered(self):
        image, target = images((5, 7))
        shown, measured = 3.0 * image.detach().numpy(), 3.0 * target.numpy()
        variance = 1e-4 + 1e-3 * np.exp(shown)
        assert (variance > 0.01).any()
        share = 4e-4 / (4e-4 + np.minimum(variance, 0.01))
        expected = (shown + share * (measured - shown)) / 3.0
        found = as_known(image, target, self.NOISE, 3.0)
        np.testing.assert_allclose(found.detach(), expected, rtol=1e-5)

    def test_nothing_is_won_by_making_a_ray_look_thick(self):
        """The gradient of squares is that with constant weights: it always points to what was measured."""
        image, target = images((5, 7))
        noise = replace(self.NOISE, per_photon=0.0, floor=1.2e-3)
        shrunk = as_known(image, target, noise, 3.0)
        (image - shrunk).square().sum().backward()
        assert not shrunk.requires_grad
        torch.testing.assert_close(image.grad, (2 * 0.25 * (image - target)).detach(), rtol=1e-4, atol=1e-7)

    def test_squares_look_at_it_and_l1_does_not(self):
        image, target = images((16, 17))
        known = as_known(image, target, self.NOISE, 3.0)
        squares, ones = (projection_loss(image, target, weight, 0.1, None, self.NOISE, 3.0) for weight in (30.0, None))
        torch.testing.assert_close(squares, projection_loss(image, known, 30.0, 0.1))
        torch.testing.assert_close(ones, projection_loss(image, target, None, 0.1))

    @pytest.mark.parametrize("per_photon", [1e-3, 0.0])
    def test_behind_metal_and_below_air_it_is_finite(self, per_photon):
        lines = torch.tensor([[-5.0, 0.0, 90.0, 2000.0]], requires_grad=True)
        found = as_known(lines, torch.zeros(1, 4), replace(self.NOISE, per_photon=per_photon), 1.0)
        assert torch.isfinite(found).all()

    def test_behind_metal_as_much_is_known_as_of_the_thickest_that_a_detector_tells(self):
        lines = torch.tensor([[90.0, 2000.0]], requires_grad=True)
        found = as_known(lines, torch.zeros(1, 2), self.NOISE, 1.0)
        torch.testing.assert_close(found, lines.detach() * (1 - 4e-4 / (4e-4 + 0.01)))
