"""What lies behind the object is judged by the training photos alone."""

from __future__ import annotations

import numpy as np
from PIL import Image

from insideout.core.capture.model import Photo, Photos
from insideout.core.evaluate.photos import photo_background
from insideout.core.views import Camera


def test_held_out_photos_do_not_decide_the_background(tmp_path):
    photos = []
    for index in range(8):
        held_out = index % 2 == 0
        path = tmp_path / f"{index}.png"
        Image.new("RGB", (40, 30), (0, 0, 0) if held_out else (200, 180, 160)).save(path)
        photos.append(Photo(path, Camera(40, 30, 50.0, 50.0, 20.0, 15.0, np.eye(4)), held_out))
    np.testing.assert_allclose(photo_background(Photos(photos)), np.array([200, 180, 160]) / 255, atol=1e-6)
