"""The Warp projection of splats and its gradients against the reference's, number by number."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

wp = pytest.importorskip("warp")

from insideout.core.render.kernels.cuda.splat_projection import lens_of, project, project_backward  # noqa: E402
from insideout.core.render.kernels.reference import splat as reference  # noqa: E402

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
LOW_PASS = 0.3


@pytest.fixture(params=[3.0, 0.3, None], ids=["from outside", "from inside", "orthographic"])
def camera(request, make_camera):
    """From inside the cloud some splats are behind the camera, and the clamp holds the slopes of others."""
    return make_camera(seed=3, orthographic=request.param is None, trainable_pose=True, distance=request.param or 3.0)


@pytest.fixture(params=[False, True], ids=["as bright", "fainter"])
def mip_filter(request):
    return request.param


@pytest.fixture
def projections(make_scene, camera, mip_filter):
    """The parameters of both projections, float64 leaves, and what becomes of them."""

    def make(degree: int):
        scene = make_scene(80, 4, degree=degree, dtype=torch.float64)
        scene.means.data[7], scene.quats.data[8], scene.opacities.data[9] = torch.nan, 0.0, 0.001
        scene = replace(scene, sh=scene.sh.detach().float().double().requires_grad_())
        leaves = (scene.means, scene.quats, scene.scales, scene.opacities, scene.sh, camera.world_to_camera)
        parameters = tuple(leaf.detach().to(DEVICE) for leaf in leaves)
        parameters = (*parameters[:4], parameters[4].float(), parameters[5])
        truth = reference.project(scene, camera, camera.world_to_camera, low_pass=LOW_PASS, mip_filter=mip_filter)
        lens = lens_of(camera, LOW_PASS, mip_filter)
        return scene, leaves, truth, parameters, project(parameters, lens, degree)

    return make


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_numbers_are_the_references(projections, camera, degree: int) -> None:
    scene, _, truth, _, found = projections(degree)
    drawn = found.depths.isfinite().cpu()
    assert torch.equal(drawn, (found.reach > 0).cpu())
    assert torch.equal(torch.sort(found.depths, stable=True).indices[: drawn.sum()].cpu(), truth.index)
    exact = {"rtol": 1e-10, "atol": 1e-12}
    for mine, expected in ((found.depths, truth.z), (found.centers, truth.centers), (found.factors, truth.factors)):
        torch.testing.assert_close(mine.cpu()[truth.index], expected.detach(), **exact)
    opacities, pose = truth.drawn(scene.opacities[truth.index]), camera.world_to_camera
    torch.testing.assert_close(found.shapes[:, 3].cpu()[truth.index], opacities.detach().float())
    colors = reference.view_colors(scene.means[truth.index], scene.sh[truth.index], camera, pose, degree)
    torch.testing.assert_close(
        found.features.cpu()[truth.index],
        torch.cat([colors, truth.z[:, None]], dim=1).detach().float(),
        rtol=1e-5,
        atol=1e-6,
    )
    info = reference._info(truth, opacities, camera, len(scene))
    assert torch.equal(found.visible.cpu(), info.visible)
    torch.testing.assert_close(found.radii.cpu(), info.radii_px.float())
    places = found.whole.cpu()[truth.index] + found.rests.cpu()[truth.index].double()
    torch.testing.assert_close(places, truth.centers.detach() - 0.5, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_gradients_are_the_references(projections, camera, mip_filter, relative_error, degree: int) -> None:
    scene, leaves, truth, parameters, _ = projections(degree)
    index, pose = truth.index, camera.world_to_camera
    colors = reference.view_colors(scene.means[index], scene.sh[index], camera, pose, degree)
    totals = torch.randn(len(index), 10, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    # With (p, q) = B d of an offset d, log α = log o − ½ (p² + q²): what its sums over pixels say of centre and B.
    (l1, k, l2), (h, hp, hq, hpp, hpq, hqq) = truth.factors.detach().unbind(1), totals[:, :6].unbind(1)
    to_centers = torch.stack([l1 * hp, k * hp + l2 * hq], dim=1)
    to_factors = -torch.stack([(hpp - k / l2 * hpq) / l1, hpq / l2, hqq / l2], dim=1)
    outputs = (truth.centers, truth.factors, truth.z, truth.drawn(scene.opacities[index]).log(), colors)
    expected = torch.autograd.grad(outputs, leaves, (to_centers, to_factors, totals[:, 9], h, totals[:, 6:9]))

    order = torch.cat([index, torch.ones(len(scene), dtype=torch.bool).index_fill(0, index, False).nonzero()[:, 0]])
    starts = torch.arange(len(scene) + 1).clamp_max(len(index))
    totals = torch.nn.functional.pad(totals, (0, 0, 0, len(scene) - len(index)))
    given = (tensor.to(DEVICE) for tensor in (order, starts, totals))
    found, screen = project_backward(parameters, lens_of(camera, LOW_PASS, mip_filter), degree, *given, want_pose=True)
    # Colours, and through them places and pose, have the digits of float32.
    for name, allowed, mine, theirs in zip(
        ("means", "quats", "scales", "opacities", "sh", "pose"), (1e-6, 1e-10, 1e-10, 1e-10, 1e-6, 1e-6), found,
        expected, strict=True,
    ):  # fmt: skip
        assert relative_error(mine.cpu(), theirs) < allowed, name
        assert mine.shape == theirs.shape
    torch.testing.assert_close(screen.cpu()[index], to_centers.float(), rtol=1e-5, atol=1e-6)
    assert not any(gradient[order[len(index) :]].any() for gradient in (*found[:5], screen))
