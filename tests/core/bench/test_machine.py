"""What a measurement says of the machine that it was made on."""

import pytest

from insideout.core.bench.machine import _first_processor, machine, summary


def test_the_cores_and_those_of_them_that_were_used_are_told():
    facts = machine() | {"cores": 8, "threads": 8}
    assert ", 8 cores, " in summary(facts)
    assert ", 8 cores (2 used), " in summary(facts | {"threads": 2})
    assert ", 1 core, " in summary(facts | {"cores": 1, "threads": 1})


def test_tables_of_before_threads_were_noted_can_still_be_read():
    facts = {key: value for key, value in machine().items() if key != "threads"}
    assert " core" in summary(facts)


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("AMD EPYC", "AMD EPYC (family 25, model 17)"),
        ("AMD EPYC 9354 32-Core Processor", "AMD EPYC 9354 32-Core Processor"),
    ],
)
def test_processors_that_are_all_called_alike_are_told_by_their_numbers(name, told):
    one = f"processor\t: 0\ncpu family\t: 25\nmodel\t\t: 17\nmodel name\t: {name}\nflags\t\t: fpu\n"
    assert _first_processor(f"{one}\n{one.replace('17', '1')}") == told
    assert _first_processor("processor\t: 0\nBogoMIPS\t: 48.00\n") == ""
