"""Splats averaged over pixels: their energy stays where they move, whatever their shape, and gradients are finite."""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np
import pytest
import torch
from scipy.special import ndtr

from insideout.core.gaussians import GaussianSet
from insideout.core.render import splat
from insideout.core.render.kernels.reference import pixel_integral
from insideout.core.views import Camera

# Ten pixels are a unit at depth 2.
CAMERA = Camera(21, 21, 20.0, 20.0, 10.5, 10.5, np.eye(4))
VALUE, GRADIENT = 1e-4, 1e-3
# Of Φ's approximation, for wide splats 2 · 0.27 % in their middle and 1 % in their tails.
APPROXIMATION = 0.006
CASES = [(1, 0.1), (60, 0.1), (60, 0.01), (200, 0.02), (100, 0.5)]


# Those that have it, in the place of all of the fixture `kernel`.
on_each_kernel = pytest.mark.parametrize("kernel", ["reference-float64", "reference-float32", "cpu"], indirect=True)


def one(scale, mean=(0.0, 0.0, 2.0), degrees=0.0, opacity=0.8) -> GaussianSet:
    half = np.radians(degrees) / 2
    gaussians = GaussianSet.create(np.array([mean]), np.atleast_2d(scale), opacities=opacity)
    return replace(gaussians, quats=np.array([[np.cos(half), 0.0, 0.0, np.sin(half)]], np.float32))


def seen(gaussians, camera=CAMERA, kernel="cpu", dtype=torch.float32, **options):
    return splat(gaussians.to_torch(dtype), camera, kernel=kernel, pixel_integration=True, **options)


def true_alpha(sigma_x, sigma_y, dx=0.0, dy=0.0, opacity=0.8, size=21) -> np.ndarray:
    """The mean over each pixel of a splat along the axes, with exact distribution functions."""

    def mean(sigma, offset):
        x = np.arange(size) - (size - 1) / 2 - offset
        if sigma > 1e4:
            return np.exp(-0.5 * (x / sigma) ** 2)
        return np.sqrt(2 * np.pi) * sigma * (ndtr((x + 0.5) / sigma) - ndtr((x - 0.5) / sigma))

    return np.minimum(np.float32(opacity) * np.outer(mean(sigma_y, dy), mean(sigma_x, dx)), 0.99)


# Energy


@pytest.mark.parametrize("kernel_name", ["cpu", "reference"])
def test_a_splat_of_three_tenths_of_a_pixel_keeps_its_energy_wherever_it_is(kernel_name) -> None:
    """Of 2πσ²o, up to what lies in pixels of α < 1/255. With a value at each centre and no low-pass it would not."""
    whole, energies, sampled = 0.8 * 2 * np.pi * 0.3**2, [], []
    pixels = np.arange(21) - 10
    for dx in np.linspace(-0.5, 0.5, 6):
        for dy in np.linspace(-0.5, 0.5, 6):
            image = seen(one(0.03, (dx / 10, dy / 10, 2.0)), kernel=kernel_name)
            energies.append(float(image.alpha.sum()) / whole)
            squared = (pixels[:, None] - dy) ** 2 + (pixels[None] - dx) ** 2
            sampled.append(0.8 * np.exp(-0.5 * squared / 0.3**2).sum() / whole)
    assert 0.98 < min(energies) < max(energies) < 1.001
    assert max(sampled) - min(sampled) > 0.5


def test_the_low_pass_makes_a_splat_of_three_tenths_four_times_as_bright() -> None:
    plain = float(splat(one(0.03).to_torch(), CAMERA).alpha.sum())
    assert plain == pytest.approx(0.8 * 2 * np.pi * (0.3**2 + 0.3), rel=0.03)
    assert float(seen(one(0.03)).alpha.sum()) == pytest.approx(0.8 * 2 * np.pi * 0.3**2, rel=0.02)


