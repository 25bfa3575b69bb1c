"""Numbers of photos: Adam for the one that is shown, nothing for the others."""

import pytest
import torch

from insideout.core.effects.numbers import PhotoNumbers


def test_a_photo_moves_as_with_torch_and_the_others_stay():
    numbers = PhotoNumbers(torch.tensor([[1.0, 2.0], [3.0, 4.0]]))
    twin = torch.tensor([3.0, 4.0], dtype=torch.float64, requires_grad=True)
    adam = torch.optim.Adam([twin], lr=0.1, eps=1e-15)
    for step in range(5):
        for leaf in (numbers.row(1), twin):
            (leaf.sin() * (step + 1)).sum().backward()
        adam.step()
        adam.zero_grad()
        numbers.step(1, [0.1, 0.1])
    torch.testing.assert_close(numbers.values[1], twin.detach(), rtol=1e-12, atol=0)
    assert numbers.values[0].tolist() == [1.0, 2.0]


def test_each_number_has_its_rate_and_gradients_of_one_step_add_up():
    one, two = (PhotoNumbers(torch.zeros(1, 3)) for _ in range(2))
    for _ in range(2):
        one.row(0).sum().backward()
    one.step(0, [0.5, 0.0, 0.1])
    torch.testing.assert_close(one.values[0], torch.tensor([-0.5, 0.0, -0.1]).double())
    two.step(0, [1.0, 1.0, 1.0])
    assert two.values[0].tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("poison", [float("nan"), float("inf")])
def test_a_gradient_that_is_not_finite_moves_nothing(poison):
    numbers = PhotoNumbers(torch.zeros(1, 2))
    (numbers.row(0) * torch.tensor([poison, 1.0])).sum().backward()
    numbers.step(0, [1.0, 1.0])
    assert numbers.values[0].tolist() == [0.0, 0.0]
    numbers.row(0).sum().backward()
    numbers.forget_gradients()
    numbers.step(0, [1.0, 1.0])
    assert numbers.values[0].tolist() == [0.0, 0.0]


def test_numbers_of_other_photos_are_not_taken_up():
    with pytest.raises(ValueError, match="not of"):
        PhotoNumbers(torch.zeros(2, 3)).restore(PhotoNumbers(torch.zeros(3, 3)).state())
