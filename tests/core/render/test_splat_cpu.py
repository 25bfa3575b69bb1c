"""The Numba renderer against the reference in float64, and that its result does not depend on threads.

α < 1/255 and T < 1e-4 are discontinuities: where rounding puts a pixel on the other side of one, its colour changes
by 1/255 of a splat, and its depth from 0 to all when no other splat is there. So images and gradients are compared
in norm, and the one pixel in 5,000 where the images differ most takes no part.
"""

from __future__ import annotations

import numba
import numpy as np
import pytest
import torch

from insideout.core.progress import Progress, Reporter
from insideout.core.render import splat
from insideout.core.render.kernels import cpu
from insideout.core.render.kernels.cpu import warm_up

VALUE, GRADIENT = 1e-4, 1e-3


@pytest.fixture
def assert_kernels_agree(make_scene, make_camera, render_and_differentiate, relative_error, all_but_flips):
    def check(count, seed, size, orthographic, distance=3.0, **options) -> None:
        pose = {"orthographic": orthographic, "trainable_pose": True, "distance": distance}
        kernels = [("cpu", torch.float32), ("reference", torch.float64)]
        inputs = [(make_scene(count, seed, dtype=dtype), make_camera(*size, seed=seed, **pose)) for _, dtype in kernels]
        options = {"background": [0.1, 0.5, 0.9], **options}
        with torch.no_grad():
            keep = all_but_flips(
                *(splat(*pair, kernel=kernel) for pair, (kernel, _) in zip(inputs, kernels, strict=True))
            )
        (image, grads), (truth, true_grads) = (
            render_and_differentiate(*pair, keep, kernel=kernel, **options)
            for pair, (kernel, _) in zip(inputs, kernels, strict=True)
        )
        for name in ("color", "alpha", "depth"):
            assert relative_error(getattr(image, name)[keep], getattr(truth, name)[keep]) < VALUE, name
        assert torch.equal(image.info.visible, truth.info.visible)
        assert relative_error(image.info.radii_px, truth.info.radii_px) < VALUE
        for name, grad in true_grads.items():
            assert relative_error(grads[name], grad) < GRADIENT, name

    return check


@pytest.mark.parametrize("orthographic", [False, True], ids=["perspective", "orthographic"])
@pytest.mark.parametrize("seed", range(6))
def test_image_and_gradients_are_the_references(assert_kernels_agree, seed: int, orthographic: bool) -> None:
    size = [(45, 37), (16, 16), (17, 33), (64, 48)][seed % 4]
    assert_kernels_agree([5, 60, 200][seed % 3], seed, size, orthographic)


@pytest.mark.parametrize("seed", range(4))
def test_they_agree_from_inside_the_cloud_where_the_jacobian_is_clamped(assert_kernels_agree, seed: int) -> None:
    assert_kernels_agree(60, seed, (45, 37), False, distance=0.3)


@pytest.mark.slow
@pytest.mark.parametrize("orthographic", [False, True], ids=["perspective", "orthographic"])
@pytest.mark.parametrize("seed", range(100, 130))
def test_image_and_gradients_are_the_references_on_more_scenes(
    assert_kernels_agree, seed: int, orthographic: bool
) -> None:
    assert_kernels_agree([1, 500, 2000][seed % 3], seed, (120, 90), orthographic)


@pytest.mark.parametrize("degree", range(4))
def test_sh_degree_limits_the_colour_functions_and_their_gradients(
    assert_kernels_agree, make_scene, make_camera, render_and_differentiate, degree: int
) -> None:
    assert_kernels_agree(40, 7, (40, 30), False, sh_degree=degree)
    _, grads = render_and_differentiate(make_scene(40, 7), make_camera(), sh_degree=degree)
    used = (degree + 1) ** 2
    assert float(grads["sh"][:, :used].abs().amax()) > 0
    assert not grads["sh"][:, used:].any()