@pytest.mark.parametrize("across", [0.005, 0.02, 0.1])
@pytest.mark.parametrize("ratio", [2.0, 10.0])
def test_a_slanted_splat_keeps_its_energy_at_every_angle(across, ratio, monkeypatch) -> None:
    """The differences telescope; all of it shows where nothing is skipped for faintness."""
    monkeypatch.setattr("insideout.core.render.kernels.reference.splat.ALPHA_MIN", 1e-12)
    camera = replace(CAMERA, width=121, height=121, cx=60.5, cy=60.5)
    for degrees in (0.0, 3.0, 20.0, 45.0, 71.0, 90.0):
        image = seen(one((across * ratio, across, 0.01), (0.013, 0.021, 2.0), degrees), camera, "reference")
        assert float(image.alpha.sum()) == pytest.approx(0.8 * 2 * np.pi * 100 * across**2 * ratio, rel=2e-3)


@pytest.mark.parametrize(
    ("across", "ratio", "most"), [(0.03, 2, 0.03), (0.03, 10, 0.05), (0.1, 5, 0.01), (0.3, 3, 0.01)]
)
def test_a_slanted_splat_is_nearly_its_mean_over_pixels(across, ratio, most) -> None:
    """Error in all pixels as a share of the energy, against 24² points a pixel."""
    camera, points = replace(CAMERA, width=61, height=61, cx=30.5, cy=30.5), (np.arange(24) + 0.5) / 24 - 0.5
    for degrees in (10.0, 37.0, 45.0, 80.0):
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        x = (np.arange(61)[:, None] - 30 + points).reshape(-1) - 0.13
        y = (np.arange(61)[:, None] - 30 + points).reshape(-1) - 0.21
        along, beside = c * x[None] + s * y[:, None], c * y[:, None] - s * x[None]
        density = np.exp(-0.5 * ((along / (10 * across * ratio)) ** 2 + (beside / (10 * across)) ** 2))
        truth = 0.8 * density.reshape(61, 24, 61, 24).mean(axis=(1, 3))
        image = seen(one((across * ratio, across, 0.01), (0.013, 0.021, 2.0), degrees), camera)
        error = np.abs(image.alpha.numpy() - np.where(truth >= 1 / 255, truth, 0.0)).sum()
        assert error < most * truth.sum() + 0.004 * 4, degrees


# Shapes


@on_each_kernel
@pytest.mark.parametrize("sigma", [0.05, 0.3, 1.0, 3.0, 30.0, 1e4, 1e9, 1e16, 3e38])
def test_a_round_splat_is_its_mean_over_each_pixel(photograph, sigma) -> None:
    """The rotation of a round splat and the size of a huge one have no part in it, nor in any gradient."""
    scale = np.float32(min(sigma / 10, 3e38))
    image = photograph(one(scale, (0.02, -0.01, 2.0)), CAMERA, pixel_integration=True)
    expected = true_alpha(*[np.float64(scale) * 10] * 2, 0.2, -0.1)
    np.testing.assert_allclose(image["alpha"], np.where(expected >= 1 / 255, expected, 0), atol=APPROXIMATION)
    assert np.abs(image.grads["quats"]).max() <= 1e-3 * np.abs(image.grads["scales"]).max() * scale + 1e-5


@on_each_kernel
@pytest.mark.parametrize(("sigma_x", "sigma_y"), [(0.2, 3.0), (3.0, 0.2), (1e4, 0.01), (0.01, 1e4), (0.7, 1e7)])
def test_a_needle_along_an_axis_is_its_mean_over_each_pixel(photograph, sigma_x, sigma_y) -> None:
    image = photograph(one((sigma_x / 10, sigma_y / 10, 1e-3), (0.02, -0.01, 2.0)), CAMERA, pixel_integration=True)
    expected = true_alpha(sigma_x, sigma_y, 0.2, -0.1)
    # The skip is a step: a pixel whose approximated α is on the other side of it is left out.
    tolerance = np.where(np.abs(expected - 1 / 255) < 2e-4, 1 / 200, APPROXIMATION)
    assert (np.abs(image["alpha"] - np.where(expected >= 1 / 255, expected, 0)) <= tolerance).all()


