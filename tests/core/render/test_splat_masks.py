"""Masks: a splat masked out is not seen and still gets the gradient of being seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from insideout.core.errors import SettingError
from insideout.core.render import splat

VALUE, GRADIENT = 1e-4, 1e-3


def a_mask(count, dtype, values="drawn"):
    numbers = np.random.default_rng(4).random(count)
    if values == "drawn":
        numbers = numbers > 0.4
    return torch.from_numpy(numbers.astype(float)).to(dtype).requires_grad_()


@pytest.mark.parametrize("kernel", ["cpu", "reference"])
def test_masked_splats_are_not_seen_at_all(make_scene, make_camera, kernel) -> None:
    scene, masks = make_scene(60, 1), a_mask(60, torch.float64)
    image = splat(scene, make_camera(), [0.1, 0.5, 0.9], kernel=kernel, masks=masks)
    kept = scene.to_numpy().select(masks.detach().numpy() > 0)
    alone = splat(kept.to_torch(torch.float64), make_camera(), [0.1, 0.5, 0.9], kernel=kernel)
    for name in ("color", "alpha", "depth"):
        torch.testing.assert_close(getattr(image, name), getattr(alone, name), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("kernel", ["cpu", "reference"])
def test_masks_of_one_change_nothing(make_scene, make_camera, render_and_differentiate, kernel) -> None:
    results = []
    for masks in (None, torch.ones(60)):
        scene = make_scene(60, 1, dtype=torch.float32)
        image, grads = render_and_differentiate(scene, make_camera(), kernel=kernel, masks=masks)
        results.append([image.color.double(), image.alpha.double(), image.depth.double(), *grads.values()])
    for plain, masked in zip(*results, strict=True):
        torch.testing.assert_close(plain, masked, rtol=1e-5, atol=1e-5 * float(plain.detach().abs().max()))


@pytest.mark.parametrize("values", ["drawn", "between"])
def test_gradients_agree_with_finite_differences(make_scene, make_camera, values) -> None:
    scene, masks = make_scene(count=4, seed=3), a_mask(4, torch.float64, values)
    scene = replace(scene, scales=scene.scales.detach() * 2)
    camera, weights = make_camera(5, 4, seed=3), torch.linspace(0.5, 1.5, 20, dtype=torch.float64).reshape(4, 5)

    def render(means, opacities, masks):
        image = splat(replace(scene, means=means, opacities=opacities), camera, kernel="reference", masks=masks)
        # Where nothing is seen depth is 0, whatever the mask of a splat there is about to become.
        depth = 0 if values == "drawn" else image.depth
        return image.color.sum(-1) * weights + image.alpha * weights.flip(0) + depth * weights.flip(1)

    inputs = (scene.means, scene.opacities, masks)
    assert torch.autograd.gradcheck(render, inputs, eps=1e-6, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("kernel", ["cpu", "reference"])
def test_a_masked_splat_gets_what_it_would_add_over_what_is_behind(make_scene, make_camera, kernel) -> None:
    """∂C/∂m = α T (c − C_behind), from two pictures: the image is linear in one splat's mask."""
    weights = torch.from_numpy(np.random.default_rng(0).normal(size=(37, 45, 3))).float()

    def loss(first, wanted=False):
        masks = torch.ones(30)
        masks[0] = first
        masks.requires_grad_(wanted)
        scene = make_scene(30, 5, dtype=torch.float32)
        # No pixel is finished, or the mask would also decide about what is behind.
        scene = replace(scene, opacities=0.2 * scene.opacities.detach())
        total = (splat(scene, make_camera(), [0.3, 0.2, 0.1], kernel=kernel, masks=masks).color * weights).sum()
        if wanted:
            total.backward()
            return masks.grad
        return float(total.detach())

    slope = loss(1.0) - loss(0.0)
    assert abs(slope) > 0.01
    for first in (0.0, 1.0):
        assert float(loss(first, True)[0]) == pytest.approx(slope, rel=1e-3)


def test_a_capped_splats_mask_has_a_gradient_though_its_opacity_has_none(make_scene, make_camera) -> None:
    scene = make_scene(1, opacities=[1.0], scales=[[50.0] * 3], dtype=torch.float32)
    masks = torch.zeros(1, requires_grad=True)
    splat(scene, make_camera(), masks=masks).alpha.sum().backward()
    assert float(masks.grad) == pytest.approx(0.99 * 45 * 37, rel=1e-4)
    assert not scene.opacities.grad.any()


@pytest.mark.parametrize("integrated", [False, True], ids=["points", "integrals"])
@pytest.mark.parametrize("values", ["drawn", "between"])
@pytest.mark.parametrize(("count", "seed"), [(5, 0), (60, 1), (200, 2), (400, 3)])
def test_image_and_gradients_are_the_references(
    make_scene, make_camera, relative_error, all_but_flips, count, seed, values, integrated
) -> None:
    def drawn(kernel, dtype):
        scene, masks = make_scene(count, seed, dtype=dtype), a_mask(count, dtype, values)
        camera = make_camera(45, 37, seed=seed)
        image = splat(scene, camera, [0.1, 0.5, 0.9], kernel, masks=masks, pixel_integration=integrated)
        return image, scene, masks

    ours, truth = drawn("cpu", torch.float32), drawn("reference", torch.float64)
    keep = all_but_flips(ours[0], truth[0])
    weights = torch.from_numpy(np.random.default_rng(5).normal(size=(37, 45, 5))) * keep[..., None]
    for image, *_ in (ours, truth):
        parts = torch.cat([image.color, image.alpha[..., None], image.depth[..., None]], -1)
        (parts * weights.to(parts)).sum().backward()
    for name in ("color", "alpha", "depth"):
        assert relative_error(getattr(ours[0], name)[keep], getattr(truth[0], name)[keep]) < VALUE, name
    masked = truth[2].detach() == 0
    for name in ("means", "quats", "scales", "opacities", "sh"):
        found, expected = getattr(ours[1], name).grad, getattr(truth[1], name).grad
        assert relative_error(found, expected) < GRADIENT, name
        assert not found[masked].any()
    assert relative_error(ours[2].grad, truth[2].grad) < GRADIENT
    if values == "drawn":
        assert relative_error(ours[2].grad[masked], truth[2].grad[masked]) < GRADIENT
        assert (ours[2].grad[masked] != 0).sum() >= 1


def test_as_many_masks_as_splats(make_scene, make_camera) -> None:
    with pytest.raises(SettingError, match="one for each of 4"):
        splat(make_scene(4), make_camera(), masks=torch.ones(3))


@pytest.mark.parametrize("options", [{"masks": torch.ones(4)}, {"pixel_integration": True}], ids=["masks", "pixels"])
def test_what_the_card_does_not_draw_the_processor_does(make_scene, make_camera, options) -> None:
    found, expected = (splat(make_scene(4), make_camera(), kernel=kernel, **options) for kernel in ("cuda", "cpu"))
    assert torch.equal(found.color, expected.color)


def test_an_empty_set_is_the_background(make_camera, make_scene) -> None:
    image = splat(make_scene(0), make_camera(), [0.1, 0.5, 0.9], masks=torch.zeros(0, requires_grad=True))
    image.color.sum().backward()
    assert not image.alpha.any()
