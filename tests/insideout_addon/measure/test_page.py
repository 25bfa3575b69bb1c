"""Pages as pixels and as PDF: coverage, sizes in mm, and a PDF that a strict reader takes."""

from __future__ import annotations

import re
import zlib

import numpy as np
import pytest

from insideout.core.errors import SettingError
from insideout.core.steps import run_through
from insideout.insideout_addon.measure.page import Outline, Page, coverage, rasterize_in_steps
from insideout.insideout_addon.measure.pdf import POINTS_PER_MM, save_page_in_steps

_SQUARE = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], float)


def _boxes(text):
    """Lettering of one square a letter."""
    return Outline([0.7 * _SQUARE + (index, -0.7) for index, letter in enumerate(text) if letter != " "], len(text))


@pytest.fixture
def page():
    page = Page(60.0, 40.0, _boxes, "Pot (no. 3) \\ mm⁻¹")
    pixels = np.zeros((2, 3, 3), np.uint8)
    pixels[0, 0], pixels[1, 2] = (255, 0, 0), (0, 0, 255)
    page.picture(10, 5, 30, 20, pixels)
    page.rectangle(10, 30, 30, 2, (0.0, 0.5, 0.0))
    page.text(50, 36, "mm⁻¹ (a)", 3.0, 1.0)
    return page


class TestCoverage:
    def test_part_of_a_pixel(self):
        covered = coverage([_SQUARE * (2.25, 1.0) + (0.5, 1.0)], 4, 3)
        np.testing.assert_allclose(covered[1], [0.5, 1.0, 0.75, 0.0], atol=1e-12)
        np.testing.assert_allclose(covered[[0, 2]], 0.0, atol=1e-12)

    def test_a_circle_has_its_area(self):
        turn = np.linspace(0, 2 * np.pi, 200, endpoint=False)
        circle = 12.3 * np.stack([np.cos(turn), np.sin(turn)], axis=1) + 15
        covered = coverage([circle], 30, 30)
        assert covered.sum() == pytest.approx(np.pi * 12.3**2, rel=2e-3)
        assert [covered[15, 15], covered[0, 0]] == pytest.approx([1.0, 0.0], abs=1e-12)

    def test_a_hole_is_left_out(self):
        covered = coverage([_SQUARE * 6, (_SQUARE * 2 + 2)[::-1]], 6, 6)
        assert covered.sum() == pytest.approx(36 - 4)
        assert covered[3, 3] == pytest.approx(0.0, abs=1e-12)

    def test_what_reaches_out_of_the_image_is_cut(self):
        assert coverage([_SQUARE * 20 - 10], 4, 4).tolist() == [[1] * 4] * 4


class TestPixels:
    def test_everything_is_where_it_was_put(self, page):
        image = run_through(rasterize_in_steps(page, 25.4))
        assert image.shape == (40, 60, 3)
        assert image[5, 10].tolist() == image[14, 19].tolist() == [255, 0, 0]
        assert image[24, 39].tolist() == [0, 0, 255]
        assert image[15, 10].tolist() == [0, 0, 0]
        assert image[31, 20].tolist() == [0, 128, 0]
        assert image[4, 10].tolist() == image[32, 20].tolist() == [255, 255, 255]

    def test_text_ends_where_it_is_aligned_to(self, page):
        image = run_through(rasterize_in_steps(page, 254.0))
        rows, columns = np.nonzero((image[330:] < 100).all(axis=2))
        assert (330 + rows.min(), 330 + rows.max()) == (339, 359)
        assert (columns.min(), columns.max()) == pytest.approx((260, 490), abs=1)

    def test_a_png_has_real_size(self, page, tmp_path, read_png):
        run_through(save_page_in_steps(tmp_path / "page.png", page, 100.0))
        pixels, per_metre, texts = read_png(tmp_path / "page.png")
        assert pixels.shape == (round(40 / 0.254), round(60 / 0.254), 3)
        assert per_metre == pytest.approx(100 / 0.0254, abs=1)
        assert texts["Title"].startswith("Pot (no. 3)")

    def test_a_large_png_has_coarser_pixels(self, tmp_path, read_png):
        run_through(save_page_in_steps(tmp_path / "page.png", Page(1000.0, 1.0, _boxes), 600.0))
        pixels, per_metre, _ = read_png(tmp_path / "page.png")
        assert pixels.shape[1] == 6000
        assert per_metre == pytest.approx(6000, abs=1)