@on_each_kernel
@pytest.mark.parametrize("degrees", [1e-3, 30.0, 45.0, 89.999])
@pytest.mark.parametrize("ratio", [3.0, 1e2, 1e6])
def test_slanted_needles_are_finite_and_so_are_their_gradients(photograph, ratio, degrees) -> None:
    needle = one((1.0, max(1.0 / ratio, 1e-7), 1e-3), (0.02, -0.01, 2.0), degrees)
    image = photograph(needle, CAMERA, pixel_integration=True, gradient_rtol=1e-2)
    # In sum what a needle of so many pixels across has: nothing where that is a part in 255 of a pixel's area.
    assert image["alpha"].max() <= 0.8 + APPROXIMATION
    assert (image["alpha"].max() > 0) == (ratio < 1e4)


@on_each_kernel
def test_nearly_round_splats_have_no_gradient_that_grows_without_bound(photograph) -> None:
    """The eigenvectors' derivative is 1/(λ₁ − λ₂); here a turn of a nearly round splat does nearly nothing."""
    turns = []
    for apart in (1e-1, 1e-3, 1e-5):
        image = photograph(
            one((0.03, 0.03 * (1 + apart), 0.03), (0.013, 0.021, 2.0), 30.0), CAMERA, pixel_integration=True
        )
        turns.append(np.abs(image.grads["quats"]).max())
    assert turns[1] < 0.1 * turns[0] + 1e-5
    assert turns[2] < 0.1 * turns[0] + 1e-5


@on_each_kernel
@pytest.mark.parametrize("scale", [0.0, 1e-30, 1e-8, (0.3, 0.0, 0.0), (0.0, 0.3, 0.3)])
def test_what_has_no_area_on_the_screen_has_no_energy(photograph, scale) -> None:
    image = photograph(one(scale), CAMERA, pixel_integration=True)
    assert not image["alpha"].any()
    assert not image.info.visible.any()
    assert not any(grad.any() for grad in image.grads.values())


@pytest.mark.parametrize("sigma", [0.06, 0.1, 0.3, 2.0, 40.0])
@pytest.mark.parametrize("slant", [0.0, 30.0, 80.0])
def test_no_pixel_is_missed_where_tiles_meet(sigma, slant) -> None:
    """The kernel's footprint against the reference, which looks at every pixel for every splat."""
    camera = replace(CAMERA, width=50, height=50, cx=25.0, cy=25.0)
    rng = np.random.default_rng(3)
    for dx, dy in [
        *rng.uniform([6.0, -10.0], [8.0, -8.0], (12, 2)),
        (7.0, 7.0),
        (-9.0, 7.0),
        (24.9, 0.0),
        (0.0, -25.3),
    ]:
        splats = one((sigma / 10, sigma / 25 if slant else sigma / 10, 0.02), (dx / 10, dy / 10, 2.0), slant, 0.9)
        ours, truth = seen(splats, camera), seen(splats, camera, "reference", torch.float64)
        assert torch.equal(ours.info.visible, truth.info.visible)
        difference = (ours.alpha.double() - truth.alpha).abs()
        # Where rounding decides about the skip a pixel has all or nothing of 1/255.
        steps = (difference > 1e-5) & ((truth.alpha.clamp_min(ours.alpha.double()) - 1 / 255).abs() < 1e-5)
        assert float(difference[~steps].max()) < 1e-5


# Kernels and gradients


