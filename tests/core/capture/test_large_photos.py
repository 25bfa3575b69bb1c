"""Photos of more pixels than Pillow takes for harmless: those of phones are read, larger ones told to be too large."""

from __future__ import annotations

import io
import struct
import threading

import numpy as np
import pytest
from PIL import Image

from insideout.core.capture import image_file
from insideout.core.capture.findings import CaptureProblem
from insideout.core.capture.image_file import MOST_PIXELS, open_image
from insideout.core.capture.model import Photo
from insideout.core.capture.photos import image_facts, read_photo, verify_images
from insideout.core.views import Camera

PHONE = (16320, 12240)


def save_jpeg(path, width, height):
    """One whose header speaks of so many pixels, few of which are there."""
    buffer = io.BytesIO()
    Image.new("RGB", (16, 16)).save(buffer, "JPEG")
    content = buffer.getvalue()
    size = content.index(b"\xff\xc0") + 5
    path.write_bytes(content[:size] + struct.pack(">2H", height, width) + content[size + 4 :])
    return path


@pytest.fixture
def suspicious(monkeypatch):
    """Pillow refuses above 2000 pixels."""
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 1000)


@pytest.fixture
def image(tmp_path):
    def image(suffix):
        pixels = np.random.default_rng(0).integers(0, 255, (50, 80, 3)).astype(np.uint8)
        Image.fromarray(pixels).save(tmp_path / f"large{suffix}")
        return tmp_path / f"large{suffix}", pixels / 255

    return image


def test_a_phones_photo_of_200_megapixels_is_opened(tmp_path):
    path, limit = save_jpeg(tmp_path / "phone.jpg", *PHONE), Image.MAX_IMAGE_PIXELS
    with pytest.raises(Image.DecompressionBombError):
        Image.open(path)
    assert image_facts(path).stored == PHONE
    assert limit == Image.MAX_IMAGE_PIXELS, "it is the whole process's"


@pytest.mark.filterwarnings("ignore::PIL.Image.DecompressionBombWarning")
def test_one_that_is_too_large_is_told_so(tmp_path):
    # Above twice its limit Pillow does not open a file, up to there it warns.
    for width in (16_000, 60_000):
        path = save_jpeg(tmp_path / f"{width}.jpg", width, 20_000)
        told = r"\.jpg: is larger than 250 megapixels; scale it down"
        with pytest.raises(CaptureProblem, match=told):
            image_facts(path)
        (problem,) = verify_images([path])
        assert "is larger than 250 megapixels" in str(problem)


def test_the_limit_is_looked_at_where_pillow_has_none(image, monkeypatch):
    path, _ = image(".png")
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", None)
    monkeypatch.setattr(image_file, "MOST_PIXELS", 3999)
    with pytest.raises(CaptureProblem, match="is larger than"):
        image_facts(path)


# Of an uncompressed TIFF Pillow looks at the limit again when it is decoded.
@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".webp", ".bmp"])
def test_large_photos_are_decoded(suffix, image, suspicious):
    path, pixels = image(suffix)
    with pytest.raises(Image.DecompressionBombError):
        Image.open(path).load()
    assert verify_images([path] * 8) == []
    camera = Camera(80, 50, 100.0, 100.0, 40.0, 25.0, np.eye(4))
    read, _ = read_photo(Photo(path, camera))
    assert read.shape == (50, 80, 3)
    if suffix not in (".jpg", ".webp"):
        np.testing.assert_allclose(read, pixels, atol=1e-6)
    assert Image.MAX_IMAGE_PIXELS == 1000


def test_the_limit_comes_back_after_an_error(image, suspicious):
    path, _ = image(".png")
    path.write_bytes(path.read_bytes()[:-2000])
    (problem,) = verify_images([path])
    assert "is damaged or truncated" in str(problem)
    assert Image.MAX_IMAGE_PIXELS == 1000


def test_one_photo_at_a_time_has_the_higher_limit(image, suspicious):
    """Else one that ends while another goes on would leave the higher limit for good."""
    path, _ = image(".png")
    opened = threading.Event()

    def other():
        with open_image(path):
            opened.set()

    thread = threading.Thread(target=other)
    with open_image(path):
        thread.start()
        assert Image.MAX_IMAGE_PIXELS == MOST_PIXELS
        assert not opened.wait(0.2)
    thread.join()
    assert opened.is_set()
    assert Image.MAX_IMAGE_PIXELS == 1000
