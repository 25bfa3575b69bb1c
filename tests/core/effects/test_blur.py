"""The scatter blur against its formula in float64."""

import numba
import numpy as np
import pytest
import torch

from insideout.core.effects.blur import scatter_blur


def images(height=11, width=14, most=4.0, seed=0):
    torch.manual_seed(seed)
    return torch.rand(height, width, 3) + 0.02, torch.rand(height, width), most * torch.rand(height, width) + 0.01


def gradients(function, inputs, given):
    leaves = [part.detach().clone().requires_grad_(True) for part in inputs]
    color, alpha = function(*leaves)
    ((color * given[0].to(color)).sum() + (alpha * given[1].to(alpha)).sum()).backward()
    return [leaf.grad for leaf in leaves]


@pytest.mark.parametrize("shape", [(11, 14), (1, 9), (7, 1), (1, 1)])
@pytest.mark.parametrize("most", [0.4, 4.0, 30.0])
def test_it_is_the_formula(shape, most, by_the_formula):
    inputs = images(*shape, most=most)
    expected = by_the_formula(*(part.double() for part in inputs))
    for found, wanted in zip(scatter_blur(*inputs), expected, strict=True):
        torch.testing.assert_close(found.double(), wanted, atol=2e-6, rtol=0)


def test_without_its_tail_a_weight_is_that_of_the_paper_to_a_part_in_2000():
    """One bright pixel: its image is the weight itself, where all radii are the same."""
    color, radius = torch.zeros(15, 15, 3), 3.0
    color[7, 7] = 1.0
    found = scatter_blur(color, torch.zeros(15, 15), torch.full((15, 15), radius))[0][..., 0].square()
    y, x = np.mgrid[:15, :15] - 7.0
    weight = 0.5 + 0.5 * np.tanh(4 * (radius - np.hypot(x, y)))
    np.testing.assert_allclose(found / found[7, 7], weight, atol=5e-4)


def test_gradients_are_those_of_the_formula_in_float64(by_the_formula):
    inputs = images()
    given = torch.randn(11, 14, 3), torch.randn(11, 14)
    expected = gradients(by_the_formula, [part.double() for part in inputs], given)
    for found, wanted in zip(gradients(scatter_blur, inputs, given), expected, strict=True):
        assert float(wanted.abs().max()) > 0.1
        torch.testing.assert_close(found.double(), wanted, atol=2e-5 * float(wanted.abs().max()), rtol=1e-4)


def test_circles_without_extent_leave_an_image_as_it_is():
    color, alpha, _ = images()
    for found, wanted in zip(scatter_blur(color, alpha, torch.zeros(11, 14)), (color, alpha), strict=True):
        torch.testing.assert_close(found, wanted, atol=1e-6, rtol=0)


def test_one_colour_stays_one_colour():
    _, _, radii = images(most=9.0)
    color, alpha = scatter_blur(torch.full((11, 14, 3), 0.37), torch.ones(11, 14), radii)
    torch.testing.assert_close(color, torch.full_like(color, 0.37), atol=1e-6, rtol=0)
    torch.testing.assert_close(alpha, torch.ones_like(alpha), atol=1e-6, rtol=0)


def test_black_has_finite_gradients_that_can_brighten_it():
    black = torch.zeros(11, 14, 3)
    given = torch.ones(11, 14, 3), torch.ones(11, 14)
    by_color, by_alpha, by_radii = gradients(scatter_blur, (black, torch.zeros(11, 14), images()[2]), given)
    assert all(bool(torch.isfinite(part).all()) for part in (by_color, by_alpha, by_radii))
    assert float(by_color.min()) > 0


def test_any_number_of_threads_gives_the_same_bits():
    inputs = images(60, 70, most=6.0)
    given = torch.randn(60, 70, 3), torch.randn(60, 70)
    most, results = numba.config.NUMBA_NUM_THREADS, []
    for threads in (most, 1):
        numba.set_num_threads(threads)
        results.append([*scatter_blur(*inputs), *gradients(scatter_blur, inputs, given)])
    for one, two in zip(*results, strict=True):
        assert torch.equal(one, two)


def test_a_radius_that_is_not_a_number_spoils_no_more_than_its_pixel():
    color, alpha, radii = images(most=2.0)
    radii[5, 5] = float("nan")
    found = gradients(scatter_blur, (color, alpha, radii), (torch.ones(11, 14, 3), torch.ones(11, 14)))
    blurred = scatter_blur(color, alpha, radii)[0]
    assert all(int((~torch.isfinite(part)).sum()) <= 3 for part in (blurred, found[0]))
