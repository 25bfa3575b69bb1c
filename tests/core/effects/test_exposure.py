"""Gains of light against photos made brighter, their gradients, and what they leave alone."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from insideout.core.effects import Exposure, PhotoEffects
from insideout.core.effects.exposure import ExposureImaging, before
from insideout.core.effects.numbers import PhotoNumbers
from insideout.core.errors import SettingError
from insideout.core.render import splat
from insideout.core.train.schedule import Decay

BACKGROUND = torch.tensor([0.74, 0.79, 0.84])


def draw(gaussians, camera):
    return splat(gaussians, camera, BACKGROUND)


def imaging(*gains):
    """The effect of photos with known gains (3,) of light."""
    return ExposureImaging(Exposure(), PhotoNumbers(torch.tensor(np.log(gains))))


@pytest.mark.parametrize("gain", [(0.5, 0.5, 0.5), (1.3, 1.2, 1.1)])
def test_it_shows_what_a_camera_shows(walls, optics, gain):
    """Off the black end of sRGB, which is no power, to a hundredth of white."""
    camera = walls.cameras[0]
    plain = optics.pinhole(walls.set, camera)
    truth = optics.to_srgb(np.clip(optics.to_linear(plain) * np.array(gain), 0, 1))
    with torch.no_grad():
        found = imaging(gain).render(0, draw, walls.set, camera).color.numpy()
    bright = plain > 0.2
    assert np.abs(found - truth)[bright].max() < 0.015
    assert found.max() <= 1.0


def test_without_a_gain_nothing_changes(walls):
    camera = walls.cameras[0]
    with torch.no_grad():
        found = imaging((1.0, 1.0, 1.0)).render(0, draw, walls.set, camera)
        plain = draw(walls.set, camera)
    torch.testing.assert_close(found.color, plain.color.clamp(max=1.0), rtol=0, atol=0)
    torch.testing.assert_close(found.alpha, plain.alpha, rtol=0, atol=0)


def test_what_was_put_behind_an_object_is_not_exposed(walls):
    """It is the same in all photos, the object is not; kept with the numbers, for the stages that follow."""
    camera, gain = walls.cameras[0], torch.tensor([0.7, 0.6, 0.8])
    settings = before([Exposure()], BACKGROUND.numpy(), True)[0]
    effect = ExposureImaging(settings, PhotoNumbers(2.2 * gain.log()[None]))
    again = ExposureImaging(Exposure(), PhotoNumbers(torch.zeros(1, 3)))
    again.restore(effect.state())
    with torch.no_grad():
        alone = splat(walls.set, camera, torch.zeros(3))
        behind = (1 - alone.alpha)[..., None] * BACKGROUND
        for one in (effect, again, again.alone(camera, 2.2 * gain.log())):
            found = one.render(0, draw, walls.set, camera).color
            torch.testing.assert_close(found, alone.color * gain + behind, rtol=0, atol=1e-5)


def test_what_an_older_version_learnt_of_cut_out_photos_is_shown_as_it_was_learnt(walls):
    older = imaging((0.5, 0.5, 0.5))
    state = {name: value for name, value in older.state().items() if name != "behind"}
    now = ExposureImaging(before([Exposure()], BACKGROUND.numpy(), True)[0], PhotoNumbers(torch.zeros(1, 3)))
    now.restore(state)
    with torch.no_grad():
        shown = [one.render(0, draw, walls.set, walls.cameras[0]).color for one in (older, now)]
    torch.testing.assert_close(shown[1], shown[0], rtol=0, atol=0)


def test_its_gradients_are_finite_differences(walls):
    camera, step = walls.cameras[0].resized(12, 12), 1e-3

    def total(numbers):
        effect = ExposureImaging(Exposure(), PhotoNumbers(torch.tensor(numbers)[None]))
        return effect, effect.render(0, draw, walls.set, camera).color.double().square().sum()

    at = np.array([-0.4, 0.05, -0.1])
    effect, loss = total(at)
    loss.backward()
    gradient = effect._numbers.row(0).grad.numpy()
    for channel in range(3):
        way = step * np.eye(3)[channel]
        slope = float(total(at + way)[1] - total(at - way)[1]) / (2 * step)
        assert gradient[channel] == pytest.approx(slope, rel=1e-2)


def test_the_mean_of_all_photos_stays_as_it_is(walls):
    """No photo tells how bright the object is."""
    effect = imaging((2.0, 1.0, 1.0), (0.5, 1.0, 1.0))
    image = effect.render(0, draw, walls.set, walls.cameras[0])
    image.color.sum().backward()
    effect.step(0, 0.0)
    gains = np.array(effect.report()["gain"])
    np.testing.assert_allclose(gains.prod(axis=0), 1, rtol=1e-12)
    assert gains[0, 0] < 2.0


def test_before_a_plain_background_its_colour_tells_how_bright_photos_are(walls):
    """It does not change; elsewhere all gains may be anything as long as the object's colours make up for it."""
    settings = before([Exposure()], BACKGROUND.numpy(), False)[0]
    assert settings == Exposure(plain=True)
    assert before([Exposure()], None, False) == (Exposure(),)
    effect = ExposureImaging(settings, PhotoNumbers(torch.full((2, 3), 0.5)))
    image = effect.render(0, draw, walls.set, walls.cameras[0])
    image.color.sum().backward()
    effect.step(0, 0.0)
    gains = np.array(effect.report()["gain"])
    np.testing.assert_allclose(gains[1], np.exp(0.5), rtol=1e-6)
    assert (gains[0] < np.exp(0.5)).all()


@pytest.mark.parametrize("color", [(0.0, 0.0, 0.0), (0.05, 0.9, 0.2), (1.0, 1.0, 1.0)])
def test_a_background_that_shows_no_exposure_tells_none(color):
    """Black cloth is as black in any, a green screen as free of red, and what is cut off at white as white."""
    assert before([Exposure()], np.float32(color), False) == (Exposure(),)


def test_it_comes_after_lens_and_shutter():
    """Light is weighed when it has arrived."""
    from insideout.core.effects import EFFECTS

    assert max(EFFECTS.values(), key=lambda effect: effect.order) is Exposure


def test_a_rate_that_is_none_is_refused(walls):
    with pytest.raises(SettingError, match=r"rate 0\.0 is not above 0"):
        PhotoEffects([Exposure(rate=Decay(0.0))], walls.cameras, 70.0)
