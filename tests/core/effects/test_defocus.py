"""Defocus against a lens made of many pinholes, its gradients, and cases where there is nothing to focus on."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from insideout.core.effects import Defocus
from insideout.core.effects.blur import scatter_blur
from insideout.core.effects.defocus import circles, disparity_image
from insideout.core.effects.numbers import PhotoNumbers
from insideout.core.errors import SettingError
from insideout.core.evaluate.metrics import psnr
from insideout.core.gaussians import GaussianSet
from insideout.core.render import splat
from insideout.core.views import Camera

EXTENT, RADIUS = 70.0, 30.0
DISTANCE, DEPTH = 200.0, 25.0
BACKGROUND = torch.tensor([0.74, 0.79, 0.84])


def draw(gaussians, camera):
    return splat(gaussians, camera, BACKGROUND)


def lens(camera, aperture, focus_depth, settings=None):
    """The effect for one photo with known numbers."""
    imaging = (settings or Defocus()).start([camera], EXTENT)
    imaging._numbers = PhotoNumbers(torch.tensor([[np.log(aperture), EXTENT / focus_depth, 0.05]]))
    return imaging


def shown(imaging, gaussians, camera):
    with torch.no_grad():
        return imaging.render(0, draw, gaussians, camera).color.numpy()


@pytest.mark.parametrize("focus", [DISTANCE - DEPTH, DISTANCE + DEPTH])
def test_it_shows_what_a_lens_shows(walls, optics, focus):
    camera = walls.cameras[0]
    truth = optics.through_lens(lambda view: optics.pinhole(walls.set, view), camera, RADIUS, focus)
    exact = camera.fx * RADIUS / (10 * EXTENT)
    errors = {}
    for factor in (0.0, 0.6, 0.8, 1.0, 1.25, 1.6):
        image = (
            optics.pinhole(walls.set, camera)
            if factor == 0
            else shown(lens(camera, factor * exact, focus), walls.set, camera)
        )
        errors[factor] = psnr(image, truth, 1.0)
    # A lens of radius R has K = f R / (10 extent): no other K is as near to it.
    assert max(errors, key=errors.get) == 1.0, errors
    assert errors[1.0] > errors[0.0] + 8


def test_a_wall_alone_is_shown_as_by_a_lens_to_half_a_percent(walls, optics):
    """No edge in depth: what is left is the shape of the circle and the gamma of 2."""
    camera, wall = walls.cameras[0], walls.set.select(slice(0, 196))
    wall = replace(wall, means=wall.means * torch.tensor([2.0, 1.0, 1.6]), scales=wall.scales * 2)
    truth = optics.through_lens(lambda view: optics.pinhole(wall, view), camera, RADIUS, DISTANCE)
    imaging = lens(camera, camera.fx * RADIUS / (10 * EXTENT), DISTANCE)
    middle = (slice(14, -14), slice(12, 30))
    sharp, blurred = optics.pinhole(wall, camera), shown(imaging, wall, camera)
    # Measured: 0.042 and 0.0027.
    assert np.abs(sharp - truth)[middle].mean() > 0.04
    assert np.abs(blurred - truth)[middle].mean() < 0.004


def test_a_smaller_image_has_smaller_circles(walls):
    """K is of the full width: at half of it the same lens has half the K."""
    camera = walls.cameras[0]
    half = camera.resized(24, 24)
    found = shown(lens(camera, 3.0, DISTANCE - DEPTH), walls.set, half)
    np.testing.assert_array_equal(found, shown(lens(half, 1.5, DISTANCE - DEPTH), walls.set, half))
    assert np.abs(found - shown(lens(half, 3.0, DISTANCE - DEPTH), walls.set, half)).max() > 0.1


def test_gradients_are_finite_differences_in_float64(walls, by_the_formula):
    """Through circles and disparity too: by depth, colour, log K and focus."""
    camera = walls.cameras[0].resized(12, 12)
    image = draw(walls.set, camera)
    alpha = 0.2 + 0.8 * image.alpha
    given = torch.randn(12, 12, 3, generator=torch.Generator().manual_seed(0))

    def loss(color, depth, log_aperture, focus, blur):
        disparity = disparity_image(depth, alpha.to(depth), EXTENT, 16)
        radii = circles(disparity, log_aperture.exp(), focus, 16.0)
        return (blur(color, alpha.to(depth), radii)[0] * given.to(depth)).sum()

    start = (image.color, image.depth.clamp_min(150), torch.tensor(0.7), torch.tensor(0.33))
    leaves = [part.detach().clone().requires_grad_(True) for part in start]
    loss(*leaves, scatter_blur).backward()
    generator, step = torch.Generator().manual_seed(1), 1e-5
    for place, leaf in enumerate(leaves):
        exact = [part.detach().double() for part in start]
        way = torch.randn(leaf.shape, generator=generator, dtype=torch.float64)
        ends = []
        for sign in (1, -1):
            moved = [part + sign * step * way if i == place else part for i, part in enumerate(exact)]
            ends.append(float(loss(*moved, by_the_formula)))
        slope = (ends[0] - ends[1]) / (2 * step)
        # What a depth lends to clear pixels beside it is taken as given.
        tolerance = 0.05 if place == 1 else 2e-3
        assert float((leaf.grad.double() * way).sum()) == pytest.approx(slope, rel=tolerance), place


def test_the_depth_of_splats_gets_a_gradient(walls):
    camera = walls.cameras[0]
    means = walls.set.means.clone().requires_grad_(True)
    image = lens(camera, 3.0, DISTANCE).render(0, draw, replace(walls.set, means=means), camera)
    image.color.sum().backward()
    assert float(means.grad.abs().max()) > 0
    assert image.info.screen_grad.shape == (len(walls.set), 2)


def test_a_closed_aperture_is_the_pinhole_itself(walls):
    camera = walls.cameras[0]
    imaging = Defocus(start_radius_px=0.0).start([camera], EXTENT)
    for name in ("color", "alpha", "depth"):
        found = getattr(imaging.render(0, draw, walls.set, camera), name)
        assert torch.equal(found, getattr(draw(walls.set, camera), name))
    tiny = lens(camera, 1e-12, DISTANCE)
    np.testing.assert_allclose(shown(tiny, walls.set, camera), draw(walls.set, camera).color, atol=1e-6)


def test_it_starts_with_the_circles_asked_for_and_the_focus_in_the_middle(walls):
    camera = walls.cameras[0]
    imaging = Defocus(start_radius_px=1.5).start([camera], EXTENT)
    imaging.render(0, draw, walls.set, camera)
    image = draw(walls.set, camera)
    seen = EXTENT / image.depth[image.alpha > 0.5]
    report = imaging.report()
    assert report["focus_disparity"][0] == pytest.approx(float(seen.mean()), rel=1e-4)
    assert 10 * report["aperture_tenths_px"][0] * float(seen.std()) == pytest.approx(1.5, rel=1e-2)


class TestNothingToFocusOn:
    def test_no_splats(self, walls):
        camera = walls.cameras[0]
        imaging = Defocus().start([camera], EXTENT)
        image = imaging.render(0, draw, GaussianSet.empty().to_torch(), camera)
        torch.testing.assert_close(image.color, BACKGROUND.expand(48, 48, 3))
        imaging.step(0, 1.0)
        assert imaging.report() == {"aperture_tenths_px": [None], "focus_disparity": [None]}

    def test_splats_seen_before_and_none_now(self, walls):
        camera = walls.cameras[0]
        assert np.isfinite(shown(lens(camera, 3.0, DISTANCE), GaussianSet.empty().to_torch(), camera)).all()

    def test_flat_depth(self):
        camera = Camera(20, 20, 20.0, 20.0, 10.0, 10.0, np.eye(4))
        x, y = np.meshgrid(np.linspace(-3, 3, 15), np.linspace(-3, 3, 15))
        flat = GaussianSet.create(np.stack([x.ravel(), y.ravel(), np.full(225, 5.0)], 1), 0.3).to_torch()
        imaging = Defocus(warm_up=0.0).start([camera], EXTENT)
        for _ in range(3):
            imaging.render(0, draw, flat, camera).color.sum().backward()
            imaging.step(0, 0.5)
        assert np.isfinite(shown(imaging, flat, camera)).all()
        assert np.isfinite(imaging.report()["aperture_tenths_px"][0])

    @pytest.mark.parametrize("depth", [float("inf"), 1e-3])
    def test_focus_at_infinity_and_before_the_lens(self, walls, depth):
        camera = walls.cameras[0]
        imaging = lens(camera, 1.0, depth)
        leaf = walls.set.means.clone().requires_grad_(True)
        image = imaging.render(0, draw, replace(walls.set, means=leaf), camera)
        (image.color.sum() + image.alpha.sum()).backward()
        assert bool(torch.isfinite(image.color).all())
        assert bool(torch.isfinite(leaf.grad).all())
        assert float((image.color.detach() - draw(walls.set, camera).color).abs().mean()) > 0.03

    def test_clear_pixels_take_the_disparity_beside_them(self):
        depth, alpha = torch.zeros(9, 40), torch.zeros(9, 40)
        depth[:, 3:6], alpha[:, 3:6] = 100.0, 1.0
        depth[:, 33:36], alpha[:, 33:36] = 50.0, 0.5
        found = disparity_image(depth, alpha, 100.0, 5.0)
        torch.testing.assert_close(found[:, :8], torch.ones(9, 8))
        torch.testing.assert_close(found[:, 31:], torch.full((9, 9), 2.0))
        torch.testing.assert_close(found[:, 20], torch.full((9,), 4 / 3))
        assert bool((disparity_image(torch.zeros(3, 4), torch.zeros(3, 4), 1.0, 5.0) == 0).all())


@pytest.mark.parametrize(
    "wrong", [{"start_radius_px": -1.0}, {"most_radius_px": 0.0}, {"most_radius_px": float("nan")}]
)
def test_settings_that_make_no_lens_are_refused(walls, wrong):
    with pytest.raises(SettingError, match="defocus"):
        Defocus(**wrong).start(walls.cameras, EXTENT)