@pytest.mark.parametrize("count", [1, 3])
def test_gradients_agree_with_finite_differences(make_scene, make_camera, count) -> None:
    scene = make_scene(count=count, seed=3)
    scales = torch.exp(torch.randn(count, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)) * 0.3
    if count == 1:
        scales = torch.full((1, 3), 0.25, dtype=torch.float64)
    camera = make_camera(5, 4, seed=3)

    def render(means, quats, scales, opacities, sh, pose):
        moved = replace(scene, means=means, quats=quats, scales=scales, opacities=opacities, sh=sh)
        view = replace(camera, world_to_camera=pose)
        image = splat(moved, view, [0.2, 0.4, 0.6], kernel="reference", pixel_integration=True)
        return image.color.sum(-1) * weights + image.alpha * weights.flip(0) + image.depth * weights.flip(1)

    weights = torch.linspace(0.5, 1.5, 20, dtype=torch.float64).reshape(4, 5)
    pose = torch.tensor(camera.world_to_camera, requires_grad=True)
    inputs = (scene.means, scene.quats, scales.requires_grad_(), scene.opacities, scene.sh, pose)
    assert torch.autograd.gradcheck(render, inputs, eps=1e-6, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("orthographic", [False, True], ids=["perspective", "orthographic"])
@pytest.mark.parametrize(("count", "scale"), CASES)
def test_image_and_gradients_are_the_references(
    make_scene, make_camera, render_and_differentiate, relative_error, all_but_flips, count, scale, orthographic
) -> None:
    def drawn(kernel, dtype, keep=None):
        rng = np.random.default_rng(count)
        scales = np.exp(rng.normal(size=(count, 3)) * 0.7) * scale
        scene = make_scene(count, 1, dtype=dtype, scales=scales)
        camera = make_camera(45, 37, seed=1, orthographic=orthographic, trainable_pose=True)
        options = {"background": [0.1, 0.5, 0.9], "kernel": kernel, "pixel_integration": True}
        if keep is None:
            with torch.no_grad():
                return splat(scene, camera, **options)
        return render_and_differentiate(scene, camera, keep, **options)

    pair = ("cpu", torch.float32), ("reference", torch.float64)
    keep = all_but_flips(*(drawn(*one) for one in pair))
    (image, grads), (truth, true_grads) = (drawn(*one, keep) for one in pair)
    for name in ("color", "alpha", "depth"):
        assert relative_error(getattr(image, name)[keep], getattr(truth, name)[keep]) < VALUE, name
    assert torch.equal(image.info.visible, truth.info.visible)
    assert relative_error(image.info.radii_px, truth.info.radii_px) < VALUE
    for name, grad in true_grads.items():
        assert relative_error(grads[name], grad) < GRADIENT, name


def test_the_same_bits_on_any_number_of_threads(make_scene, make_camera, render_and_differentiate) -> None:
    available, results = numba.get_num_threads(), []
    try:
        for threads in (1, available):
            numba.set_num_threads(threads)
            scene, camera = make_scene(2000, 11, dtype=torch.float32), make_camera(90, 70, trainable_pose=True)
            image, grads = render_and_differentiate(scene, camera, pixel_integration=True)
            results.append([image.color, image.alpha, image.depth, *grads.values()])
    finally:
        numba.set_num_threads(available)
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_the_window_keeps_its_digits_however_wide_the_splat_is() -> None:
    """Against the difference itself in float64, and its limit exp(−½x²/σ²) where that has no digits left."""
    x = torch.linspace(-3, 3, 61, dtype=torch.float64)
    for sigma in (0.01, 0.3, 2.0, 50.0):
        low, high = ((x * 1.0 + side) / sigma for side in (-0.5, 0.5))
        phi = [torch.sigmoid(1.6 * at + 0.07 * at**3) for at in (low, high)]
        expected = np.sqrt(2 * np.pi) * sigma * (phi[1] - phi[0])
        found = pixel_integral.window(x, torch.tensor(1 / sigma, dtype=torch.float64))
        torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-12)
    wide = pixel_integral.window(1e12 * x, torch.tensor(1e-12, dtype=torch.float64))
    np.testing.assert_allclose(wide, np.exp(-0.5 * x**2), rtol=0.02, atol=5e-4)
