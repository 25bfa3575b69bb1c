"""The rolling shutter against each row from its own camera, its gradients, and a camera that stands still."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation, Slerp

from insideout.core.effects import RollingShutter
from insideout.core.effects.numbers import PhotoNumbers
from insideout.core.effects.paths import row_poses
from insideout.core.errors import SettingError
from insideout.core.evaluate.metrics import psnr
from insideout.core.gaussians import GaussianSet
from insideout.core.render import splat

EXTENT = 70.0
BACKGROUND = torch.tensor([0.74, 0.79, 0.84])
# Radians and extents; some seven pixels from the first row to the last.
MOTION = torch.tensor([0.02, -0.03, 0.02, 0.03, 0.01, 0.02, 0.004, -0.003, 0.002, 0.01, -0.01, 0.005]).double()


def draw(gaussians, camera):
    return splat(gaussians, camera, BACKGROUND)


def moving(camera, numbers, **settings):
    """The effect for one photo with known numbers."""
    imaging = RollingShutter(**settings).start([camera], EXTENT)
    imaging._numbers = PhotoNumbers(numbers[None])
    return imaging


def still(imaging, gaussians, camera):
    with torch.no_grad():
        return imaging.render(0, draw, gaussians, camera)


@pytest.mark.parametrize(("tolerance", "least_db"), [(0.01, 70.0), (0.1, 36.0)])
def test_it_shows_each_row_from_its_own_camera(walls, optics, tolerance, least_db):
    camera = walls.cameras[0]
    poses = row_poses(camera.world_to_camera, MOTION, torch.arange(48) / 47, EXTENT).numpy()
    truth = optics.row_by_row(lambda view: optics.pinhole(walls.set, view), camera, poses)
    image = still(moving(camera, MOTION, tolerance_px=tolerance), walls.set, camera).color.clamp(0, 1).numpy()
    assert psnr(image, truth, 1.0) > least_db
    assert psnr(optics.pinhole(walls.set, camera), truth, 1.0) < 22


@pytest.mark.parametrize("kernel", ["cpu", "reference"])
def test_splats_much_larger_than_a_band_have_the_shape_of_the_whole_image(walls, kernel):
    """Near and long in depth, so that the slope at which each is projected decides its shape."""
    camera = walls.cameras[0].resized(24, 24)
    long = walls.truth.select(slice(None, None, 8))
    axis = long.means[:, :1] * 0 + np.array([[40.0, 60.0, 20.0]], np.float32)
    large = replace(long, scales=axis, opacities=0 * long.opacities + 0.2).to_torch()
    whole = splat(large, camera, BACKGROUND, kernel=kernel).color
    parts = [splat(large, camera.rows(row, row + 2), BACKGROUND, kernel=kernel).color for row in range(0, 24, 2)]
    torch.testing.assert_close(torch.cat(parts), whole, atol=2e-5, rtol=0)
    clipped = [
        splat(large, replace(camera.rows(row, row + 2), slopes=None), BACKGROUND, kernel=kernel).color
        for row in range(0, 24, 2)
    ]
    assert float((torch.cat(clipped) - whole).abs().max()) > 1e-3


def test_no_row_is_farther_from_its_place_than_the_tolerance(walls, monkeypatch):
    from insideout.core.effects import rolling_shutter

    camera, kept = walls.cameras[0], []

    def keep(draw, gaussians, bands, poses):
        kept.append((bands, poses))
        return draw_bands(draw, gaussians, bands, poses)

    draw_bands = rolling_shutter.draw_bands
    monkeypatch.setattr(rolling_shutter, "draw_bands", keep)
    still(moving(camera, MOTION), walls.set, camera)
    (bands, poses), row = kept[0], 0
    assert 1 < len(bands) < 48
    for band, pose in zip(bands, poses.numpy(), strict=True):
        rows = torch.arange(row, row + band.camera.height)
        row += band.camera.height
        for own in row_poses(camera.world_to_camera, MOTION, rows / 47, EXTENT).numpy():
            places = []
            for matrix in (pose, own):
                local = walls.truth.means[band.which] @ matrix[:3, :3].T + matrix[:3, 3]
                places.append(camera.fx * local[:, :2] / local[:, 2:])
            assert np.linalg.norm(places[0] - places[1], axis=1).max() < 0.1


@pytest.mark.parametrize(("motion", "round_mm"), [(3.0, None), (0.1, 2.5)])
def test_splats_left_out_of_a_band_do_not_reach_into_it(walls, monkeypatch, motion, round_mm):
    """Round splats reach as far down as across."""
    from insideout.core.effects import rolling_shutter

    camera = walls.cameras[3]
    imaging, some = (
        moving(camera, motion * MOTION, tolerance_px=0.02),
        walls.truth.select(slice(None, None, 5)).to_torch(),
    )
    if round_mm is not None:
        some = replace(some, scales=torch.full_like(some.scales, round_mm))
    few = still(imaging, some, camera)
    everything = torch.arange(len(some))
    monkeypatch.setattr(rolling_shutter, "members", lambda _, __, edges: [everything] * (len(edges) - 1))
    every = still(imaging, some, camera)
    for name in ("color", "alpha", "depth"):
        assert torch.equal(getattr(few, name), getattr(every, name))
    assert torch.equal(few.info.visible, every.info.visible)
    assert torch.equal(few.info.radii_px, every.info.radii_px)


def test_poses_are_slerped_and_lerped_between_the_ends(walls):
    given, times = walls.cameras[1].world_to_camera, np.linspace(0, 1, 7)
    poses = np.linalg.inv(row_poses(given, MOTION, torch.from_numpy(times), EXTENT).numpy())
    between = Slerp([0, 1], Rotation.from_matrix(poses[[0, -1], :3, :3]))(times)
    np.testing.assert_allclose(poses[:, :3, :3], between.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(
        poses[:, :3, 3], poses[0, :3, 3] + times[:, None] * (poses[-1, :3, 3] - poses[0, :3, 3]), atol=1e-9
    )
    turn = Rotation.from_matrix(poses[0, :3, :3].T @ poses[-1, :3, :3]).as_rotvec()
    np.testing.assert_allclose(np.linalg.norm(turn), np.linalg.norm(MOTION[:3]), rtol=1e-9)
    np.testing.assert_allclose(row_poses(given, 0 * MOTION, torch.tensor([0.0, 1.0]), EXTENT), [given] * 2, atol=1e-12)


def test_gradients_are_finite_differences_in_float64(walls):
    """By the motion and by the splats, through the reference kernel."""
    camera = walls.cameras[0].resized(16, 16)
    some = walls.truth.select(slice(None, None, 4)).to_torch(torch.float64)
    given = torch.randn(16, 16, 3, generator=torch.Generator().manual_seed(0)).double()

    def exact(gaussians, view):
        return splat(gaussians, view, BACKGROUND, kernel="reference")

    def loss(numbers, means, opacities):
        # Wide splats at which no threshold lies near: 1/255 is a step that differences would see.
        wide = replace(some, means=means, opacities=opacities, scales=6 * some.scales)
        imaging = moving(camera, numbers.detach(), tolerance_px=1e-9)
        imaging._numbers._shown[0] = numbers
        image = imaging.render(0, exact, wide, camera)
        return (image.color * given).sum() + 0.1 * image.alpha.sum() + 0.01 * image.depth.sum(), image

    start = MOTION, some.means, 0.3 * some.opacities
    leaves = [part.clone().requires_grad_(True) for part in start]
    value, image = loss(*leaves)
    value.backward()
    assert float(image.info.screen_grad.abs().sum()) > 0
    generator, step = torch.Generator().manual_seed(1), 1e-7
    for place, leaf in enumerate(leaves):
        way = torch.randn(leaf.shape, generator=generator, dtype=torch.float64)
        ends = []
        for sign in (1, -1):
            moved = [part + sign * step * way if i == place else part for i, part in enumerate(start)]
            ends.append(float(loss(*moved)[0].detach()))
        assert float((leaf.grad * way).sum()) == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-4), place


def test_gradients_of_the_fast_kernel_are_those_of_bands_by_autograd(walls):
    """Summed over bands as if each had been drawn from the whole set; screen gradients too."""
    camera = walls.cameras[0]
    imaging = moving(camera, MOTION, tolerance_px=0.5)
    given = torch.randn(48, 48, 3, generator=torch.Generator().manual_seed(0))
    means, weights = walls.set.means.clone().requires_grad_(True), torch.ones(len(walls.set), requires_grad=True)

    def faded(gaussians, view, weights):
        return splat(replace(gaussians, opacities=gaussians.opacities * weights), view, BACKGROUND)

    image = imaging.render(0, faded, replace(walls.set, means=means), camera, weights)
    (image.color * given).sum().backward()
    from insideout.core.effects import rolling_shutter

    kept = []
    original = rolling_shutter.draw_bands
    rolling_shutter.draw_bands = lambda *parts: kept.append(parts) or original(*parts)
    try:
        imaging.render(0, faded, walls.set, camera, weights.detach())
    finally:
        rolling_shutter.draw_bands = original
    own, whole, screen, row = (
        means.detach().clone().requires_grad_(True),
        torch.ones(len(means), requires_grad=True),
        0,
        0,
    )
    for band, pose in zip(kept[0][2], kept[0][3].detach(), strict=True):
        view = replace(band.camera, world_to_camera=pose)
        part = faded(replace(walls.set, means=own), view, whole)
        (part.color * given[row : row + view.height]).sum().backward()
        screen, row = screen + part.info.screen_grad, row + view.height
    for found, wanted in ((means.grad, own.grad), (weights.grad, whole.grad), (image.info.screen_grad, screen)):
        torch.testing.assert_close(found, wanted, atol=1e-5 * float(wanted.abs().max()), rtol=1e-4)


def test_a_camera_that_stands_still_gives_the_image_of_splat(walls):
    camera = walls.cameras[0]
    imaging, plain = RollingShutter().start([camera], EXTENT), draw(walls.set, camera)
    learning = imaging.render(0, draw, walls.set, camera)
    for name in ("color", "alpha", "depth"):
        assert torch.equal(getattr(still(imaging, walls.set, camera), name), getattr(plain, name))
        torch.testing.assert_close(getattr(learning, name).detach(), getattr(plain, name), atol=1e-6, rtol=1e-5)
    assert torch.equal(learning.info.visible, plain.info.visible)


def test_it_learns_to_move_from_standing_still(walls):
    camera = walls.cameras[0]
    imaging = RollingShutter(warm_up=0.0).start([camera], EXTENT)
    imaging.render(0, draw, walls.set, camera).color.square().sum().backward()
    imaging.step(0, 0.0)
    assert bool((imaging._numbers.values[0, :6] != 0).all())
    assert bool((imaging._numbers.values[0, 6:] == 0).all())


def test_neighbours_are_drawn_together(walls):
    imaging = RollingShutter(smoothness=1.0, warm_up=0.0).start(walls.cameras[:3], EXTENT)
    imaging._numbers.values[0, 1], imaging._numbers.values[2, 1] = 0.02, 0.02
    for _ in range(40):
        imaging.penalty(1).backward()
        imaging.step(1, 0.0)
    assert float(imaging._numbers.values[1, 1]) == pytest.approx(0.02, abs=0.005)
    assert imaging._numbers.values[0].tolist() == [0.0, 0.02, *[0.0] * 10]
    assert RollingShutter().start(walls.cameras[:1], EXTENT).penalty(0) is None


@pytest.mark.parametrize("height", [1, 2, 48])
def test_images_without_splats_and_of_one_row(walls, height):
    camera = replace(walls.cameras[0], height=height, cy=height / 2)
    for gaussians in (walls.set, GaussianSet.empty().to_torch()):
        means = gaussians.means.clone().requires_grad_(True)
        imaging = moving(camera, MOTION)
        image = imaging.render(0, draw, replace(gaussians, means=means), camera)
        image.color.sum().backward()
        assert image.color.shape == (height, 48, 3)
        assert bool(torch.isfinite(image.color).all())
        assert bool(torch.isfinite(means.grad).all())
        imaging.step(0, 1.0)
        assert bool(torch.isfinite(imaging._numbers.values).all())


def test_a_camera_amid_the_splats_gives_numbers(walls):
    """Splats behind it, in its plane and right before it."""
    camera = replace(walls.cameras[0], world_to_camera=np.eye(4))
    image = still(moving(camera, MOTION), walls.set, camera)
    assert bool(torch.isfinite(image.color).all())


def test_a_tolerance_of_nothing_is_refused(walls):
    with pytest.raises(SettingError, match="rolling shutter"):
        RollingShutter(tolerance_px=0.0).start(walls.cameras, EXTENT)
