"""What `check` says: how far an object reaches beyond the detector, and how far photos are from the origin."""

import numpy as np
import pytest
from PIL import Image

from insideout.core.capture.describe import cut_off_share, describe_photos, describe_volume
from insideout.core.capture.model import Photo, Photos
from insideout.core.densities import PER_MM, Densities
from insideout.core.views import Camera
from insideout.core.volume import Volume


def views(width, height=6):
    """Four projections of a slab as wide as the detector, of which one ends before its sides."""
    images = np.ones((4, height, width), np.float32)
    images[0, :, :2] = images[0, :, -2:] = 0.0
    return images


def test_it_is_the_share_of_views_whose_object_reaches_the_side():
    assert cut_off_share(views(12), axis=2) == 0.75


@pytest.mark.parametrize(("width", "height"), [(1, 6), (2, 6), (6, 1), (1, 1)])
def test_a_detector_of_one_row_or_column_has_edges_too(width, height):
    images = np.ones((3, height, width), np.float32)
    assert cut_off_share(images, axis=2) == cut_off_share(images, axis=1) == 1.0
    assert cut_off_share(0 * images, axis=2) == 0.0


@pytest.mark.parametrize(("easting_m", "told"), [(0.0, False), (5e3, False), (5e5, True)])
def test_cameras_in_map_coordinates_are_warned_of(easting_m, told, tmp_path):
    photos = []
    for index in range(8):
        Image.new("RGB", (16, 12)).save(tmp_path / f"{index}.png")
        pose = np.eye(4)
        pose[:3, 3] = [-easting_m - index, 0, 2]
        photos.append(Photo(tmp_path / f"{index}.png", Camera(16, 12, 20.0, 20.0, 8.0, 6.0, pose)))
    findings = describe_photos(tmp_path, Photos(photos), "transforms.json")
    assert any("units from the origin" in str(finding.message) for finding in findings) is told


@pytest.mark.parametrize(
    ("densities", "told"),
    [
        (PER_MM, "attenuation 0 to 0.05 mm⁻¹"),
        (Densities(water_per_mm=0.02), "attenuation 0 to 0.05 mm⁻¹"),
        (Densities(relative=True), "relative densities 0 to 0.05"),
    ],
)
def test_grey_values_of_a_volume_have_no_unit(densities, told, tmp_path):
    values = np.linspace(0, 0.05, 8, dtype=np.float32).reshape(2, 2, 2)
    (found, *_) = describe_volume(tmp_path, Volume.centered(values, np.full(3, 4.0)), densities)
    assert str(found.message).endswith(f", {told}")
