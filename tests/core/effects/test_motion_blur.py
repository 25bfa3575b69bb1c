"""Motion blur against the mean light of what a camera saw on its way, its gradients, and a camera that stands still."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from insideout.core.effects import MotionBlur, PhotoEffects
from insideout.core.effects.numbers import PhotoNumbers
from insideout.core.effects.paths import row_poses
from insideout.core.errors import SettingError
from insideout.core.evaluate.metrics import psnr
from insideout.core.gaussians import GaussianSet
from insideout.core.render import splat

EXTENT = 70.0
BACKGROUND = torch.tensor([0.74, 0.79, 0.84])
# Radians and extents; some six pixels in all.
MOTION = torch.tensor([0.02, -0.03, 0.02, -0.02, -0.02, 0.02]).double()


def draw(gaussians, camera):
    return splat(gaussians, camera, BACKGROUND)


def moving(camera, numbers, **settings):
    """The effect for one photo with known numbers."""
    imaging = MotionBlur(**settings).start([camera], EXTENT)
    imaging._numbers = PhotoNumbers(numbers[None])
    return imaging


def seen(imaging, gaussians, camera):
    with torch.no_grad():
        return imaging.render(0, draw, gaussians, camera)


def on_the_way(camera, count, motion=MOTION):
    """Cameras evenly over the motion."""
    numbers, times = torch.cat([motion, torch.zeros(6)]), (torch.arange(count) + 0.5) / count
    return [
        replace(camera, world_to_camera=pose)
        for pose in row_poses(camera.world_to_camera, numbers, times, EXTENT).numpy()
    ]


def blurred(walls, optics, camera, motion=MOTION):
    """The mean light of 32 views, at the gamma of screens."""
    light = [optics.to_linear(optics.pinhole(walls.set, view)) for view in on_the_way(camera, 32, motion)]
    return optics.to_srgb(np.mean(light, axis=0)).astype(np.float32)


def test_it_shows_the_mean_light_of_the_way(walls, optics):
    """By five to nine views instead of 32, and squares instead of the screens' own curve."""
    camera = walls.cameras[0]
    truth = blurred(walls, optics, camera)
    image = seen(moving(camera, MOTION), walls.set, camera).color.clamp(0, 1).numpy()
    assert psnr(image, truth, 1.0) > 34
    assert psnr(optics.pinhole(walls.set, camera), truth, 1.0) < 22


def test_forwards_and_backwards_are_the_same_photo(walls):
    camera = walls.cameras[1]
    there, back = (seen(moving(camera, sign * MOTION), walls.set, camera) for sign in (1, -1))
    torch.testing.assert_close(there.color, back.color, atol=1e-6, rtol=0)
    ends, turned = (moving(camera, sign * MOTION).ends(0) for sign in (1, -1))
    torch.testing.assert_close(ends, turned.flip(0))
    middle = np.asarray(camera.center)
    centers = [replace(camera, world_to_camera=pose.numpy()).center for pose in ends]
    np.testing.assert_allclose(np.mean(centers, axis=0), middle, atol=1e-9)


def test_as_many_views_as_the_motion_needs(walls):
    camera, drawn = walls.cameras[0], []

    def counted(gaussians, view):
        drawn.append(view)
        return draw(gaussians, view)

    counts = []
    for share in (0.01, 1.0, 10.0):
        drawn.clear()
        with torch.no_grad():
            moving(camera, share * MOTION).render(0, counted, walls.set, camera)
        counts.append(len(drawn))
    assert counts[0] == 5
    assert 5 < counts[1] <= 9
    assert counts[2] == 9


def test_gradients_are_finite_differences_in_float64(walls):
    """By the motion and by the splats, through the reference kernel. No two splats are equally far from this camera:
    which covers the other is a step, too."""
    camera = walls.cameras[3].resized(16, 16)
    some = walls.truth.select(slice(None, None, 4)).to_torch(torch.float64)
    given = torch.randn(16, 16, 3, generator=torch.Generator().manual_seed(0)).double()

    def exact(gaussians, view):
        return splat(gaussians, view, BACKGROUND, kernel="reference")

    def loss(numbers, means, opacities):
        # Wide splats at which no threshold lies near: 1/255 is a step that differences would see.
        wide = replace(some, means=means, opacities=opacities, scales=6 * some.scales)
        imaging = moving(camera, numbers.detach())
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


