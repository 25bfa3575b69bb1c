"""The Warp splat renderer against the reference in float64, on a card if there is one, else on Warp's CPU device.

`warp.config.enable_cpu_blocks` runs the blocks of 256 threads that a card runs, one thread a pixel, on the processor;
without it one thread goes through a tile's pixels.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

wp = pytest.importorskip("warp")

from insideout.core.gaussians import GaussianSet  # noqa: E402
from insideout.core.render import splat  # noqa: E402
from insideout.core.render.kernels.cpu import tiles as cpu_tiles  # noqa: E402
from insideout.core.render.kernels.cuda.tiles import bin_ellipses  # noqa: E402

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
VALUE, GRADIENT = 1e-4, 1e-3
PARAMETERS = ("means", "quats", "scales", "opacities", "sh")


@pytest.fixture(params=[False, True], ids=["a thread a tile", "a thread a pixel"])
def blocks(request, monkeypatch) -> None:
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", request.param)


def render(scene, camera, kernel: str, device: str, keep=None, **options):
    """The image, and the gradients of a random weighting of colour, alpha and depth."""
    leaves = {name: getattr(scene, name).detach().to(device).requires_grad_() for name in PARAMETERS}
    scene = replace(scene, density=scene.density.to(device), modality=scene.modality.to(device), **leaves)
    image = splat(scene, camera, kernel=kernel, **options)
    rng = np.random.default_rng(5)
    keep = torch.ones_like(image.alpha) if keep is None else keep.to(image.alpha)
    parts = (image.color * keep[..., None], image.alpha * keep, image.depth * keep)
    sum((part * torch.from_numpy(rng.normal(size=tuple(part.shape))).to(part)).sum() for part in parts).backward()
    grads = {name: leaf.grad for name, leaf in leaves.items()}
    grads["screen"] = image.info.screen_grad
    if isinstance(camera.world_to_camera, torch.Tensor):
        grads["pose"] = camera.world_to_camera.grad
    return image, {name: grad.cpu().double() for name, grad in grads.items()}


@pytest.fixture
def assert_kernels_agree(make_scene, make_camera, relative_error, all_but_flips):
    def check(count, seed, size, orthographic=False, distance=3.0, **options) -> None:
        options = {"background": [0.1, 0.5, 0.9], **options}

        def drawn(kernel, dtype, device, **more):
            pose = {"orthographic": orthographic, "trainable_pose": True, "distance": distance}
            camera = make_camera(*size, seed=seed, **pose)
            return render(make_scene(count, seed, dtype=dtype), camera, kernel, device, **options, **more)

        ours, reference = ("cuda", torch.float32, DEVICE), ("reference", torch.float64, "cpu")
        keep = all_but_flips(drawn(*ours)[0], drawn(*reference)[0])
        (image, grads), (truth, true_grads) = drawn(*ours, keep=keep), drawn(*reference, keep=keep)
        for name in ("color", "alpha", "depth"):
            found, expected = (getattr(seen, name).cpu()[keep] for seen in (image, truth))
            assert relative_error(found, expected) < VALUE, name
        assert torch.equal(image.info.visible.cpu(), truth.info.visible)
        assert relative_error(image.info.radii_px.cpu(), truth.info.radii_px) < VALUE
        for name, grad in true_grads.items():
            assert relative_error(grads[name], grad) < GRADIENT, name

    return check


@pytest.mark.parametrize("orthographic", [False, True], ids=["perspective", "orthographic"])
@pytest.mark.parametrize("seed", range(4))
def test_image_and_gradients_are_the_references(blocks, assert_kernels_agree, seed: int, orthographic: bool) -> None:
    size = [(45, 37), (16, 16), (17, 33), (64, 48)][seed]
    assert_kernels_agree([5, 60, 200][seed % 3], seed, size, orthographic)


@pytest.mark.slow
@pytest.mark.parametrize("orthographic", [False, True], ids=["perspective", "orthographic"])
@pytest.mark.parametrize("seed", range(100, 130))
def test_image_and_gradients_are_the_references_on_more_scenes(
    assert_kernels_agree, seed: int, orthographic: bool
) -> None:
    assert_kernels_agree([1, 500, 2000][seed % 3], seed, (120, 90), orthographic)


def test_they_agree_from_inside_the_cloud_where_the_jacobian_is_clamped(assert_kernels_agree) -> None:
    assert_kernels_agree(60, 1, (45, 37), distance=0.3)


@pytest.mark.parametrize("degree", [0, 2])
def test_sh_degree_limits_the_colour_functions(assert_kernels_agree, degree: int) -> None:
    assert_kernels_agree(40, 7, (40, 30), sh_degree=degree)


def test_pixels_that_are_full_before_the_last_splat(assert_kernels_agree) -> None:
    assert_kernels_agree(1500, 3, (33, 30))


def test_the_same_bits_every_time(make_scene, make_camera, blocks) -> None:
    camera = make_camera(70, 50, seed=11)
    scene = make_scene(400, 11, dtype=torch.float32)
    first, first_grads = render(scene, camera, "cuda", DEVICE)
    again, again_grads = render(scene, camera, "cuda", DEVICE)
    assert torch.equal(first.color, again.color)
    assert all(torch.equal(first_grads[name], again_grads[name]) for name in first_grads)


def test_a_saturated_splat_is_capped_and_passes_no_gradient_to_its_opacity(make_camera) -> None:
    one = GaussianSet.create(np.zeros((1, 3)), 1e4).to_torch()
    image, grads = render(one, make_camera(8, 8), "cuda", DEVICE)
    torch.testing.assert_close(image.alpha.cpu(), torch.full((8, 8), 0.99), rtol=0, atol=1e-6)
    assert not grads["opacities"].any()


@pytest.mark.parametrize(
    "fields",
    [
        {"scales": np.full((6, 3), [1e-8, 1e-8, 1e-2])},
        {"scales": np.full((6, 3), 1e8)},
        {"scales": np.full((6, 3), 3e37)},
        {"quats": np.zeros((6, 4))},
        {"scales": np.full((6, 3), [1e8, 0.1, 0.2])},
        {"scales": np.full((6, 3), [1e12, 0.1, 0.2])},
    ],
    ids=["needles", "huge", "larger than float32 holds", "zero quaternions", "long needles", "longer needles"],
)
def test_hard_splats_give_the_references_image_and_gradients(
    make_scene, make_camera, relative_error, fields: dict
) -> None:
    results = [
        render(make_scene(6, 4, dtype=dtype, **fields), make_camera(), kernel, device)
        for kernel, dtype, device in (("cuda", torch.float32, DEVICE), ("reference", torch.float64, "cpu"))
    ]
    (image, grads), (truth, true_grads) = results
    torch.testing.assert_close(image.color.cpu().double(), truth.color, rtol=1e-4, atol=1e-5)
    assert image.info.radii_px.isfinite().all()
    largest = max(float(grad.double().norm()) for grad in true_grads.values())
    for name, expected in true_grads.items():
        assert grads[name].isfinite().all(), name
        if float(expected.double().norm()) > 1e-6 * largest:
            assert relative_error(grads[name].cpu(), expected) < 1e-3, name


def test_splats_that_are_not_numbers_or_behind_the_camera_are_not_drawn(make_scene, make_camera) -> None:
    scene = make_scene(30, 2, degree=0, dtype=torch.float32)
    with torch.no_grad():
        scene.means[:10, 2] -= 20.0
        scene.scales[10:12] = torch.nan
    image, grads = render(scene, make_camera(), "cuda", DEVICE)
    assert not image.info.visible[:12].any()
    assert image.info.visible[12:].any()
    assert image.color.isfinite().all()
    assert all(not grad[:12].any() for grad in grads.values())


def test_an_empty_set_is_the_background(make_camera) -> None:
    image = splat(
        GaussianSet.empty(3).to_torch(device=DEVICE), make_camera(), background=[0.2, 0.3, 0.4], kernel="cuda"
    )
    torch.testing.assert_close(image.color.cpu(), torch.tensor([0.2, 0.3, 0.4]).expand(37, 45, 3))
    assert not image.alpha.any()
    assert not image.depth.any()


def test_what_the_caller_does_to_the_image_does_not_reach_the_gradients(make_scene, make_camera) -> None:
    def gradient(spoil: bool) -> torch.Tensor:
        scene = make_scene(dtype=torch.float32)
        image = splat(scene, make_camera(), kernel="cuda")
        loss = (image.color * 2).sum()
        if spoil:
            image.color.detach().zero_()
        loss.backward()
        return scene.means.grad

    assert torch.equal(gradient(False), gradient(True))


def test_tiles_are_those_of_the_cpu_kernel() -> None:
    rng = np.random.default_rng(3)
    count, width, height = 300, 100, 75
    centers = rng.uniform(-20, 120, (count, 2))
    factors = np.stack([rng.uniform(0.05, 1, count), rng.normal(size=count) * 0.3, rng.uniform(0.05, 1, count)], 1)
    reach = rng.uniform(-0.5, 3, count)
    factors, reach = factors.astype(np.float32), reach.astype(np.float32)
    expected = cpu_tiles.bin_ellipses(centers, factors, reach, np.arange(count, dtype=np.int32), width, height)
    ellipses = (torch.from_numpy(centers), torch.from_numpy(factors).double(), torch.from_numpy(reach).double())
    found = bin_ellipses(*ellipses, torch.arange(count), width, height)
    for name in ("starts", "splats", "slots", "slot_starts"):
        np.testing.assert_array_equal(getattr(found, name).numpy(), getattr(expected, name))