def _read_pdf(content):
    """Objects of a PDF by number, found by its table alone, which must be right to the byte."""
    assert content.startswith(b"%PDF-1.7\n")
    assert content.endswith(b"%%EOF\n")
    table = int(re.search(rb"startxref\n(\d+)\n%%EOF\n$", content).group(1))
    head = re.match(rb"xref\n0 (\d+)\n", content[table:])
    count, rows = int(head.group(1)), content[table + head.end() :]
    assert rows[:20] == b"0000000000 65535 f \n"
    objects = {}
    for number in range(1, count):
        row = rows[20 * number : 20 * number + 20]
        assert re.fullmatch(rb"\d{10} 00000 n \n", row)
        body = content[int(row[:10]) :]
        assert body.startswith(b"%d 0 obj\n" % number)
        objects[number] = body[body.index(b"\n") + 1 : body.index(b"\nendobj\n")]
    trailer = rows[20 * count :]
    assert re.search(rb"/Size (\d+)", trailer).group(1) == b"%d" % count
    assert b"/Root 1 0 R" in trailer
    return objects


def _stream(body):
    head, _, rest = body.partition(b"stream\n")
    length = int(re.search(rb"/Length (\d+)", head).group(1))
    assert rest[length:] == b"\nendstream"
    return zlib.decompress(rest[:length])


class TestPdf:
    @pytest.fixture
    def objects(self, page, tmp_path):
        run_through(save_page_in_steps(tmp_path / "page.pdf", page, 100.0))
        return _read_pdf((tmp_path / "page.pdf").read_bytes())

    def test_the_page_has_real_size(self, objects):
        assert b"/Type /Catalog" in objects[1]
        assert b"/Kids [3 0 R] /Count 1" in objects[2]
        box = re.search(rb"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", objects[3]).groups()
        assert [float(side) / POINTS_PER_MM for side in box] == pytest.approx([60, 40], abs=1e-3)

    def test_it_holds_the_picture_as_it_is(self, objects, page):
        name, number = re.search(rb"/XObject << /(\w+) (\d+) 0 R >>", objects[3]).groups()
        image = objects[int(number)]
        assert b"/Width 3 /Height 2 /ColorSpace /DeviceRGB /BitsPerComponent 8" in image
        assert _stream(image) == page.parts[0].pixels.tobytes()
        assert b"/" + name + b" Do" in _stream(objects[4])

    def test_places_are_mm_from_the_top_left(self, objects):
        lines = _stream(objects[4]).decode("latin-1").splitlines()
        assert [float(value) for value in lines[0].split()[:6]] == pytest.approx(
            [POINTS_PER_MM, 0, 0, -POINTS_PER_MM, 0, 40 * POINTS_PER_MM], abs=1e-3
        )
        # The unit square's top is the picture's first row.
        assert lines[1] == "q 30.0000 0 0 -20.0000 10.0000 25.0000 cm /Im0 Do Q"
        assert "0.000 0.500 0.000 rg" in lines
        assert "10.0000 30.0000 m 40.0000 30.0000 l 40.0000 32.0000 l 10.0000 32.0000 l h" in lines

    def test_its_text_can_be_searched(self, objects):
        content = _stream(objects[4]).decode("cp1252")
        assert r"(mm-¹ \(a\)) Tj" in content
        assert "3 Tr" in content, "over the outlines, unseen"
        assert r"/Title (Pot \(no. 3\) \\ mm-¹)".encode("cp1252") in objects[6]

    def test_every_reference_is_there(self, objects):
        for body in objects.values():
            head = body.partition(b"stream\n")[0]
            assert {int(number) for number in re.findall(rb"(\d+) 0 R", head)} <= set(objects)


def test_other_kinds_of_files_are_refused(page, tmp_path):
    with pytest.raises(SettingError, match=r"\.pdf or \.png"):
        run_through(save_page_in_steps(tmp_path / "page.jpg", page, 100.0))
