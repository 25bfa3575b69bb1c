"""With how many images the numbers of a photo that was not trained on are begun, as forecasts count them."""

import pytest
import torch

from insideout.core.effects import EFFECTS
from insideout.core.render import splat


@pytest.mark.parametrize("name", EFFECTS)
def test_no_more_images_are_drawn_than_an_effect_says(name, walls):
    drawn = []

    def draw(gaussians, camera):
        drawn.append(camera)
        return splat(gaussians, camera, torch.zeros(3))

    imaging = EFFECTS[name]().start(walls.cameras, 70.0)
    begun = imaging.starts(draw, walls.set, walls.cameras[5])
    assert len(drawn) + len(begun) == EFFECTS[name].tries
