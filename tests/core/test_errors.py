"""An error is one sentence: whole, or a template with values, of which a translation can be made."""

from __future__ import annotations

import json
import pickle
from pathlib import Path

import numpy as np
import pytest

from insideout.core.capture.findings import CaptureProblem
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


@pytest.mark.parametrize(
    ("place", "value", "sent"),
    [
        ("{a:,}", np.int64(1200), 1200),
        ("{a}", np.float32(0.1), float(np.float32(0.1))),
        ("{a:.3g}", np.float64(0.12345), 0.12345),
        ("{a:.1f}", 2, 2),
        ("{a}", True, "True"),
        ("{a}", None, "None"),
        ("{a}", (2, 3), "(2, 3)"),
        ("{a}", np.array([1.0, 2.0]), "[1. 2.]"),
        ("{a}", Path("a {b}.ply"), str(Path("a {b}.ply"))),
        ("{a}", OSError(2, "No such file"), "[Errno 2] No such file"),
    ],
)
def test_another_program_makes_the_same_sentence(place, value, sent):
    error = SettingError(f"{place} is no size.", a=value)
    told = json.loads(json.dumps(error.told()))
    assert told == {"template": f"{place} is no size.", "values": {"a": sent}}
    assert told["template"].format(**told["values"]) == str(error)


def test_an_error_does_not_keep_another_alive():
    """Whose traceback holds the arrays of all that was being done."""
    assert SettingError("a: cannot be read ({error}).", error=ValueError("no number")).values == {"error": "no number"}


def test_an_error_of_ours_inside_of_another_can_be_translated_too():
    inner = SettingError("{count} are too many.", count=3)
    told = SettingError("{folder}: left out, {error}", folder="a", error=inner).told()
    assert told["values"] == {"folder": "a", "error": {"template": "{count} are too many.", "values": {"count": 3}}}


def test_one_of_a_capture_is_put_together_of_what_is_wrong_and_what_to_do():
    error = CaptureProblem("a {b}", "has {count:,} points", 'write {{"points": []}} in {name}', count=1200, name="{c}")
    assert str(error) == 'a {b}: has 1,200 points; write {"points": []} in {c}.'
    values = {"subject": "a {b}", "count": 1200, "name": "{c}"}
    assert error.told() == {
        "template": "{subject}: {message}; {advice}.",
        "values": {
            "subject": "a {b}",
            "message": {"template": "has {count:,} points", "values": values},
            "advice": {"template": 'write {{"points": []}} in {name}', "values": values},
        },
    }
    assert (error.finding.subject, error.finding.message) == ("a {b}", "has 1,200 points")
    assert error.finding.advice == 'write {"points": []} in {c}'


def test_braces_are_one_where_there_is_no_value_beside_them():
    error = CaptureProblem("a", "is not a JSON object", 'write {{"spacing_mm": [x, y, z]}}')
    assert str(error) == 'a: is not a JSON object; write {"spacing_mm": [x, y, z]}.'
