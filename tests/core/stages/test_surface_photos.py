"""Photos as they are trained on, and which of their pixels are the object."""

import numpy as np
import pytest
from PIL import Image

from insideout.core.capture.model import Photo
from insideout.core.stages.surface.photos import TrainingPhotos
from insideout.core.views import Camera

WALL = np.array([0.93, 0.93, 0.93], np.float32)


@pytest.fixture
def photos(tmp_path):
    """Four of a dark thing with a grey part that is a quarter of each, the last one at half the light; and the grey
    part from near, with a red detail."""

    def write():
        images = [np.tile(WALL, (60, 80, 1)) for _ in range(4)]
        for image in images:
            image[15:45, 20:60] = 0.2, 0.1, 0.1
            image[15:45, 40:60] = 0.6
        images[3] = images[3] * 0.75
        near = np.full((60, 80, 3), 0.6)
        near[20:32, 30:46] = 0.8, 0.2, 0.1
        for index, image in enumerate([*images, near]):
            path = tmp_path / f"{index}.png"
            Image.fromarray(np.round(255 * image).astype(np.uint8)).save(path)
            yield Photo(path, Camera(80, 60, 90.0, 90.0, 40.0, 30.0, np.eye(4)))

    return list(write())


def test_a_part_seen_from_near_is_all_object_and_another_exposure_keeps_its_outline(photos):
    training = TrainingPhotos(photos, 80, WALL)
    masks = [training.read(index)[2].numpy() for index in range(5)]
    assert [mask.mean() for mask in masks] == pytest.approx([0.25, 0.25, 0.25, 0.25, 1.0])
