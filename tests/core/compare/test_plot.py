"""What is on the plot, and that all of it can be seen."""

import numpy as np
from PIL import Image, ImageDraw

from insideout.core.compare.methods import METHODS
from insideout.core.compare.plot import draw_plot, legend_height, plot_points
from insideout.core.plotting import INK, mark


def test_the_plot_shows_x_gaussian_s_attenuation_as_it_shows_that_of_others(content, skull, row):
    rival = row("X-Gaussian", "xray", 17.0)
    rival["sections"] = {**rival["sections"], "paper": {"piqe": 30.0, "psnr": 16.0, "ssim": 0.5}}
    skull["methods"]["x_gaussian"] = rival
    assert {point.label: point.psnr for point in plot_points(content)}["X-Gaussian"] == 17.0


def test_no_two_rows_have_the_same_mark():
    """All filled, as rows that saw X-rays are."""
    image = Image.new("RGB", (40 * len(METHODS), 40), "white")
    for index in range(len(METHODS)):
        mark(ImageDraw.Draw(image), (40 * index + 20, 20), index, True)
    marks = {image.crop((40 * index, 0, 40 * index + 40, 40)).tobytes() for index in range(len(METHODS))}
    assert len(marks) == len(METHODS)


def test_the_plot_has_a_mark_for_every_row_with_sections_at_its_better_reading(content, tmp_path):
    points = plot_points(content)
    assert [(point.label, round(point.seconds), point.psnr, point.solid) for point in points] == [
        ("3DGS", 60, 16.0, False),
        ("R²-Gaussian", 30, 29.0, True),
        ("InsideOut", 900, 31.5, True),
    ]
    draw_plot(content, tmp_path / "plot.png")
    drawn = np.asarray(Image.open(tmp_path / "plot.png").convert("RGB")).reshape(-1, 3)
    # The mark in the plot and the one in the legend; that of photos alone is hollow.
    for color, least in (((213, 94, 0), 400), ((0, 114, 178), 400), ((0, 158, 115), 200)):
        assert (drawn == color).all(axis=1).sum() > least


def test_no_mark_lies_on_the_frame_or_under_insideout_s(content, skull, row, tmp_path):
    """Halves apart come near to it in both."""
    skull["methods"]["insideout"]["sections"]["psnr"] = 40.0
    skull["methods"]["apart"] = {**row("InsideOut, halves apart", "both", 39.9), "seconds": 900.0}
    draw_plot(content, tmp_path / "plot.png")
    panel = np.asarray(Image.open(tmp_path / "plot.png").convert("RGB"))[:, :640].astype(int)
    top = np.flatnonzero((panel == INK).all(axis=2).sum(axis=1) > 400)[0]
    colored = np.ptp(panel, axis=2) > 60
    assert np.flatnonzero(colored.any(axis=1))[0] > top + 2
    assert (panel == (0, 158, 115)).all(axis=2).sum() > 200, "the third of the rows that saw X-rays"


def test_what_finds_nothing_can_be_seen_to(content, tmp_path):
    """Figures of air everywhere are a line, below which there is no result."""

    def greys():
        draw_plot(content, tmp_path / "plot.png")
        drawn = np.asarray(Image.open(tmp_path / "plot.png").convert("RGB"))
        return (drawn == 128).all(axis=2).sum(axis=1)

    assert greys().max() > 400
    content["captures"]["skull"]["truth"]["nothing"] = None
    assert greys().max() < 100


def test_the_plot_has_a_panel_for_each_capture_and_says_so_when_there_is_nothing(content, skull, tmp_path):
    sizes = []
    for count in (0, 1, 2, 5):
        captures = {f"capture {i}": skull for i in range(count)}
        draw_plot({**content, "captures": captures}, tmp_path / "plot.png")
        sizes.append(Image.open(tmp_path / "plot.png").size)
    assert sizes == [(980, 510), (980, 510), (1620, 510), (1620, 1370)]


def test_the_legend_of_all_methods_is_not_cut_off_beside_one_panel(content, skull, row, tmp_path):
    skull["methods"] = {name: row(one.label, one.modality, 20.0) for name, one in METHODS.items()}
    draw_plot({**content, "captures": {"skull": skull}}, tmp_path / "plot.png")
    image = Image.open(tmp_path / "plot.png").convert("L")
    assert image.size == (980, legend_height(len(METHODS)))
    dark = (np.asarray(image)[:, 640:] < 128).any(axis=1)
    # The two lines of words under the last row are there, and end before the picture does.
    assert dark[-80:].any()
    assert not dark[-15:].any()
