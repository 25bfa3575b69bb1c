"""How much splats are widened in images: as 3DGS does, or less, on every kernel and in their gradients."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from insideout.core.errors import SettingError
from insideout.core.gaussians import GaussianSet
from insideout.core.render import splat
from insideout.core.views import Camera

# Ten pixels are a unit at depth 2, and the middle of a pixel is looked at.
CAMERA = Camera(21, 21, 20.0, 20.0, 10.5, 10.5, np.eye(4))
VALUE, GRADIENT = 1e-4, 1e-3


def one(scale, opacity=0.8) -> GaussianSet:
    return GaussianSet.create(np.array([[0.0, 0.0, 2.0]]), np.atleast_2d(scale), opacities=opacity)


@pytest.mark.parametrize("kernel", ["cpu", "reference"])
@pytest.mark.parametrize("low_pass", [0.01, 1 / 12, 0.3])
@pytest.mark.parametrize("masked", [False, True])
def test_a_splats_variance_grows_by_it(kernel, low_pass, masked) -> None:
    """A splat of half a pixel: α falls from its middle as exp(−x² / 2(¼ + ε))."""
    masks = torch.ones(1) if masked else None
    image = splat(one(0.05).to_torch(), CAMERA, kernel=kernel, low_pass=low_pass, masks=masks)
    expected = 0.8 * np.exp(-0.5 * np.arange(2) ** 2 / (0.25 + low_pass))
    np.testing.assert_allclose(image.alpha[10, 10:12].detach(), expected, rtol=1e-5)


def test_if_not_told_it_is_that_of_3dgs(make_scene, make_camera) -> None:
    scene, camera = make_scene(dtype=torch.float32), make_camera(seed=1)
    assert torch.equal(splat(scene, camera).color, splat(scene, camera, low_pass=0.3).color)
    assert not torch.equal(splat(scene, camera).color, splat(scene, camera, low_pass=0.1).color)


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("low_pass", [0.01, 0.1])
@pytest.mark.parametrize(("count", "seed"), [(60, 1), (400, 3)])
def test_image_and_gradients_are_the_references(
    make_scene, make_camera, relative_error, all_but_flips, count, seed, low_pass, masked
) -> None:
    """Of splats from a tenth of a pixel on."""

    def drawn(kernel, dtype):
        scales = np.exp(np.random.default_rng(seed).normal(size=(count, 3))) * 0.02
        scene = make_scene(count, seed, dtype=dtype, scales=scales)
        masks = torch.linspace(0, 1, count, dtype=dtype) if masked else None
        image = splat(scene, make_camera(seed=seed), [0.1, 0.5, 0.9], kernel, low_pass=low_pass, masks=masks)
        return image, scene

    ours, truth = drawn("cpu", torch.float32), drawn("reference", torch.float64)
    keep = all_but_flips(ours[0], truth[0])
    weights = torch.from_numpy(np.random.default_rng(5).normal(size=(37, 45, 3))) * keep[..., None]
    for image, _ in (ours, truth):
        (image.color * weights.to(image.color)).sum().backward()
    assert relative_error(ours[0].color[keep], truth[0].color[keep]) < VALUE
    for name in ("means", "quats", "scales", "opacities", "sh"):
        assert relative_error(getattr(ours[1], name).grad, getattr(truth[1], name).grad) < GRADIENT, name


@pytest.mark.parametrize("kernel", ["cpu", "reference"])
@pytest.mark.parametrize("scale", [[1e-30, 1e-30, 1e-30], [1e-9, 10.0, 1e-9], [1e3, 1e3, 1e-20]])
def test_specks_needles_and_sheets_have_finite_gradients(kernel, scale) -> None:
    scene = one(scale).to_torch()
    for name in ("means", "quats", "scales", "opacities"):
        getattr(scene, name).requires_grad_()
    image = splat(scene, CAMERA, kernel=kernel, low_pass=0.01)
    image.alpha.sum().backward()
    alpha = image.alpha.detach()
    assert torch.isfinite(alpha).all()
    assert float(alpha[10, 10]) == pytest.approx(0.8, rel=1e-5)
    for name in ("means", "quats", "scales", "opacities"):
        assert torch.isfinite(getattr(scene, name).grad).all(), name


@pytest.mark.parametrize("low_pass", [0.0, 0.009, 0.31, -0.1, float("nan"), float("inf")])
def test_what_is_less_or_more_than_makes_sense_is_refused(low_pass) -> None:
    with pytest.raises(SettingError, match=r"choose 0\.01 to 0\.3"):
        splat(one(0.1).to_torch(), CAMERA, low_pass=low_pass)
