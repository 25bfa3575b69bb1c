"""An error is one sentence: whole, or a template with values, of which a translation can be made."""

from __future__ import annotations

import pickle

from insideout.core.errors import InsideOutError, SettingError


def test_a_template_is_filled_in():
    error = SettingError("{count:,} of {file}: too many; choose fewer.", count=1200, file="a {b}.ply")
    assert str(error) == "1,200 of a {b}.ply: too many; choose fewer."
    assert error.template == "{count:,} of {file}: too many; choose fewer."
    assert error.values == {"count": 1200, "file": "a {b}.ply"}


def test_braces_of_a_whole_sentence_stay():
    assert str(InsideOutError("a {b}.ply: is not there; choose another.")) == "a {b}.ply: is not there; choose another."


def test_it_goes_to_another_process():
    """As the one that reconstructs volumes sends them."""
    error = pickle.loads(pickle.dumps(SettingError("{file}: is not there.", file="a {b}")))
    assert type(error) is SettingError
    assert (str(error), error.template, error.values) == (
        "a {b}: is not there.",
        "{file}: is not there.",
        {"file": "a {b}"},
    )