def test_the_same_bits_on_any_number_of_threads(make_scene, make_camera, render_and_differentiate) -> None:
    available = numba.get_num_threads()
    results = []
    try:
        for threads in sorted({1, min(2, available), available}):
            numba.set_num_threads(threads)
            scene = make_scene(3000, 11, dtype=torch.float32)
            camera = make_camera(120, 90, seed=11, trainable_pose=True)
            image, grads = render_and_differentiate(scene, camera, kernel="cpu")
            results.append([image.color, image.alpha, image.depth, *grads.values()])
    finally:
        numba.set_num_threads(available)
    for result in results[1:]:
        for one, other in zip(results[0], result, strict=True):
            assert torch.equal(one, other)


def test_float64_sets_are_rendered_and_get_float64_gradients(make_scene, make_camera) -> None:
    scene = make_scene(dtype=torch.float64)
    image = splat(scene, make_camera(), kernel="cpu")
    image.color.sum().backward()
    assert scene.means.grad.dtype == torch.float64
    assert float(scene.means.grad.abs().sum()) > 0


@pytest.mark.parametrize("kernel", ["cpu", "reference"])
def test_screen_gradient_is_per_pixel_and_zero_for_what_is_not_visible(make_scene, make_camera, kernel: str) -> None:
    scene = make_scene(50, 2, degree=0, dtype=torch.float32)
    with torch.no_grad():
        scene.means[:10, 2] -= 20.0
    camera = make_camera(orthographic=True)
    image = splat(scene, camera, kernel=kernel)
    assert image.info.screen_grad is None
    assert not image.info.visible[:10].any()
    assert not image.info.radii_px[:10].any()
    weights = torch.from_numpy(np.random.default_rng(0).normal(size=(37, 45, 3))).float()
    (image.color * weights).sum().backward()
    assert image.info.screen_grad.shape == (50, 2)
    assert not image.info.screen_grad[:10].any()
    # In an orthographic view a step of the mean moves the centre by fx pixels and changes nothing else.
    focal = torch.tensor([camera.fx, camera.fy])
    torch.testing.assert_close(scene.means.grad[:, :2], image.info.screen_grad * focal, rtol=1e-4, atol=1e-5)


def test_what_the_caller_does_to_the_image_does_not_reach_the_gradients(make_scene, make_camera) -> None:
    def gradient(spoil: bool) -> torch.Tensor:
        scene = make_scene(dtype=torch.float32)
        image = splat(scene, make_camera())
        loss = (image.color * 2).sum()
        if spoil:
            image.color.detach().zero_()
        loss.backward()
        return scene.means.grad

    assert torch.equal(gradient(False), gradient(True))


def test_the_depth_of_a_lone_splat_is_its_own_whatever_its_opacity(make_scene, make_camera) -> None:
    """A quotient of two sums gives it up to rounding only, and a faint pixel divides that rounding by its alpha."""
    camera, scene = make_camera(), make_scene(1, dtype=torch.float32)
    image = splat(scene, camera)
    image.depth.sum().backward()
    pose = camera.world_to_camera
    (z,) = scene.means.detach().numpy().astype(np.float64) @ pose[2, :3] + pose[2, 3]
    seen = image.depth[image.alpha > 0]
    assert len(seen) > 20
    torch.testing.assert_close(seen, torch.full_like(seen, float(z)), rtol=1e-7, atol=0)
    assert scene.opacities.grad.tolist() == [0.0]
    assert not scene.scales.grad.any()


@pytest.mark.parametrize("compiled", [False, True])
def test_the_user_is_told_what_the_first_use_waits_for_unless_the_kernels_are_on_disk(monkeypatch, compiled) -> None:
    told: list[Progress] = []
    monkeypatch.setattr(cpu, "_on_disk", lambda kernel: compiled)
    cpu.announce(Reporter(told.append), Progress("surface", "rgb", 0.25), ("splat",))
    assert told == ([] if compiled else [Progress("surface", "rgb", 0.25, message="compiling kernels, once")])


def test_kernels_that_were_warmed_up_are_on_disk() -> None:
    warm_up()
    assert cpu.is_compiled(("splat", "radiograph", "section"))
