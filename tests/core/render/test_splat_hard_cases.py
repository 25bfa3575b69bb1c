"""Splats and cameras that break renderers: every value and every gradient stays finite, in both kernels."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from insideout.core.gaussians import GaussianSet
from insideout.core.render import splat

KERNELS = [("cpu", torch.float32), ("reference", torch.float64), ("reference", torch.float32)]


@pytest.fixture(params=KERNELS, ids=["cpu", "reference-float64", "reference-float32"])
def finite_render(request, make_scene, make_camera, render_and_differentiate):
    """Renders six random splats, some fields replaced, and checks that all that comes out is finite."""
    kernel, dtype = request.param

    def run(count=6, camera=None, edit=None, **fields):
        scene = make_scene(count, 1, dtype=dtype, **fields)
        if edit is not None:
            with torch.no_grad():
                edit(scene)
        camera = camera or make_camera(trainable_pose=True)
        image, grads = render_and_differentiate(scene, camera, kernel=kernel, background=[0.2, 0.3, 0.4])
        for name in ("color", "alpha", "depth"):
            assert torch.isfinite(getattr(image, name)).all(), name
        assert torch.isfinite(image.info.radii_px).all()
        for name, grad in grads.items():
            assert torch.isfinite(grad).all(), name
        return image, grads

    return run


def test_an_empty_set_shows_the_background(make_camera) -> None:
    for kernel in ("cpu", "reference"):
        image = splat(GaussianSet.empty(3).to_torch(), make_camera(), background=[0.2, 0.3, 0.4], kernel=kernel)
        assert image.color.shape == (37, 45, 3)
        np.testing.assert_allclose(image.color[20, 20].numpy(), [0.2, 0.3, 0.4], rtol=1e-6)
        assert not image.alpha.any()
        assert not image.depth.any()
        assert image.info.visible.shape == (0,)


def test_an_empty_set_that_is_trained_gets_empty_gradients(make_camera, finite_render) -> None:
    image, grads = finite_render(count=0)
    assert grads["means"].shape == (0, 3)
    assert not grads["pose"].any()
    assert not image.alpha.any()


def test_zero_scales_are_points_of_the_low_pass(finite_render) -> None:
    image, _ = finite_render(scales=np.zeros((6, 3)))
    assert image.alpha.max().item() > 0


def test_flat_splats_seen_edge_on(finite_render) -> None:
    image, _ = finite_render(scales=np.tile([0.3, 0.3, 0.0], (6, 1)), quats=np.tile([1.0, 1.0, 0, 0], (6, 1)))
    assert image.info.visible.all()


def test_huge_scales_are_finite(finite_render) -> None:
    finite_render(scales=np.full((6, 3), 1e8), opacities=np.full(6, 0.5))


def test_huge_scales_are_flat_over_the_image_in_float64_and_on_the_cpu(make_scene, make_camera) -> None:
    for kernel, dtype in KERNELS[:2]:
        scene = make_scene(6, 1, dtype=dtype, scales=np.full((6, 3), 1e8), opacities=np.full(6, 0.5))
        alpha = splat(scene, make_camera(), kernel=kernel).alpha.detach().numpy()
        np.testing.assert_allclose(alpha, 1 - 0.5**6, rtol=1e-6)


def test_scales_beyond_float32(finite_render) -> None:
    finite_render(scales=np.full((6, 3), 3e37))


def test_needles_a_million_times_longer_than_thick(finite_render) -> None:
    image, _ = finite_render(scales=np.tile([1e3, 1e-3, 1e-3], (6, 1)))
    assert image.alpha.max().item() > 0


def test_needles_lie_where_the_reference_puts_them(make_scene, make_camera, relative_error) -> None:
    """The conic of a slanted needle cancels in float32; the triangular factor does not."""
    images = [
        splat(
            make_scene(6, 1, dtype=dtype, scales=np.tile([1e3, 1e-3, 1e-3], (6, 1))),
            make_camera(120, 90),
            kernel=kernel,
        )
        for kernel, dtype in KERNELS[:2]
    ]
    assert relative_error(images[0].alpha, images[1].alpha) < 1e-3


@pytest.mark.parametrize("depth", [-7.0, 0.0, 0.05, 0.0999, 0.1, 0.1001, 0.11])
def test_splats_around_the_camera_and_at_the_near_plane(finite_render, depth: float) -> None:
    """The camera is at z = −3 and its near plane 0.1 in front of it; at 0.1 rounding decides."""

    def move(scene) -> None:
        scene.means[:, 2] = depth - 3.0
        scene.means[0, :2] = 0.0

    image, _ = finite_render(edit=move)
    if depth < 0.1:
        assert not image.info.visible.any()
    if depth > 0.1:
        assert image.info.visible[0]


def test_splats_far_outside_the_field_of_view_are_finite_and_clamped(finite_render) -> None:
    """At a slope of 40 the unclamped Jacobian would smear a splat across the image."""

    def move(scene) -> None:
        scene.means[:, 0] = 4.0
        scene.means[:, 2] = -2.89

    finite_render(edit=move)


def test_zero_quaternions_mean_no_rotation(finite_render) -> None:
    turned, grads = finite_render(quats=np.zeros((6, 4)))
    straight, _ = finite_render(quats=np.tile([1.0, 0, 0, 0], (6, 1)))
    assert torch.equal(turned.color, straight.color)
    assert not grads["quats"].any()


def test_quaternions_of_any_length_give_the_same_image(finite_render) -> None:
    quats = np.random.default_rng(0).normal(size=(6, 4))
    one, _ = finite_render(quats=quats)
    other, _ = finite_render(quats=1e6 * quats)
    np.testing.assert_allclose(one.color.detach().numpy(), other.color.detach().numpy(), atol=1e-5)


def test_transparent_splats_are_not_drawn(finite_render) -> None:
    image, grads = finite_render(opacities=np.zeros(6))
    assert not image.alpha.any()
    assert not image.info.visible.any()
    assert not grads["means"].any()


def test_opaque_splats_pass_no_gradient_under_the_cap(finite_render) -> None:
    """Saturated splats that fill the image: no pixel's α depends on them."""
    image, grads = finite_render(opacities=np.ones(6), scales=np.full((6, 3), 1e4))
    assert image.alpha.min().item() >= 0.99 - 1e-6
    assert not grads["opacities"].any()
    assert grads["sh"].any()


