"""The plain torch renderer is the truth for the others, so it is held against formulas and finite differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from insideout.core.errors import SettingError
from insideout.core.gaussians import GaussianSet
from insideout.core.render import splat
from insideout.core.render.kernels.reference.splat import sh_basis
from insideout.core.spherical_harmonics import rgb_to_sh
from insideout.core.spherical_harmonics import sh_basis as sh_basis_numpy
from insideout.core.views import Camera

RED, GREEN = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])


def on_axis(depths: list[float], opacities: list[float], colors: list[np.ndarray]) -> GaussianSet:
    """Round splats of σ = 0.1 behind each other on the axis of a camera at the origin."""
    means = np.array([[0.0, 0.0, depth] for depth in depths])
    sh = rgb_to_sh(np.array(colors))[:, None, :]
    return GaussianSet.create(means, 0.1, opacities=np.array(opacities), sh=sh).to_torch(torch.float64)


def front_camera(size: int = 21) -> Camera:
    return Camera(size, size, 20.0, 20.0, size / 2, size / 2, np.eye(4))


def test_one_splat_is_a_gaussian_of_the_projected_size_plus_the_low_pass() -> None:
    image = splat(on_axis([2.0], [0.8], [RED]), front_camera(), kernel="reference")
    variance = (0.1 * 20 / 2) ** 2 + 0.3
    for offset in (0, 1, 2, 3):
        alpha = 0.8 * np.exp(-0.5 * offset**2 / variance)
        assert float(image.alpha[10, 10 + offset]) == pytest.approx(alpha, rel=1e-6)
        assert float(image.color[10 + offset, 10, 0]) == pytest.approx(alpha, rel=1e-6)
    assert float(image.depth[10, 10]) == pytest.approx(2.0)
    assert float(image.info.radii_px[0]) == pytest.approx(3 * np.sqrt(variance), rel=1e-6)


def test_the_nearer_splat_covers_the_farther_whatever_their_order_and_the_background_shines_through() -> None:
    scene = on_axis([3.0, 2.0], [0.5, 0.6], [GREEN, RED])
    image = splat(scene, front_camera(), background=[0.0, 0.0, 1.0], kernel="reference")
    np.testing.assert_allclose(image.color[10, 10].numpy(), [0.6, 0.4 * 0.5, 0.4 * 0.5], rtol=1e-6)
    assert float(image.depth[10, 10]) == pytest.approx((0.6 * 2 + 0.2 * 3) / 0.8)


def test_alpha_is_capped_at_99_percent() -> None:
    image = splat(on_axis([2.0], [1.0], [RED]), front_camera(), kernel="reference")
    assert float(image.alpha[10, 10]) == pytest.approx(0.99)


def test_alpha_under_one_part_in_255_is_skipped() -> None:
    image = splat(on_axis([2.0], [1.0], [RED]), front_camera(), kernel="reference")
    seen = image.alpha[image.alpha > 0]
    assert float(seen.min()) >= 1 / 255 - 1e-12
    assert float(image.alpha[0, 0]) == 0.0


def test_a_pixel_is_finished_before_its_transmittance_would_fall_under_one_part_in_ten_thousand() -> None:
    image = splat(on_axis([2.0, 3.0, 4.0], [0.98, 0.98, 0.98], [RED] * 3), front_camera(), kernel="reference")
    assert float(image.alpha[10, 10]) == pytest.approx(1 - 0.02**2, rel=1e-9)


def test_splats_at_and_behind_the_near_plane_are_not_drawn() -> None:
    scene = on_axis([-1.0, 0.0, 0.005, 0.01], [1.0] * 4, [RED] * 4)
    image = splat(scene, front_camera(), kernel="reference")
    assert not image.info.visible.any()
    assert float(image.alpha.max()) == 0.0


def test_sh_basis_is_that_of_the_numpy_module() -> None:
    directions = np.random.default_rng(0).normal(size=(20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for degree in range(4):
        found = sh_basis(torch.from_numpy(directions), degree).numpy()
        np.testing.assert_allclose(found, sh_basis_numpy(directions, degree), atol=1e-12)


@pytest.mark.parametrize("orthographic", [False, True])
def test_gradients_agree_with_finite_differences(make_scene, make_camera, orthographic: bool) -> None:
    scene = make_scene(count=3, seed=3)
    scene = replace(scene, scales=(scene.scales.detach() * 2).requires_grad_())
    camera = make_camera(5, 4, seed=3, orthographic=orthographic)

    def render(means, quats, scales, opacities, sh, pose):
        moved = replace(scene, means=means, quats=quats, scales=scales, opacities=opacities, sh=sh)
        view = replace(camera, world_to_camera=pose)
        image = splat(moved, view, background=[0.2, 0.4, 0.6], kernel="reference")
        return image.color, image.alpha, image.depth

    pose = torch.tensor(camera.world_to_camera, requires_grad=True)
    inputs = (scene.means, scene.quats, scene.scales, scene.opacities, scene.sh, pose)
    assert torch.autograd.gradcheck(render, inputs, eps=1e-6, atol=1e-5, rtol=1e-4)


def test_wrong_settings_are_named(make_scene, make_camera) -> None:
    with pytest.raises(SettingError, match="kernel 'fast'"):
        splat(make_scene(2), make_camera(), kernel="fast")
    with pytest.raises(SettingError, match="0 x 10"):
        splat(make_scene(2), make_camera(0, 10))
