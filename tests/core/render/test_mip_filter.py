"""Splats that become fainter by as much as the low-pass makes them wider, on every kernel and in their gradients."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest
import torch

from insideout.core.gaussians import GaussianSet
from insideout.core.render import splat
from insideout.core.views import Camera

# Ten pixels are a unit at depth 2, and the middle of a pixel is looked at.
CAMERA = Camera(21, 21, 20.0, 20.0, 10.5, 10.5, np.eye(4))
KERNELS = ["cpu", "reference", *(["cuda"] if importlib.util.find_spec("warp") else [])]
VALUE, GRADIENT = 1e-4, 1e-3


def with_gradients(gaussians: GaussianSet) -> GaussianSet:
    scene = gaussians.to_torch()
    for name in ("means", "quats", "scales", "opacities"):
        getattr(scene, name).requires_grad_()
    return scene


def one(scale, opacity=0.8, x=0.0, y=0.0, quats=None) -> GaussianSet:
    return GaussianSet.create(np.array([[x, y, 2.0]]), np.atleast_2d(scale), quats=quats, opacities=opacity)


@pytest.mark.parametrize("kernel", KERNELS)
def test_a_round_splat_fades_by_the_area_it_gains(kernel) -> None:
    """Half a pixel wide: of ¼ px² in each direction become ¼ + 1/12, a share of ¾."""
    image = splat(one(0.05).to_torch(), CAMERA, kernel=kernel, low_pass=1 / 12, mip_filter=True)
    assert float(image.alpha[10, 10]) == pytest.approx(0.8 * 0.75, rel=1e-5)


@pytest.mark.parametrize("kernel", KERNELS)
def test_a_line_fades_by_its_width_alone(kernel) -> None:
    """A needle of 1000 x 0.5 pixels, turned by 30 degrees: √(¼ / (¼ + 1/12)) is left."""
    turned = [[np.cos(np.pi / 12), 0.0, 0.0, np.sin(np.pi / 12)]]
    scene = one([100.0, 0.05, 0.05], quats=np.array(turned)).to_torch()
    image = splat(scene, CAMERA, kernel=kernel, low_pass=1 / 12, mip_filter=True)
    assert float(image.alpha[10, 10]) == pytest.approx(0.8 * np.sqrt(0.75), rel=1e-4)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("scale", [0.05, 0.03, 0.02])
def test_a_splat_covers_as_much_of_an_image_however_small_it_is(kernel, scale) -> None:
    """Half to a fifth of a pixel, in the mean of 25 places in a pixel; what is under 1/255 is left out."""

    def covered(mip_filter: bool) -> float:
        places = 0.1 * np.arange(-0.4, 0.5, 0.2)
        sets = (one(scale, 0.9, x, y).to_torch() for x in places for y in places)
        options = {"kernel": kernel, "low_pass": 1 / 12, "mip_filter": mip_filter}
        return float(np.mean([float(splat(scene, CAMERA, **options).alpha.sum()) for scene in sets]))

    variance = (10 * scale) ** 2
    assert covered(True) == pytest.approx(0.9 * 2 * np.pi * variance, rel=0.06)
    assert covered(False) == pytest.approx(0.9 * 2 * np.pi * (variance + 1 / 12), rel=0.06)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("scale", [[1e-30, 1e-30, 1e-30], [1e-9, 10.0, 1e-9], [1e3, 1e-20, 1e3]])
def test_points_lines_and_sheets_from_the_side_are_not_seen(kernel, scale) -> None:
    scene = with_gradients(one(scale))
    image = splat(scene, CAMERA, kernel=kernel, low_pass=0.01, mip_filter=True)
    image.alpha.sum().backward()
    assert float(image.alpha.detach().max()) == 0.0
    assert not image.info.visible[0]
    assert not any(getattr(scene, name).grad.any() for name in ("means", "quats", "scales", "opacities"))


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize(
    "scale",
    [
        pytest.param([1e3, 1e3, 1e-20], id="sheet from the front"),
        pytest.param([1e3, 0.05, 0.05], id="needle"),
        pytest.param([1e3, 1.7e-4, 1e-20], id="hardly drawn needle"),
        pytest.param([2.1e-3, 2.1e-3, 1e-20], id="hardly drawn speck"),
        pytest.param([0.05, 0.05, 0.05], id="half a pixel"),
    ],
)
def test_gradients_by_scales_and_opacity_where_they_are_delicate(kernel, scale) -> None:
    """In the middle α = o·w₁w₂ / √((w₁² + ε)(w₂² + ε)), of widths of w pixels; so ∂α/∂log w = α·ε/(w² + ε)."""
    low_pass = 1 / 12
    scene = with_gradients(one(scale))
    image = splat(scene, CAMERA, kernel=kernel, low_pass=low_pass, mip_filter=True)
    image.alpha[10, 10].backward()
    left = low_pass / (np.square(10.0 * np.array(scale[:2])) + low_pass)
    alpha = 0.8 * float(np.sqrt(1 - left).prod())
    assert 1 / 255 < float(image.alpha[10, 10].detach()) == pytest.approx(alpha, rel=1e-4)
    assert float(scene.opacities.grad[0]) == pytest.approx(alpha / 0.8, rel=1e-4)
    by_log = (scene.scales.grad * scene.scales.detach())[0].double().numpy()
    np.testing.assert_allclose(by_log, [*(alpha * left), 0.0], rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("kernel", KERNELS)
def test_of_what_is_averaged_over_pixels_nothing_becomes_fainter(make_scene, make_camera, kernel) -> None:
    scene, camera = make_scene(dtype=torch.float32), make_camera(seed=1)
    one, other = (splat(scene, camera, kernel=kernel, pixel_integration=True, mip_filter=on) for on in (False, True))
    assert torch.equal(one.color, other.color)


@pytest.mark.parametrize("kernel", KERNELS)
def test_large_splats_are_as_they_were(kernel) -> None:
    scene = one(0.5).to_torch()
    plain, filtered = (splat(scene, CAMERA, kernel=kernel, low_pass=0.1, mip_filter=on).alpha for on in (False, True))
    assert 0.99 < float(filtered[10, 10] / plain[10, 10]) < 1.0


@pytest.mark.parametrize(
    ("kernel", "masked"), [("cpu", False), ("cpu", True), *([("cuda", False)] if "cuda" in KERNELS else [])]
)
@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize(("count", "seed", "low_pass"), [(60, 1, 1 / 12), (400, 3, 0.3)])
def test_image_and_gradients_are_the_references(
    make_scene, make_camera, render_and_differentiate, relative_error, all_but_flips, kernel, masked, orthographic,
    count, seed, low_pass,
) -> None:  # fmt: skip
    """Of splats from a tenth of a pixel on, the camera's own gradient among them."""

    def drawn(kernel, dtype, keep=None):
        scales = np.exp(np.random.default_rng(seed).normal(size=(count, 3))) * 0.02
        scene = make_scene(count, seed, dtype=dtype, scales=scales)
        camera = make_camera(seed=seed, orthographic=orthographic, trainable_pose=True)
        masks = torch.linspace(0, 1, count, dtype=dtype) if masked else None
        options = {"low_pass": low_pass, "mip_filter": True, "masks": masks, "kernel": kernel}
        return render_and_differentiate(scene, camera, keep, **options)

    keep = all_but_flips(drawn(kernel, torch.float32)[0], drawn("reference", torch.float64)[0])
    (ours, found), (truth, expected) = drawn(kernel, torch.float32, keep), drawn("reference", torch.float64, keep)
    assert relative_error(ours.color[keep], truth.color[keep]) < VALUE
    for name in found:
        assert relative_error(found[name], expected[name]) < GRADIENT, name


def test_the_references_gradients_are_those_of_differences(make_scene, make_camera) -> None:
    """In float64, of splats of a fifth of a pixel to two."""
    scales = np.exp(np.random.default_rng(2).normal(size=(12, 3)) * 0.7) * 0.03
    scene, camera = make_scene(12, 2, scales=scales), make_camera(15, 12, seed=2)
    weights = torch.from_numpy(np.random.default_rng(3).normal(size=(12, 15, 3)))

    def loss() -> torch.Tensor:
        image = splat(scene, camera, kernel="reference", low_pass=0.1, mip_filter=True)
        return (image.color * weights).sum()

    loss().backward()
    rng = np.random.default_rng(4)
    for name in ("means", "quats", "scales", "opacities"):
        field = getattr(scene, name)
        way = torch.from_numpy(rng.normal(size=tuple(field.shape))) * field.detach().abs().clamp_min(0.01)
        slope = float((field.grad * way).sum())
        values = []
        for sign in (1, -1):
            with torch.no_grad():
                field += sign * 1e-6 * way
                values.append(float(loss()))
                field -= sign * 1e-6 * way
        assert (values[0] - values[1]) / 2e-6 == pytest.approx(slope, rel=1e-5), name
