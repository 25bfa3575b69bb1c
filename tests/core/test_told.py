"""A text that is told is an English `str`, and knows what it was made of."""

from __future__ import annotations

import copy
import json
import pickle

import numpy as np

from insideout.core.told import Told


def _said(told):
    """As another program makes the text again."""
    values = {name: _said(one) if isinstance(one, dict) else one for name, one in told["values"].items()}
    return told["template"].format(**values) if values else told["template"]


def test_it_is_the_english_text():
    told = Told("{count:,} of {file} are {size:.1f} px", count=1200, file="a {b}.ply", size=2.04)
    assert told == "1,200 of a {b}.ply are 2.0 px"
    assert json.dumps([told]) == '["1,200 of a {b}.ply are 2.0 px"]'


def test_braces_of_a_text_without_values_stay():
    assert Told("a {b}.ply") == _said(Told("a {b}.ply").to_json()) == "a {b}.ply"


def test_another_program_makes_it_again():
    inner = Told("{names} and {more} more", names="{a}, b", more=np.int64(3))
    told = Told("{share:.2f} %: {inner}; {inner}", share=np.float32(0.25), inner=inner)
    sent = json.loads(json.dumps(told.to_json()))
    assert _said(sent) == told == "0.25 %: {a}, b and 3 more; {a}, b and 3 more"
    assert sent["values"]["inner"] == {"template": inner.template, "values": {"names": "{a}, b", "more": 3}}


def test_it_is_read_again_with_what_it_was_made_of():
    told = Told("{share:.2f} %: {inner}", share=0.25, inner=Told("{count} of {count}", count=3))
    again = Told.from_json(json.loads(json.dumps(told.to_json())))
    assert (again, again.to_json()) == (told, told.to_json())
    assert Told.from_json("As {before}.") == "As {before}."


def test_it_goes_to_another_process_and_is_copied_with_what_it_was_made_of():
    told = Told("{file}: is {size}", file="a {b}", size=2)
    for other in (pickle.loads(pickle.dumps(told)), copy.deepcopy(told)):
        assert type(other) is Told
        assert (other, other.template, other.values) == (told, told.template, told.values)
