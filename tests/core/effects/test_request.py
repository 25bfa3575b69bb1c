"""What a user may write after --effects."""

from pathlib import Path

import pytest

from insideout.core.capture.model import Capture
from insideout.core.effects.request import parse_effects
from insideout.core.errors import SettingError


def test_auto_looks_for_all_but_those_that_are_left_out():
    assert parse_effects("auto").wants("geometry")
    assert not parse_effects("auto,-geometry").wants("geometry")
    assert parse_effects("auto").concerns("photos")
    left_out = "auto,-moving_background,-lens,-exposure,-rolling_shutter,-defocus,-motion_blur,-pixel_integration"
    assert not parse_effects(left_out).concerns("photos")


def test_names_alone_are_used_and_nothing_else_is_looked_for():
    request = parse_effects("exposure, defocus")
    assert request.wants("exposure")
    assert request.wants("defocus")
    assert not request.wants("geometry")
    assert request.concerns("photos")
    assert not request.concerns("xray")


def test_none_wants_nothing():
    request = parse_effects("none")
    assert str(request) == "none"
    assert not request.concerns("photos")
    assert not request.concerns("xray")


@pytest.mark.parametrize("text", ["none", "auto", "auto,exposure,-geometry,-scatter", "defocus,geometry"])
def test_a_request_can_be_written_down_and_read_again(text):
    assert parse_effects(str(parse_effects(text))) == parse_effects(text)


def test_the_same_wish_is_written_in_the_same_words():
    asked = ("auto,exposure,defocus", " defocus, auto,exposure", "exposure,defocus,defocus,auto")
    assert {str(parse_effects(text)) for text in asked} == {"auto,defocus,exposure"}


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "is empty"),
        ("sepia", "no effect 'sepia'; choose of photos moving_background, lens, exposure"),
        ("none,geometry", "'none' stands alone"),
        ("-geometry", "write auto,-geometry"),
        ("auto,geometry,-geometry", "asked for and left out"),
        ("motion_blur,rolling_shutter", "motion_blur and rolling_shutter cannot be learned at once"),
        ("auto,defocus,motion_blur", "motion_blur and defocus cannot be learned at once"),
    ],
)
def test_what_cannot_be_meant_is_refused(text, says):
    with pytest.raises(SettingError, match=says):
        parse_effects(text)


@pytest.mark.parametrize(("name", "lacks"), [("rolling_shutter", "of photos"), ("geometry", "of X-ray projections")])
def test_an_effect_of_what_the_capture_lacks_is_refused(name, lacks):
    """A rolling shutter of a scanner's projections, say."""
    with pytest.raises(SettingError, match=f"{name} is an effect {lacks}, and the capture has none"):
        parse_effects(name).check(Capture(Path("nothing")))
    parse_effects("auto").check(Capture(Path("nothing")))