def test_gradients_of_the_fast_kernel_are_those_of_the_views_by_autograd(walls):
    camera = walls.cameras[0]
    given = torch.randn(48, 48, 3, generator=torch.Generator().manual_seed(0))
    means, own = (walls.set.means.clone().requires_grad_(True) for _ in range(2))
    image = moving(camera, MOTION, most_views=5).render(0, draw, replace(walls.set, means=means), camera)
    (image.color * given).sum().backward()
    parts = [draw(replace(walls.set, means=own), view) for view in on_the_way(camera, 5)]
    mixed = torch.stack([part.color.square() for part in parts]).mean(dim=0).sqrt()
    torch.testing.assert_close(image.color.detach(), mixed.detach(), atol=1e-6, rtol=0)
    (mixed * given).sum().backward()
    screen = sum(part.info.screen_grad for part in parts)
    for found, wanted in ((means.grad, own.grad), (image.info.screen_grad, screen)):
        torch.testing.assert_close(found, wanted, atol=1e-5 * float(wanted.abs().max()), rtol=1e-4)


def test_a_camera_that_stands_still_gives_the_image_of_splat(walls):
    camera = walls.cameras[0]
    imaging, plain = moving(camera, torch.zeros(6).double()), draw(walls.set, camera)
    for name in ("color", "alpha", "depth"):
        assert torch.equal(getattr(seen(imaging, walls.set, camera), name), getattr(plain, name))


def test_each_photo_starts_with_a_gradient_and_a_direction_of_its_own(walls):
    imaging = MotionBlur(warm_up=0.0).start(walls.cameras[:3], EXTENT)
    first = imaging._numbers.values.clone()
    for photo, camera in enumerate(walls.cameras[:3]):
        imaging.render(photo, draw, walls.set, camera).color.square().sum().backward()
        imaging.step(photo, 0.0)
    assert bool((imaging._numbers.values != first).all())
    ways = first[:, :2] * walls.cameras[0].fx
    torch.testing.assert_close(ways.norm(dim=1), torch.ones(3).double())
    assert float(torch.linalg.svdvals(ways).min()) > 0.3


def test_a_motion_is_found_whatever_direction_it_starts_in(walls, optics):
    """The splats as they are: the twist alone. It may come out backwards."""
    for index, camera in enumerate(walls.cameras[:3]):
        imaging = MotionBlur(warm_up=0.0).start([camera] * (index + 1), EXTENT)
        target = torch.from_numpy(blurred(walls, optics, camera))
        for step in range(80):
            (imaging.render(index, draw, walls.set, camera).color - target).abs().mean().backward()
            imaging.step(index, step / 80)
        image = seen_as(imaging, index, walls.set, camera)
        assert psnr(image, target.numpy(), 1.0) > 32


def seen_as(imaging, photo, gaussians, camera):
    with torch.no_grad():
        return imaging.render(photo, draw, gaussians, camera).color.clamp(0, 1).numpy()


def test_a_photo_can_be_fitted_without_a_training(walls, optics):
    """As a finished model is measured: the true splats, a photo and nothing else."""
    camera = walls.cameras[5]
    photo = blurred(walls, optics, camera)
    effects = PhotoEffects((MotionBlur(),), [camera], EXTENT)
    shown = effects.fitted(draw, walls.set, camera, torch.from_numpy(photo)).color.numpy()
    assert psnr(shown, photo, 1.0) > psnr(optics.pinhole(walls.set, camera), photo, 1.0) + 8


def test_a_sharp_photo_stays_sharp_when_it_is_fitted(walls, optics):
    """Of a camera that stood still while all others moved."""
    camera = walls.cameras[5]
    photo = optics.pinhole(walls.set, camera)
    effects = PhotoEffects((MotionBlur(start_px=4.0),), [walls.cameras[0]], EXTENT)
    shown = effects.fitted(draw, walls.set, camera, torch.from_numpy(photo)).color.clamp(0, 1).numpy()
    assert psnr(shown, photo, 1.0) > 40


def test_images_without_splats(walls):
    camera, empty = walls.cameras[0], GaussianSet.empty().to_torch()
    imaging = moving(camera, MOTION)
    image = imaging.render(0, draw, replace(empty, means=empty.means.requires_grad_(True)), camera)
    image.color.sum().backward()
    torch.testing.assert_close(image.color.detach(), BACKGROUND.expand(48, 48, 3), atol=1e-6, rtol=0)
    imaging.step(0, 1.0)
    assert bool(torch.isfinite(imaging._numbers.values).all())


def test_a_camera_amid_the_splats_gives_numbers(walls):
    camera = replace(walls.cameras[0], world_to_camera=np.eye(4))
    assert bool(torch.isfinite(seen(moving(camera, MOTION), walls.set, camera).color).all())


@pytest.mark.parametrize("wrong", [{"least_views": 1}, {"most_views": 4}, {"start_px": 0.0}, {"spacing_px": 0.0}])
def test_settings_that_make_no_motion_are_refused(walls, wrong):
    with pytest.raises(SettingError, match="motion blur"):
        MotionBlur(**wrong).start(walls.cameras, EXTENT)
