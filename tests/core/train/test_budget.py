"""How many iterations take a time, and that a run taken up again hears the same number."""

import json

import pytest

from insideout.core.errors import Cancelled, SettingError
from insideout.core.train.budget import TooLong, iterations_in_time, last_number, next_guess


class Method:
    """Takes seconds that grow as a power of its iterations, `jumps` aside; remembers its runs."""

    def __init__(self, each=0.008, power=1.0, jumps=()):
        self.each, self.power, self.jumps, self.runs = each, power, dict(jumps), []

    def __call__(self, count, longest):
        self.runs.append(count)
        return self.jumps.get(len(self.runs), 1.0) * self.each * count**self.power


def found(method, kept, seconds=60.0, first=2000, **options):
    return iterations_in_time(seconds, lambda: first, method, kept / "rows" / "budget.json", **options)


def test_the_last_run_takes_the_time(tmp_path):
    method = Method(each=0.01)
    budget = found(method, tmp_path)
    assert budget == {"iterations": 6000, "seconds": 60.0, "tries": [[2000, 20.0], [6000, 60.0]]}
    assert method.runs == [2000, 6000]


@pytest.mark.parametrize("took", [60.5, 63.0, 65.5])
def test_a_try_that_is_near_or_takes_a_little_more_is_the_last(tmp_path, took):
    assert found(Method(jumps={1: took / 16}), tmp_path)["tries"] == [[2000, pytest.approx(took)]]


@pytest.mark.parametrize("took", [59.5, 66.5])
def test_a_try_that_is_not_is_followed_by_another(tmp_path, took):
    assert len(found(Method(jumps={1: took / 16}), tmp_path)["tries"]) > 1


@pytest.mark.parametrize("power", [1.0, 1.5, 2.0, 2.5])
@pytest.mark.parametrize("seconds", [8.0, 60.0, 200.0])
def test_a_method_that_gets_slower_with_its_splats_is_found_too(tmp_path, power, seconds):
    method = Method(each=20 / 2000**power, power=power)
    budget = found(method, tmp_path, seconds)
    assert seconds <= method.each * budget["iterations"] ** power <= 1.1 * seconds


def test_a_machine_that_jumps_ends_it_after_four_tries_with_the_nearest_that_took_enough(tmp_path):
    method = Method(jumps={1: 0.5, 2: 2.0, 3: 0.5, 4: 0.6})
    budget = found(method, tmp_path)
    tries = budget["tries"]
    assert len(method.runs) == len(tries) == 5
    assert tries[3][1] < 60.0
    enough = [one for one in tries[:4] if one[1] >= 60.0]
    assert budget["iterations"] == method.runs[-1] == min(enough, key=lambda one: one[1])[0]
    # Taken up again it is not made a sixth time.
    assert found(method, tmp_path) == budget
    assert len(method.runs) == 5


def test_where_the_fourth_try_took_enough_it_is_the_last(tmp_path):
    method = Method(jumps={1: 0.5, 2: 2.0, 3: 0.5, 4: 2.0})
    assert len(found(method, tmp_path)["tries"]) == 4


class Impatient(Method):
    """Breaks off what takes too long; remembers the runs that it made to their end."""

    def __init__(self, **options):
        super().__init__(**options)
        self.whole = []

    def __call__(self, count, longest):
        took = super().__call__(count, longest)
        if took > longest:
            raise TooLong(took)
        self.whole.append(count)
        return took


def test_a_try_that_takes_too_long_is_broken_off_and_tells_what_it_would_have_taken(tmp_path):
    method = Impatient(each=0.1)
    budget = found(method, tmp_path)
    assert budget["tries"] == [[2000, 200.0], [630, 63.0]]
    assert (method.runs, method.whole) == ([2000, 630], [630])
    assert found(method, tmp_path) == budget
    assert method.runs == [2000, 630]


def test_the_last_run_is_made_to_its_end_however_long_it_takes(tmp_path):
    method = Impatient(each=30.0)
    budget = found(method, tmp_path, least=7)
    assert (budget["iterations"], method.whole) == (7, [7])
    assert budget["tries"][-1] == [7, 210.0]
    assert found(method, tmp_path, least=7) == budget
    assert method.whole == [7]


def test_limits_hold_and_the_same_number_is_not_tried_twice(tmp_path):
    method = Method()
    assert found(method, tmp_path, most=900)["iterations"] == 900
    assert method.runs == [900]
    slow = Method(each=30.0)
    assert found(slow, tmp_path, least=7)["iterations"] == 7
    assert slow.runs[-1] == 7
    assert len(set(slow.runs)) == len(slow.runs)


def test_a_run_broken_off_in_its_first_try_goes_on_with_the_same_number(tmp_path):
    def broken(count, longest):
        raise Cancelled

    with pytest.raises(Cancelled):
        found(broken, tmp_path, first=1234)
    method = Method()
    found(method, tmp_path, first=999)
    assert method.runs[0] == 1234


def test_a_guess_lies_between_the_tries_on_either_side_of_the_time():
    assert 1500 < next_guess([(1000, 40.0), (3000, 140.0), (1500, 50.0)], 60.0) < 2000
    # Whatever the machine did in between.
    assert 1000 < next_guess([(1000, 40.0), (3000, 140.0)], 60.0) < 3000


def test_a_run_taken_up_again_makes_nothing_twice(tmp_path):
    def broken(count, longest):
        if count > 2000:
            raise Cancelled
        return 20.0

    with pytest.raises(Cancelled):
        found(broken, tmp_path)
    method = Method(each=0.01)
    again = found(method, tmp_path)
    assert again["tries"] == [[2000, 20.0], [6000, 60.0]]
    assert method.runs == [6000]
    assert found(method, tmp_path) == again
    assert method.runs == [6000]


@pytest.mark.parametrize("other", [{"seconds": 30.0}, {"most": 5000}, {"made_with": {"rate": 2}}])
def test_another_question_is_answered_anew(tmp_path, other):
    found(Method(), tmp_path, made_with={"rate": 1})
    method = Method()
    found(method, tmp_path, **{"made_with": {"rate": 1}, **other})
    assert method.runs[0] == 2000


@pytest.mark.parametrize("content", ["", "{", "[]", '{"asked": 60.0}', "3", '{"asked": {}, "tries": [3]}'])
def test_a_damaged_file_is_made_anew(tmp_path, content):
    kept = tmp_path / "rows" / "budget.json"
    kept.parent.mkdir()
    kept.write_text(content)
    budget = found(Method(), tmp_path)
    assert json.loads(kept.read_text())["tries"] == budget["tries"]


@pytest.mark.parametrize("wrong", [{"seconds": 0.0}, {"seconds": 1.0, "least": 5, "most": 4}])
def test_mistakes_are_named(tmp_path, wrong):
    with pytest.raises(SettingError, match="leaves nothing to do"):
        found(Method(), tmp_path, **wrong)


def test_a_guess_goes_three_times_as_far_at_most():
    assert next_guess([(100, 1.0)], 1000.0) == 300
    assert next_guess([(1000, 1000.0)], 10.0) == 10
    assert next_guess([(4, 1000.0)], 1.0) == 2


def test_a_search_tells_the_next_one_what_it_ended_with(tmp_path):
    kept = tmp_path / "rows" / "budget.json"
    assert last_number(kept) is None
    budget = found(Method(each=0.01), tmp_path)
    assert last_number(kept) == budget["iterations"] == 6000
    kept.write_text('{"tries": []}')
    assert last_number(kept) is None
