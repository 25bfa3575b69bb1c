"""Losses: the right value, the right gradient, and nothing that is not finite."""

import numpy as np
import pytest
import torch

from insideout.core.train.losses import d_ssim, image_loss, l1, total_variation, zero_one
from insideout.core.train.ssim import ssim


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
