"""Pictures of curves in Blender: drawn when they change, and gone with the add-on."""

from __future__ import annotations

import numpy as np

from insideout.insideout_addon.engine import curve_icons
from insideout.insideout_addon.engine.curve_picture import SIDE, CurvePoint, draw_mark, draw_picture

FIRST = (CurvePoint("surface", "rgb", 10.0, photos=20.0),)
SECOND = (*FIRST, CurvePoint("surface", "rgb", 20.0, photos=30.0))


def _image(place, which="image"):
    preview = curve_icons._collections[0][place]
    size = getattr(preview, f"{which}_size")
    pixels = np.empty(size[0] * size[1] * 4, np.float32)
    getattr(preview, f"{which}_pixels_float").foreach_get(pixels)
    return pixels.reshape(size[1], size[0], 4)


def test_blender_has_the_picture_as_it_was_drawn(blender):
    curve_icons.curve_icon("run", SECOND)
    assert _image("run").shape == (SIDE, SIDE, 4)
    np.testing.assert_allclose(_image("run"), draw_picture(SECOND), atol=1 / 255)
    curve_icons.mark_icon("photos")
    np.testing.assert_allclose(_image("mark of photos", "icon"), draw_mark("photos"), atol=1 / 255)


def test_it_is_drawn_anew_where_the_points_are_others_and_not_at_each_redraw(blender, monkeypatch):
    drawn = []
    monkeypatch.setattr(curve_icons, "draw_picture", lambda points: drawn.append(points) or draw_picture(points))
    for points in (FIRST, FIRST, SECOND, SECOND, ()):
        curve_icons.curve_icon("run", points)
    assert drawn == [FIRST, SECOND, ()]
    np.testing.assert_allclose(_image("run"), draw_picture(()), atol=1 / 255)


def test_two_panels_have_a_picture_each(blender):
    curve_icons.curve_icon("run", FIRST)
    curve_icons.curve_icon("model", SECOND)
    np.testing.assert_allclose(_image("run"), draw_picture(FIRST), atol=1 / 255)
    np.testing.assert_allclose(_image("model"), draw_picture(SECOND), atol=1 / 255)


def test_nothing_is_made_before_a_panel_asks(blender):
    assert curve_icons._collections == []