@pytest.mark.parametrize("field", ["means", "quats", "scales", "opacities", "sh"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_splats_with_a_non_finite_parameter_are_left_out(finite_render, field: str, value: float) -> None:
    def spoil(scene) -> None:
        getattr(scene, field)[2].view(-1)[0] = value

    image, grads = finite_render(edit=spoil)
    assert not image.info.visible[2]
    assert image.info.visible.sum() == 5
    assert not grads[field][2].any()


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (40, 1), (15, 17), (16, 16), (33, 31)])
def test_images_of_any_size(make_camera, finite_render, size) -> None:
    image, _ = finite_render(camera=make_camera(*size, trainable_pose=True))
    assert image.color.shape == (size[1], size[0], 3)


def test_many_identical_splats_are_blended_in_their_order(make_scene, make_camera, relative_error) -> None:
    fields = {"means": np.zeros((300, 3)), "opacities": np.full(300, 0.05)}
    images = [
        splat(make_scene(300, 4, dtype=dtype, **fields), make_camera(), kernel=kernel).color
        for kernel, dtype in KERNELS[:2]
    ]
    assert relative_error(*images) < 1e-4


def test_negative_colours_are_black_and_get_no_gradient(finite_render) -> None:
    sh = np.zeros((6, 1, 3))
    sh[:, 0] = -10.0
    image, grads = finite_render(sh=sh)
    assert image.color.min().item() >= 0.0
    assert not grads["sh"].any()
