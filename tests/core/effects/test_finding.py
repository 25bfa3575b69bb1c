"""What a row of the report says of an effect: sentences that follow each other, and what they were made of."""

from __future__ import annotations

import pytest

from insideout.core.effects.choose import ASKED, Choice, leave
from insideout.core.effects.finding import EffectFinding, say, unsay
from insideout.core.effects.request import parse_effects
from insideout.core.told import Told

_FOUND = Told("It is {size:.1f} px; less than {least:g} px does no harm.", size=0.42, least=1)
_MORE = Told("In a short trial views set aside have {best:.1f} dB with it.", best=30.04)


@pytest.fixture
def row():
    choice = Choice()
    choice.add(EffectFinding("defocus", False, 0.42, "px", 1.0, _FOUND), parse_effects("defocus"), 0.1)
    return choice.rows[0]


def _again(row):
    return " ".join(one["template"].format(**one["values"]) for one in row["told"])


def test_what_it_says_can_be_said_again(row):
    say(row, _MORE)
    assert row["reason"] == f"{_FOUND} {ASKED} {_MORE}" == _again(row)


def test_an_effect_that_is_not_used_after_all_is_not_said_to_be(row):
    leave(row, _MORE)
    assert row["used"] is False
    assert row["reason"] == f"{_FOUND} {_MORE}" == _again(row)


def test_only_what_is_said_last_is_taken_away(row):
    say(row, _MORE)
    unsay(row, ASKED)
    assert row["reason"] == f"{_FOUND} {ASKED} {_MORE}" == _again(row)


def test_a_row_of_before_stays_english():
    """Half of it in another language would be worse."""
    row = {"reason": "It is 0.4 px."}
    say(row, ASKED)
    say(row, _MORE)
    unsay(row, _MORE)
    assert row == {"reason": f"It is 0.4 px. {ASKED}"}
